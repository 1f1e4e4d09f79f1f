"""What the numbers of a cloud mean: the kinds of its per-point fields, and its units."""

from __future__ import annotations

from enum import Enum

METRE = "m"
NORMALIZED = "normalized"


class Kind(str, Enum):
    """How a per-point field behaves when the cloud is moved or averaged."""

    POSITION = "position"  # (N, 3) float: moved by the 4x4; averaged
    DIRECTION = "direction"  # (N, 3) float: moved by the inverse transpose, renormalised; averaged and renormalised
    INVARIANT = "invariant"  # anything: not moved; floats averaged, integers voted, never averaged
    MINIMUM = (
        "minimum"  # integers: not moved; of several the lowest counts, as a chain is as strong as its weakest link
    )


CORE_KINDS = {
    "points": Kind.POSITION,
    "colors": Kind.INVARIANT,
    "normals": Kind.DIRECTION,
    "labels": Kind.INVARIANT,
    "source_index": Kind.INVARIANT,
}
