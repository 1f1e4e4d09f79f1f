"""Do the poses lead where they say? Views of one still scene agree under the right convention alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from pcdata.functional import rigid
from pcdata.functional.view_agreement import Agreement, view_agreement
from pcdata.structures import DepthFrame
from pcdata.validation.check import Check, Verdict

NAME = "pose_direction"
_OPENGL = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
_LEAST_COMPARED = 200  # readings that two views must share before they can be said to agree or not
_AGREE = 0.5  # of the readings compared: under a wrong pose few agree, and those by chance
_SURE = 0.9  # when so many agree, no other convention can agree much better
_MARGIN = 0.1  # by which another convention must agree better to be named
_LEAST_MOTION = (0.02, 0.035)  # metres, radians: closer cameras agree under every convention


class PosedView(NamedTuple):
    """One view with its pose."""

    sample_id: str
    depth: Tensor  # (H, W)
    intrinsics: Tensor  # (3, 3)
    distortion: Tensor | None
    pose: Tensor  # (4, 4) world_from_camera as given


def _with_translation(pose: Tensor, factor: float) -> Tensor:
    scaled = pose.clone()
    scaled[:3, 3] *= factor
    return scaled


def _transposed_rotation(pose: Tensor) -> Tensor:
    turned = pose.clone()
    turned[:3, :3] = pose[:3, :3].mT
    return turned


# What the poses may be instead of world_from_camera: the mistake in words, and the poses set right.
CONVENTIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "camera_from_world, the inverse of what is needed": rigid.invert_rigid,
    "rotations stored transposed": _transposed_rotation,
    "poses of OpenGL cameras (y up, z backwards)": lambda pose: pose @ _OPENGL.to(pose.device),
    "translations in millimetres": lambda pose: _with_translation(pose, 1e-3),
    "translations in centimetres": lambda pose: _with_translation(pose, 1e-2),
}


def posed_views(frame: DepthFrame) -> list[PosedView]:
    """Return the views of a frame with their poses; none where there are no poses."""
    if frame.world_from_camera is None:
        return []
    camera = frame.camera
    lenses: Sequence[Tensor | None] = [None] * frame.num_views if camera.distortion is None else list(camera.distortion)
    return [
        PosedView(frame.sample_id, depth, k, lens, pose)
        for depth, k, lens, pose in zip(frame.depth, camera.intrinsics, lenses, frame.world_from_camera)
    ]


class PoseDirectionOverTime:
    """Compares each capture of a moving camera with an earlier one of the same camera; keeps one depth image."""

    def __init__(self) -> None:
        self._earlier: PosedView | None = None

    def check(self, frame: DepthFrame) -> list[Check]:
        """Judge the pose of the next capture; says nothing until the camera has moved."""
        views = posed_views(frame)
        if len(views) != 1:
            return []
        earlier, now = self._earlier, views[0]
        if earlier is None:
            self._earlier = now
            return []
        if not _moved(earlier.pose, now.pose):
            return []
        self._earlier = now
        return [direction_check([(earlier, now)], f"{earlier.sample_id!r} and this capture")]


def direction_checks(frame: DepthFrame) -> list[Check]:
    """Judge the poses of a frame with several views, each with the next one."""
    views = posed_views(frame)
    pairs = [(a, b) for a, b in pairwise(views) if _moved(a.pose, b.pose)]
    return [direction_check(pairs, "the views")] if pairs else []


def direction_check(pairs: Sequence[tuple[PosedView, PosedView]], who: str) -> Check:
    """Compare how well views agree with the poses as given and with the poses as other conventions read them."""
    given = _agreement(pairs, lambda pose: pose)
    share = _share(given)
    verdict, advice = Verdict.PASS, ""
    found = f"{who} agree at {100 * share:.0f} % of {given.compared:,} readings that both can see"
    shares = {name: _share(_agreement(pairs, read)) for name, read in CONVENTIONS.items()} if share < _SURE else {}
    name = max(shares, key=lambda one: shares[one], default="")
    if shares and shares[name] >= max(_AGREE, share + _MARGIN):
        verdict = Verdict.FAIL
        found += f"; {100 * shares[name]:.0f} % would if the poses were {name}"
        advice = f"the poses look like {name}: convert them to world_from_camera with OpenCV axes, in metres"
    elif given.compared < _LEAST_COMPARED:
        verdict, found = Verdict.WARN, f"not measurable: {who} see hardly anything in common"
    elif share < _AGREE:
        verdict = Verdict.WARN
        advice = "the views agree under no convention: is the calibration old, the scene moving, the unit wrong?"
    return Check(
        name=NAME,
        verdict=verdict,
        found=found,
        value=share if given.compared >= _LEAST_COMPARED else None,
        threshold=_AGREE,
        fails_at=_AGREE,
        advice=advice,
    )


def _agreement(pairs: Sequence[tuple[PosedView, PosedView]], read: Callable[[Tensor], Tensor]) -> Agreement:
    """Carry each view of a pair into the other and add up."""
    total = Agreement(0, 0)
    for first, second in pairs:
        for a, b in ((first, second), (second, first)):
            b_from_a = rigid.invert_rigid(read(b.pose)) @ read(a.pose)
            one = view_agreement(
                a.depth,
                b.depth,
                a.intrinsics,
                b.intrinsics,
                b_from_a,
                distortion_a=a.distortion,
                distortion_b=b.distortion,
            )
            total = Agreement(total.agree + one.agree, total.compared + one.compared)
    return total


def _share(agreement: Agreement) -> float:
    return agreement.agree / max(agreement.compared, _LEAST_COMPARED)


def _moved(a: Tensor, b: Tensor) -> bool:
    motion = rigid.invert_rigid(a) @ b
    turn = torch.linalg.matrix_norm(motion[:3, :3] - torch.eye(3, dtype=motion.dtype, device=motion.device)) / 2**0.5
    return bool(motion[:3, 3].norm() > _LEAST_MOTION[0]) or bool(turn > _LEAST_MOTION[1])
