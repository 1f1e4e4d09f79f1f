"""Between depth images and points: the pinhole camera with the distortion of its lens.

OpenCV axes (x right, y down, z forward). Integer pixel coordinates are pixel centers, so pixel (u, v) is seen along
``K^-1 (u, v, 1)``. Depth is the z coordinate, not the ray length. A skewed K (K[0,1] not 0) is honored throughout.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner, op
from pcdata.contracts.known import FINITE, note
from pcdata.contracts.on_host import bounds_of, on_host, read_together
from pcdata.contracts.tensors import check_depths, check_tensors
from pcdata.errors import CaptureError
from pcdata.functional.rows import (
    cloud_of_rows,
    ptr_from_counts,
    rows_of_mask,
)
from pcdata.geometry.lens import distort_normalized, fold_radius, undistort_normalized
from pcdata.geometry.lens_models import check_distortion


@op(depth="V H W", intrinsics="V 3 3 : float", distortion="V D : float")
def deproject_depth(
    depth: Tensor,  # (V, H, W) float32, metres, 0 = no reading
    intrinsics: Tensor,  # (V, 3, 3) float32 or float64, pixels
    *,
    distortion: Tensor | None = None,  # (V, D) lenses, see pcdata.geometry.lens_models
    backend: str = "auto",
) -> tuple[Tensor, Tensor, Tensor]:  # points (M, 3) float32 metres, ptr (V+1,), pixel_index (M,) int64
    """Turn every depth reading into a 3D point in its own camera's frame.

    Points keep row-major pixel order; ``pixel_index`` is ``v * width + u`` within the point's own image. The ray of a
    pixel (:func:`pixel_rays`) is rounded to float32, then multiplied by the depth in float32.

    Raises:
        CaptureError: a negative depth, impossible intrinsics or distortion, or a reading where the lens model has no
            inverse.
        NonFiniteError: NaN or infinity anywhere.

    Source: Hartley & Zisserman, Multiple View Geometry, 2nd ed., section 6.1.
    """
    check_intrinsics("deproject_depth", intrinsics)
    check_depths("deproject_depth", "depth", depth)
    height, width = depth.shape[1:]
    rays = pixel_rays(intrinsics, (height, width), distortion).float()
    valid = depth > 0
    beyond = (rays.detach() * depth.detach()[..., None]).isfinite().all(-1).logical_not_() & valid
    counts, (lost, wild) = read_together([valid.sum(dim=(1, 2)), torch.stack([_lost(rays, valid), beyond.sum()])])
    _require_rays("deproject_depth", lost)
    rows = rows_of_mask(valid.flatten(), sum(counts))
    z = depth.flatten()[rows]
    points = torch.cat([rays.flatten(0, 2)[rows] * z[:, None], z[:, None]], dim=1)
    if not wild:
        note(FINITE, points)
    return points, ptr_from_counts(counts, depth.device), rows % (height * width)


@inner
def mask_depth(depth: Tensor, near: float | None, far: float | None, mask: Tensor | None) -> Tensor:
    """Return the depth (V, H, W) where it lies within [near, far] and inside the mask (V, H, W); 0 elsewhere."""
    keep = depth > 0
    if near is not None:
        keep &= depth >= near
    if far is not None:
        keep &= depth <= far
    if mask is not None:
        keep &= mask
    return torch.where(keep, depth, 0.0)


@dataclass(frozen=True)
class Deprojected:
    """Points of depth images with what other images say about the same pixels."""

    points: Tensor  # (M, 3) float32
    ptr: Tensor  # (V+1,)
    source_index: Tensor  # (M,) int64, the pixel counted over all views
    colors: Tensor | None  # (M, 3) float32 in [0, 1]
    rows: dict[str, Tensor]  # image name -> (M, ...)


@inner
def deproject_images(
    depth: Tensor,  # (V, H, W) float32
    intrinsics: Tensor,  # (V, 3, 3)
    distortion: Tensor | None,  # (V, D)
    colors: Tensor | None,  # (V, H, W, 3) uint8
    images: Mapping[str, Tensor],  # each (V, H, W, ...)
) -> Deprojected:
    """Run :func:`deproject_depth` and look up the same pixels in other images."""
    points, ptr, pixel_index = deproject_depth(depth, intrinsics, distortion=distortion)
    source_index = cloud_of_rows(ptr) * depth[0].numel() + pixel_index
    rgb = None if colors is None else colors.reshape(-1, 3)[source_index].float() / 255
    rows = {name: image.flatten(0, 2)[source_index] for name, image in images.items()}
    return Deprojected(points, ptr, source_index, rgb, rows)


def pixel_rays(
    intrinsics: Tensor,  # (V, 3, 3), pixels
    size: tuple[int, int],  # (height, width)
    distortion: Tensor | None = None,  # (V, D)
) -> Tensor:  # (V, H, W, 2) float64
    """Return (x/z, y/z) of the ray seen by every pixel center; NaN where the lens model has no inverse.

    Such pixels lie outside the lens circle (the corners of some wide-angle images) and should hold no reading.

    Raises:
        CaptureError: impossible intrinsics or distortion.
    """
    check_camera("pixel_rays", intrinsics, distortion)
    height, width = size
    fx, skew, cx, fy, cy = _pinhole(intrinsics[:, :, :, None, None])
    u = torch.arange(width, dtype=torch.float64, device=intrinsics.device)
    v = torch.arange(height, dtype=torch.float64, device=intrinsics.device)[:, None]
    y = ((v - cy) / fy).expand(-1, -1, width)
    x = (u - cx - skew * y) / fx
    rays = torch.stack([x, y], dim=-1)
    return rays if distortion is None else undistort_normalized(rays, distortion)


@op(points="N 3 : float", intrinsics="V 3 3 : float", distortion="V D : float", ptr="ptr N V")
def project_points(
    points: Tensor,  # (N, 3) float32 or float64, metres, in each view's camera frame
    ptr: Tensor | None = None,  # (V+1,)
    *,
    intrinsics: Tensor,  # (V, 3, 3), pixels
    distortion: Tensor | None = None,  # (V, D)
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:  # pixels (N, 2) float64 (u, v); depth (N,) in the points' dtype
    """Project the points of cloud b into view b; the inverse of :func:`deproject_depth`.

    Pixels are NaN for a point that has no image: z not positive, or so far off axis that the lens model folds back.
    Comparisons with NaN are false, so "inside the image" needs no extra case.

    Raises:
        CaptureError: impossible intrinsics or distortion.
    """
    assert ptr is not None  # @op fills it
    return projected(points, ptr, intrinsics, distortion)


def projected(points: Tensor, ptr: Tensor, intrinsics: Tensor, distortion: Tensor | None) -> tuple[Tensor, Tensor]:
    """Run the body of :func:`project_points`, in torch."""
    check_camera("project_points", intrinsics, distortion)
    view = cloud_of_rows(ptr)
    x, y, z = points.double().unbind(-1)
    visible = z > 0
    # What is not visible is not computed with: a NaN on the way would be in every gradient.
    xy = torch.stack([x, y], dim=-1) / torch.where(visible, z, 1.0)[:, None]
    if distortion is not None:
        visible = visible & (xy.square().sum(-1) < fold_radius(distortion).square()[view])
        xy = _distort_rows(torch.where(visible[:, None], xy, 0.0), ptr, distortion)
    fx, skew, cx, fy, cy = (value[view] for value in _pinhole(intrinsics))
    u = fx * xy[:, 0] + skew * xy[:, 1] + cx
    v = fy * xy[:, 1] + cy
    return torch.where(visible[:, None], torch.stack([u, v], dim=-1), torch.nan), points[:, 2]


def range_to_depth(
    ray_length: Tensor,  # (V, H, W) float32, metres along the ray, 0 = no reading
    intrinsics: Tensor,  # (V, 3, 3), pixels
    distortion: Tensor | None = None,  # (V, D)
) -> Tensor:  # (V, H, W) float32, metres along z
    """Convert the images of sensors that give ray length (range) into depth; 0 stays 0.

    Raises:
        CaptureError: as :func:`deproject_depth`.
    """
    check_tensors("range_to_depth", {"ray_length": ray_length}, {"ray_length": "V H W : depth"})
    check_camera("range_to_depth", intrinsics, distortion, views=len(ray_length))
    height, width = ray_length.shape[1:]
    rays = pixel_rays(intrinsics, (height, width), distortion)
    check_rays("range_to_depth", rays, ray_length > 0)
    known = ray_length > 0
    rays = torch.where(known[..., None], rays, 0.0)  # a pixel without a ray has no gradient
    depth = ray_length.double() / (1 + rays.square().sum(-1)).sqrt()
    return torch.where(known, depth, 0.0).float()


def check_intrinsics(where: str, intrinsics: Tensor) -> None:
    """Require (V, 3, 3) camera matrices ``[[fx, s, cx], [0, fy, cy], [0, 0, 1]]`` with positive focal lengths.

    Raises:
        CaptureError: the first fault, with the view and what to do.
    """
    for view, (row0, row1, row2) in enumerate(on_host(intrinsics).tolist()):
        found = f"{where}: the intrinsics of view {view}"
        if row2 != [0.0, 0.0, 1.0]:
            raise CaptureError(f"{found} must have the last row 0 0 1, got {row2}; is the matrix transposed?")
        if row1[0] != 0.0:
            raise CaptureError(f"{found} must have K[1,0] = 0, got {row1[0]:g}; is there a rotation in the matrix?")
        if row0[0] <= 0.0 or row1[1] <= 0.0:
            raise CaptureError(
                f"{found} must have positive focal lengths, got fx={row0[0]:g}, fy={row1[1]:g}; PyRep and "
                "RLBench write negative ones: negate both and turn the camera by 180 degrees about its z axis "
                "(world_from_camera @ diag(-1, -1, 1, 1))"
            )


def check_rays(where: str, rays: Tensor, needed: Tensor) -> None:
    """Require a ray (V, H, W, 2) wherever one is needed (V, H, W).

    Raises:
        CaptureError: with the number of pixels that have none.
    """
    _require_rays(where, int(_lost(rays, needed)))


def _lost(rays: Tensor, needed: Tensor) -> Tensor:
    return (needed & rays[..., 0].isnan()).sum()


def _require_rays(where: str, lost: int) -> None:
    if lost:
        raise CaptureError(
            f"{where}: the lens model cannot be inverted at {lost} pixels that have a reading (they lie "
            "beyond the radius where it folds back); check the order of the coefficients, or set those pixels to 0"
        )


def check_camera(where: str, intrinsics: Tensor, distortion: Tensor | None, views: int | None = None) -> None:
    """Require intrinsics (V, 3, 3), of so many views where that is said, and lenses (V, D) that can be.

    Raises:
        ShapeError, DTypeError, NonFiniteError, CaptureError: they are not such.
    """
    specs = {"intrinsics": f"{'V' if views is None else views} 3 3 : float", "distortion": "V D : float"}
    if views is not None:
        specs["distortion"] = f"{views} D : float"
    check_tensors(where, {"intrinsics": intrinsics, "distortion": distortion}, specs)
    check_intrinsics(where, intrinsics)
    if distortion is not None:
        check_distortion(where, distortion)


def _pinhole(intrinsics: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return fx, skew, cx, fy, cy, each (V,) float64."""
    k = intrinsics.double()
    return k[:, 0, 0], k[:, 0, 1], k[:, 0, 2], k[:, 1, 1], k[:, 1, 2]


def _distort_rows(xy: Tensor, ptr: Tensor, distortion: Tensor) -> Tensor:
    bounds = bounds_of(ptr)
    clouds = zip(bounds, bounds[1:], distortion)
    return torch.cat([distort_normalized(xy[start:stop][None], one[None])[0] for start, stop, one in clouds])
