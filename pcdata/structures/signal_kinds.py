"""What the numbers of a signal mean: one row per kind, and the words that name them.

A kind is one text, such as ``"invariant"``, ``"pose xyz_quat_xyzw"`` or, for columns of several kinds side by side,
``"delta_pose xyz_axis_angle + invariant 1"``. A new kind is its row in :data:`SIGNAL_KINDS`: then clouds move it, keep
it and hold it to its rules.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pcdata.errors import ConfigError, DTypeError, near_matches
from pcdata.geometry import rigid
from pcdata.structures.pose_layouts import LAYOUTS, Fault, Motion, PoseLayout, applied, per_cloud


def _moved_position(values: Tensor, motion: Motion, layout: PoseLayout | None) -> Tensor:
    linear, offset = (per_cloud(part, values, 1) for part in (motion.linear, motion.offset))
    return applied(linear, values) + offset


def _moved_displacement(values: Tensor, motion: Motion, layout: PoseLayout | None) -> Tensor:
    return applied(per_cloud(motion.linear, values, 1), values)


def _moved_direction(values: Tensor, motion: Motion, layout: PoseLayout | None) -> Tensor:
    turned = applied(per_cloud(motion.normals, values, 1), values)
    length, own = _length(turned), _length(values)
    return turned * (own / torch.where(length > 0, length, 1.0))


def _length(vectors: Tensor) -> Tensor:
    x, y, z = vectors.split(1, dim=-1)
    squared = (x * x + y * y) + z * z
    # The root has no slope at 0: a gradient through it would be NaN.
    return torch.where(squared > 0, torch.where(squared > 0, squared, 1.0).sqrt(), 0.0)


def _moved_pose(values: Tensor, motion: Motion, layout: PoseLayout | None) -> Tensor:
    assert layout is not None
    position, rotation = layout.parts(values)
    axes = len(layout.row)
    turned = layout.turned(
        rotation, per_cloud(motion.rotation, values, axes), lambda: per_cloud(motion.quaternion, values, axes)
    )
    return layout.joined(values, None if position is None else _moved_position(position, motion, None), turned)


def _moved_delta(values: Tensor, motion: Motion, layout: PoseLayout | None) -> Tensor:
    assert layout is not None
    position, rotation = layout.parts(values)
    axes = len(layout.row)
    handedness = per_cloud(motion.handedness[:, None], values, axes)
    turned = layout.conjugated(rotation, per_cloud(motion.rotation, values, axes), handedness)
    return layout.joined(values, None if position is None else _moved_displacement(position, motion, None), turned)


@dataclass(frozen=True, kw_only=True)
class _SignalRow:
    """All that clouds know about one kind of signal."""

    holds: str  # in words
    moves: str  # what a motion of the cloud does to it, in words
    mirrors: str  # what a mirror does, in words
    move: Callable[[Tensor, Motion, PoseLayout | None], Tensor] | None = None  # float64 (B, ..., row); None = stays
    columns: int | None = None  # None = any number, or as the layout says
    has_layout: bool = False


_unmoved = functools.partial(_SignalRow, moves="not at all", mirrors="not at all")
_vector = functools.partial(_SignalRow, holds="float (B, ..., 3)", columns=3)
_pose = functools.partial(_SignalRow, has_layout=True)

SIGNAL_KINDS = {
    "invariant": _unmoved(holds="numbers (B, ...); `invariant N`: N columns"),
    "position": _vector(moves="as a point", mirrors="as a point", move=_moved_position),
    "displacement": _vector(
        moves="as the difference of two points: turned and scaled, not shifted",
        mirrors="as the difference of two points",
        move=_moved_displacement,
    ),
    "direction": _vector(
        moves="turned as a normal is; keeps its own length", mirrors="as a normal", move=_moved_direction
    ),
    "pose": _pose(
        holds="float, of a stated layout",
        moves="its position as a point; its rotation turned by the nearest rotation, no scale in it",
        mirrors="refused",
        move=_moved_pose,
    ),
    "delta_pose": _pose(
        holds="float, of a stated layout: a motion along the axes of the frame",
        moves="its shift as a displacement; its rotation R becomes Q R Q^T, Q the nearest rotation",
        mirrors="as the motion seen in the mirror",
        move=_moved_delta,
    ),
    "text": _unmoved(holds="B texts"),
}


def signal_kinds_table() -> str:
    """Return the rows as Markdown, for docs/signals.md."""
    rows = [f"| `{name}` | {row.holds} | {row.moves} | {row.mirrors} |" for name, row in SIGNAL_KINDS.items()]
    layouts = [
        f"| `{name}` | {', '.join(map(str, ('B', '...', *row.row)))} | {row.holds} |" for name, row in LAYOUTS.items()
    ]
    return "\n".join(
        [
            "| kind | holds | is moved | is mirrored |",
            "|---|---|---|---|",
            *rows,
            "",
            "| layout | shape | holds |",
            "|---|---|---|",
            *layouts,
        ]
    )


def moved_values(values: Tensor, parts: Sequence[_Part], motion: Motion) -> Tensor:
    """Return spatial (B, ..., row) values of some parts after a motion: computed in float64, in their dtype."""
    if motion.all_rest:
        return values
    moved = [
        own if part.row.move is None else part.row.move(own, motion, part.layout)
        for part, own in zip(parts, columns_of(values.double(), parts))
    ]
    rests = motion.rests.reshape(-1, *[1] * (values.ndim - 1))
    return torch.where(rests, values, torch.cat(moved, dim=-1).to(values.dtype))


def pose_faults(values: Tensor, parts: Sequence[_Part]) -> Iterator[Fault]:
    """Yield what can be wrong with the poses among (B, ..., row) values, and where it is."""
    for part, own in zip(parts, columns_of(values, parts)):
        if part.layout is not None:
            yield from part.layout.faults_of(own.double())


def columns_of(values: Tensor, parts: Sequence[_Part]) -> Sequence[Tensor]:
    """Return the columns of each part of (B, ..., row) values."""
    return [values] if len(parts) == 1 else values.split([part.columns or 0 for part in parts], dim=-1)


def poses_of_signal(kind: str, values: Tensor) -> Tensor | None:  # (B, ..., 4, 4) float64
    """Return the poses that values are, as matrices; None where their kind is another, or has no position."""
    parts = parse_kind(kind).parts
    layout = parts[0].layout
    if len(parts) > 1 or parts[0].name != "pose" or layout is None or not layout.has_position:
        return None
    position, rotation = layout.parts(values.double())
    assert position is not None  # has_position
    return rigid.from_rotation_translation(layout.rotation(rotation), position)


# -- the words -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Part:
    """One kind within a signal's columns."""

    name: str
    row: _SignalRow
    layout: PoseLayout | None
    columns: int | None  # None = all, of whatever shape


@dataclass(frozen=True)
class _Parsed:
    """What a text says: its canonical form and its parts, in order of columns."""

    text: str
    parts: tuple[_Part, ...]

    @functools.cached_property
    def is_spatial(self) -> bool:
        return any(part.row.move is not None for part in self.parts)

    @functools.cached_property
    def has_pose(self) -> bool:
        return any(part.name == "pose" for part in self.parts)

    @functools.cached_property
    def is_text(self) -> bool:
        return self.parts[0].name == "text"

    @functools.cached_property
    def row(self) -> tuple[int, ...] | None:
        """The shape of one row; None = any."""
        first = self.parts[0]
        if len(self.parts) == 1:
            return first.layout.row if first.layout else None if first.columns is None else (first.columns,)
        return (sum(part.columns or 0 for part in self.parts),)


def parse_kind(kind: str) -> _Parsed:
    """Read a kind of signals.

    Raises:
        DTypeError: it is no text.
        ConfigError: it is none that is known; says which are.
    """
    if not isinstance(kind, str):
        raise DTypeError(f"a signal's kind must be a text such as 'invariant', got {type(kind).__name__}; {_FORMS}")
    return _parsed(str(kind))


_FORMS = "one of {kinds}, or several joined by ' + ', such as 'pose xyz_quat_xyzw + invariant 1'".format(
    kinds=", ".join(f"'{name} LAYOUT'" if row.has_layout else f"'{name}'" for name, row in SIGNAL_KINDS.items())
)


@functools.lru_cache(maxsize=256)
def _parsed(kind: str) -> _Parsed:
    terms = [term.split() for term in kind.split("+")]
    parts = tuple(_part(kind, words, len(terms) > 1) for words in terms)
    texts = []
    for words, part in zip(terms, parts):
        number = [] if part.name != "invariant" or part.columns is None else [str(part.columns)]
        texts.append(" ".join([part.name, *words[1:2]] if part.layout else [part.name, *number]))
    return _Parsed(" + ".join(texts), parts)


def _part(kind: str, words: list[str], is_joined: bool) -> _Part:
    def fault(what: str) -> ConfigError:
        return ConfigError(f"a signal's kind {kind!r:.200}: {what}")

    name, *rest = words or [""]
    if name not in SIGNAL_KINDS:
        raise fault(f"there is no {name!r:.100}{near_matches(name, SIGNAL_KINDS)}; it must be {_FORMS}")
    row = SIGNAL_KINDS[name]
    if name == "text" and is_joined:
        raise fault("texts have no columns; give them as a signal of their own")
    if row.has_layout:
        layout = _layout(fault, name, rest)
        if layout.is_matrix and is_joined:
            raise fault("a matrix has no columns beside it; give it as a signal of its own")
        return _Part(name, row, layout, layout.row[-1])
    if name == "invariant":
        if len(rest) > 1 or not all(map(_is_count, rest)):
            raise fault(f"after invariant stands how many columns, 1 or more, not {' '.join(rest)!r:.100}")
        if is_joined and not rest:
            raise fault("beside other kinds say how many columns are invariant, such as 'invariant 1'")
        return _Part(name, row, None, int(rest[0]) if rest else None)
    if rest:
        raise fault(f"nothing stands after {name}, got {' '.join(rest)!r:.100}; several of them are rows: (B, n, 3)")
    return _Part(name, row, None, row.columns)


def _is_count(word: str) -> bool:
    return word.isascii() and word.isdigit() and len(word) <= 9 and int(word) > 0


def _layout(fault: Callable[[str], ConfigError], name: str, rest: list[str]) -> PoseLayout:
    known = ", ".join(LAYOUTS)
    if not rest:
        raise fault(f"say how the {name} is written, '{name} LAYOUT' with one of {known}")
    if len(rest) > 1 or rest[0] not in LAYOUTS:
        given = " ".join(rest)
        unstated = [layout for layout in LAYOUTS if layout.startswith(f"{given}_")]
        if unstated:
            raise fault(f"{given} does not state the order; say {' or '.join(unstated)}")
        raise fault(f"there is no layout {given!r:.100}{near_matches(given, LAYOUTS)}; it must be one of {known}")
    return LAYOUTS[rest[0]]
