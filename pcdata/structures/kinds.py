"""What the numbers of a cloud mean: one row per kind of field, one row per field, and the units of length.

A new kind is a name and its row in :data:`KINDS`: then clouds move it, average it, pad it and keep it on disk, and the
laws of the test suite hold it to that. Fields of every kind are joined one after another.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

import torch
from torch import Tensor

from pcdata.errors import ConfigError, DTypeError, near_matches
from pcdata.functional.rows import group_first, transform_directions, transform_points
from pcdata.functional.voxel_averages import (
    voxel_majority,
    voxel_maximum,
    voxel_mean,
    voxel_mean_direction,
    voxel_minimum,
)

METRE = "m"
CAMERA_FRAME = "camera"  # of each camera of a capture
NORMALIZED = "normalized"

Move = Callable[[Tensor, Tensor, Tensor], Tensor]  # rows, ptr, matrix (B, 4, 4) float64 -> rows
Average = Callable[[Tensor, Tensor, int], Tensor]  # rows (N, ...), group (N,) int64, their number G -> (G, ...)
Padding = Callable[[torch.dtype], int]  # what stands for "no row": 0 or -1


def _stays(rows: Tensor, ptr: Tensor, matrix: Tensor) -> Tensor:
    return rows


def _mean_or_vote(rows: Tensor, group: Tensor, num_groups: int) -> Tensor:
    """Average floats; of integers the most frequent one counts, the lowest of equals."""
    if rows.is_floating_point():
        columns = rows.reshape(len(rows), math.prod(rows.shape[1:]))
        return voxel_mean(columns, group, num_groups).reshape(num_groups, *rows.shape[1:])
    return _column_by_column(voxel_majority, rows, group, num_groups)


def _minimum(rows: Tensor, group: Tensor, num_groups: int) -> Tensor:
    return _column_by_column(voxel_minimum, rows, group, num_groups)


def _column_by_column(decide: Average, rows: Tensor, group: Tensor, num_groups: int) -> Tensor:
    columns = rows.reshape(len(rows), math.prod(rows.shape[1:]))
    columns = columns if rows.is_floating_point() else columns.long()
    decided = [decide(column, group, num_groups) for column in columns.unbind(1)]
    return torch.stack(decided, dim=1).to(rows.dtype).reshape(num_groups, *rows.shape[1:])


def _first(rows: Tensor, group: Tensor, num_groups: int) -> Tensor:
    return rows[group_first(group, num_groups)]


def _zero(dtype: torch.dtype) -> int:
    return 0


def _no_number(dtype: torch.dtype) -> int:
    """Return -1 where the dtype has it, as no label and no row is called so; else 0."""
    return -1 if dtype in (torch.int16, torch.int32, torch.int64) else 0


def _any(dtype: torch.dtype) -> bool:
    return True


def _floats(dtype: torch.dtype) -> bool:
    return dtype.is_floating_point


def _whole(dtype: torch.dtype) -> bool:
    return not (dtype.is_floating_point or dtype.is_complex)


class Kind(str, Enum):
    """How the values of a field behave when its cloud is moved, averaged, padded or stored: see :data:`KINDS`."""

    POSITION = "position"
    DIRECTION = "direction"
    INVARIANT = "invariant"
    MINIMUM = "minimum"  # as a chain is as strong as its weakest link

    @classmethod
    def _missing_(cls, value: object) -> Kind:
        known = [kind.value for kind in cls]
        hint = near_matches(value, known) if isinstance(value, str) else ""
        raise ConfigError(f"kind: a field is one of {', '.join(known)}, not {value!r:.100}{hint}")


@dataclass(frozen=True, kw_only=True)
class _KindRow:
    """All that clouds know about one kind of field; a file keeps the kind's name."""

    holds: str  # what its values must be, in words
    moves: str  # what a motion of the cloud does to it, in words
    averages: str  # what becomes of several, in words
    fits: Callable[[torch.dtype], bool]  # whether they are of such a dtype
    row: tuple[int, ...] | None = None  # the shape that a row must have; None = any
    move: Move
    average: Average
    padding: Padding
    is_length: bool = False  # in the unit of the points, so scaled where a file's unit is another one


_vector = functools.partial(_KindRow, holds="float (N, 3)", fits=_floats, row=(3,), padding=_zero)
_unmoved = functools.partial(_KindRow, moves="not at all", move=_stays, padding=_no_number)

KINDS = {
    Kind.POSITION: _vector(
        moves="by the 4x4", averages="the mean", move=transform_points, average=_mean_or_vote, is_length=True
    ),
    Kind.DIRECTION: _vector(
        moves="by the inverse transpose, back to unit length",
        averages="the mean, back to unit length",
        move=transform_directions,
        average=voxel_mean_direction,
    ),
    Kind.INVARIANT: _unmoved(
        holds="numbers (N, ...)",
        averages="of floats the mean; of integers a vote, the lowest of equals: an integer is never averaged",
        fits=_any,
        average=_mean_or_vote,
    ),
    Kind.MINIMUM: _unmoved(holds="integers (N, ...)", averages="the lowest", fits=_whole, average=_minimum),
}


def kinds_table() -> str:
    """Return the rows as Markdown, for docs/clouds.md."""
    rows = [f"| `{kind.value}` | {row.holds} | {row.moves} | {row.averages} |" for kind, row in KINDS.items()]
    return "\n".join(["| kind | holds | is moved | several become |", "|---|---|---|---|", *rows])


@dataclass(frozen=True)
class _PointField:
    """A field that every cloud may have: its kind, its contract, and how it is averaged where not as its kind."""

    kind: Kind
    spec: str  # see pcdata.contracts.tensors
    average: Average | None = None


FIELDS = {
    "points": _PointField(Kind.POSITION, "N 3"),
    "colors": _PointField(Kind.INVARIANT, "N 3"),
    "normals": _PointField(Kind.DIRECTION, "N 3"),
    "labels": _PointField(Kind.INVARIANT, "N : int64"),
    "source_index": _PointField(Kind.INVARIANT, "N : int64", average=_first),  # a place, of which there is no majority
}


def kind_of(name: str, kinds: Mapping[str, Kind]) -> Kind:
    """Return the kind of a field: of an extra one as declared."""
    return FIELDS[name].kind if name in FIELDS else kinds[name]


def averaged(name: str, rows: Tensor, kind: Kind, group: Tensor, num_groups: int, how: str | None = None) -> Tensor:
    """Reduce the rows of one field group by group: by one of REDUCTIONS, or as the field or else its kind says."""
    own = FIELDS[name].average if name in FIELDS else None
    return (REDUCTIONS[how] if how else own or KINDS[kind].average)(rows, group, num_groups)


def _floats_alone(rows: Tensor, group: Tensor, num_groups: int) -> Tensor:
    if not rows.is_floating_point():
        raise DTypeError(f"the mean of {rows.dtype} is not taken: choose 'vote', 'first', 'min' or 'max'")
    return _mean_or_vote(rows, group, num_groups)


def _maximum(rows: Tensor, group: Tensor, num_groups: int) -> Tensor:
    return _column_by_column(voxel_maximum, rows, group, num_groups)


def _vote(rows: Tensor, group: Tensor, num_groups: int) -> Tensor:
    if rows.is_floating_point():
        raise DTypeError(f"a vote among {rows.dtype} has no sense: choose 'mean', 'first', 'min' or 'max'")
    return _mean_or_vote(rows, group, num_groups)


# How several rows may become one where a caller does not leave it to their kind.
REDUCTIONS: dict[str, Average] = {
    "first": _first,
    "max": _maximum,
    "mean": _floats_alone,
    "min": _minimum,
    "vote": _vote,
}


def fillers(fields: Mapping[str, Tensor], kinds: Mapping[str, Kind]) -> dict[str, int]:
    """Return what stands for "no row" in each field."""
    return {name: KINDS[kind_of(name, kinds)].padding(value.dtype) for name, value in fields.items()}


def moved(fields: Mapping[str, Tensor], kinds: Mapping[str, Kind], ptr: Tensor, matrix: Tensor) -> dict[str, Tensor]:
    """Move the rows of all fields by one affine (B, 4, 4) float64 matrix per cloud, each as its kind says."""
    result = {}
    for name, rows in fields.items():
        row = KINDS[FIELDS[name].kind if name in FIELDS else kinds[name]]
        result[name] = rows if row.move is _stays else row.move(rows, ptr, matrix)
    return result


def attributes(rows: Mapping[str, Tensor]) -> dict[str, Any]:
    """Return fields by name as a cloud holds them: those of :data:`FIELDS` as attributes, the others in ``extra``."""
    own: dict[str, Any] = {"extra": {}}
    for name, value in rows.items():
        (own if name in FIELDS else own["extra"])[name] = value
    return own


def present_fields(clouds: Any) -> dict[str, Tensor]:
    """Return the per-point fields that clouds have, by name: the inverse of :func:`attributes`."""
    held = vars(clouds)
    fields = {name: held[name] for name in FIELDS if held[name] is not None}
    return {**fields, **held["extra"]}
