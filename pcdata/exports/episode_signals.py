"""States and actions out of the signals of clouds, each in the coordinates of its cloud."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.errors import CaptureError, near_matches
from pcdata.structures import DepthFrame, PointCloud
from pcdata.structures.signal_kinds import poses_in_a_row
from pcdata.structures.signals import Signal, cloud_from_frame, is_frame_of_camera

_STILL = 1e-6  # metres and parts of a rotation by which the poses of a camera that stands still may differ


def signal_row(
    where: str, cloud: PointCloud | DepthFrame, what: str, names: str, *, poses: str = "", free: bool = False
) -> NDArray[np.float32]:
    """Return signals of one cloud or capture side by side, as float32 (D,); with ``free`` one signal of any shape.

    Poses are written in the layout ``poses``; "" = as they were recorded, matrices as :data:`USUAL_ROW`. With ``free``
    the signal stays as it is.

    Raises:
        CaptureError: there is no such signal, or one that is no row of numbers.
    """
    parts, signals = [], cloud.signals
    for name in map(str.strip, names.split(",")):
        if name not in signals:
            known = ", ".join(signals) or "none"
            raise CaptureError(
                f"{where}: {what} is the signal {name!r}, which is not there{near_matches(name, signals)}; the "
                f"signals are: {known}; attach it to the captures (with_signal), or say {what}=NAME,NAME"
            )
        values: Any = signals[name]
        if not free:
            values = _in_a_row(cloud.recorded_signals[name].kind, values, poses)
        parts.append(_numbers(where, what, name, values, free=free))
    return np.concatenate(parts)


def next_row(
    where: str, cloud: PointCloud, following: PointCloud, names: str, *, poses: str = ""
) -> NDArray[np.float32]:
    """Return the signals of the following cloud in the coordinates of this one, side by side, as :func:`signal_row`.

    Raises:
        CaptureError: this cloud does not know the frame that one was recorded in.
    """
    parts = []
    for name in map(str.strip, names.split(",")):
        signal: Signal = following.recorded_signals[name]
        values: Any = signal.values
        if signal.frame is not None:
            if signal.frame != cloud.source_frame and signal.frame not in cloud.frames:
                raise CaptureError(
                    f"{where}: the next state {name!r} is in {signal.frame!r}, which this cloud does not know; record "
                    "all steps of an episode in one frame"
                )
            if is_frame_of_camera(cloud, signal.frame) and not _stays(cloud, following):
                raise CaptureError(
                    f"{where}: the next state {name!r} is in the frame of a camera that moves on; record it in "
                    "a frame that stands still"
                )
            values = signal.moved(cloud_from_frame(cloud, signal.frame))
        parts.append(_numbers(where, "state", name, _in_a_row(signal.kind, values, poses), free=False))
    return np.concatenate(parts)


def _in_a_row(kind: str, values: Any, poses: str) -> Any:
    return poses_in_a_row(kind, values, poses)[1] if isinstance(values, Tensor) else values


def _stays(cloud: PointCloud, following: PointCloud) -> bool:
    """Whether the frames that two clouds know lie alike for both."""
    both = cloud.frames.keys() & following.frames.keys()
    return all(torch.allclose(cloud.frames[one], following.frames[one], rtol=0.0, atol=_STILL) for one in both)


def _numbers(where: str, what: str, name: str, values: Any, *, free: bool) -> NDArray[np.float32]:
    if not isinstance(values, Tensor) or (not free and values.ndim not in (1, 2)):
        found = "a text" if not isinstance(values, Tensor) else f"of shape {tuple(values.shape[1:])}"
        way = "choose another, or record it in a row (docs/signals.md)"
        if isinstance(values, Tensor) and tuple(values.shape[1:]) == (4, 4):
            way = (
                "if it is a pose, say so where it is recorded: its kind is 'pose matrix' and it has a frame; of a "
                f"recording of a robot --signal {name}='pose matrix in FRAME'"
            )
        raise CaptureError(f"{where}: {what} must be a row of numbers, but the signal {name!r} is {found}; {way}")
    row = values[0].to("cpu", torch.float64)
    narrow: NDArray[np.float32] = np.atleast_1d(row.numpy()).astype(np.float32)
    if not np.isfinite(narrow).all():
        raise CaptureError(f"{where}: {what} has values of {name!r} that no finite float32 holds; repair the recording")
    return narrow
