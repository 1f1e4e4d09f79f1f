"""Kernels of what lies around points: normals, shapes of neighborhoods, clusters."""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

# The operations must be registered before their kernels.
import pcdata.functional.clusters
import pcdata.functional.neighborhoods  # noqa: F401
from pcdata.contracts.dispatch import INNER, held_to, kernel
from pcdata.functional.image_grid import ImageGrid
from pcdata.functional.normals import check_viewpoint
from pcdata.functional.radius import require_cells
from pcdata.kernels.cpu.native import answers, call, room, room_for
from pcdata.kernels.cpu.search_arguments import core_rows, grid_arguments, limit_of, reachable


@kernel("estimate_normals", "cpu")
def estimate_normals(
    *, points: Tensor, ptr: Tensor, radius: float | None, max_neighbors: int, grid: ImageGrid | None
) -> Tensor:
    """Run the reference's contract in the core."""
    return _normals(points, ptr, radius, max_neighbors, grid, None)


@kernel("normals_facing", "cpu")
def normals_facing(
    points: Tensor, ptr: Tensor, radius: float | None, max_neighbors: int, grid: ImageGrid | None, viewpoint: Tensor
) -> Tensor:
    """Do so, and turn them in the same call; a place of another dtype than float32 is the reference's."""
    if viewpoint.dtype is not torch.float32:
        found: Tensor = INNER["normals_facing"].reference(points, ptr, radius, max_neighbors, grid, viewpoint)
        return found
    given = {"points": points, "ptr": ptr, "radius": radius, "max_neighbors": max_neighbors, "grid": grid}
    held = held_to("estimate_normals", **given)
    check_viewpoint(points, points, viewpoint)
    return _normals(**held, viewpoint=viewpoint.detach().contiguous())


def _normals(
    points: Tensor,
    ptr: Tensor,
    radius: float | None,
    max_neighbors: int,
    grid: ImageGrid | None,
    viewpoint: Tensor | None,
) -> Tensor:
    points, ptr = core_rows(points, ptr)
    normals = room(points.shape, torch.float32)
    search = ptr.shape[0] - 1, reachable(max_neighbors, points), limit_of(radius), *grid_arguments(grid)
    call("pc_normals", points, ptr, *search, viewpoint, viewpoint is not None and viewpoint.numel() == 3, normals)
    return normals


@kernel("facing_normals", "cpu")
def facing_normals(points: Tensor, normals: Tensor, viewpoint: Tensor) -> Tensor:
    """Turn them in one pass; another dtype than float32 is the reference's."""
    if any(one.dtype is not torch.float32 for one in (points, normals, viewpoint)):
        found: Tensor = INNER["facing_normals"].reference(points, normals, viewpoint)
        return found
    facing, of_all = room(normals.shape, torch.float32), viewpoint.numel() == 3
    arrays = points.contiguous(), normals.contiguous(), points.shape[0], viewpoint.contiguous()
    call("pc_face_normals", *arrays, of_all, facing)
    return facing


@kernel("neighborhood_shapes", "cpu")
def neighborhood_shapes(points: Tensor, index: Tensor, centers: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sum up one neighborhood after another."""
    queries, k = index.shape
    mean, covariance = room_for(((queries, 3), torch.float32), ((queries, 3, 3), torch.float64))
    counts = room(queries, torch.int64)
    arrays = points.detach().contiguous(), points.shape[0], index.contiguous(), queries, k, centers.contiguous()
    call("pc_neighborhood_shapes", *arrays, mean, covariance, counts)
    return mean, covariance, counts


@kernel("density_clusters", "cpu")
def density_clusters(points: Tensor, ptr: Tensor, eps: float, min_points: int, grid: ImageGrid | None) -> Tensor:
    """Join cells that hold core points, then number the clusters and label their borders."""
    label = room(points.shape[0], torch.int64)
    largest = answers(kind=ctypes.c_double)
    enough = min(min_points, points.shape[0] + 1)
    call("pc_dbscan", points, ptr, ptr.shape[0] - 1, eps, enough, label, largest)
    require_cells("dbscan", eps, largest[0])
    return label
