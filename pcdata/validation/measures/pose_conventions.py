"""What captures may be instead of ours: poses, depth and rows; and how far views agree when they are read so."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from pcdata.alignment.view_agreement import view_agreement
from pcdata.functional.depth.rendered import ray_lengths
from pcdata.geometry import rigid
from pcdata.geometry.camera_axes import CAMERA_AXES
from pcdata.structures import DepthFrame
from pcdata.structures.structure import derived

Agreement = tuple[int, int]  # of readings carried from one view into another: that agree, that were compared
Reading = Callable[[DepthFrame], DepthFrame]  # one view as given -> as it is when read by a convention

LEAST_COMPARED = 200  # readings that views must share before they can be said to agree or not
RAYS = "lengths along the rays"  # the name of that convention
AGREE = 0.5  # of the readings compared: under a wrong pose few agree, and those by chance
_LEAST_GAIN = 0.1  # by which another convention must agree better
_LEAST_MOTION = (0.02, 0.035)  # metres, radians: closer cameras agree under every convention


def _with_translation(pose: Tensor, factor: float) -> Tensor:
    scaled = pose.clone()
    scaled[:3, 3] *= factor
    return scaled


def _transposed_rotation(pose: Tensor) -> Tensor:
    turned = pose.clone()
    turned[:3, :3] = pose[:3, :3].mT
    return turned


def as_given(view: DepthFrame) -> DepthFrame:
    """Return the view itself."""
    return view


def _of_pose(read: Callable[[Tensor], Tensor]) -> Reading:
    """Return what reads the pose of a view by a function of (4, 4), and its depth as given."""
    return lambda view: derived(view, world_from_camera=read(pose_of(view))[None])


def _from_axes(name: str) -> Reading:
    return _of_pose(lambda pose: pose @ CAMERA_AXES[name].to(pose.device))


def _along_axis(view: DepthFrame) -> DepthFrame:
    """Return a view whose lengths along rays are z."""
    lengths = ray_lengths(view.size, view.camera.intrinsics, view.camera.distortion)
    return derived(view, depth=(view.depth / lengths).nan_to_num(0.0).float())


def _top_first(view: DepthFrame) -> DepthFrame:
    return derived(view, depth=view.depth.flip(1))


class _Convention(NamedTuple):
    """What a capture may be instead: the mistake in words, the captures set right, and how that is said."""

    subject: str  # of the mistake
    read: Reading
    option: str  # what reads such captures; "" = they are to be written again


# The mistake in words.
CONVENTIONS: dict[str, _Convention] = {
    "camera_from_world, the inverse of what is needed": _Convention(
        "the poses", _of_pose(rigid.invert_rigid), "--option convention.poses=camera_from_world"
    ),
    "rotations stored transposed": _Convention("the poses", _of_pose(_transposed_rotation), ""),
    "poses of OpenGL cameras (y up, z backwards)": _Convention(
        "the poses", _from_axes("opengl"), "--convention opengl"
    ),
    "view matrices of OpenGL (camera_from_world with y up, z backwards)": _Convention(
        "the poses",
        _of_pose(lambda pose: rigid.invert_rigid(pose) @ CAMERA_AXES["opengl"].to(pose.device)),
        "--convention opengl --option convention.poses=camera_from_world",
    ),
    "poses of CoppeliaSim's cameras (x left, y up)": _Convention(
        "the poses", _from_axes("coppeliasim"), "--convention coppeliasim"
    ),
    "poses of bodies (x forward, y left, z up)": _Convention("the poses", _from_axes("body"), "--convention body"),
    "translations in millimetres": _Convention("the poses", _of_pose(lambda pose: _with_translation(pose, 1e-3)), ""),
    "translations in centimetres": _Convention("the poses", _of_pose(lambda pose: _with_translation(pose, 1e-2)), ""),
    RAYS: _Convention("the depth", _along_axis, "--option convention.depth=ray"),
    "images whose bottom row is first": _Convention("the depth", _top_first, "--option convention.rows=bottom_first"),
}


def advice_of(name: str) -> str:
    """Return what to do about captures of a convention."""
    subject, _, option = CONVENTIONS[name]
    advice = f"{subject} look{'s' if subject == 'the depth' else ''} like {name}: "
    if subject == "the poses":
        advice += "convert them to world_from_camera with OpenCV axes, in metres"
        return f"{advice}, or read them so: {option}" if option else advice
    return f"{advice}read them so: {option}"


def posed_views(frame: DepthFrame) -> list[DepthFrame]:
    """Return each view of a frame, of its images the depth alone; none where there are no poses."""
    if frame.world_from_camera is None:
        return []
    bare = derived(frame, colors=None, labels=None, confidence=None, mask=None)
    return [bare.view(number) for number in range(frame.num_views)]


def pose_of(view: DepthFrame) -> Tensor:  # (4, 4) world_from_camera
    """Return the pose of a frame of one view, as it was given."""
    assert view.world_from_camera is not None
    return view.world_from_camera[0]


def agreement(a: DepthFrame, b: DepthFrame, read_a: Reading = as_given, read_b: Reading = as_given) -> Agreement:
    """Carry each of two frames of one view into the other, read so, and add up."""
    a, b = read_a(a), read_b(b)
    pose_a, pose_b = pose_of(a), pose_of(b)
    found = []
    for one, other, other_from_one in (
        (a, b, rigid.invert_rigid(pose_b) @ pose_a),
        (b, a, rigid.invert_rigid(pose_a) @ pose_b),
    ):
        found.append(
            view_agreement(
                one.depth[0],
                other.depth[0],
                one.camera.intrinsics[0],
                other.camera.intrinsics[0],
                other_from_one,
                distortion_a=None if one.camera.distortion is None else one.camera.distortion[0],
                distortion_b=None if other.camera.distortion is None else other.camera.distortion[0],
            )
        )
    return total(found)


def total(parts: Iterable[Agreement]) -> Agreement:
    """Add up what became of several sets of readings."""
    agree, compared = zip((0, 0), *parts)
    return sum(agree), sum(compared)


def share(found: Agreement) -> float:
    """Return the part of the readings compared that agree; of too few, they count as too few that agree."""
    agree, compared = found
    return agree / max(compared, LEAST_COMPARED)


def explains_more(share_read: float, share_given: float) -> bool:
    """Whether a convention agrees at all, better by a margin, and resolves half of what contradicts as given."""
    gain = share_read - share_given
    return share_read >= AGREE and gain >= max(_LEAST_GAIN, 0.5 * (1.0 - share_given))


def has_moved(a: DepthFrame, b: DepthFrame) -> bool:
    """Whether the poses of two frames of one view lie so far apart that conventions can be told from each other."""
    motion = rigid.invert_rigid(pose_of(a)) @ pose_of(b)
    turn = torch.linalg.matrix_norm(motion[:3, :3] - torch.eye(3, dtype=motion.dtype, device=motion.device)) / 2**0.5
    return bool(motion[:3, 3].norm() > _LEAST_MOTION[0]) or bool(turn > _LEAST_MOTION[1])


def agreements(views: Mapping[int, DepthFrame]) -> dict[tuple[int, int], Agreement]:
    """Return how far every two views agree that do not see from the same place."""
    return {
        (i, j): agreement(views[i], views[j])
        for i, j in itertools.combinations(views, 2)
        if has_moved(views[i], views[j])
    }
