"""The calibration file: what is written comes back, what is wrong is named with its place, frames chain."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from pcdata.errors import CalibrationError, CaptureError, ConfigError, FrameError
from pcdata.io import open_source, read_calibration, write_calibration, write_depth
from pcdata.structures import Calibration, Evidence
from tests.calibrations import camera, cell
from tests.messages import check_fault_is_told

GOOD = """\
format: pcdata-calibration
version: 1
unit: metre
cameras:
  wrist: {model: opencv, width: 640, height: 480, fx: 600.5, fy: 601, cx: 320, cy: 240.25, distortion: [0.1, 0, 0, 0]}
transforms:
  gripper_from_wrist:
    translation: [0.1, 0.2, 0.3]
    quaternion_xyzw: [0, 0, 0, 1]
    evidence: {method: by hand, num_observations: 12, residuals: {translation_rms_m: 1e-3}, date: 2026-01-31}
"""


# -- file ----------------------------------------------------------------------------------------------------------


def test_what_is_saved_is_loaded_bit_for_bit(tmp_path: Path) -> None:
    write_calibration(tmp_path / "cell.yaml", cell())
    back = read_calibration(tmp_path / "cell.yaml")
    assert {name: one.to_dict() for name, one in back.cameras.items()} == {
        name: one.to_dict() for name, one in cell().cameras.items()
    }
    assert back.transforms.keys() == cell().transforms.keys()
    assert all(torch.equal(back.transforms[name], matrix) for name, matrix in cell().transforms.items())
    assert back.evidence == cell().evidence


def test_equal_calibrations_are_equal_bytes_and_leave_no_other_file(tmp_path: Path) -> None:
    write_calibration(tmp_path / "a.yaml", cell())
    write_calibration(tmp_path / "b.yaml", read_calibration(tmp_path / "a.yaml"))
    assert (tmp_path / "a.yaml").read_bytes() == (tmp_path / "b.yaml").read_bytes()
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a.yaml", "b.yaml"]


def test_a_file_written_by_hand_is_read_as_it_says(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text(GOOD)
    found = read_calibration(tmp_path / "c.yaml")
    wrist = found.camera()
    assert wrist.size == (480, 640)
    assert wrist.intrinsics[0].tolist() == [[600.5, 0, 320], [0, 601, 240.25], [0, 0, 1]]
    assert wrist.distortion is not None
    assert wrist.distortion.tolist() == [[0.1, 0, 0, 0]]
    assert found.transform("gripper", "wrist")[:3].tolist() == [[1, 0, 0, 0.1], [0, 1, 0, 0.2], [0, 0, 1, 0.3]]
    assert found.evidence["gripper_from_wrist"] == Evidence(
        method="by hand", num_observations=12, residuals={"translation_rms_m": 0.001}, date="2026-01-31"
    )


def test_a_quaternion_and_a_rotation_vector_say_the_same_rotation(tmp_path: Path) -> None:
    half = 2**-0.5
    texts = (f"quaternion_xyzw: [0, 0, {half}, {half}]", "rotation_vector: [0, 0, 1.5707963267948966]")
    for number, text in enumerate(texts):
        (tmp_path / f"{number}.yaml").write_text(GOOD.replace("quaternion_xyzw: [0, 0, 0, 1]", text))
    first, second = (read_calibration(tmp_path / f"{n}.yaml").transforms["gripper_from_wrist"] for n in (0, 1))
    torch.testing.assert_close(first, second, atol=1e-12, rtol=0)
    torch.testing.assert_close(first[:3, 0], torch.tensor([0.0, 1, 0], dtype=torch.float64), atol=1e-12, rtol=0)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("cameras:", "camera:", r"4:1: a calibration: no such key 'camera'; did you mean 'cameras'"),
        ("pcdata-calibration", "kalibr", r"1:9: format must be 'pcdata-calibration', got 'kalibr'"),
        ("version: 1", "version: 2", r"2:10: version must be 1, got 2; a file of another version"),
        ("unit: metre\n", "", r"1:1: a calibration: 'unit' is missing"),
        ("unit: metre", "unit: millimetre", r"3:7: unit must be 'metre', got 'millimetre'; convert"),
        ("fx: 600.5, ", "", r"5:10: camera 'wrist': 'fx' is missing"),
        ("fx: 600.5", "fx: -600.5", r"5:3: camera 'wrist': .*focal lengths must be positive"),
        ("fx: 600.5", "fx: .nan", r"5:55: camera 'wrist': fx must be a finite number, got nan"),
        ("fx: 600.5", "Fx: 600.5", r"no such key 'Fx'; did you mean 'fx'"),
        ("fx: 600.5", "fx: 1" + "0" * 400, r"fx must be a finite number, got 10000"),
        ("width: 640", "width: 640.5", r"width must be a whole number from 1 to 65536, got 640.5"),
        ("cx: 320", "cx: 900", r"principal point .* outside the 640x480 image"),
        ("[0.1, 0, 0, 0]", "[0.1, 0, 0]", r"distortion must be a list of 4 or 5 or 8 or 12 or 14 numbers, got 3"),
        (
            "model: opencv",
            "model: panini",
            r"5:18: camera 'wrist': model must be one of pinhole, opencv, .*, got 'panini'",
        ),
        ("model: opencv", "model: pinhole", r"model pinhole has no distortion"),
        ("gripper_from_wrist", "gripper_to_wrist", r"7:3: a transform is named to_from, .* got 'gripper_to_wrist'"),
        ("gripper_from_wrist", "wrist_from_wrist", r"7:3: a transform is named to_from"),
        ("[0, 0, 0, 1]", "[0, 0, 0, 0.9]", r"9:22: .*quaternion_xyzw must have length 1, has 0.9"),
        ("[0, 0, 0, 1]", "[0, 0, 1]", r"quaternion_xyzw must be a list of 4 numbers, got 3"),
        ("quaternion_xyzw: [0, 0, 0, 1]", "rotation_vector: [0, 0, 90]", r"in radians; is this in degrees"),
        ("[0.1, 0.2, 0.3]", "[100, 200, 300]", r"8:18: gripper_from_wrist: .* 374.166 m long; is it in millimetres"),
        ("    translation: [0.1, 0.2, 0.3]\n", "", r"give matrix alone, or translation with .*; got quaternion_xyzw"),
        ("method: by hand, ", "", r"evidence: 'method' is missing"),
        ("num_observations: 12", "num_observations: many", r"num_observations must be a whole number"),
        ("residuals", "residual", r"no such key 'residual'; did you mean 'residuals'"),
        ("transforms:", "  wrist: {}\ntransforms:", r"6:3: cameras: 'wrist' is given twice"),
        ("by hand", "*alias", r"aliases .* are not allowed"),
        ("by hand", "!<tag:yaml.org,2002:python/name:os.system> ''", r"YAML tags .* are not allowed"),
        ("fx: 600.5", "fx: !<tag:yaml.org,2002:python/name:os.system> ''", r"YAML tags .* are not allowed"),
    ],
)
def test_a_fault_is_named_with_its_place(tmp_path: Path, old: str, new: str, message: str) -> None:
    check_fault_is_told(read_calibration, tmp_path / "c.yaml", GOOD, old, new, message)


def test_all_faults_are_told_at_once(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text(GOOD.replace("fx:", "Fx:").replace("0.3]", "x]").replace("unit: metre\n", ""))
    with pytest.raises(CalibrationError) as caught:
        read_calibration(tmp_path / "c.yaml")
    assert str(caught.value).count("c.yaml:") == 4  # unit missing; Fx unknown; fx missing; x no number


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1.01, 0], [0, 0, 0, 1]]", "not rigid"),
        ("[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]", "mirror"),
        ("[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 2, 3, 1]]", "transposed"),
        ("[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]", "four rows"),
    ],
)
def test_a_matrix_that_is_no_pose_is_refused(tmp_path: Path, rows: str, message: str) -> None:
    text = "format: pcdata-calibration\nversion: 1\nunit: metre\ntransforms:\n  a_from_b: {matrix: " + rows + "}\n"
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(CalibrationError, match=rf"c\.yaml:5:22: a_from_b.*{message}"):
        read_calibration(tmp_path / "c.yaml")


def test_a_file_that_is_not_there_is_a_capture_error(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="no such file"):
        read_calibration(tmp_path / "none.yaml")


def test_a_loop_in_a_file_is_named_with_its_place(tmp_path: Path) -> None:
    again = "  wrist_from_gripper: {translation: [0, 0, 0], rotation_vector: [0, 0, 0]}\n"
    (tmp_path / "c.yaml").write_text(GOOD + again)
    with pytest.raises(CalibrationError, match=r"c\.yaml:11:3: wrist_from_gripper: .* two ways"):
        read_calibration(tmp_path / "c.yaml")


# -- captures ------------------------------------------------------------------------------------------------------


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    root = tmp_path / "capture"
    (root / "depth").mkdir(parents=True)
    write_depth(root / "depth" / "0.png", torch.full((6, 8), 0.5), metres_per_unit=0.001)
    stated = {"width": 8, "height": 6, "fx": 10.0, "fy": 10.0, "cx": 3.5, "cy": 2.5, "metres_per_unit": 0.001}
    (root / "intrinsics.json").write_text(json.dumps(stated))
    return root


def test_a_calibration_file_replaces_the_camera_of_a_capture_and_gives_its_pose(capture: Path) -> None:
    write_calibration(capture.parent / "cell.yaml", cell())
    source = open_source(capture, calibration=capture.parent / "cell.yaml", camera="right", frame_id="table")
    frame = source.load("0")
    assert torch.equal(frame.camera.intrinsics, camera().intrinsics)
    assert frame.world_from_camera is not None
    assert torch.equal(frame.world_from_camera[0], cell().transform("table", "right"))
    assert frame.frame_id == "table"
    assert (frame.provenance["calibration"], frame.provenance["camera"]) == ("cell.yaml", "right")


def test_poses_of_the_capture_stay_and_a_frame_not_asked_for_gives_none(capture: Path) -> None:
    assert open_source(capture, calibration=cell(), camera="left").load("0").world_from_camera is None
    (capture / "poses").mkdir()
    (capture / "poses" / "0.txt").write_text("1 0 0 7  0 1 0 0  0 0 1 0  0 0 0 1")
    frame = open_source(capture, calibration=cell(), camera="left", frame_id="base").load("0")
    assert frame.world_from_camera is not None
    assert frame.world_from_camera[0, 0, 3] == 7
    assert frame.camera.intrinsics[0, 1, 1] == 601.1


def test_a_calibration_that_does_not_fit_the_capture_is_refused(capture: Path) -> None:
    with pytest.raises(CaptureError, match="is 8x6 but camera 'c' of the calibration is 10x10"):
        open_source(capture, calibration=Calibration(cameras={"c": camera(size=(10, 10))}))
    with pytest.raises(FrameError, match="no frame 'bass'; did you mean 'base'"):
        open_source(capture, calibration=cell(), camera="left", frame_id="bass")
    with pytest.raises(ConfigError, match=r"camera='left'.*calibration"):
        open_source(capture, camera="left")
