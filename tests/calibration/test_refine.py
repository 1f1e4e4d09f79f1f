import functools
import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from pcdata.alignment.pose_graph import average_motions
from pcdata.calibration import Calibration, Evidence, refine_extrinsics
from pcdata.calibration.refine import Refinement
from pcdata.cli import main
from pcdata.errors import CalibrationError, ConfigError
from pcdata.geometry import rigid
from pcdata.geometry.small_motions import motion_from_twist, twist_from_motion
from pcdata.io import write_calibration, write_ply
from pcdata.io.calibration.capture_camera import CaptureCamera, write_capture_camera
from pcdata.io.images.writing import write_depth
from pcdata.structures import DepthFrame, PointCloud
from pcdata.synthetic import Miscalibration, Tabletop, tabletop
from tests.scenes import overlapping

pytestmark = pytest.mark.usefixtures("patches_fitted_once")

NAMES = ["left", "right", "top"]


def scene(seed: int) -> Tabletop:
    return overlapping(seed, 3)


def rig(seed: int, *, millimetres: float = 10.0, degrees: float = 1.0, wrong: int = 1) -> DepthFrame:
    error = Miscalibration(
        translation=[1e-3 * millimetres * (view == wrong) for view in range(3)],
        rotation_degrees=[degrees * (view == wrong) for view in range(3)],
    )
    true = scene(seed)
    return replace(true.frame, world_from_camera=error.apply(true.truth.world_from_camera, seed))


@functools.cache
def refined(seed: int, fixed: str | None = None) -> Refinement:
    """The rig whose camera ``right`` is off, refined once for all claims about it."""
    frame = rig(seed)
    poses, depth = frame.world_from_camera.clone(), frame.depth.clone()
    found = refine_extrinsics([frame], names=NAMES, fixed=fixed)
    assert torch.equal(frame.world_from_camera, poses), "the capture is left as it was"
    assert torch.equal(frame.depth, depth)
    return found


def errors_at_scene(poses: torch.Tensor, seed: int, center: tuple[float, ...]) -> torch.Tensor:
    """(V, 2): millimetres at the middle of the overlap, and degrees."""
    wrong = poses @ rigid.invert_rigid(scene(seed).truth.world_from_camera)
    twist = twist_from_motion(wrong, torch.tensor(center, dtype=torch.float64))
    return torch.stack([twist[:, 3:].norm(dim=1) * 1e3, torch.rad2deg(twist[:, :3].norm(dim=1))], dim=1)


@pytest.mark.parametrize("seed", [0, 2])
def test_a_camera_off_by_10_mm_and_1_degree_is_brought_back(seed):
    found = refined(seed)
    poses = torch.stack([camera.world_from_camera for camera in found.cameras])
    left = errors_at_scene(poses, seed, found.overlap.cameras[1].center)
    assert float(left[:, 0].max()) < 1.0
    assert float(left[:, 1].max()) < 0.1
    assert found.cameras[1].shift == pytest.approx(0.01, abs=1e-3)
    assert found.cameras[1].rotation_degrees == pytest.approx(1.0, abs=0.1)
    assert all(camera.rmse_after < camera.rmse_before / 2 for camera in found.cameras)


@pytest.mark.parametrize("fixed", ["left", "right"])  # a camera that is right, and the one that is off
def test_the_fixed_camera_stays_and_the_others_meet_it(fixed):
    frame = rig(0)
    found = refined(0, fixed)
    stays = NAMES.index(fixed)
    assert torch.equal(found.cameras[stays].world_from_camera, frame.world_from_camera[stays])
    moved = torch.stack([camera.world_from_camera for camera in found.cameras])
    relative = rigid.invert_rigid(moved[:1]) @ moved
    true = scene(0).truth.world_from_camera
    apart = twist_from_motion(
        rigid.invert_rigid(rigid.invert_rigid(true[:1]) @ true) @ relative, torch.tensor([0.0, 0.0, 0.9]).double()
    )
    assert float(apart[:, 3:].norm(dim=1).max()) < 0.001


def test_captures_that_are_refused_are_left_as_they_were_too():
    frame = rig(0)
    poses, depth = frame.world_from_camera.clone(), frame.depth.clone()
    with pytest.raises(CalibrationError, match="more than 5 mm"):
        refine_extrinsics([frame], names=NAMES, max_shift=0.005)
    assert torch.equal(frame.world_from_camera, poses)
    assert torch.equal(frame.depth, depth)


def test_a_camera_knocked_over_is_refused():
    with pytest.raises(CalibrationError, match=r"right: would move by 2\d mm .* more than 20 mm"):
        refine_extrinsics([rig(0, millimetres=28.0, degrees=0.0)], names=NAMES)


def test_poses_that_bring_no_surface_nearer_are_refused():
    # One camera's image twice: where both agree exactly, nothing can be made better.
    one = scene(0).frame.view(0)
    pose = scene(0).truth.world_from_camera[:1].repeat(2, 1, 1)
    camera = replace(one.camera, intrinsics=one.camera.intrinsics.repeat(2, 1, 1))
    twice = replace(
        one, depth=one.depth.repeat(2, 1, 1), colors=None, labels=None, camera=camera, world_from_camera=pose
    )
    with pytest.raises(CalibrationError, match="as well as these captures can tell"):
        refine_extrinsics([twice], names=["a", "b"], fixed="a")


def test_gaps_are_those_of_samples_left_out_and_fall():
    found = refined(0)
    assert found.rmse_gap[1] < found.rmse_gap[0] / 2
    assert found.median_gap[1] < found.median_gap[0]
    assert "left out of the fit" in found.text()
    assert found.to_json()["rmse_gap"] == list(found.rmse_gap)


def test_a_bare_table_is_refused_as_undetermined():
    bare = tabletop(0, 0, 3, noise="stereo", floor=False, size=(240, 320)).frame
    depth = torch.zeros_like(bare.depth)
    depth[:, 80:160, 100:220] = bare.depth[:, 80:160, 100:220]
    with pytest.raises(
        CalibrationError, match=r"does not determine its pose: shift along .*at most 1 mm.*upright sides"
    ):
        refine_extrinsics([replace(bare, depth=depth)], names=NAMES, fixed="left")


def test_two_cameras_that_disagree_need_one_said_to_be_right():
    true = scene(2)
    frame = replace(
        true.frame.view(0),
        depth=true.frame.depth[[0, 2]],
        colors=None,
        labels=None,
        camera=replace(true.frame.camera, intrinsics=true.frame.camera.intrinsics[[0, 2]]),
        world_from_camera=rig(2, wrong=2).world_from_camera[[0, 2]],
    )
    with pytest.raises(CalibrationError, match="nothing tells which"):
        refine_extrinsics([frame], names=["a", "b"])
    assert refine_extrinsics([frame], names=["a", "b"], fixed="a").cameras[1].shift == pytest.approx(0.01, abs=1.5e-3)


@pytest.mark.parametrize("change", [{"method": "icp"}, {"fixed": "front"}, {"names": ["a"]}])
def test_unknown_names_are_refused(change):
    with pytest.raises(ConfigError):
        refine_extrinsics([rig(0)], **{"names": NAMES, **change})


def test_small_gicp_agrees_with_our_own():
    pytest.importorskip("small_gicp")
    ours = refined(0, "left")
    theirs = refine_extrinsics([rig(0)], names=NAMES, fixed="left", method="small_gicp")
    center = torch.tensor(ours.overlap.cameras[1].center, dtype=torch.float64)
    for one, other in zip(ours.cameras, theirs.cameras, strict=True):
        twist = twist_from_motion(one.world_from_camera @ rigid.invert_rigid(other.world_from_camera), center)
        assert float(twist[3:].norm()) < 0.002
        assert math.degrees(float(twist[:3].norm())) < 0.3


def test_averaging_consistent_pairs_gives_the_motions_back():
    generator = torch.Generator().manual_seed(0)
    pivot = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    twists = 1e-3 * torch.randn(4, 6, generator=generator, dtype=torch.float64)
    twists[2] = 0
    motions = motion_from_twist(twists, pivot)
    identity = torch.eye(6, dtype=torch.float64)
    pairs = [
        (s, t, rigid.invert_rigid(motions[t]) @ motions[s], identity * (1 + s))
        for s, t in [(0, 1), (1, 2), (2, 3), (0, 3)]
    ]
    torch.testing.assert_close(average_motions(pairs, 4, pivot, fixed=2), motions, atol=5e-6, rtol=0)


def calibration_of(frame: DepthFrame) -> Calibration:
    cameras = {name: frame.camera.view(view) for view, name in enumerate(NAMES)}
    mount = torch.eye(4, dtype=torch.float64)
    mount[2, 3] = 0.1
    left, right, top = frame.world_from_camera
    return Calibration(
        cameras=cameras,
        transforms={
            "base_from_left": left,
            "right_from_base": rigid.invert_rigid(right),  # the other way round
            "base_from_mast": mount,
            "mast_from_top": rigid.invert_rigid(mount) @ top,
        },
        evidence={"right_from_base": Evidence(method="by hand"), "left": Evidence(method="factory")},
    )


def test_a_refined_calibration_gives_the_refined_poses_and_says_how():
    frame = rig(0)
    given = calibration_of(frame)
    found = refined(0, "left")
    new = found.applied_to(given)
    for camera in found.cameras:
        torch.testing.assert_close(new.transform("base", camera.name), camera.world_from_camera)
    assert torch.equal(new.transform("base", "mast"), given.transform("base", "mast"))
    assert new.evidence["left"] == given.evidence["left"]
    assert "pcdata calib refine" in new.evidence["base_from_right"].method
    assert new.evidence["base_from_right"].residuals["shift_mm"] == pytest.approx(10.0, abs=1.0)
    assert "right_from_base" in given.transforms


def write_rig(folder, frame: DepthFrame) -> None:
    for view, name in enumerate(NAMES):
        (folder / name / "depth").mkdir(parents=True)
        write_depth(folder / name / "depth" / "0001.png", frame.depth[view], metres_per_unit=0.001)
        write_capture_camera(
            folder / name / "intrinsics.json", CaptureCamera(camera=frame.camera.view(view), metres_per_unit=0.001)
        )


def test_the_commands_judge_and_refine_a_rig_on_disk(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    frame = rig(0)
    write_rig(tmp_path / "rig", frame)
    write_calibration(tmp_path / "old.yaml", calibration_of(frame))
    before = (tmp_path / "old.yaml").read_bytes()
    line = [str(tmp_path / "rig"), "--calibration", str(tmp_path / "old.yaml")]
    assert (
        main(["calib", "overlap", *line, "--json", str(tmp_path / "o.json"), "--figure", str(tmp_path / "o.png")]) == 1
    )
    assert "recalibrate right" in capsys.readouterr().out
    assert (tmp_path / "o.png").read_bytes().startswith(b"\x89PNG")
    new = tmp_path / "new.yaml"
    assert main(["calib", "refine", *line, "--out", str(new)]) == 0
    assert (tmp_path / "old.yaml").read_bytes() == before
    line[-1] = str(new)
    assert main(["calib", "overlap", *line]) == 0
    assert "overlap: pass" in capsys.readouterr().out
    assert main(["calib", "refine", *line, "--out", str(new)]) == 2
    assert "name a new file" in capsys.readouterr().err
    (tmp_path / "rig" / "top").rename(tmp_path / "rig" / "ceiling")
    assert main(["calib", "overlap", *line]) == 1
    assert "missing: top" in capsys.readouterr().err


def test_a_recording_of_several_views_is_judged_and_refined_as_a_rig_is(tmp_path, capsys):
    pytest.importorskip("pyarrow")
    write_rig(tmp_path / "rig", rig(0))
    calibration, recording = str(tmp_path / "old.yaml"), str(tmp_path / "recording")
    write_calibration(calibration, calibration_of(rig(0)))
    read = [str(tmp_path / "rig"), "--calibration", calibration, "--frame", "base"]
    assert main(["convert", *read, "--to", "lerobot", "--out", recording]) == 0
    assert main(["calib", "overlap", recording, "--json", str(tmp_path / "o.json")]) == 1
    assert "recalibrate right" in capsys.readouterr().out
    (stand,) = json.loads((tmp_path / "o.json").read_text())["stands"]
    pairs = {(pair["first"], pair["second"]) for pair in stand["pairs"]}
    assert pairs == {("left", "right"), ("left", "top"), ("right", "top")}
    new = str(tmp_path / "new.yaml")
    assert main(["calib", "refine", recording, "--calibration", calibration, "--out", new]) == 0
    assert main(["calib", "overlap", recording, "--calibration", new]) == 0


def test_captures_of_a_camera_that_moves_are_judged_stand_by_stand(tmp_path, capsys):
    right, wrong = rig(0, millimetres=0, degrees=0), rig(0)
    for sample, frame in (("0001", right), ("0002", wrong), ("0003", right)):
        for view, name in enumerate(NAMES):
            camera = tmp_path / "rig" / name
            for folder in ("depth", "poses"):
                (camera / folder).mkdir(parents=True, exist_ok=True)
            write_depth(camera / "depth" / f"{sample}.png", frame.depth[view], metres_per_unit=0.001)
            np.savetxt(camera / "poses" / f"{sample}.txt", frame.world_from_camera[view].numpy())
            facts = CaptureCamera(camera=frame.camera.view(view), metres_per_unit=0.001, frame_id="base")
            write_capture_camera(camera / "intrinsics.json", facts)
    assert main(["calib", "overlap", str(tmp_path / "rig"), "--json", str(tmp_path / "o.json")]) == 1
    out = capsys.readouterr().out
    assert "capture 0001, 0003\noverlap: pass" in out
    assert "capture 0002\noverlap: fail" in out
    told = json.loads((tmp_path / "o.json").read_text())
    assert told["verdict"] == "fail"
    assert [stand["captures"] for stand in told["stands"]] == [["0001", "0003"], ["0002"]]


def test_captures_that_cannot_be_compared_are_told_with_advice(tmp_path, capsys):
    write_rig(tmp_path / "rig", rig(0))
    assert main(["calib", "overlap", str(tmp_path / "rig" / "left")]) == 1
    assert "one folder per camera" in capsys.readouterr().err
    write_ply(tmp_path / "cloud.ply", PointCloud(points=torch.rand(50, 3), ptr=None, frame_id="base"))
    assert main(["calib", "overlap", str(tmp_path / "cloud.ply")]) == 1
    assert "holds clouds; give the depth images" in capsys.readouterr().err
    assert main(["calib", "refine", str(tmp_path / "rig"), "--out", str(tmp_path / "new.yaml")]) == 2
    assert "with --calibration FILE" in capsys.readouterr().err
