"""Points that are sorted once and searched often."""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner
from pcdata.contracts.numbers import checked_count
from pcdata.contracts.tensors import check_tensors
from pcdata.errors import ShapeError
from pcdata.functional.neighbor_rows import Listed, nearest_rows, rows_within
from pcdata.functional.neighbors import all_within, checked_radius, nearest


@inner
def sorted_rows(
    points: Tensor,  # (N, D) float32
    ptr: Tensor,  # (B+1,)
    *,
    backend: str = "auto",
) -> dict[str, Tensor]:
    """Prepare points for :func:`nearest_in`; the reference has nothing to prepare."""
    return {}


@inner
def nearest_in(
    points: Tensor,  # (N, D) float32
    ptr: Tensor,  # (B+1,)
    prepared: dict[str, Tensor],
    k: int,
    *,
    queries: Tensor | None = None,  # (Q, D) float32; None = the points
    queries_ptr: Tensor | None = None,
    radius: float | Tensor | None = None,  # or (Q,) float32
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:  # index (Q, k) int64, distance (Q, k) float32
    """Find what :func:`nearest_rows` finds, among points that were prepared by the same backend."""
    found: tuple[Tensor, Tensor] = nearest_rows(
        points, ptr, k, queries=queries, queries_ptr=queries_ptr, radius=radius, backend="auto"
    )
    return found


@inner
def within_in(
    points: Tensor,  # (N, D) float32
    ptr: Tensor,  # (B+1,)
    prepared: dict[str, Tensor],
    radius: float | Tensor,  # or (Q,) float32
    *,
    queries: Tensor | None = None,  # (Q, D) float32; None = the points
    queries_ptr: Tensor | None = None,
    exclude_self: bool = False,
    backend: str = "auto",
) -> Listed:
    """Find what :func:`rows_within` finds, among points that were prepared by the same backend."""
    found: Listed = rows_within(
        points, ptr, radius, queries=queries, queries_ptr=queries_ptr, exclude_self=exclude_self, backend="auto"
    )
    return found


class NeighborIndex:
    """Points that are sorted once and searched often: the answers of the functions of the same names, bit for bit.

    The points are checked and sorted when the index is made, so a call costs what its queries cost. In memory it takes
    about 25 bytes for each point of three columns; for others, and on other devices than the CPU, nothing is sorted
    ahead. It stands for the points as they were: do not change them in place.

    Args:
        points: the clouds to search, (N, D) float32.
        ptr: row pointers (B+1,); None = one cloud.

    Raises:
        ShapeError, DTypeError, DeviceError, NonFiniteError: points and pointers do not fit.
    """

    def __init__(self, points: Tensor, ptr: Tensor | None = None) -> None:
        if ptr is None and isinstance(points, Tensor) and points.ndim:
            ptr = torch.tensor([0, len(points)], dtype=torch.int64, device=points.device)
        check_tensors("NeighborIndex", {"points": points, "ptr": ptr}, {"points": "N D", "ptr": "ptr N B"})
        assert ptr is not None  # checked
        self.points, self.ptr = points, ptr
        self._plain = points.detach().contiguous()
        self._prepared = sorted_rows(self._plain, ptr)

    def __len__(self) -> int:
        """The number of points."""
        return len(self.points)

    def __repr__(self) -> str:
        return f"NeighborIndex({len(self.ptr) - 1} clouds, {len(self)} points of {self.points.shape[1]} columns)"

    def __reduce__(self) -> tuple[Any, ...]:
        return NeighborIndex, (self.points, self.ptr)

    def knn(
        self,
        *,
        k: int,
        queries: Tensor | None = None,  # (Q, D) float32; None = the points themselves
        queries_ptr: Tensor | None = None,  # (B+1,); None = one cloud
        exclude_self: bool = False,
    ) -> tuple[Tensor, Tensor]:  # index (Q, k) int64; distance (Q, k) float32
        """Find the k nearest points for every query; see :func:`knn`."""
        own = self._checked("NeighborIndex.knn", queries, queries_ptr, k=k)
        return nearest("NeighborIndex.knn", self._find, self.points, **own, radius=None, exclude_self=exclude_self)

    def ball_query(
        self,
        *,
        radius: float | Tensor,  # or (Q,) float
        max_neighbors: int,
        queries: Tensor | None = None,  # (Q, D) float32; None = the points themselves
        queries_ptr: Tensor | None = None,  # (B+1,); None = one cloud
        exclude_self: bool = False,
    ) -> tuple[Tensor, Tensor, Tensor]:  # index (Q, m) int64; distance (Q, m) float32; count (Q,) int64
        """Find the nearest points within a radius, at most so many; see :func:`ball_query`."""
        where = "NeighborIndex.ball_query"
        own = self._checked(where, queries, queries_ptr, max_neighbors=max_neighbors, radius=radius)
        found = nearest(where, self._find, self.points, **own, exclude_self=exclude_self)
        return *found, (found[0] < len(self)).sum(1)

    def radius_neighbors(
        self,
        *,
        radius: float | Tensor,  # or (Q,) float
        queries: Tensor | None = None,  # (Q, D) float32; None = the points themselves
        queries_ptr: Tensor | None = None,  # (B+1,); None = one cloud
        exclude_self: bool = False,
    ) -> tuple[Tensor, Tensor, Tensor]:  # index (E,) int64; distance (E,) float32; neighbors_ptr (Q+1,)
        """Find all points within a radius; see :func:`radius_neighbors`."""
        where = "NeighborIndex.radius_neighbors"
        own = self._checked(where, queries, queries_ptr, radius=radius)
        find = functools.partial(within_in, self._plain, self.ptr, self._prepared)
        return all_within(where, find, self.points, **own, exclude_self=exclude_self)

    @property
    def _find(self) -> Any:
        return functools.partial(nearest_in, self._plain, self.ptr, self._prepared)

    def _checked(
        self, where: str, queries: Tensor | None, queries_ptr: Tensor | None, **numbers: Any
    ) -> dict[str, Any]:
        """Hold queries and numbers to the contract of the functions."""
        if queries is None:
            if queries_ptr is not None:
                raise ShapeError(f"{where}: queries_ptr was given without queries; pass both or neither")
        else:
            if queries_ptr is None and isinstance(queries, Tensor) and queries.ndim:
                queries_ptr = torch.tensor([0, len(queries)], dtype=torch.int64, device=queries.device)
            # A row of the points, so that columns, device and number of clouds must agree; not read again.
            known = {"points": self._plain[:0], "ptr": self.ptr, "queries": queries, "queries_ptr": queries_ptr}
            check_tensors(where, known, {"points": "N D", "queries": "Q D", "ptr": "ptr M B", "queries_ptr": "ptr Q B"})
        arguments = {"points": self.points, "queries": queries, **numbers}
        for name in numbers.keys() & {"k", "max_neighbors"}:
            numbers["k"] = checked_count(where, name, arguments)
        if "radius" in numbers:
            numbers["radius"] = checked_radius(where, "radius", arguments)
        numbers.pop("max_neighbors", None)
        return {"queries": queries, "queries_ptr": queries_ptr, **numbers}
