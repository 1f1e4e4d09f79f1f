"""Points and triangles projected, and who is in front at every pixel."""

from __future__ import annotations

import torch
from torch import Tensor

from pcdata.contracts.dispatch import INNER, OPERATIONS, kernel
from pcdata.functional.depth.deproject import check_camera
from pcdata.functional.rendering import RenderedPoints
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


@kernel("least_at_pixels", "cpu")
def least_at_pixels(value: Tensor, pixel: Tensor, num_pixels: int) -> tuple[Tensor, Tensor]:
    """Keep the least key of every pixel, whichever thread brings it."""
    if len(value) > _MAX_ROWS:
        found: tuple[Tensor, Tensor] = INNER["least_at_pixels"].reference(value, pixel, num_pixels)
        return found
    least, index = room_for(((num_pixels,), torch.float32), ((num_pixels,), torch.int64))
    call("pc_least_at_pixels", value.contiguous(), pixel.contiguous(), len(value), num_pixels, least, index)
    return least, index


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
