"""pcdata calib: what is printed, written and returned."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pcdata.calibration import Calibration, Evidence
from pcdata.cli import main
from pcdata.io import read_calibration, write_calibration, write_depth
from pcdata.sensors import sensor_profile
from tests.calibration.boards import CAMERA, CHARUCO, good_poses, rendered
from tests.calibration.robots import HOLDER_FROM_TARGET, MOUNT_FROM_CAMERA, apart, camera_poses, robot_poses
from tests.calibration.test_plane_check import wall
from tests.calibration.test_robot_poses import plain


def run(capsys, *arguments: object) -> tuple[int, str, str]:
    try:
        code = main([str(argument) for argument in arguments])
    except SystemExit as leave:  # argparse
        code = int(leave.code or 0)
    out, err = capsys.readouterr()
    return code, out, err


# -- check ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def walls(tmp_path: Path) -> Path:
    root = tmp_path / "walls"
    (root / "depth").mkdir(parents=True)
    for name, distance in (("near", 0.6), ("far", 1.2)):
        frame = wall(normal_distance=distance, noise=0.004 * distance**2, scale=1.003)
        write_depth(root / "depth" / f"{name}.png", frame.depth[0], metres_per_unit=0.0001, round_to_unit=True)
    k = frame.camera.to_dict()
    (fx, _, cx), (_, fy, cy), _ = k["intrinsics"][0]
    stated = {"width": 320, "height": 240, "fx": fx, "fy": fy, "cx": cx, "cy": cy, "metres_per_unit": 0.0001}
    (root / "intrinsics.json").write_text(json.dumps(stated | {"distortion": k["distortion"][0]}))
    return root


def test_check_tells_one_line_per_capture(capsys, walls: Path):
    code, out, err = run(capsys, "calib", "check", walls)
    assert (code, err) == (0, "")
    far, near = out.splitlines()[2:4]
    assert far.split()[0] == "far"
    assert float(far.split()[1]) == pytest.approx(1.2036, abs=2e-3)
    assert float(near.split()[7]) == pytest.approx(1.44, rel=0.03)
    assert "verdict  pass: 2 of 2 captures in order" in out


def test_check_fails_on_bias_and_names_the_limit(capsys, walls: Path):
    code, out, _ = run(capsys, "calib", "check", walls, "--distance", "1.2", "--along", "normal")
    assert code == 1
    assert "near: bias, part of the distance is" in out
    assert "at most 0.5 %: measure the distance again" in out
    assert "verdict  FAIL: 1 of 2 captures in order" in out


def test_check_holds_noise_to_a_sensor(capsys, walls: Path):
    profile = sensor_profile("realsense_d435")
    code, out, _ = run(capsys, "calib", "check", walls, "--sensor", profile.name, "--limit", "1")
    expected = math.hypot(profile.noise_at(1.2036, focal=300.0), profile.depth_step / 12**0.5)
    assert float(out.splitlines()[2].split()[8]) == pytest.approx(1000 * expected, rel=0.01)
    assert code == (0 if 1.5 * expected >= 0.004 * 1.2**2 * 1.0 else 1)
    code, out, _ = run(capsys, "calib", "check", walls, "--sensor", "photoneo_phoxi_m")  # a scanner is finer by far
    assert code == 1
    assert "near: depth RMS over expected noise is" in out
    code, _, err = run(capsys, "calib", "check", walls, "--sensor", "realsense_d436")
    assert code == 2
    assert "realsense_d435" in err


def test_check_names_a_bowl_and_tells_its_height(capsys, tmp_path: Path, walls: Path):
    (tmp_path / "depth").mkdir()
    (tmp_path / "intrinsics.json").write_text((walls / "intrinsics.json").read_text())
    bowl = wall(noise=0.001, bowl=0.012)
    write_depth(tmp_path / "depth" / "bowl.png", bowl.depth[0], metres_per_unit=0.0001, round_to_unit=True)
    for sensor in ((), ("--sensor", "realsense_d435")):
        code, out, _ = run(capsys, "calib", "check", tmp_path, *sensor)
        assert code == 1
        assert out.splitlines()[0].split("  ")[-2].strip() == "warp mm"
        assert float(out.splitlines()[2].split()[-2]) == pytest.approx(12.0, rel=0.05)
        assert "bowl: warp is 1" in out


# -- intrinsics ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def shots(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("shots")
    for n, pose in enumerate(good_poses()[:8]):
        Image.fromarray(rendered(pose, CHARUCO)).save(folder / f"{n}.png")
    Image.fromarray(np.full((480, 640), 90, np.uint8)).save(folder / "dark.png")
    return folder


def test_intrinsics_are_written_with_their_evidence(capsys, tmp_path: Path, shots: Path):
    out_file = tmp_path / "cell.yaml"
    known = Calibration(
        transforms={"base_from_wrist": MOUNT_FROM_CAMERA}, evidence={"base_from_wrist": Evidence(method="tape")}
    )
    write_calibration(out_file, known)
    options = [
        "--board",
        CHARUCO,
        "--camera",
        "wrist",
        "--coefficients",
        "4",
        "--out",
        out_file,
        "--date",
        "2026-01-31",
    ]
    code, out, err = run(capsys, "calib", "intrinsics", shots, *options)
    assert (code, err) == (0, "")
    assert "no board in dark.png" in out
    assert "verdict  pass" in out
    found = read_calibration(out_file)
    assert abs(float(found.camera("wrist").intrinsics[0, 0, 0]) / 604.0 - 1) < 0.005
    assert found.evidence["wrist"].date == "2026-01-31"
    assert found.evidence["wrist"].num_observations == 8
    assert torch.equal(found.transforms["base_from_wrist"], MOUNT_FROM_CAMERA)  # what was there is kept


def test_intrinsics_that_do_not_pass_are_not_written(capsys, tmp_path: Path, shots: Path):
    few = sorted(shots.glob("[0-3].png"))
    code, out, err = run(capsys, "calib", "intrinsics", *few, "--board", CHARUCO, "--out", tmp_path / "c.yaml")
    assert (code, out) == (1, "")
    assert "4 views of the board; at least 6" in err
    assert not (tmp_path / "c.yaml").exists()


def test_a_board_that_is_none_is_a_wrong_call(capsys, shots: Path):
    code, _, err = run(capsys, "calib", "intrinsics", shots, "--board", "chessboard:9x6:25")
    assert code == 2
    assert "metres, not millimetres" in err


# -- hand-eye ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("setup", "name"), [("eye-in-hand", "tool_from_cam"), ("eye-to-hand", "base_from_cam")])
def test_hand_eye_is_written_under_its_name(capsys, tmp_path: Path, setup: str, name: str):
    (tmp_path / "poses.json").write_text(json.dumps(plain(robot_poses(camera_poses(12), setup=setup, noise=0.2))))
    options = ["--setup", setup, "--camera", "cam", "--gripper", "tool", "--out", tmp_path / "cell.yaml"]
    code, out, err = run(capsys, "calib", "hand-eye", tmp_path / "poses.json", *options)
    assert (code, err) == (0, "")
    for word in ("OpenCV Tsai", "Park-Martin", "least squares over all poses", "pose11", "translation RMS", name):
        assert word in out
    found = read_calibration(tmp_path / "cell.yaml")
    assert apart(found.transforms[name], MOUNT_FROM_CAMERA)[0] < 0.5
    assert found.evidence[name].num_observations == 12
    assert found.evidence[name].residuals["translation_rms_m"] < 0.002
    assert found.evidence[name].date is None


def test_the_wrong_setup_writes_nothing_and_says_so(capsys, tmp_path: Path):
    (tmp_path / "poses.json").write_text(json.dumps(plain(robot_poses(camera_poses(12), noise=0.2))))
    options = ["--setup", "eye-to-hand", "--out", tmp_path / "cell.yaml"]
    code, out, _ = run(capsys, "calib", "hand-eye", tmp_path / "poses.json", *options)
    assert code == 1
    assert "verdict  FAIL: nothing is written" in out
    assert "the poses fit as eye-in-hand: check --setup" in out
    assert not (tmp_path / "cell.yaml").exists()


def test_target_poses_are_found_in_images(capsys, tmp_path: Path):
    seen = camera_poses(8, seed=3, degrees=25.0)
    exact = plain(robot_poses(seen))
    for n, pose in enumerate(seen):
        Image.fromarray(rendered(pose, CHARUCO)).save(tmp_path / f"{n}.png")
        del exact["poses"][n]["camera_from_target"]
        exact["poses"][n]["image"] = f"{n}.png"
    (tmp_path / "poses.json").write_text(json.dumps(exact))
    write_calibration(tmp_path / "cell.yaml", Calibration(cameras={"cam": CAMERA}))
    common = ["calib", "hand-eye", tmp_path / "poses.json", "--setup", "eye-in-hand", "--camera", "cam"]
    cell = ["--calibration", tmp_path / "cell.yaml"]
    code, _, err = run(capsys, *common, *cell, "--board", CHARUCO, "--out", tmp_path / "cell.yaml")
    assert (code, err) == (0, "")
    found = read_calibration(tmp_path / "cell.yaml")
    millimetres, degrees = apart(found.transform("gripper", "cam"), MOUNT_FROM_CAMERA)
    assert millimetres < 2.0  # eight poses, corners found in the images
    assert degrees < 0.2
    for options, message in [
        ([*cell, "--board", "chessboard:8x6:0.025"], "looks the same turned by half a turn"),
        (cell, "--board and --calibration go together"),
    ]:
        code, _, err = run(capsys, *common, *options)
        assert code == 2
        assert message in err


def test_help_and_debug_are_known_to_every_step(capsys, tmp_path: Path):
    for step in ("check", "intrinsics", "hand-eye"):
        code, out, _ = run(capsys, "calib", step, "--help")
        assert code == 0
        assert out.startswith(f"usage: pcdata calib {step}")
    with pytest.raises(ValueError, match="no such file"):
        main(["calib", "hand-eye", str(tmp_path / "none.csv"), "--setup", "eye-in-hand", "--debug"])


def test_build_takes_a_calibration_file(capsys, tmp_path: Path, walls: Path):
    camera = wall().camera
    write_calibration(
        tmp_path / "cell.yaml", Calibration(cameras={"cam": camera}, transforms={"base_from_cam": HOLDER_FROM_TARGET})
    )
    (tmp_path / "c.yaml").write_text("depth: [Deproject]\ncloud: [ToFrame: {frame: base}]\n")
    options = ["--source", walls, "--out", tmp_path / "set", "--frame", "base"]
    code, _, err = run(capsys, "build", tmp_path / "c.yaml", *options, "--calibration", tmp_path / "cell.yaml")
    assert code == 0, err
    code, _, err = run(capsys, "build", tmp_path / "c.yaml", *options, "--overwrite")
    assert code != 0  # without it the camera's place in the base frame is not known
