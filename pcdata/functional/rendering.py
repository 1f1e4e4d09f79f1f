"""Points and triangles as images: who is in front at every pixel.

Source: the z-buffer is Catmull's, 1974; rays against triangles Moeller & Trumbore, 1997.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner, op
from pcdata.contracts.numbers import checked_count, checked_image_size, checked_positive
from pcdata.contracts.on_host import uploaded
from pcdata.functional.depth.deproject import pixel_rays, project_points, projected
from pcdata.functional.rows import cloud_of_rows

_INDEX_BITS = 32  # of a key; the bits of its depth lie above them
_EMPTY = torch.iinfo(torch.int64).max
_LARGEST = 65  # pixels that a point is wide at most: nearer ones are no larger


class RenderedPoints(NamedTuple):
    """What is in front at every pixel."""

    depth: Tensor  # (V, H, W) float32 metres along z, 0 = nothing
    point_index: Tensor  # (V, H, W) int64 rows of the points; their number where there is nothing


class RenderedTriangles(NamedTuple):
    """What is in front at every pixel, and where in its triangle."""

    depth: Tensor  # (V, H, W) float32 metres along z, 0 = nothing
    triangle_index: Tensor  # (V, H, W) int64; their number where there is nothing
    weights: Tensor  # (V, H, W, 3) float32 of the triangle's corners, 0 where there is nothing


def _checked_size_of_points(where: str, name: str, arguments: Mapping[str, Any]) -> float:
    value = arguments[name]
    if value == 0 and not isinstance(value, bool):
        return 0.0
    return checked_positive(where, name, arguments)


@op(
    points="N 3",
    ptr="ptr N V",
    intrinsics="V 3 3 : float",
    distortion="V D : float",
    size=checked_image_size,
    point_size=_checked_size_of_points,
    gradient=False,
)
def render_points(
    points: Tensor,  # (N, 3) float32 metres, those of cloud v in the frame of camera v
    ptr: Tensor | None = None,  # (V+1,)
    *,
    intrinsics: Tensor,  # (V, 3, 3) pixels
    size: tuple[int, int],  # (height, width)
    distortion: Tensor | None = None,  # (V, D)
    point_size: float = 0.0,
    backend: str = "auto",
) -> RenderedPoints:
    """Render every cloud in its camera: at each pixel the nearest point, of equally near ones the first.

    A point covers the pixels whose centers lie in a square about where it projects, half-open: ``point_size`` metres
    wide at its depth, at least one pixel and at most 65. All of the square is as deep as the point.

    Raises:
        CaptureError: impossible intrinsics or distortion.
        ConfigError: a size below one pixel, or a point size that is negative or not finite.
    """
    assert ptr is not None
    pixels, _ = projected(points, ptr, intrinsics, distortion)
    view = cloud_of_rows(ptr)
    z = points[:, 2]
    visible = ~pixels[:, 0].isnan()
    at = torch.where(visible[:, None], pixels, 0.0)
    focal = intrinsics.double().diagonal(dim1=1, dim2=2)[:, :2][view]
    width = point_size * focal / torch.where(visible, z, 1.0).double()[:, None]
    half = width.clamp(1.0, float(_LARGEST)) / 2
    boxes = _Boxes.about(at - half, at + half, visible, view, size)
    return in_front(z, boxes.pixels(), (len(intrinsics), *size))


def in_front(
    depth: Tensor,  # (N,) float32
    targets: Iterable[tuple[Tensor, Tensor]],  # rows and a pixel of each, int64, counted over all images
    shape: tuple[int, int, int],  # (V, H, W)
) -> RenderedPoints:
    """Return the row with the least positive depth of all that a pixel is a target of, the first of equals."""
    image = torch.full((math.prod(shape),), _EMPTY, dtype=torch.int64, device=depth.device)
    keys = _keys(depth)
    for rows, target in targets:
        image.scatter_reduce_(0, target, keys[rows], "amin")
    image = image.reshape(shape)
    found = image != _EMPTY
    least = torch.where(found, (image >> _INDEX_BITS).int().view(torch.float32), 0.0)
    return RenderedPoints(least, torch.where(found, image & ((1 << _INDEX_BITS) - 1), len(depth)))


@inner
def front_triangles(
    boxes: tuple[Tensor, Tensor, Tensor],  # (T,) int64 each: the first pixel of a triangle's box, pixels across, down
    width: int,  # of an image
    rays: Tensor,  # (P, 2) float64 x/z, y/z of every pixel of all images
    normal: Tensor,  # (T, 3) float64
    offset: Tensor,  # (T,) float64
    sides: Tensor,  # (T, 3, 3) float64
    *,
    backend: str = "auto",
) -> tuple[Tensor, Tensor, Tensor]:  # depth (P,) float32, index (P,) int64, weights (P, 3) float32
    """Return the nearest triangle that the ray of every pixel meets; depth 0, T and weights 0 where it meets none."""
    image = torch.full((len(rays),), _EMPTY, dtype=torch.int64, device=rays.device)
    for rows, target in _Boxes(*boxes, width).pixels():
        depth = _met(rays[target], normal[rows], offset[rows], sides[rows])[0]
        hit = depth > 0
        image.scatter_reduce_(0, target[hit], _keys(depth[hit].float(), rows[hit]), "amin")
    found = (image != _EMPTY).nonzero().squeeze(1)
    index = torch.full((len(rays),), len(normal), dtype=torch.int64, device=rays.device)
    index[found] = image[found] & ((1 << _INDEX_BITS) - 1)
    front = index[found]
    depth_at, weights_at = _met(rays[found], normal[front], offset[front], sides[front])
    depth = torch.zeros(len(rays), dtype=torch.float32, device=rays.device)
    weights = torch.zeros(len(rays), 3, dtype=torch.float32, device=rays.device)
    depth[found], weights[found] = depth_at.float(), weights_at.float()
    return depth, index, weights


@op(
    triangles="T 3 3",
    ptr="ptr T V",
    intrinsics="V 3 3 : float",
    distortion="V D : float",
    size=checked_image_size,
    steps=(front_triangles,),
    gradient=False,
)
def render_triangles(
    triangles: Tensor,  # (T, 3, 3) float32 metres: the corners, those of mesh v in the frame of camera v
    ptr: Tensor | None = None,  # (V+1,)
    *,
    intrinsics: Tensor,  # (V, 3, 3) pixels
    size: tuple[int, int],  # (height, width)
    distortion: Tensor | None = None,  # (V, D)
    backend: str = "auto",
) -> RenderedTriangles:
    """Render every mesh in its camera: where the ray of each pixel's center first meets a triangle, either side.

    Depth and weights are those of the ray and the triangle's plane, in float64, so exact with a lens too. A triangle
    with a corner that has no pixel (behind the camera, or beyond the lens) is not drawn. Of triangles met at the same
    depth the first is taken.

    Raises:
        CaptureError: impossible intrinsics or distortion.
        ConfigError: a size below one pixel.
    """
    assert ptr is not None
    corners = triangles.double()
    project = projected if backend == "torch" else project_points
    pixels, _ = project(corners.flatten(0, 1), 3 * ptr, intrinsics=intrinsics, distortion=distortion)
    pixels = pixels.reshape(-1, 3, 2)
    visible = ~pixels.isnan().flatten(1).any(1)
    at = torch.where(visible[:, None, None], pixels, 0.0)
    # A lens bends edges outward by less than a pixel where triangles are a few pixels wide; a pinhole does not.
    margin = 1e-6 if distortion is None else 1.0 + 0.05 * (at.amax(1) - at.amin(1))
    boxes = _Boxes.about(at.amin(1) - margin, at.amax(1) + margin, visible, cloud_of_rows(ptr), size)
    rays = pixel_rays(intrinsics, size, distortion).flatten(0, 2)
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], dim=-1)
    offset = (normal * corners[:, 0]).sum(-1)
    sides = torch.stack(
        [torch.linalg.cross(corners[:, i], corners[:, j], dim=-1) for i, j in ((1, 2), (2, 0), (0, 1))], 1
    )
    depth, index, weights = front_triangles(boxes[:3], size[1], rays, normal, offset, sides, backend=backend)
    shape = (len(intrinsics), *size)
    return RenderedTriangles(depth.reshape(shape), index.reshape(shape), weights.reshape(*shape, 3))


def _met(rays: Tensor, normal: Tensor, offset: Tensor, sides: Tensor) -> tuple[Tensor, Tensor]:
    """Return the depth (P,) at which rays (x/z, y/z) meet triangles, 0 where they miss; weights (P, 3) of corners."""
    x, y = rays.unbind(-1)

    def along(vector: Tensor) -> Tensor:
        return vector[..., 0] * x + vector[..., 1] * y + vector[..., 2]

    volumes = torch.stack([along(sides[:, corner]) for corner in range(3)], dim=-1)
    total = along(normal)
    inside = ((volumes >= 0).all(-1) | (volumes <= 0).all(-1)) & (total != 0)
    safe = torch.where(inside, total, 1.0)
    depth = torch.where(inside, offset / safe, 0.0)
    shares = ((volumes[..., 0] + volumes[..., 1]) + volumes[..., 2])[..., None]
    weights = volumes / torch.where(shares == 0, 1.0, shares)
    return torch.where(inside & (depth > 0), depth, 0.0), weights


def _keys(depth: Tensor, index: Tensor | None = None) -> Tensor:
    """Return what orders by depth, then by index: the bits of positive floats are ordered as they are."""
    if index is None:
        index = torch.arange(len(depth), dtype=torch.int64, device=depth.device)
    return depth.contiguous().view(torch.int32).long().bitwise_left_shift(_INDEX_BITS).bitwise_or(index)


class _Boxes(NamedTuple):
    """Pixels of V images that N boxes cover."""

    first: Tensor  # (N,) int64 the first pixel of each, over all images
    across: Tensor  # (N,) int64
    down: Tensor  # (N,) int64
    width: int  # of an image

    @classmethod
    def about(cls, low: Tensor, high: Tensor, visible: Tensor, view: Tensor, size: tuple[int, int]) -> _Boxes:
        """Return the pixels with low <= center < high, each (N, 2), within the image of each box's view."""
        most = uploaded(torch.tensor([size[1], size[0]], dtype=torch.float64, device="cpu"), low.device)
        left, top = low.ceil().clamp(min=0).minimum(most).long().unbind(-1)
        right, bottom = high.ceil().clamp(min=0).minimum(most).long().unbind(-1)
        return cls((view * size[0] + top) * size[1] + left, (right - left) * visible, (bottom - top) * visible, size[1])

    def pixels(self) -> Any:
        """Yield rows of the boxes and a pixel of each, until all pixels of all boxes were there."""
        seen = ((self.across > 0) & (self.down > 0)).nonzero().squeeze(1)
        for row in range(int(self.down[seen].max()) if len(seen) else 0):
            left = seen[self.down[seen] > row]
            for column in range(int(self.across[left].max()) if len(left) else 0):
                left = left[self.across[left] > column]
                yield left, self.first[left] + (row * self.width + column)


@op(
    depth="V H W : depth",
    intrinsics="V 3 3 : float",
    distortion="V D : float",
    reach=partial(checked_count, maximum=16),
    max_jump=partial(checked_positive, finite=False),
    gradient=False,
)
def depth_normals(
    depth: Tensor,  # (V, H, W) float32 metres, 0 = no reading
    intrinsics: Tensor,  # (V, 3, 3) pixels
    *,
    distortion: Tensor | None = None,  # (V, D)
    reach: int = 1,
    max_jump: float = 0.02,
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:  # normals (V, H, W, 3) float32 unit, toward the camera; curvature (V, H, W) float32
    """Return the normal and the curvature of the surface at every pixel of depth images; zero where there is none.

    The neighborhood is the window of ``2 reach + 1`` pixels whose depths differ from the middle's by at most
    ``max_jump`` times it: an edge is no surface. The normal is the direction of least variance of its points, in
    float64; the curvature their surface variation, the least variance as a share of all three, 0 (flat) to 1/3. Fewer
    than three points, or points on one line, have neither.

    Raises:
        CaptureError: a negative depth, or impossible intrinsics or distortion.

    Source: Hoppe et al., 1992; surface variation: Pauly, Gross & Kobbelt, 2002.
    """
    views, height, width = depth.shape
    rays = pixel_rays(intrinsics, (height, width), distortion).nan_to_num()
    z = depth.double()
    points = torch.cat([rays * z[..., None], z[..., None]], dim=-1)
    padded = torch.nn.functional.pad(points, (0, 0, reach, reach, reach, reach))
    count = torch.zeros_like(z)
    first = torch.zeros_like(points)
    second = z.new_zeros(views, height, width, 3, 3)
    for row in range(2 * reach + 1):
        for column in range(2 * reach + 1):
            other = padded[:, row : row + height, column : column + width]
            near = (other[..., 2] > 0) & (z > 0) & ((other[..., 2] - z).abs() <= max_jump * z)
            apart = torch.where(near[..., None], other - points, 0.0)
            count += near
            first += apart
            second += apart[..., :, None] * apart[..., None, :]
    mean = first / count.clamp(min=1)[..., None]
    covariance = second / count.clamp(min=1)[..., None, None] - mean[..., :, None] * mean[..., None, :]
    values, vectors = torch.linalg.eigh(covariance)
    known = (count >= 3) & (values[..., 1] > 1e-9 * values[..., 2])
    normal = vectors[..., 0]
    toward = torch.where(((normal * points).sum(-1) > 0)[..., None], -normal, normal)
    curvature = values[..., 0].clamp(min=0) / values.clamp(min=0).sum(-1).clamp(min=1e-300)
    return torch.where(known[..., None], toward, 0.0).float(), torch.where(known, curvature, 0.0).float()
