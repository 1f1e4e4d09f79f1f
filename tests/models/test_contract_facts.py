"""Numbers that the models' own code gives, held against what the presets make; the pages name file and commit."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pcdata.errors import ConfigError, PoseError
from pcdata.io import open_source
from pcdata.models import CONTRACTS, check, contract, preset, to_source
from pcdata.rng import seeded
from pcdata.structures import DepthFrame, PointCloud
from pcdata.synthetic import tabletop
from pcdata.transforms import Compose, RandomFlip
from pcdata.verdicts import Verdict
from tests.models.captures import ANSWERS, answers, capture, correct_batch, made_preset, sample_of

GRASP_NETWORKS = ["graspnet_baseline", "gsnet", "anygrasp", "anygrasp_tracking"]


def before_sampling(name: str, frame: DepthFrame) -> PointCloud:
    """What the preset samples from, or gives where it takes every point."""
    steps = [step for step in made_preset(name).pipeline.steps if type(step).__name__ != "RandomSample"]
    return Compose(steps)(frame)


# -- the workspace mask ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", GRASP_NETWORKS)
def test_grasp_networks_see_nothing_outside_the_workspace_mask_of_a_capture(name):
    """graspnet-baseline demo.py: mask = workspace_mask & (depth > 0)."""
    frame = capture()
    mask = torch.zeros_like(frame.depth, dtype=torch.bool)
    mask[:, 40:200, :170] = True
    within = before_sampling(name, replace(frame, mask=mask))
    crop = CONTRACTS[name].crop
    near = (frame.depth > 0) & (frame.depth <= (9.0 if crop is None else crop[1][2]))
    assert torch.equal(within.source_index, torch.nonzero((mask & near).flatten())[:, 0])
    assert before_sampling(name, frame).num_points == int(near.sum()) > within.num_points


@pytest.mark.parametrize(("name", "far"), [("graspnet_baseline", 9.0), ("anygrasp", 1.0), ("anygrasp_tracking", 1.5)])
def test_the_official_frame_has_as_many_points_as_its_own_demo_makes_of_it(test_data: Path, name, far):
    """graspnet-baseline demo.py on doc/example_data; anygrasp_sdk: z < 1 m in the detector, < 1.5 m in the tracker."""
    image = pytest.importorskip("PIL.Image")
    folder = test_data / "graspnet_frame"
    depth = np.array(image.open(folder / "depth.png")) / 1000.0
    inside = np.array(image.open(folder / "workspace_mask.png")) & (depth > 0) & (depth < far)
    (frame,) = (source.load(source.ids[0]) for source in [open_source(folder)])
    cloud = before_sampling(name, frame)
    assert cloud.num_points == int(inside.sum())
    if name == "graspnet_baseline":
        assert cloud.num_points == 513_688
        assert int((frame.depth > 0).sum()) == 825_160


def test_a_mirrored_scene_gives_no_grasps_back():
    """What the pages of graspnet_baseline and gsnet say of their x-mirror: poses have no image under it."""
    for name in ("graspnet_baseline", "gsnet"):
        assert any("mirrors x" in trap and "PoseError" in trap for trap in CONTRACTS[name].traps)
    assert any("mirrors x and y" in trap and "poses" in trap for trap in CONTRACTS["pointcept"].traps)
    made = preset("graspnet_baseline")
    flipped = RandomFlip(probability=(1.0, 0.0, 0.0))(sample_of("graspnet_baseline"), generator=seeded(0))
    with pytest.raises(PoseError, match="mirror"):
        to_source(made.collate([flipped]), poses=torch.eye(4)[None])


# -- crops, counts, sizes ----------------------------------------------------------------------------------------------


def test_m2t2_takes_the_mean_of_what_lies_inside_the_scene_bounds(test_data: Path):
    """M2T2 m2t2/dataset.py, load_rgb_xyz: an open box in the world, then xyz - xyz.mean(dim=0)."""
    folder = test_data / "m2t2_real_tabletop" / "03"
    meta = json.loads((folder / "meta_data.json").read_text())
    depth = np.load(folder / "depth.npy").astype(np.float32)
    k, pose = np.array(meta["intrinsics"]), np.array(meta["camera_pose"])
    v, u = np.nonzero(depth > 0)
    z = depth[v, u].astype(np.float64)
    world = np.stack([(u - k[0, 2]) * z / k[0, 0], (v - k[1, 2]) * z / k[1, 1], z], 1) @ pose[:3, :3].T + pose[:3, 3]
    low, high = meta["scene_bounds"][:3], meta["scene_bounds"][3:]
    mean = world[((world > low) & (world < high)).all(1)].mean(0)
    frame = DepthFrame.from_numpy(
        depth, k, colors=np.zeros((*depth.shape, 3), np.uint8), world_from_camera=pose, frame_id="base"
    )
    made = preset("m2t2", frame="base", crop=(tuple(low), tuple(high)))
    batch = made.collate([made.pipeline(frame, generator=seeded(0))])
    shift = (batch["points"] - batch["inputs"][..., :3])[0].double().mean(0).numpy()
    assert np.abs(shift - mean).max() < 2e-4  # float32 edges of the box
    assert np.linalg.norm(world.mean(0) - mean) > 0.16
    with pytest.raises(ConfigError, match="crop="):
        preset("m2t2", frame="base")


@pytest.mark.parametrize(
    ("name", "counts"),
    [("idp3", {10000, 4096}), ("graspgen", {3500, 2048, 16384}), ("dexart", {1024}), ("demogen", {1024, 512})],
)
def test_the_counts_are_those_of_the_scripts(name, counts):
    """iDP3 convert_demos.py and deploy.py; GraspGen runs/*.sh and scripts/config.yaml; DP3 dexart_*.yaml; DemoGen."""
    assert {CONTRACTS[name].count, *CONTRACTS[name].counts} == counts
    for count in counts:
        assert contract(name, num_points=count).count == count


def test_idp3_files_are_filled_up_with_zeros_and_deployment_draws_with_replacement():
    """multi_realsense.py, create_colored_point_cloud."""
    files, live = preset("idp3"), preset("idp3", num_points=4096)
    few = files.collate([files.pipeline(capture((90, 120)), generator=seeded(0))])["point_cloud"][0]
    assert few.shape == (10000, 3)
    filled = (few != 0).any(dim=-1)
    assert 1000 < int(filled.sum()) < 10000
    assert len(torch.unique(few[filled], dim=0)) == int(filled.sum())
    drawn = live.collate([live.pipeline(capture(), generator=seeded(0))])["point_cloud"][0]
    assert bool((drawn != 0).any(dim=-1).all())
    assert len(torch.unique(drawn, dim=0)) < 4096


@pytest.mark.parametrize(
    ("name", "width", "choice"),
    [("idp3", 6, "['xyz', 'rgb_255']"), ("dp3_sim", 3, "['xyz']"), ("rise", 5, ""), ("pointnet2_cls_tf", 3, "['xyz']")],
)
def test_a_tensor_of_other_columns_names_the_choice_that_makes_them_right(name, width, choice):
    spec = contract(name).main
    told = check({spec.key: torch.rand(1, 64, width)}, name).checks["layout", None].worst
    assert told.verdict is Verdict.FAIL
    assert told.advice.endswith(f"channels={choice}" if choice else "collate do it")


def test_fcgqcnn_takes_an_image_of_its_phoxi_models_as_it_is(test_data: Path):
    """gqcnn cfg/examples/fc_gqcnn_pj.yaml and fc_gqcnn_suction.yaml: im_height 386, im_width 516."""
    depth = np.load(test_data / "gqcnn_phoxi" / "depth_0.npy").squeeze().astype(np.float32)
    frame = DepthFrame.from_numpy(depth, [[552.5, 0, 255.5], [0, 552.5, 191.75], [0, 0, 1]])
    made = preset("fcgqcnn", image_size=(386, 516))
    batch = made.collate([made.pipeline(frame)])
    assert batch["im"].shape == (1, 386, 516, 1)
    assert np.array_equal(batch["im"][0, ..., 0].numpy()[depth > 0], depth[depth > 0])
    assert check(batch, "fcgqcnn").samples[Verdict.FAIL] == 0
    with pytest.raises(ConfigError, match=r"\(480, 640\) or \(386, 516\), got \(100, 100\)"):
        preset("fcgqcnn", image_size=(100, 100))


def test_the_window_of_ggcnn_lies_40_pixels_above_the_middle_in_service():
    """mvp_grasp ggcnn_service.yaml: crop_size 350, crop_y_offset 40; process_depth_image subtracts it from the rows."""
    frame = tabletop(3, num_objects=4, size=(480, 640)).frame
    made = preset("ggcnn", window=350, window_up=40)
    window = made.pipeline.steps[0](frame)
    assert torch.equal(window.depth, frame.depth[:, 25:375, 145:495])
    assert made.collate([made.pipeline(frame)])["x"].shape == (1, 1, 300, 300)
    with pytest.raises(ConfigError, match="no choice 'window_up'"):
        preset("grconvnet", window_up=40)


def test_pointnet_counts_a_block_from_its_smallest_sampled_point():
    """pointnet sem_seg/indoor3d_util.py, room2blocks_plus_normalized: x - (min(x) + 0.5); blocks of 100 points do."""
    xyz = correct_batch("pointnet_semseg")["pointclouds_pl"][..., :3]
    assert torch.allclose(xyz[..., :2].amin(dim=1), torch.full((2, 2), -0.5), atol=1e-6)
    assert CONTRACTS["pointnet_semseg"].column_points == 100
    around = correct_batch("pointnet2_semseg")["points"][:, :2]  # the port: around the point that it drew
    assert not torch.allclose(around.amin(dim=2), torch.full((2, 2), -0.5), atol=1e-3)


@pytest.mark.parametrize("name", ["pointnet_cls", "pointnet2_cls_tf"])
def test_the_rows_that_pointnet_takes_of_a_normalized_file_are_not_centered_again(name):
    """pointnet train.py: current_data[:, 0:NUM_POINT, :] of 2048 rows; pointnet2 modelnet_dataset.py: pc_normalize."""
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(2048, 3, generator=generator) * torch.tensor([1.0, 0.4, 0.2])
    points -= points.mean(0)
    rows = (points / points.norm(dim=1).max())[None, :1024]
    channels = {} if name == "pointnet_cls" else {"channels": ["xyz"]}
    assert float(rows.mean(1).norm()) > 1e-3
    told = check({"pointclouds_pl": rows}, name, frame_id="object", unit="normalized", frame="object", **channels)
    wanted = Verdict.PASS if name == "pointnet_cls" else Verdict.FAIL
    assert told.checks["normalization", None].worst.verdict is wanted


# -- tensors and encoders ----------------------------------------------------------------------------------------------


def test_colors_are_0_to_1_for_robotwin_and_bytes_for_dp3():
    """RoboTwin camera.py clamps to [0, 1]; DP3's simulators store 0-255."""
    robotwin, dp3 = (correct_batch(name)["point_cloud"][..., 3:] for name in ("maniflow", "dp3_sim"))
    assert float(robotwin.max()) <= 1.0 < float(dp3.max())


def test_rise2_feeds_no_colors_and_counts_cells_after_its_workspace():
    """RISE-2 dataset/realworld.py: crop, voxels, points / voxel_size as int32."""
    batch = correct_batch("rise2")
    points = batch["cloud_feats"]
    assert points.shape[1] == 3
    cells = (points.double() / 0.005).to(torch.int32)
    assert torch.equal(batch["cloud_coords"][:, 1:], cells)
    order = [type(step).__name__ for step in made_preset("rise2").pipeline.steps]
    assert order == ["DecimateDepth", "MaskDepth", "Deproject", "CropWorkspace", "VoxelDownsample"]


def test_pretrained_encoders_get_their_coordinates_among_nine_features():
    """sonata, concerto, utonia: feat_keys = coord, color, normal; in_channels = 9."""
    for name in ("sonata", "concerto", "utonia"):
        batch = correct_batch(name)
        assert batch["feat"].shape[1] == 9
        assert torch.equal(batch["feat"][:, :3], batch["coord"])


def test_utonia_counts_cells_of_a_centimetre_after_its_scale_and_leads_back_to_metres():
    """Pointcept configs/utonia: RandomScale [0.5, 0.5], CenterShift, GridSample 0.01: voxels of 20 mm in the room."""
    cloud = preset("pointcept", frame="base").pipeline(capture(), generator=seeded(0))
    made = preset("utonia", frame="base", scale=0.5)
    half = made.collate([made.pipeline(capture(), generator=seeded(0))])
    assert half.counts == (cloud.num_points,)
    cells = torch.floor(half["coord"] / 0.01).long()
    assert torch.equal(half["grid_coord"], cells - cells.amin(dim=0))
    back = to_source(half, points=half["coord"][None]).points[0]
    there = cloud.in_source_frame().points
    assert torch.allclose(back.amin(dim=0), there.amin(dim=0).double(), atol=0.02)
    assert torch.allclose(back.amax(dim=0), there.amax(dim=0).double(), atol=0.02)


def pointnet_of_dp3(channels: int) -> torch.nn.Module:
    """DP3's encoder of points, before its maximum: a layer per point of 64, 128 and 256, each normalized."""
    sizes = [channels, 64, 128, 256]
    layers = [
        layer
        for before, after in itertools.pairwise(sizes)
        for layer in (torch.nn.Linear(before, after), torch.nn.LayerNorm(after), torch.nn.ReLU())
    ]
    return torch.nn.Sequential(*layers)


@pytest.mark.parametrize("name", ["dp3_sim", "dp3_real", "dexart", "maniflow", "demogen", "pointflowmatch"])
def test_the_encoder_of_dp3_takes_the_batch_and_its_points_count(name):
    """pointnet_extractor.py: (B, N, C) without a transpose; of six channels the policy cuts three."""
    batch = next(iter(correct_batch(name).values()))[..., :3]
    encoder = pointnet_of_dp3(3)
    features = encoder(batch).amax(dim=1)
    assert features.shape == (2, 256)
    assert torch.isfinite(features).all()
    assert not torch.allclose(features, encoder(batch * 1000).amax(dim=1))


def test_the_imagined_robot_of_dexart_joins_its_cloud():
    """DP3Encoder.forward: imagin_robot, cut to the cloud's channels, joins its points."""
    cloud = correct_batch("dexart")["point_cloud"]
    joined = torch.cat([cloud, torch.zeros(2, 96, 7)[..., : cloud.shape[-1]]], dim=1)
    assert pointnet_of_dp3(3)(joined).shape == (2, 1024 + 96, 256)


def test_the_encoder_of_idp3_takes_three_channels_and_six_raise():
    """multi_stage_pointnet.py: conv_in = Conv1d(3, ...) on (B, 3, N), whatever use_pc_color says."""
    conv = torch.nn.Conv1d(3, 128, 1)
    batch = correct_batch("idp3")
    assert conv(batch["point_cloud"].transpose(1, 2)).shape == (2, 128, 10000)
    stored = preset("idp3", channels=["xyz", "rgb_255"])
    files = stored.collate([sample_of("idp3")])["point_cloud"]
    assert files.shape == (1, 10000, 6)
    assert torch.equal(files[..., :3], batch["point_cloud"][:1])
    with pytest.raises(RuntimeError, match="channels"):
        conv(files.transpose(1, 2))
    assert check(stored.collate([sample_of("idp3")]), "idp3").samples[Verdict.FAIL] == 0


def test_every_choice_that_a_contract_leaves_open_has_an_answer_here():
    assert {choice for name in CONTRACTS for choice in answers(name)} == set(ANSWERS)
