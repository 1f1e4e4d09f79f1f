"""A small calibration of a work cell."""

from __future__ import annotations

import torch
from torch import Tensor

from pcdata.geometry import rigid
from pcdata.structures import Calibration, Camera, Evidence


def pose(seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    quaternion = torch.randn(4, dtype=torch.float64, generator=generator)
    translation = torch.randn(3, dtype=torch.float64, generator=generator)
    return rigid.from_rotation_translation(rigid.rotation_from_quaternion(quaternion), translation)


def camera(**changes: object) -> Camera:
    values = {"fx": 1000 / 3, "fy": 601.1, "cx": 3.1, "cy": 2.2, "size": (6, 8), "distortion": [0.1, 1 / 3, 1e-17, 0.0]}
    return Camera.pinhole(**(values | changes))  # type: ignore[arg-type]


def cell() -> Calibration:
    return Calibration(
        cameras={"left": camera(), "right": camera(distortion=None)},
        transforms={"base_from_left": pose(1), "right_from_left": pose(2), "base_from_table": pose(3)},
        evidence={
            "left": Evidence(method="chessboard 9x6: squares of 0.025 m", num_observations=20, date="2026-01-31"),
            "base_from_left": Evidence(method="hand-eye", residuals={"translation_rms_m": 1 / 3000}, notes="cold"),
        },
    )
