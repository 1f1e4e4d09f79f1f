"""Points and triangles projected, who is in front at every pixel, and what it looks like."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

import pcdata.functional.shading  # noqa: F401
from pcdata.contracts.dispatch import INNER, OPERATIONS, kernel
from pcdata.functional.depth.deproject import check_camera
from pcdata.functional.ranges import pixel_borders, pixel_turns
from pcdata.functional.rendering import RenderedPoints
from pcdata.functional.rows import ptr_from_counts
from pcdata.geometry.lens import plain_lenses
from pcdata.kernels.cpu.native import call, room, room_for

# The core keeps rows in 32 bits.
_MAX_ROWS = 2**32 - 2


@kernel("project_points", "cpu")
def project_points(
    *, points: Tensor, ptr: Tensor, intrinsics: Tensor, distortion: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Project in one pass where the lenses are polynomials without tilt."""
    check_camera("project_points", intrinsics, distortion)
    lenses = None if distortion is None else plain_lenses(distortion)
    if distortion is not None and lenses is None:
        found: tuple[Tensor, Tensor] = OPERATIONS["project_points"].reference(
            points, ptr, intrinsics=intrinsics, distortion=distortion
        )
        return found
    pixels = room((len(points), 2), torch.float64)
    cameras = intrinsics.double().contiguous(), lenses
    call("pc_project_points", points.double().contiguous(), ptr, len(ptr) - 1, *cameras, pixels)
    return pixels, points[:, 2]


@kernel("render_points", "cpu")
def render_points(
    *,
    points: Tensor,
    ptr: Tensor,
    intrinsics: Tensor,
    size: tuple[int, int],
    distortion: Tensor | None,
    point_size: float,
) -> RenderedPoints:
    """Project and draw in one pass; whichever thread comes first, the nearest point stays."""
    check_camera("project_points", intrinsics, distortion)
    lenses = None if distortion is None else plain_lenses(distortion)
    if (distortion is not None and lenses is None) or len(points) > _MAX_ROWS:
        found: RenderedPoints = OPERATIONS["render_points"].reference(
            points, ptr, intrinsics=intrinsics, size=size, distortion=distortion, point_size=point_size
        )
        return found
    shape = (len(intrinsics), *size)
    depth, index = room_for((shape, torch.float32), (shape, torch.int64))
    cameras = intrinsics.double().contiguous(), lenses
    call("pc_render_points", points, ptr, len(ptr) - 1, *cameras, *size, point_size, depth, index)
    return RenderedPoints(depth, index)


@kernel("render_ranges", "cpu")
def render_ranges(
    *, points: Tensor, ptr: Tensor, size: tuple[int, int], elevations: tuple[float, float]
) -> RenderedPoints:
    """Place and draw in one pass."""
    borders = pixel_borders("render_ranges", size, elevations)
    if len(points) > _MAX_ROWS:
        found: RenderedPoints = OPERATIONS["render_ranges"].reference(points, ptr, size=size, elevations=elevations)
        return found
    shape = (len(ptr) - 1, *size)
    depth, index = room_for((shape, torch.float32), (shape, torch.int64))
    call("pc_render_ranges", points, ptr, len(ptr) - 1, *size, *borders, depth, index)
    return RenderedPoints(depth, index)


@kernel("deproject_ranges", "cpu")
def deproject_ranges(*, ranges: Tensor, elevations: tuple[float, float]) -> tuple[Tensor, Tensor, Tensor]:
    """Count the readings of every row, then write their points."""
    views, beams, columns = ranges.shape
    turns = pixel_turns("deproject_ranges", (beams, columns), elevations)
    # Not torch's sum: its threads would be woken for a fraction of a millisecond.
    starts = ptr_from_counts(torch.from_numpy(np.count_nonzero(ranges.flatten(0, 1).numpy() > 0, axis=1)))
    size = int(starts[-1])
    points, pixel_index = room_for(((size, 3), torch.float32), ((size,), torch.int64))
    call("pc_deproject_ranges", ranges, views, beams, columns, starts, *turns, points, pixel_index)
    first = torch.arange(views + 1, dtype=torch.int64, device="cpu") * beams
    return points, starts[first], pixel_index


@kernel("shaded", "cpu")
def shaded(
    values: Tensor,
    item: Tensor,
    num_items: int,
    corners: Tensor | None = None,
    weights: Tensor | None = None,
    *,
    as_bytes: bool = False,
) -> Tensor:
    """Mix and round in one pass."""
    pixels = len(item)
    (result,) = room_for(((pixels, 3), torch.uint8 if as_bytes else torch.float32))
    where = item.contiguous(), pixels, num_items
    mixing = (
        (None, None, 1)
        if corners is None or weights is None
        else (corners.contiguous(), weights.contiguous(), corners.shape[1])
    )
    call("pc_shade", *where, *mixing, values.contiguous(), *((None, result) if as_bytes else (result, None)))
    return result


@kernel("front_triangles", "cpu")
def front_triangles(
    boxes: tuple[Tensor, Tensor, Tensor], width: int, rays: Tensor, normal: Tensor, offset: Tensor, sides: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Draw all triangles, some at a time; then look up where in the nearest one every pixel lies."""
    if len(normal) > _MAX_ROWS:
        found: tuple[Tensor, Tensor, Tensor] = INNER["front_triangles"].reference(
            boxes, width, rays, normal, offset, sides
        )
        return found
    pixels = len(rays)
    depth, index, weights = room_for(((pixels,), torch.float32), ((pixels,), torch.int64), ((pixels, 3), torch.float32))
    planes = normal.contiguous(), offset.contiguous(), sides.contiguous()
    call(
        "pc_front_triangles",
        *(*(part.contiguous() for part in boxes), len(normal), width, rays.contiguous(), pixels),
        *(*planes, depth, index, weights),
    )
    return depth, index, weights
