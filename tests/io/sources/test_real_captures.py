"""Every real capture opens by its path alone where its files answer, and gives the numbers that are known of it.

What is known: counts, units, intrinsics and ranges that their publishers state, and the stored images decoded here once
more with NumPy alone.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy.io import loadmat
from scipy.spatial import cKDTree

from pcdata import Deproject, ToFrame, open_source, read_pcd
from pcdata.errors import CaptureError, IntrinsicsError, UnitError
from pcdata.validation import validate_frame
from pcdata.verdicts import Verdict

NYU = "open3d_rgbd/other_formats/NYU_depth.pgm"
SUN3D = "open3d_rgbd/other_formats/SUN_depth.png"
TUM = "open3d_rgbd/other_formats/TUM_depth.png"
LENS = (582.62, 582.69, 313.04, 238.44)  # of other images than these: their own is not known
TABLETOP = (927.17, 927.37, 651.32, 349.62)

OPTIONS: dict[str, dict[str, Any]] = {  # what no file of a capture answers
    NYU: {"intrinsics": LENS},
    SUN3D: {"intrinsics": LENS, "metres_per_unit": 0.001, "depth_encoding": "rotated"},
    TUM: {"intrinsics": LENS, "metres_per_unit": 0.0002},
    "tabletop_stream": {"intrinsics": TABLETOP, "metres_per_unit": 0.001},
}

# By path: layout, samples, views, size, fx fy cx cy, the frame of the poses.
FACTS: dict[str, tuple[str, int, int, tuple[int, int], tuple[float, ...], str | None]] = {
    "apc_multiview_shelf": ("apc", 15, 1, (480, 640), (615.19519, 615.195251, 298.442688, 247.519196), "world"),
    "azure_kinect_mkv": ("azure_kinect", 1, 1, (576, 640), (504.6076, 504.7325, 332.7811, 348.8297), None),
    "d3roma_ir_stereo": ("pairs", 1, 1, (360, 640), (443.9146, 443.9146, 315.9384, 186.5704), None),
    "d435_transparent": ("pairs", 4, 1, (720, 1280), (921, 921, 642, 359), None),
    "gqcnn_phoxi": ("pairs", 1, 1, (386, 516), (552.5, 552.5, 255.5, 191.75), "world"),
    "graspnet_frame": ("graspnet", 1, 1, (720, 1280), (631.5486, 631.2075, 638.4352, 366.499), None),
    "m2t2_real_tabletop/03": ("pairs", 1, 1, (720, 1280), (912.7214, 912.741, 649.0037, 363.2525), "base"),
    "open3d_rgbd": ("open3d", 5, 1, (480, 640), (525, 525, 319.5, 239.5), "world"),
    NYU: ("nyu_raw", 1, 1, (480, 640), LENS, None),
    SUN3D: ("pairs", 1, 1, (480, 640), LENS, None),
    TUM: ("pairs", 1, 1, (480, 640), LENS, None),
    "realsense_bag": ("realsense_bag", 2, 1, (480, 640), (390.4315, 390.4315, 331.3879, 242.1873), None),
    "rlbench_five_cameras": ("rlbench", 6, 5, (128, 128), (175.8386, 175.8386, 64, 64), "world"),
    "seven_scenes": ("seven_scenes", 50, 1, (480, 640), (585, 585, 320, 240), "world"),
    "tabletop_stream": ("pairs", 10, 1, (720, 1280), TABLETOP, None),
}
NEEDS = {"azure_kinect_mkv": "av", "d435_transparent": "OpenEXR", "realsense_bag": "rosbags"}


def first(test_data: Path, name: str, **options: Any) -> Any:
    """The first sample of a real capture."""
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    source = open_source(test_data / name, **OPTIONS.get(name, {}), **options)
    return source.load(source.ids[0])


def stored(path: Path) -> NDArray[Any]:
    return np.load(path) if path.suffix == ".npy" else np.asarray(Image.open(path))


@pytest.mark.parametrize("name", FACTS)
def test_a_real_capture_opens_with_what_its_files_cannot_answer(name: str, test_data: Path) -> None:
    kind, count, views, size, lens, frame_id = FACTS[name]
    frame = first(test_data, name)
    source = open_source(test_data / name, **OPTIONS.get(name, {}))
    assert (source.kind, len(source)) == (kind, count)
    assert (frame.num_views, frame.size, frame.frame_id) == (views, size, frame_id)
    (fx, _, cx), (_, fy, cy), _ = frame.camera.intrinsics[0].tolist()
    assert (fx, fy, cx, cy) == pytest.approx(lens, abs=1e-3)
    assert (frame.world_from_camera is not None) == (frame_id is not None)


# -- depth, decoded once more ------------------------------------------------------------------------------------------


def rotated(bits: NDArray[np.uint16]) -> NDArray[np.uint16]:
    return (bits >> 3) | (bits << 13)


def of_nyu(path: Path) -> NDArray[np.float64]:
    head, _, pixels = path.read_bytes().partition(b"65535\n")
    assert head.split() == [b"P5", b"640", b"480"]
    disparity = np.frombuffer(pixels, "<u2").reshape(480, 640).astype(np.float64)
    return np.where(disparity < 2047, 351.3 / (1092.5 - disparity), 0)


# By path: the first depth image, and how NumPy alone makes metres of it.
DECODED: dict[str, tuple[str, Callable[[Path], NDArray[Any]]]] = {
    "apc_multiview_shelf": ("frame-000000.depth.png", lambda path: rotated(stored(path).astype(np.uint16)) / 10_000),
    "d3roma_ir_stereo": ("0000_depth.png", lambda path: stored(path) / 1000),
    "gqcnn_phoxi": ("depth_0.npy", lambda path: stored(path).reshape(386, 516)),
    "graspnet_frame": ("depth.png", lambda path: stored(path) / 1000),
    "m2t2_real_tabletop/03": ("depth.npy", stored),
    "open3d_rgbd": ("depth/00000.png", lambda path: stored(path) / 1000),
    NYU: ("", of_nyu),
    SUN3D: ("", lambda path: rotated(stored(path).astype(np.uint16)) / 1000),
    TUM: ("", lambda path: stored(path) / 5000),
    "seven_scenes": ("frame-000000.depth.png", lambda path: np.where(stored(path) == 65535, 0, stored(path) / 1000)),
    "tabletop_stream": ("depth_000.npy", lambda path: stored(path) / 1000),
}
# By path: how many pixels have a reading, and between which metres they, or half of them, lie.
READINGS: dict[str, tuple[float, Callable[[Any], Any], float, float]] = {
    "apc_multiview_shelf": (0.265, np.median, 0.53, 0.57),  # as plain millimetres it would be metres away
    "azure_kinect_mkv": (0.76, np.median, 1.49, 1.492),
    "gqcnn_phoxi": (0.68, np.median, 0.6, 1.0),
    "graspnet_frame": (825_160 / (1280 * 720), lambda depth: [depth.min(), depth.max()], 0.229, 1.59001),
    "tabletop_stream": (0.998, lambda depth: np.percentile(depth, [1, 99]), 0.45, 0.59),
}


@pytest.mark.parametrize("name", DECODED)
def test_depth_of_a_real_capture_is_that_of_its_encoding(name: str, test_data: Path) -> None:
    file, decode = DECODED[name]
    expected = np.asarray(decode(test_data / name / file if file else test_data / name), np.float64)
    assert np.abs(first(test_data, name).depth[0].numpy() - expected).max() < 1e-6


@pytest.mark.parametrize("name", READINGS)
def test_readings_of_a_real_capture_are_as_many_and_as_far_as_stated(name: str, test_data: Path) -> None:
    share, told, low, high = READINGS[name]
    depth = first(test_data, name).depth[0].numpy()
    assert float((depth > 0).mean()) == pytest.approx(share, abs=0.005)
    assert low <= np.min(told(depth[depth > 0]))
    assert np.max(told(depth[depth > 0])) <= high


def test_openexr_depth_is_metres_and_transparent_objects_are_marked(test_data: Path) -> None:
    frame = first(test_data, "d435_transparent")
    assert open_source(test_data / "d435_transparent").ids == [
        f"{number}-{state}" for number in ("000000080", "000000123") for state in ("opaque", "transparent")
    ]
    assert float(frame.depth[frame.depth > 0].median()) == pytest.approx(0.599, abs=0.01)
    assert np.array_equal(frame.labels[0].numpy(), stored(test_data / "d435_transparent" / "000000080-mask.png"))


def test_the_unit_of_a_stereo_camera_is_what_its_disparity_says(test_data: Path, tmp_path: Path) -> None:
    folder = test_data / "d3roma_ir_stereo"
    assert first(test_data, "d3roma_ir_stereo").provenance["metres_per_unit"] == 0.001
    for name in ("0000_depth.png", "0000_rgb.png", "intrinsics.txt"):
        shutil.copy(folder / name, tmp_path)
    with pytest.raises(UnitError, match=r"no file states the unit.*--metres-per-unit"):
        open_source(tmp_path).load("0000")


# -- poses, registration, labels, signals ------------------------------------------------------------------------------


def test_poses_of_real_captures_are_those_of_their_files(test_data: Path) -> None:
    seven = open_source(test_data / "seven_scenes").load("frame-000020")
    expected = np.loadtxt(test_data / "seven_scenes" / "frame-000020.pose.txt")
    assert np.abs(seven.world_from_camera[0].numpy() - expected).max() < 1e-5
    open3d = open_source(test_data / "open3d_rgbd").load("00002")
    lines = (test_data / "open3d_rgbd" / "trajectory.log").read_text().splitlines()
    expected = np.array([line.split() for line in lines[11:15]], np.float64)
    assert np.abs(open3d.world_from_camera[0].numpy() - expected).max() < 1e-6
    gqcnn = first(test_data, "gqcnn_phoxi").world_from_camera[0].numpy()
    assert gqcnn[:3, 3] == pytest.approx([0.385146, -0.121589, 0.808145])
    assert gqcnn[:3, 2] == pytest.approx([0.001249, 0.14642, -0.989222], abs=1e-5), "the camera looks down"


def test_seven_scenes_are_every_twentieth_frame_of_a_thousand(test_data: Path) -> None:
    source = open_source(test_data / "seven_scenes")
    assert source.ids == [f"frame-{number:06d}" for number in range(0, 1000, 20)]
    raw = stored(test_data / "seven_scenes" / "frame-000860.depth.png")
    assert (raw == 65535).sum() == 3577
    assert not source.load("frame-000860").depth[0].numpy()[raw == 65535].any()


def test_graspnets_matlab_file_says_what_the_frame_has(test_data: Path) -> None:
    frame = first(test_data, "graspnet_frame")
    said = loadmat(str(test_data / "graspnet_frame" / "meta.mat"))
    assert int((frame.depth > 0).sum()) == 825_160
    assert frame.provenance["metres_per_unit"] == 1 / float(said["factor_depth"].item()) == 0.001
    assert np.array_equal(frame.camera.intrinsics[0].numpy(), said["intrinsic_matrix"].astype(np.float64))
    assert frame.provenance["cls_indexes"] == said["cls_indexes"].ravel().tolist()
    poses = np.array(frame.provenance["camera_from_object"])[:, :3]
    assert np.array_equal(poses, said["poses"].transpose(2, 0, 1).astype(np.float64))
    assert np.array_equal(frame.mask[0].numpy(), stored(test_data / "graspnet_frame" / "workspace_mask.png") > 0)


def test_the_shelf_is_registered_to_the_posed_camera_and_the_other_stands_beside_it(test_data: Path) -> None:
    source = open_source(test_data / "apc_multiview_shelf", registered=True)
    assert source.ids == [f"frame-{number:06d}" for number in (0, 2, 4, 7, 10)]
    seen = source.load("frame-000002")
    source = open_source(test_data / "apc_multiview_shelf", registered=False)
    own = source.load("frame-000002")
    between = np.linalg.inv(seen.world_from_camera[0].numpy()) @ own.world_from_camera[0].numpy()
    text = (test_data / "apc_multiview_shelf" / "cam.info.txt").read_text()
    block = text.partition("Depth-to-color")[2].splitlines()[1:5]
    assert np.abs(between - np.array([line.split() for line in block], np.float64)).max() < 1e-6
    assert (seen.colors is None, own.colors is None) == (False, True)


def test_views_of_the_shelf_meet_by_the_color_camera_that_depth_is_registered_to(test_data: Path) -> None:
    root = test_data / "apc_multiview_shelf"
    right, wrong = (
        _gaps([source.load(f"frame-{number:06d}") for number in (5, 6, 7)])
        for source in (open_source(root), open_source(root, registered=False))
    )
    assert np.median(np.abs(right)) < 0.003
    assert abs(np.median(right)) < 0.001
    assert np.median(np.abs(wrong)) > 0.005, "as if the images were the depth camera's own"
    assert abs(np.median(wrong)) > 0.002


def _gaps(frames: list[Any]) -> np.ndarray:  # signed metres from points of a view to the surface of the one before
    clouds = [_in_world(frame).points.double().numpy() for frame in frames]
    gaps = []
    for one, other, frame in zip(clouds[1:], clouds, frames):
        some = one[::97]
        distance, nearest = cKDTree(other).query(some, k=16, distance_upper_bound=0.03)
        near = np.isfinite(distance).all(1)
        patch = other[nearest[near]]
        center = patch.mean(1)
        apart = patch - center[:, None]
        normal = np.linalg.eigh(np.einsum("nki,nkj->nij", apart, apart))[1][:, :, 0]
        towards = np.sign((normal * (frame.world_from_camera[0, :3, 3].numpy() - center)).sum(1))
        gaps.append(((some[near] - center) * normal).sum(1) * towards)
    return np.concatenate(gaps)


def test_the_real_tabletop_of_m2t2_is_told_alike_by_json_and_by_a_pickle(test_data: Path, tmp_path: Path) -> None:
    frame = first(test_data, "m2t2_real_tabletop/03")
    said = json.loads((test_data / "m2t2_real_tabletop" / "03" / "meta_data.json").read_text())
    assert np.abs(frame.world_from_camera[0].numpy() - np.array(said["camera_pose"])).max() < 1e-6
    assert set(frame.labels.unique().tolist()) == {0, 2, 3, *range(101, 107)}
    shutil.copytree(test_data / "m2t2_real_tabletop" / "03", tmp_path / "03")
    (tmp_path / "03" / "meta_data.json").unlink()
    other = open_source(tmp_path / "03").load("03")
    assert torch.equal(other.world_from_camera, frame.world_from_camera)
    assert torch.equal(other.camera.intrinsics, frame.camera.intrinsics)
    assert other.recorded_signals["ee_pose"].same_bits(frame.recorded_signals["ee_pose"])
    assert frame.recorded_signals["ee_pose"].values[0].tolist() == pytest.approx(np.array(said["ee_pose"]))


def test_the_kinect_recording_has_a_rational_lens_and_color_to_register_to(test_data: Path) -> None:
    frame = first(test_data, "azure_kinect_mkv")
    assert frame.camera.distortion.shape[-1] == 8
    assert frame.camera.off_center()[0] > 0.1
    assert frame.camera.is_window  # the mode cuts its image from the sensor's
    seen = first(test_data, "azure_kinect_mkv", registered=True)
    assert (seen.size, seen.colors.shape[-3:]) == ((720, 1280), (720, 1280, 3))
    assert float(seen.depth[seen.depth > 0].median()) == pytest.approx(1.44, abs=0.05)


def test_the_realsense_recording_states_its_unit_beside_the_images(test_data: Path) -> None:
    frame = first(test_data, "realsense_bag")
    assert (frame.provenance["metres_per_unit"], frame.provenance["unit_is_recorded"]) == (pytest.approx(0.001), True)
    assert frame.provenance["sensor_name"] == "Intel RealSense D435"
    with pytest.raises(CaptureError, match=r"--max-time-apart 0\.0\d+\)") as caught:
        open_source(test_data / "realsense_bag", registered=True)
    apart = float(str(caught.value).partition("--max-time-apart ")[2].partition(")")[0])
    source = open_source(test_data / "realsense_bag", registered=True, max_time_apart=apart)
    assert source.load(source.ids[0]).colors is not None


def test_labeled_scenes_are_counted_and_their_objects_begin_at_twenty(test_data: Path) -> None:
    source = open_source(test_data / "osd")
    assert source.ids == [f"learn{number}" for number in range(45)]
    for name in ("learn0", "learn44"):
        cloud = source.load(name)
        assert cloud.num_points < 640 * 480, "without the pixels that have no reading"
        labels = set(cloud.labels.tolist())
        assert 1 in labels
        assert all(1 <= label <= 9 or label >= 20 for label in labels)


def test_organized_clouds_have_colors(test_data: Path) -> None:
    source = open_source(test_data / "pcd")
    assert source.ids == ["milk_cartoon_all_small_clorox", "table_scene_mug_stereo_textured"]
    for name in source.ids:
        header = (test_data / "pcd" / f"{name}.pcd").read_bytes()[:400]
        assert b"WIDTH 640\nHEIGHT 480" in header
        cloud = source.load(name)
        assert cloud.colors is not None
        assert cloud.num_points == read_pcd(test_data / "pcd" / f"{name}.pcd").num_points


# -- five simulated cameras --------------------------------------------------------------------------------------------


def meeting(frame: Any) -> list[float]:
    """Of each pair of views, the share of the pixels of one that lie within 5 mm of what the other sees there."""
    height, width = frame.size
    v, u = np.mgrid[:height:3, :width:3]
    depths, poses = frame.depth.double().numpy(), frame.world_from_camera.numpy()
    cameras, shares = frame.camera.intrinsics.double().numpy(), []
    rays = [
        np.stack([(u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], np.ones(u.shape)]).reshape(3, -1) for k in cameras
    ]
    for one in range(frame.num_views):
        world = poses[one] @ np.vstack([rays[one] * depths[one][v, u].ravel(), np.ones(u.size)])
        for other in range(one + 1, frame.num_views):
            seen = (np.linalg.inv(poses[other]) @ world)[:3]
            pixel = cameras[other] @ seen[:, seen[2] > 0.01]
            x, y = np.rint(pixel[:2] / pixel[2]).astype(int)
            inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            gap = np.abs(depths[other][y[inside], x[inside]] - pixel[2, inside])
            shares.append(float((gap < 0.005).mean()) if gap.size else 0.0)
    return shares


def one_step(folder: Path, target: Path) -> tuple[Path, dict[str, Any]]:
    """The first step of the five cameras, without colors and masks, to be changed."""
    for depth in sorted(folder.glob("*_depth")):
        (target / depth.name).mkdir(parents=True)
        shutil.copy(depth / "0.png", target / depth.name)
    said: dict[str, Any] = json.loads((folder / "meta_data.json").read_text())
    return target, said


def positive_focal_lengths(folder: Path, said: dict[str, Any]) -> None:
    for name, value in said.items():
        if name.endswith("_intrinsics"):
            assert value[0][0] < 0
            value[0][0], value[1][1] = -value[0][0], -value[1][1]


def bytes_the_other_way(folder: Path, said: dict[str, Any]) -> None:
    for file in folder.glob("*_depth/0.png"):
        Image.fromarray(np.ascontiguousarray(stored(file)[..., ::-1])).save(file)


def planes_of_another_camera(folder: Path, said: dict[str, Any]) -> None:
    for name in said:
        if name.endswith("_far"):
            said[name] *= 1.1


def poses_the_other_way(folder: Path, said: dict[str, Any]) -> None:
    for name, value in said.items():
        if name.endswith("_extrinsics"):
            value[0] = np.linalg.inv(np.array(value[0])).tolist()


def test_five_simulated_cameras_meet_by_the_right_decode(test_data: Path) -> None:
    shares = meeting(first(test_data, "rlbench_five_cameras"))
    assert len(shares) == 10
    assert min(shares) > 0.2, "what one camera sees is partly hidden from the other"
    assert np.median(shares) > 0.4


@pytest.mark.parametrize(
    "change", [positive_focal_lengths, bytes_the_other_way, planes_of_another_camera, poses_the_other_way]
)
def test_five_simulated_cameras_do_not_meet_by_a_wrong_decode(
    test_data: Path, tmp_path: Path, change: Callable[[Path, dict[str, Any]], None]
) -> None:
    folder, said = one_step(test_data / "rlbench_five_cameras", tmp_path / "episode")
    change(folder, said)
    (folder / "meta_data.json").write_text(json.dumps(said))
    assert np.median(meeting(open_source(folder).load("0"))) < 0.02


def test_a_near_plane_behind_the_far_one_is_refused(test_data: Path, tmp_path: Path) -> None:
    folder, said = one_step(test_data / "rlbench_five_cameras", tmp_path / "episode")
    said |= {
        f"{camera}_camera_{one}": said[f"{camera}_camera_{other}"]
        for camera in ("front", "wrist", "overhead", "left_shoulder", "right_shoulder")
        for one, other in (("near", "far"), ("far", "near"))
    }
    (folder / "meta_data.json").write_text(json.dumps(said))
    with pytest.raises(CaptureError, match="0 < near < far"):
        open_source(folder).load("0")


def test_a_simulator_that_states_its_planes_leaves_no_doubt_about_the_unit(test_data: Path) -> None:
    frame = open_source(test_data / "rlbench_five_cameras").load("80")
    found = [one.verdict for one in validate_frame(frame) if one.name == "depth_unit"]
    assert found == [Verdict.PASS] * 5


def test_five_simulated_cameras_meet_on_the_table(test_data: Path) -> None:
    frame = open_source(test_data / "rlbench_five_cameras").load("0")
    clouds = [cloud.points.double().numpy() for cloud in _in_world(frame)]
    trees, gaps = [cKDTree(cloud) for cloud in clouds], []
    for one in range(5):
        for other in range(one + 1, 5):
            some = clouds[one][::7]
            distance, nearest_nine = trees[other].query(some, k=9)
            near = nearest_nine[distance[:, 8] < 0.03]
            patch = clouds[other][near]
            center = patch.mean(1, keepdims=True)
            spread, axes = np.linalg.eigh((patch - center).transpose(0, 2, 1) @ (patch - center))
            off = np.abs(((some[distance[:, 8] < 0.03] - center[:, 0]) * axes[:, :, 0]).sum(1))
            gaps.append(float(np.median(off[spread[:, 0] < 1e-7])))
    assert len(gaps) == 10
    assert max(gaps) < 0.0002, "half a pixel off or axes not turned: 2 mm or metres"


def _in_world(frame: Any) -> Any:
    return ToFrame(frame="world")(Deproject()(frame))


# -- what no file answers is named -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("tabletop_stream", "metres_per_unit=0.001 (--metres-per-unit 0.001)"),
        ("open3d_rgbd/other_formats/TUM_depth.png", "metres_per_unit=0.0002 (--metres-per-unit 0.0002)"),
        ("open3d_rgbd/other_formats/SUN_depth.png", "(--metres-per-unit 0.001 --depth-encoding rotated)"),
    ],
)
def test_units_of_real_captures_are_named_and_not_guessed(name: str, unit: str, test_data: Path) -> None:
    source = open_source(test_data / name, intrinsics=(582.6, 582.7, 313.0, 238.0))
    with pytest.raises(UnitError) as caught:
        source.load(source.ids[0])
    assert unit in str(caught.value)


def test_images_of_different_units_in_one_folder_are_not_named_one(test_data: Path) -> None:
    lens = (582.6, 582.7, 313.0, 238.0)
    source = open_source(test_data / "open3d_rgbd" / "other_formats", intrinsics=lens)
    for name in source.ids:
        with pytest.raises(UnitError, match=r"images are not of the same: .*Give the path of one image") as caught:
            source.load(name)
        assert "--metres-per-unit" not in str(caught.value)
    with pytest.raises(IntrinsicsError, match=r"no file states the intrinsics.*the images are not of the same"):
        open_source(test_data / "open3d_rgbd" / "other_formats")
