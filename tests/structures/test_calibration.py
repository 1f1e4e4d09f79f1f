"""Calibrations: frames chain and invert, what cannot be one is refused."""

from __future__ import annotations

import pytest
import torch

from pcdata.errors import CalibrationError, FrameError, PoseError
from pcdata.structures import Calibration, Evidence
from tests.calibrations import camera, cell, pose


def test_transforms_chain_and_invert_through_the_frames_between() -> None:
    found = cell().transform("table", "right")
    expected = torch.linalg.inv(pose(3)) @ pose(1) @ torch.linalg.inv(pose(2))
    torch.testing.assert_close(found, expected, atol=1e-12, rtol=0)
    torch.testing.assert_close(
        cell().transform("right", "table") @ found, torch.eye(4, dtype=torch.float64), atol=1e-12, rtol=0
    )


def test_a_frame_seen_from_itself_is_the_identity() -> None:
    assert torch.equal(cell().transform("left", "left"), torch.eye(4, dtype=torch.float64))


def test_unknown_and_unconnected_frames_are_refused() -> None:
    with pytest.raises(FrameError, match="no frame 'bas'; did you mean 'base'"):
        cell().transform("bas", "left")
    apart = Calibration(cameras={"left": camera()}, transforms={"base_from_table": pose(1)})
    with pytest.raises(FrameError, match=r"nothing joins 'base' and 'left'; .* no other frame"):
        apart.transform("base", "left")


@pytest.mark.parametrize("name", ["base_from_right", "left_from_base", "right_from_table"])
def test_a_second_way_between_frames_is_refused(name: str) -> None:
    with pytest.raises(CalibrationError, match=f"{name}: .* two ways would give two answers"):
        Calibration(transforms={**cell().transforms, name: pose(9)})


def test_replacing_a_transform_drops_the_evidence_of_the_old_one() -> None:
    changed = cell().with_transform("left_from_base", pose(7), Evidence(method="tape"))
    assert torch.equal(changed.transforms["left_from_base"], pose(7))
    assert "base_from_left" not in changed.transforms
    assert set(changed.evidence) == {"left", "left_from_base"}
    assert set(cell().with_camera("left", camera()).evidence) == {"base_from_left"}


def test_what_is_no_calibration_is_refused() -> None:
    with pytest.raises(PoseError, match="not rigid"):
        Calibration(transforms={"a_from_b": 2 * torch.eye(4, dtype=torch.float64)})
    far = torch.eye(4, dtype=torch.float64)
    far[0, 3] = 500
    with pytest.raises(PoseError, match="in millimetres"):
        Calibration(transforms={"a_from_b": far})
    with pytest.raises(CalibrationError, match="evidence for 'x'"):
        Calibration(evidence={"x": Evidence(method="none")})
    with pytest.raises(CalibrationError, match="no camera 'lef'; did you mean 'left'"):
        cell().camera("lef")
    with pytest.raises(CalibrationError, match="say which camera; it has left, right"):
        cell().camera()
