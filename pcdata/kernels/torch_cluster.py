"""torch-cluster as a backend, on the CPU and where it can keep pcdata's contract; taken only when asked for by name.

It is refused on CUDA: its farthest point sampling starts from squared distances of 5e4, so larger ones tie, and its
radius search keeps the first neighbors it meets, not the nearest.
"""

from __future__ import annotations

from types import ModuleType

import torch
from torch import Tensor

from pcdata.contracts.dispatch import kernel
from pcdata.contracts.on_host import bounds_of
from pcdata.errors import BackendError
from pcdata.functional.image_grid import ImageGrid
from pcdata.functional.rows import cloud_of_rows, ptr_from_counts

INSTALL = "pip install ninja && pip install --no-build-isolation torch-cluster"

# Its kd-tree prunes with float32 bounds and squares the radius in float64: search a little wider, then cut exactly.
_WIDER = 1.001


def unavailable() -> str | None:
    """Return why torch-cluster cannot be used and what to do, or None."""
    try:
        _load()
    except ImportError:
        return f"torch-cluster is not installed; build it (about 20 minutes) with: {INSTALL}"
    except OSError as error:
        # Its compiled part belongs to one torch version and fails to link with any other.
        return f"torch-cluster does not load with torch {torch.__version__} ({error}); rebuild it with: {INSTALL}"
    return None


@kernel("farthest_rows", "torch_cluster")
def farthest_rows(points: Tensor, ptr: Tensor, counts: list[int]) -> Tensor:
    """Sample with ``torch_cluster.fps``, cloud by cloud: it takes a ratio, and writes out of bounds for empty samples.

    Raises:
        BackendError: on CUDA, or when torch-cluster repeated a point (it does once only duplicates are left).
    """
    _require_cpu("farthest_point_sample", points)
    starts = bounds_of(ptr)
    picked = [
        start + _sample_cloud(points[start:stop], count, cloud)
        for cloud, (start, stop, count) in enumerate(zip(starts, starts[1:], counts, strict=False))
    ]
    return torch.cat(picked)


@kernel("ball_query", "torch_cluster")
def ball_query(
    points: Tensor,
    ptr: Tensor,
    radius: float | Tensor,
    max_neighbors: int,
    queries: Tensor | None,
    queries_ptr: Tensor | None,
    exclude_self: bool,
    norm: str,
    grid: ImageGrid | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Search with ``torch_cluster.radius``, asking for *all* neighbors, then keep the nearest by the contract's order.

    Memory grows with the number of pairs within the radius, unlike the reference.

    Raises:
        BackendError: on CUDA; for a radius per query, without the points themselves, or where not in three dimensions.
    """
    _require_cpu("ball_query", points)
    if isinstance(radius, Tensor) or exclude_self or norm != "l2" or points.shape[1] != 3:
        raise BackendError(
            "ball_query: torch-cluster takes one radius, three coordinates, no other norm than l2 and no exclude_self; "
            "use backend='auto'"
        )
    if queries is None:
        queries, queries_ptr = points, ptr
    assert queries_ptr is not None  # @op fills it
    query, row = _load().radius(
        points, queries, radius * _WIDER, cloud_of_rows(ptr), cloud_of_rows(queries_ptr), max_num_neighbors=len(points)
    )
    squared = _squared_distance(points[row], queries[query])
    limit = torch.tensor(radius, dtype=torch.float32, device="cpu").square()
    within = squared < limit
    return _nearest_per_query(query[within], row[within], squared[within], len(queries), max_neighbors, len(points))


def _load() -> ModuleType:
    import torch_cluster

    return torch_cluster


def _require_cpu(name: str, points: Tensor) -> None:
    if points.device.type != "cpu":
        raise BackendError(
            f"{name}: torch-cluster keeps the contract on the CPU only, the points are on {points.device}; "
            "use backend='auto'"
        )


def _sample_cloud(points: Tensor, count: int, cloud: int) -> Tensor:
    if count == 0:
        return torch.empty(0, dtype=torch.int64, device="cpu")
    # It takes ceil(ratio * n) points in float32; half a point below the count cannot round to a neighbor.
    index: Tensor = _load().fps(points, ratio=(count - 0.5) / len(points), random_start=False)
    if len(index) != count or len(index.unique()) != count:
        raise BackendError(
            f"farthest_point_sample: torch-cluster returned {len(index.unique())} distinct points of {count} for cloud "
            f"{cloud}; it repeats points once only duplicates are left, use backend='auto'"
        )
    return index


def _squared_distance(a: Tensor, b: Tensor) -> Tensor:
    dx, dy, dz = (a - b).unbind(-1)
    return dx * dx + dy * dy + dz * dz


def _nearest_per_query(
    query: Tensor, row: Tensor, squared: Tensor, num_queries: int, max_neighbors: int, num_points: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Order pairs by (query, squared distance, row) and lay the first ``max_neighbors`` of each query side by side."""
    order = torch.arange(len(query), dtype=torch.int64, device="cpu")
    for key in (row, squared, query):  # least significant first; stable sorts keep the order among equals
        order = order[key[order].argsort(stable=True)]
    query, row, squared = query[order], row[order], squared[order]
    found = torch.bincount(query, minlength=num_queries)
    place = torch.arange(len(query), dtype=torch.int64, device="cpu") - ptr_from_counts(found)[query]
    kept = place < max_neighbors
    index = torch.full((num_queries, max_neighbors), num_points, dtype=torch.int64, device="cpu")
    distance = torch.full((num_queries, max_neighbors), torch.inf, dtype=torch.float32, device="cpu")
    index[query[kept], place[kept]] = row[kept]
    distance[query[kept], place[kept]] = squared[kept].double().sqrt().float()
    return index, distance, found.clamp(max=max_neighbors)
