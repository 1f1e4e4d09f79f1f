"""How networks and datasets write grasps, and grasps rewritten from one to the other."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from pcdata.contracts.tensors import check_tensors
from pcdata.errors import ConfigError, ShapeError, near_matches
from pcdata.functional.grasps import LONGEST, ParallelJaw
from pcdata.geometry.rigid import check_rigid

Axis = Literal["x", "y", "z"]
_AXES = ("x", "y", "z")


class GraspConvention(NamedTuple):
    """What the columns of a grasp's rotation and its origin are."""

    approach: Axis  # from the palm to the tips of the fingers
    closing: Axis  # along which the fingers move
    tip: float | None  # metres from the origin to the tips along the approach; None = each grasp has its own


# GraspNet: the origin lies between the fingers, their tips ``depth`` beyond it: graspnetAPI, utils/utils.py,
# plot_gripper_pro_max. AnyGrasp gives graspnetAPI's GraspGroup. Contact-GraspNet and M2T2: the flange of a Panda hand:
# contact_graspnet.py, build_6d_grasp, whose columns are base direction, approach x base, approach, and whose contacts
# lie 0.1034 m before the origin. ACRONYM: the same axes, tips at 0.11217 m: acronym_tools, create_gripper_marker.
GRASP_CONVENTIONS: Mapping[str, GraspConvention] = {
    "graspnet": GraspConvention("x", "y", None),
    "anygrasp": GraspConvention("x", "y", None),
    "contact_graspnet": GraspConvention("z", "x", 0.1034),
    "m2t2": GraspConvention("z", "x", 0.1034),
    "acronym": GraspConvention("z", "x", 0.11217),
}


def convert_grasps(
    grasps: Tensor,  # (G, 4, 4) float
    *,
    source: str | GraspConvention | ParallelJaw,
    target: str | GraspConvention | ParallelJaw,
    source_tips: Tensor | float | None = None,  # (G,) float metres, or one for all
    target_tips: Tensor | float | None = None,  # likewise
) -> Tensor:  # (G, 4, 4) float64
    """Rewrite grasps of one convention in another: the same fingers at the same place, the same frame.

    The tips of the fingers stay where they are; axes are renamed, and the origin goes to where the other convention has
    it.

    Args:
        grasps: rigid poses of the gripper.
        source: what they are written in: a name of ``GRASP_CONVENTIONS``, a gripper, or axes and origin.
        target: what they are to be written in.
        source_tips: how far the tips are from the origins; None = as the convention says. GraspNet's depth.
        target_tips: likewise, of the result.

    Raises:
        ConfigError: an unknown name; no tips, and the convention has none; one axis for both.
        ShapeError, DTypeError, NonFiniteError, PoseError: the grasps are no rigid poses (G, 4, 4).
    """
    where = "convert_grasps"
    check_tensors(where, {"grasps": grasps}, {"grasps": "G 4 4 : float"})
    check_rigid(f"{where}: grasps", grasps)
    old, new = _convention(where, "source", source), _convention(where, "target", target)
    wide = grasps.double()
    columns = wide[:, :3, :3].mT
    approach, closing = columns[:, _AXES.index(old.approach)], columns[:, _AXES.index(old.closing)]
    here = _tips(where, "source", old, source_tips, wide)
    there = _tips(where, "target", new, target_tips, wide)
    first, second = _AXES.index(new.approach), _AXES.index(new.closing)
    across = torch.linalg.cross(approach, closing)
    moved = wide.clone()
    moved[:, :3, first], moved[:, :3, second] = approach, closing
    moved[:, :3, 3 - first - second] = across if (second - first) % 3 == 1 else -across  # right-handed
    moved[:, :3, 3] = wide[:, :3, 3] + (here - there)[:, None] * approach
    return moved


def _convention(where: str, name: str, given: str | GraspConvention | ParallelJaw) -> GraspConvention:
    if isinstance(given, ParallelJaw):
        return GraspConvention(given.approach, given.closing, given.tip)
    if isinstance(given, str):
        if given not in GRASP_CONVENTIONS:
            raise ConfigError(
                f"{where}: {name}={given!r} is no convention; there are {', '.join(GRASP_CONVENTIONS)}; or give a "
                f"ParallelJaw{near_matches(given, GRASP_CONVENTIONS)}"
            )
        return GRASP_CONVENTIONS[given]
    if not isinstance(given, GraspConvention):
        raise ConfigError(
            f"{where}: {name} must be a name of GRASP_CONVENTIONS, a GraspConvention or a ParallelJaw, got {given!r}"
        )
    if given.approach not in _AXES or given.closing not in _AXES or given.approach == given.closing:
        raise ConfigError(f"{where}: {name} must have two axes of {_AXES}, got {given.approach!r}, {given.closing!r}")
    return given


def _tips(where: str, name: str, convention: GraspConvention, given: Tensor | float | None, grasps: Tensor) -> Tensor:
    value = convention.tip if given is None else given
    if value is None:
        raise ConfigError(
            f"{where}: every grasp of {name} has its own distance from origin to tips; give {name}_tips, such as "
            "GraspNet's depths"
        )
    tips = torch.as_tensor(value, dtype=torch.float64, device=grasps.device).detach()
    if tips.ndim == 0:
        tips = tips.expand(len(grasps))
    if tips.shape != grasps.shape[:1]:
        raise ShapeError(f"{where}: {name}_tips must be one number or ({len(grasps)},), got {tuple(tips.shape)}")
    if not bool((tips.abs() <= LONGEST).all()):
        raise ConfigError(f"{where}: {name}_tips must be finite metres, at most {LONGEST:g}; are they in millimetres?")
    return tips


class GraspGroup(NamedTuple):
    """What the rows of graspnetAPI's GraspGroup say of G grasps, in GraspNet's convention."""

    grasps: Tensor  # (G, 4, 4) float64, in the frame that they were found in
    openings: Tensor  # (G,) float64 metres between the fingers: their width
    tips: Tensor  # (G,) float64 metres from the origin to the tips: their depth
    scores: Tensor  # (G,) float64
    objects: Tensor  # (G,) int64 object ids, -1 = none


def read_grasp_group(rows: Tensor) -> GraspGroup:  # (G, 17) float
    """Return the grasps of graspnetAPI's array, as GraspNet's baselines and AnyGrasp give them.

    A row is score, width, height, depth, the 9 numbers of the rotation row by row, translation, object id.

    Raises:
        ShapeError, DTypeError, NonFiniteError: it is not (G, 17) finite numbers.
        PoseError: a rotation is none.
    """
    where = "read_grasp_group"
    check_tensors(where, {"rows": rows}, {"rows": "G 17 : float"})
    wide = rows.detach().double()
    grasps = torch.eye(4, dtype=torch.float64, device=rows.device).repeat(len(rows), 1, 1)
    grasps[:, :3, :3], grasps[:, :3, 3] = wide[:, 4:13].reshape(-1, 3, 3), wide[:, 13:16]
    check_rigid(f"{where}: rotations", grasps)
    return GraspGroup(grasps, wide[:, 1], wide[:, 3], wide[:, 0], wide[:, 16].to(torch.int64))
