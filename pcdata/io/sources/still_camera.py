"""Whether captures were taken by one camera that stood still."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from pcdata.contracts.on_host import on_host
from pcdata.errors import CaptureError
from pcdata.structures import Camera, DepthFrame

# A robot that stands still reports poses that differ by less; half a pixel at 500 pixels focal length.
MAX_SHIFT = 0.001  # metres
MAX_TURN = 0.001  # radians


def check_still_camera(where: str, frames: Sequence[DepthFrame]) -> None:
    """Require frames of equal size, intrinsics, lens, and pose where they have one.

    Raises:
        CaptureError: the first frame that differs from the first of all, and in what.
    """
    first = frames[0]
    for frame in frames[1:]:
        names = f"{where}: capture {frame.sample_id!r} and {first.sample_id!r}"
        if frame.size != first.size or frame.num_views != first.num_views:
            raise CaptureError(
                f"{names} have {frame.num_views} views of {frame.size} and {first.num_views} of {first.size}; they "
                "must come from the same cameras"
            )
        if not same_camera(frame.camera, first.camera):
            raise CaptureError(f"{names} have other intrinsics or distortion; they must come from the same cameras")
        if frame.frame_id != first.frame_id:
            raise CaptureError(f"{names} have poses in {frame.frame_id!r} and {first.frame_id!r}; they must agree")
        if frame.world_from_camera is None or first.world_from_camera is None:
            continue
        shift, turn = _motion(frame.world_from_camera, first.world_from_camera)
        if shift > MAX_SHIFT or turn > MAX_TURN:
            raise CaptureError(
                f"{names} are {1000 * shift:.1f} mm and {turn:.4f} rad apart, but the camera must stand still (within "
                f"{1000 * MAX_SHIFT:g} mm and {MAX_TURN:g} rad); fuse moving captures into a volume instead"
            )


def same_camera(one: Camera, other: Camera) -> bool:
    """Say whether two cameras have the same intrinsics and lens."""
    pairs = (one.intrinsics, other.intrinsics), (one.distortion, other.distortion)
    return all(
        (mine is None and theirs is None)
        or (mine is not None and theirs is not None and torch.equal(on_host(mine), on_host(theirs)))
        for mine, theirs in pairs
    )


def _motion(one: torch.Tensor, other: torch.Tensor) -> tuple[float, float]:
    """Return the largest shift in metres and turn in radians between (V, 4, 4) poses."""
    shift = (one[:, :3, 3] - other[:, :3, 3]).norm(dim=-1).max()
    # Of small turns: the difference of two rotations has the Frobenius norm sqrt(2) times the angle.
    turn = torch.linalg.matrix_norm(one[:, :3, :3] - other[:, :3, :3]).max() / 2**0.5
    return float(shift), float(turn)
