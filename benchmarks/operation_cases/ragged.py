"""10,000 clouds of 50 points in one call, and one cloud of the same 500,000 points: no operation loops over clouds."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator
from typing import Any

import torch
from timing import timed

from pcdata import functional as F

CLOUDS, EACH = 10_000, 50
# Searches of one cloud grow faster than linear where all pairs are looked at: those take fewer points.
_REPEATS = 3

Call = Callable[[torch.Tensor, torch.Tensor], Any]


def rows(only: str = "") -> list[dict[str, Any]]:
    """Time each operation on both; prints a line for each."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(CLOUDS * EACH, 3, generator=generator)
    many = torch.arange(CLOUDS + 1) * EACH
    one = torch.tensor([0, CLOUDS * EACH])
    found = []
    for name, call in calls():
        if only in name:
            row = {"operation": name, "many_ms": median(call, points, many), "one_ms": median(call, points, one)}
            found.append(row)
            print(f"{name}: 10,000 clouds {row['many_ms']:.1f} ms, one cloud {row['one_ms']:.1f} ms", flush=True)
    return found


def median(call: Call, points: torch.Tensor, ptr: torch.Tensor) -> float:
    seconds: list[float] = []
    call(points, ptr)
    for _ in range(_REPEATS):
        timed(lambda: call(points, ptr), seconds)
        if seconds[0] > 1.0:
            break
    return 1000 * statistics.median(seconds)


def calls() -> Iterator[tuple[str, Call]]:
    """Operations as calls of points and row pointers; clouds of 50 points in a cube of 1 m."""
    shape = {"max_neighbors": 16}
    k = torch.tensor([[640.0, 0.0, 320.0], [0.0, 640.0, 240.0], [0.0, 0.0, 1.0]])

    def wide(points: torch.Tensor, width: int) -> torch.Tensor:
        return torch.cat([points] * (width // 3), 1).contiguous()

    def labels(points: torch.Tensor) -> torch.Tensor:
        return (points[:, 2] * 4).long()

    yield "voxels", lambda p, ptr: F.voxel_downsample(p, ptr, voxel_size=0.1)
    yield "voxels, stated origin", lambda p, ptr: F.voxel_downsample(p, ptr, voxel_size=0.1, origin=(0, 0, 0))
    yield "farthest points, ratio 1/10", lambda p, ptr: F.farthest_point_sample(p, ptr, ratio=0.02)
    yield (
        "farthest points, start drawn",
        lambda p, ptr: F.farthest_point_sample(p, ptr, ratio=0.02, seeds=torch.arange(len(ptr) - 1)),
    )
    yield (
        "farthest points, balanced labels",
        lambda p, ptr: F.farthest_point_sample(p, ptr, ratio=0.02, labels=labels(p)),
    )
    yield "farthest points and nearest sample", lambda p, ptr: F.farthest_point_groups(p, ptr, ratio=0.02)
    yield "kNN 8, 3 columns", lambda p, ptr: F.knn(p, ptr, k=8)
    yield "all neighbors within 2 cm", lambda p, ptr: F.radius_neighbors(p, ptr, radius=0.02)
    yield (
        "32 nearest, a radius per query",
        lambda p, ptr: F.ball_query(p, ptr, radius=0.01 + 0.02 * p[:, 0], max_neighbors=32),
    )
    yield "covariance of 16 neighbors", lambda p, ptr: F.neighborhood_covariance(p, ptr, **shape)
    yield "Chamfer, both sides", lambda p, ptr: F.chamfer_distance(p, ptr, p.flip(0).contiguous(), ptr)
    yield (
        "Chamfer, L1",
        lambda p, ptr: F.chamfer_distance(p, ptr, p.flip(0).contiguous(), ptr, norm="l1", squared=False),
    )
    yield "F-score", lambda p, ptr: F.f_score(p, ptr, p.flip(0).contiguous(), ptr, threshold=0.05)
    yield "Hausdorff distance", lambda p, ptr: F.hausdorff_distance(p, ptr, p.flip(0).contiguous(), ptr)
    yield (
        "cloud to depth, 64x48",
        lambda p, ptr: F.render_points(
            p + 1, ptr, intrinsics=(k / torch.tensor([[10.0], [10.0], [1.0]])).expand(len(ptr) - 1, 3, 3), size=(48, 64)
        ),
    )
    yield "lidar to range image, 8x64", lambda p, ptr: F.render_ranges(p, ptr, size=(8, 64))
    yield (
        "box mask",
        lambda p, ptr: F.box_mask(p, ptr, lower=torch.zeros(len(ptr) - 1, 3), upper=torch.full((len(ptr) - 1, 3), 0.5)),
    )
    yield "repeated points", lambda p, ptr: F.duplicate_mask(p, ptr)
