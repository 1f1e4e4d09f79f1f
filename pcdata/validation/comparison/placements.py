"""What is placed in a frame can be compared only against a place that both sources share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcdata.validation.comparison.description import Series

_LEVEL = 45.0  # degrees: a plane that is steeper has no height
_STILL = (0.001, 0.1)  # metres and degrees: a camera that wanders by less stands


def place(a: Series, b: Series, views: list[int | None]) -> None:
    """Add ``table_height`` and ``table_tilt``, ``camera_x`` to ``camera_z`` and ``turned_x`` to ``turned_z``.

    Heights are those of the planes at the middle of all tables; turns are about the mean of all poses, in the axes of
    the camera.
    """
    for view in views:
        middle = _median(np.concatenate([one.columns("center", 3, view) for one in (a, b)]))
        for one in (a, b):
            plane = one.columns("plane", 4, view)
            with np.errstate(invalid="ignore", divide="ignore"):
                tilt = np.degrees(np.arccos(np.clip(np.abs(plane[:, 2]), 0, 1)))
                height = -(plane[:, 0] * middle[0] + plane[:, 1] * middle[1] + plane[:, 3]) / plane[:, 2]
                level = tilt <= _LEVEL
            one.set("table_tilt", view, np.where(level, tilt, np.nan))
            one.set("table_height", view, np.where(level, height, np.nan))
        poses = [one.columns("pose", 12, view).reshape(-1, 3, 4) for one in (a, b)]
        mean = _mean_rotation(np.concatenate(poses)[:, :, :3])
        for one, own in zip((a, b), poses):
            for axis, name in enumerate("xyz"):
                one.set(f"camera_{name}", view, own[:, axis, 3])
            if mean is not None:
                for axis, name in enumerate("xyz"):
                    one.set(f"turned_{name}", view, _turns(mean.T @ own[:, :, :3])[:, axis])


def stands(one: Series, view: int | None) -> bool | None:
    """Whether the camera of a view has one pose in all captures; None where poses are not known or too few."""
    known = [one.values(f"{kind}_{axis}", view) for kind in ("camera", "turned") for axis in "xyz"]
    if any(np.isfinite(column).sum() < 3 for column in known):
        return None
    spread = [float(np.nanstd(column)) for column in known]
    return max(spread[:3]) < _STILL[0] and max(spread[3:]) < _STILL[1]


def _median(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    known = rows[np.isfinite(rows).all(1)]
    return np.median(known, axis=0) if len(known) else np.zeros(rows.shape[1])


def _mean_rotation(rotations: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the rotation nearest to the sum of all."""
    known = rotations[np.isfinite(rotations).all((1, 2))]
    if not len(known):
        return None
    u, _, vt = np.linalg.svd(known.sum(0))
    nearest: NDArray[np.float64] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return nearest


def _turns(rotations: NDArray[np.float64]) -> NDArray[np.float64]:  # (N, 3, 3) -> (N, 3) degrees
    """Return rotation vectors; NaN of rotations that are not known."""
    from scipy.spatial.transform import Rotation

    turns = np.full((len(rotations), 3), np.nan)
    known = np.isfinite(rotations).all((1, 2))
    if known.any():
        turns[known] = np.degrees(Rotation.from_matrix(rotations[known]).as_rotvec())
    return turns
