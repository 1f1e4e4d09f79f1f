"""Poses among the numbers of a signal written in another layout of a row, and their quaternions without jumps.

A rotation is two quaternions of opposite signs. One alone is written with w >= 0; where poses follow each other in time
that rule lets the numbers jump wherever w passes 0, and a model that learns from them sees a jump. So in a trajectory
every quaternion has the sign that is nearest to the one before.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from pcdata.errors import ConfigError, ShapeError, near_matches
from pcdata.geometry.rotations import nearest_sign
from pcdata.structures.pose_layouts import LAYOUTS, PoseLayout
from pcdata.structures.signal_kinds import columns_of, parse_kind

USUAL_ROW = "xyz_rot6d_rows"  # the numbers of R never jump, as those of angles may


def checked_pose_layout(where: str, layout: str) -> str:
    """Require a layout that writes a whole pose in one row.

    Raises:
        ConfigError: there is none of this name; says which are.
    """
    known = [name for name, one in LAYOUTS.items() if one.has_position and not one.is_matrix]
    if layout not in known:
        raise ConfigError(
            f"{where}: a pose is written in a row as one of {', '.join(known)}, not {layout!r:.100}"
            f"{near_matches(str(layout), known)}"
        )
    return layout


def poses_rewritten(kind: str, values: Tensor, layout: str) -> tuple[str, Tensor]:
    """Return a kind and values (B, ...) with every pose written in another layout of a row, in the same dtype.

    A rotation alone becomes the rotation part of the layout. What is no pose, or is in this layout, keeps its bits.
    """
    parsed = parse_kind(kind)
    words, columns = [], []
    for part, own, word in zip(parsed.parts, columns_of(values, parsed.parts), parsed.text.split(" + ")):
        if part.layout is not None:
            name = layout if part.layout.has_position else layout.removeprefix("xyz_")
            if LAYOUTS[name] is not part.layout:
                position, rotation = part.layout.parts(own.double())
                written = LAYOUTS[name].written(part.layout.rotation(rotation))
                own = (written if position is None else torch.cat([position, written], dim=-1)).to(values.dtype)
            word = f"{part.name} {name}"
        words.append(word)
        columns.append(own)
    return " + ".join(words), columns[0] if len(columns) == 1 else torch.cat(columns, dim=-1)


def poses_in_a_row(kind: str, values: Tensor, layout: str = "") -> tuple[str, Tensor]:
    """Return a kind and values with its poses as a row of numbers holds them.

    Written in ``layout``; "" = as they are, but matrices as :data:`USUAL_ROW`.
    """
    parts = parse_kind(kind).parts
    is_matrix = any(part.layout is not None and part.layout.is_matrix for part in parts)
    return poses_rewritten(kind, values, layout or USUAL_ROW) if layout or is_matrix else (kind, values)


def continued(kind: str, values: Tensor, before: Tensor) -> Tensor:
    """Return values (B, ..., row) with the quaternions of poses in the sign that is nearest to those before.

    A motion, ``delta_pose``, goes on from none before it, and stays.

    Args:
        kind: of both.
        values: of one step.
        before: (B, ..., row) of the step before it.
    """
    parts, columns = parse_kind(kind).parts, []
    for part, own, former in zip(parts, columns_of(values, parts), columns_of(before.to(values), parts)):
        if (layout := _of_quaternion(part)) is not None:
            position, turn = layout.parts(own)
            own = layout.joined(own, position, nearest_sign(turn, layout.parts(former)[1]))
        columns.append(own)
    return columns[0] if len(columns) == 1 else torch.cat(columns, dim=-1)


def continued_along(kind: str, values: Tensor, axis: int) -> Tensor:
    """Return values (B, ..., row) with the quaternions of poses continued along one of the axes before the row.

    Raises:
        ShapeError: there are such, and no such axis.
    """
    parts = parse_kind(kind).parts
    if not any(map(_of_quaternion, parts)):
        return values
    if isinstance(axis, bool) or not isinstance(axis, int) or not 0 <= axis < values.ndim - 1:
        raise ShapeError(
            f"along must be an axis on which poses follow each other, 0 to {values.ndim - 2} of {tuple(values.shape)}, "
            f"got {axis!r:.100}"
        )
    columns = []
    for part, own in zip(parts, columns_of(values, parts)):
        if (layout := _of_quaternion(part)) is not None:
            position, turn = layout.parts(own)
            steps = turn.movedim(axis, 0)
            # Where one turns away from the one before, it and all that follow change their sign once more.
            flips = torch.where((steps[1:] * steps[:-1]).sum(-1, keepdim=True) < 0, -1, 1).cumprod(0)
            turned = torch.cat([steps[:1], flips.to(steps.dtype) * steps[1:]]).movedim(0, axis)
            own = layout.joined(own, position, turned)
        columns.append(own)
    return columns[0] if len(columns) == 1 else torch.cat(columns, dim=-1)


def _of_quaternion(part: Any) -> PoseLayout | None:
    """Return the layout of a part whose rotations have two signs, else None."""
    layout: PoseLayout | None = part.layout if part.name == "pose" else None
    return layout if layout is not None and layout.is_quaternion else None
