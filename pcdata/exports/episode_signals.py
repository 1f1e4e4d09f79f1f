"""States and actions out of the signals of clouds, each in the coordinates of its cloud."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.errors import CaptureError, near_matches
from pcdata.structures import DepthFrame, PointCloud
from pcdata.structures.pose_rows import continued, poses_in_a_row
from pcdata.structures.signals import Signal, cloud_from_frame, is_frame_of_camera

_STILL = 1e-6  # metres and parts of a rotation by which the poses of a camera that stands still may differ


def signal_row(
    where: str,
    cloud: PointCloud | DepthFrame,
    what: str,
    names: str,
    *,
    poses: str = "",
    free: bool = False,
    before: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Return signals of one cloud or capture side by side, as float32 (D,); with ``free`` one signal of any shape.

    Poses are written in the layout ``poses``; "" = as they were recorded, matrices as :data:`USUAL_ROW`. With ``free``
    the signal stays as it is. With the row of the step ``before`` quaternions have the sign nearest to it, but for
    those that are written as they were recorded and in the frame that they were recorded in.

    Raises:
        CaptureError: there is no such signal, or one that is no row of numbers.
    """
    parts: list[NDArray[np.float32]] = []
    signals = cloud.signals
    for name in map(str.strip, names.split(",")):
        if name not in signals:
            known = ", ".join(signals) or "none"
            raise CaptureError(
                f"{where}: {what} is the signal {name!r}, which is not there{near_matches(name, signals)}; the "
                f"signals are: {known}; attach it to the captures (with_signal), or say {what}=NAME,NAME"
            )
        values: Any = signals[name]
        recorded = cloud.recorded_signals[name]
        values = _written(recorded, values, poses, free=free, before=_further(before, parts))
        parts.append(_numbers(where, what, name, values, free=free))
    return np.concatenate(parts)


def next_row(
    where: str,
    cloud: PointCloud,
    following: PointCloud,
    names: str,
    *,
    poses: str = "",
    before: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Return the signals of the following cloud in the coordinates of this one, side by side, as :func:`signal_row`.

    ``before`` is the state of this cloud.

    Raises:
        CaptureError: this cloud does not know the frame that one was recorded in.
    """
    parts: list[NDArray[np.float32]] = []
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
        values = _written(signal, values, poses, free=False, before=_further(before, parts))
        parts.append(_numbers(where, "state", name, values, free=False))
    return np.concatenate(parts)


def _further(before: NDArray[np.float32] | None, parts: Sequence[NDArray[np.float32]]) -> NDArray[np.float32] | None:
    """Return what of the row before stands after some parts of this one, which have the same widths."""
    return None if before is None else before[sum(map(len, parts)) :]


def _written(recorded: Signal, values: Any, poses: str, *, free: bool, before: NDArray[np.float32] | None) -> Any:
    """Return values as the row holds them; quaternions that are computed go on from those before."""
    if not isinstance(values, Tensor) or not isinstance(recorded.values, Tensor):
        return values
    kind, row = (recorded.kind, values) if free else poses_in_a_row(recorded.kind, values, poses)
    is_recorded = not poses and kind == recorded.kind and torch.equal(values, recorded.values)
    if is_recorded or before is None or before.size < row.numel():  # of a row that is narrower the caller tells
        return row
    return continued(kind, row, torch.from_numpy(before.reshape(-1)[: row.numel()]).reshape(row.shape))


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
