"""Parts joined to objects, those first that are drawn together most.

Source: Keuper et al., Efficient decomposition of image and mesh graphs by lifted multicuts, ICCV 2015 (greedy additive
edge contraction).
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from typing import NamedTuple

# Of the lines between two parts of a convex thing cameras see through 5 % by their errors. At what lies above that the
# evidence of contacts is outweighed: 18 % free lines part even what no view saw apart. Six lines tell little.
_FREE_FROM, _CONVEX, _FEW_LINES = 0.05, 1.5, 6
_FEW_CELLS = 20  # less is no object: smaller than a cube of 2 cm


class Edge(NamedTuple):
    """What is known of two parts; of two objects it is the sum over their parts."""

    drawn: float = 0.0  # together, over all pairs of cells and views
    weight: int = 0  # how many those are
    free: int = 0  # lines between them that cameras see through
    lines: int = 0

    def __add__(self, other: Edge) -> Edge:  # type: ignore[override]
        return Edge(
            self.drawn + other.drawn,
            self.weight + other.weight,
            self.free + other.free,
            self.lines + other.lines,
        )

    def sum(self) -> float:
        """How strongly they are drawn together; below 0 they are driven apart."""
        through = self.free / (self.lines + _FEW_LINES)
        return self.drawn - self.weight * _CONVEX * max(0.0, through - _FREE_FROM)


def contracted(beside: list[dict[int, Edge]], num_cells: Sequence[int]) -> list[int]:
    """Contract the edge of the largest sum while it is above 0; parallel edges are added up.

    What is still too small for an object is then joined to what it is least apart from.

    Args:
        beside: what is known of every part (row) and the others; it is used up.
        num_cells: of every part.

    Returns:
        The part that stands for the object of each.
    """
    waiting = [(-edge.sum(), a, b, edge) for a, row in enumerate(beside) for b, edge in row.items() if a < b]
    waiting = [one for one in waiting if one[0] < 0]
    heapq.heapify(waiting)
    of = list(range(len(beside)))
    while waiting:
        _, a, b, edge = heapq.heappop(waiting)
        if beside[a].get(b) != edge:  # one of them is gone, or the sum has changed
            continue
        kept, gone = (a, b) if len(beside[a]) >= len(beside[b]) else (b, a)
        of[gone] = kept
        del beside[kept][gone]
        for c, weight in beside[gone].items():
            if c == kept:
                continue
            del beside[c][gone]
            before = beside[kept].get(c)
            added = weight if before is None else before + weight
            beside[kept][c] = beside[c][kept] = added
            value = added.sum()
            if value > 0:
                heapq.heappush(waiting, (-value, min(kept, c), max(kept, c), added))
        beside[gone] = {}
    _join_small(of, beside, num_cells)
    return [_root(of, one) for one in range(len(of))]


def _join_small(of: list[int], beside: list[dict[int, Edge]], num_cells: Sequence[int]) -> None:
    """Join what is too small for an object to what it is least apart from."""
    size = [0] * len(of)
    for one, count in enumerate(num_cells):
        size[_root(of, one)] += count
    for count, one in sorted((count, one) for one, count in enumerate(size) if 0 < count < _FEW_CELLS):
        touched = [(edge.drawn / edge.weight, -other) for other, edge in beside[one].items() if edge.weight]
        if touched and size[one] == count:
            of[one] = -max(touched)[1]
            size[_root(of, one)] += count


def _root(of: list[int], one: int) -> int:
    while of[one] != one:
        one = of[one]
    return one
