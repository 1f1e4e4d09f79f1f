from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pcdata import io
from pcdata.errors import CaptureError, PoseError, UnitError
from pcdata.structures import Camera

GOOD: dict[str, Any] = {"width": 640, "height": 480, "fx": 585.5, "fy": 584.5, "cx": 320.25, "cy": 240.75}


def write(path: Path, content: Any) -> Path:
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_every_number_of_a_calibration_arrives_where_it_belongs(tmp_path: Path) -> None:
    extra = {"distortion": [0.1, -0.2, 0.01, 0.02, 0.3], "metres_per_unit": 0.001, "frame_id": "base", "notes": "x"}
    calibration = io.read_capture_camera(write(tmp_path / "c.json", GOOD | extra))
    assert calibration.camera.size == (480, 640)
    assert calibration.camera.intrinsics[0].tolist() == [[585.5, 0, 320.25], [0, 584.5, 240.75], [0, 0, 1]]
    assert calibration.camera.distortion is not None
    assert calibration.camera.distortion[0].tolist() == extra["distortion"]
    assert (calibration.metres_per_unit, calibration.frame_id) == (0.001, "base")


def test_what_a_calibration_does_not_say_is_none(tmp_path: Path) -> None:
    calibration = io.read_capture_camera(write(tmp_path / "c.json", GOOD))
    assert (calibration.camera.distortion, calibration.metres_per_unit, calibration.frame_id) == (None, None, None)


@pytest.mark.parametrize("distortion", [None, [0.1, 1 / 3, 0.0, 1e-17]])
def test_a_written_calibration_reads_back_exactly(tmp_path: Path, distortion: list[float] | None) -> None:
    camera = Camera.pinhole(fx=1 / 3 * 1000, fy=601.1, cx=1.1, cy=2.2, size=(4, 6), distortion=distortion)
    io.write_capture_camera(
        tmp_path / "c.json", io.CaptureCamera(camera=camera, metres_per_unit=0.00025, frame_id="table")
    )
    back = io.read_capture_camera(tmp_path / "c.json")
    assert back.camera.to_dict() == camera.to_dict()
    assert (back.metres_per_unit, back.frame_id) == (0.00025, "table")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            {k: v for k, v in GOOD.items() if k != "fx"} | {"Fx": 1},
            "'fx' is missing, 'Fx' is not known; did you mean 'fx'",
        ),
        (GOOD | {"distorsion": [0, 0, 0, 0]}, "'distorsion' is not known; did you mean 'distortion'"),
        (GOOD | {"depth_scale": 1000}, "three incompatible meanings"),
        (GOOD | {"fx": -585}, "focal lengths must be positive"),
        (GOOD | {"fx": 0}, "focal lengths must be positive"),
        (GOOD | {"fx": "585"}, "'fx' must be a number"),
        (GOOD | {"fx": True}, "'fx' must be a number"),
        (GOOD | {"fx": 10**400}, "'fx' must be a finite number"),
        (GOOD | {"cx": 1000}, r"principal point .* outside the 640x480 image.*Camera\.resized"),
        (GOOD | {"width": 640.5}, "'width' must be a whole number"),
        (GOOD | {"height": 0}, "'height' must be a whole number"),
        (GOOD | {"distortion": [1, 2, 3]}, "'distortion' must be a list of 4, 5, 8, 12"),
        (GOOD | {"distortion": [1, 2, 3, None]}, "'distortion' must be a number"),
        (GOOD | {"frame_id": ""}, "'frame_id' must be a name"),
        (json.dumps(GOOD).replace("585.5", "NaN"), "NaN is not a finite number"),
        (json.dumps(GOOD).replace("585.5", "Infinity"), "Infinity is not"),
        ('{"fx": 1, "fx": 2}', "given twice"),
        ("[1, 2]", "must be a JSON object"),
        ("{", "not valid JSON"),
        ("[" * 100_000, "not valid JSON"),
        ("", "is empty"),
        ("x" * (1 << 21), "more than the limit"),
    ],
)
def test_a_wrong_calibration_is_refused_with_the_reason_and_the_file(
    tmp_path: Path, content: Any, message: str
) -> None:
    with pytest.raises(CaptureError, match=message) as caught:
        io.read_capture_camera(write(tmp_path / "c.json", content))
    assert str(tmp_path / "c.json") in str(caught.value)


def test_a_divisor_is_refused_as_metres_per_unit(tmp_path: Path) -> None:
    with pytest.raises(UnitError, match="at most 1, got 1000"):
        io.read_capture_camera(write(tmp_path / "c.json", GOOD | {"metres_per_unit": 1000}))


def test_binary_files_are_refused_as_calibration(tmp_path: Path) -> None:
    (tmp_path / "c.json").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(CaptureError, match="UTF-8"):
        io.read_capture_camera(tmp_path / "c.json")


def test_intrinsics_text_gives_the_matrix_and_takes_the_size(tmp_path: Path) -> None:
    camera = io.read_intrinsics(write(tmp_path / "k.txt", "585 0 320\n0 584 240\n0 0 1\n"), size=(480, 640))
    assert camera.intrinsics[0].tolist() == [[585, 0, 320], [0, 584, 240], [0, 0, 1]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("585 0 320 0 585 240 0 0", "nine numbers, got 8"),
        ("585 0 0 0 585 0 320 240 1", "transposed"),
        ("585 0 320 0 x 240 0 0 1", "numbers only"),
        ("nan 0 320 0 585 240 0 0 1", "NaN"),
        ("585 0 1320 0 585 240 0 0 1", "outside"),
    ],
)
def test_wrong_intrinsics_text_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(CaptureError, match=message):
        io.read_intrinsics(write(tmp_path / "k.txt", text), size=(480, 640))


def pose_matrix() -> torch.Tensor:
    rotation, _ = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3)))
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation * torch.linalg.det(rotation).sign()
    pose[:3, 3] = torch.tensor([0.1, -2.0, 1 / 3])
    return pose


def test_a_written_pose_reads_back_exactly(tmp_path: Path) -> None:
    io.write_pose(tmp_path / "p.txt", pose_matrix())
    assert torch.equal(io.read_pose(tmp_path / "p.txt"), pose_matrix())
    np.save(tmp_path / "p.npy", pose_matrix().numpy())
    assert torch.equal(io.read_pose(tmp_path / "p.npy"), pose_matrix())


def rows(matrix: torch.Tensor) -> str:
    return "\n".join(" ".join(map(str, row)) for row in matrix.tolist())


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (pose_matrix() * torch.tensor([[2.0], [2.0], [2.0], [1.0]]), "not rigid"),
        (pose_matrix() * torch.tensor([[-1.0], [1.0], [1.0], [1.0]]), "mirror"),
        (pose_matrix().T, "rigid|last row"),
        (torch.full((4, 4), -torch.inf, dtype=torch.float64), "tracking lost"),
        (torch.full((4, 4), torch.nan, dtype=torch.float64), "tracking lost"),
    ],
)
def test_a_pose_that_is_not_rigid_is_refused_with_its_file(tmp_path: Path, pose: torch.Tensor, message: str) -> None:
    with pytest.raises(PoseError, match=message) as caught:
        io.read_pose(write(tmp_path / "p.txt", rows(pose)))
    assert "p.txt" in str(caught.value)


def test_a_pose_of_other_shape_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="got 7; a place and a quaternion are seven: write the matrix"):
        io.read_pose(write(tmp_path / "q.txt", "0.1 0.2 0.3 0 0 0 1"))
    with pytest.raises(CaptureError, match="got 12; the last row 0 0 0 1 is missing"):
        io.read_pose(write(tmp_path / "p.txt", "1 0 0 0 0 1 0 0 0 0 1 0"))
    np.save(tmp_path / "p.npy", np.eye(3))
    with pytest.raises(CaptureError, match=r"\(4, 4\)"):
        io.read_pose(tmp_path / "p.npy")
    np.save(tmp_path / "p.npy", np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(CaptureError, match=r"not a readable \.npy"):
        io.read_pose(tmp_path / "p.npy")
