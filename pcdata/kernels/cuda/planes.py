"""RANSAC: a thread for every few hypotheses walks past the points; a fit and its inliers are one kernel a round."""

from __future__ import annotations

import torch
from torch import Tensor

import pcdata.functional.planes  # noqa: F401 - the functions must be registered before their kernels
from pcdata.contracts.dispatch import kernel
from pcdata.functional.plane_steps import MAX_REFINEMENTS, spread_points, tries_needed, within_tilt
from pcdata.functional.rows import cloud_of_rows, counts_from_ptr
from pcdata.geometry.plane_fit import plane_of_moments
from pcdata.kernels.cuda.launching import BLOCK, Launcher, launcher_of

_ROWS_OF_A_BLOCK = 2048
SUMS = 12  # kPlaneSums of the kernel


@kernel("record_planes", "cuda")
def record_planes(
    points: Tensor, ptr: Tensor, planes: Tensor, competes: Tensor, distance: float, floors: Tensor
) -> Tensor:
    """Count for all planes at once; the one wait is for their counts."""
    clouds, some = competes.shape
    launcher, device = launcher_of(points), points.device
    asked = planes.float().masked_fill(~competes[..., None], torch.nan).to(device)
    found = torch.zeros((clouds, some), dtype=torch.int32, device=device)
    blocks = blocks_of_a_cloud(launcher, len(points), clouds)
    launcher.launch_blocks(
        "pc_count_near_planes",
        *(clouds * blocks, points.contiguous(), ptr.contiguous(), blocks, asked, some, float(distance), found),
    )
    counts = found.cpu().long()
    before = torch.cat([floors[:, None], counts[:, :-1]], 1).cummax(1).values
    return counts.masked_fill_((counts <= before) | (counts <= floors[:, None]), 0)


@kernel("search_planes", "cuda")
def search_planes(
    points: Tensor,
    ptr: Tensor,
    planes: Tensor,
    competes: Tensor,
    distance: float,
    probability: float,
    not_drawn: int,
    bits: int,
) -> Tensor:
    """Count for all planes at once, which costs less than a second wait, and forget those behind the last try."""
    points, ptr = spread_points(points, ptr, bits)
    floors = torch.zeros(len(planes), dtype=torch.int64, device="cpu")
    counts = record_planes(points, ptr, planes, competes, distance, floors)
    sizes = counts_from_ptr(ptr).cpu()[:, None].double()
    drawn = torch.arange(1, planes.shape[1] + 1, dtype=torch.float64, device="cpu") - not_drawn
    is_enough = drawn >= tries_needed(counts.cummax(1).values, sizes, probability)
    return counts.masked_fill_(is_enough.cumsum(1) - is_enough.int() > 0, 0)


@kernel("refine_planes", "cuda")
def refine_planes(
    points: Tensor, ptr: Tensor, planes: Tensor, distance: float, ups: Tensor | None, max_tilt: float | None
) -> tuple[Tensor, Tensor]:
    """Mark and sum up in one kernel, one wait a round; the fits are the reference's, from moments."""
    points, ptr, planes = points.contiguous(), ptr.contiguous(), planes.clone()
    cloud = cloud_of_rows(ptr) if len(planes) > 1 else None
    origins = points[ptr[:-1]].double()
    inliers = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    before, sums = _marked(points, ptr, planes, distance, origins, inliers)
    inliers = before
    open_ = torch.ones(len(planes), dtype=torch.bool, device="cpu")
    host_origins = origins.cpu()
    for _ in range(MAX_REFINEMENTS):
        refitted = _fitted(sums, host_origins)
        fits = open_ & ~refitted[:, 0].isnan() & within_tilt(refitted, ups, max_tilt)
        asked = refitted.masked_fill(~fits[:, None], torch.nan)
        after, sums = _marked(points, ptr, asked, distance, origins, inliers)
        fits &= sums[:, 0] >= 3
        planes[fits] = refitted[fits]
        if cloud is None:
            inliers = after if bool(fits) else inliers
        else:
            inliers = torch.where(fits.to(points.device)[cloud], after, inliers)
        open_ = fits & (sums[:, 1] > 0)
        if not bool(open_.any()):
            break
    return planes, inliers


def _marked(
    points: Tensor, ptr: Tensor, planes: Tensor, distance: float, origins: Tensor, before: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the points near their cloud's plane (N,) bool, and the sums over these (B, 12) float64 on the CPU."""
    launcher, clouds = launcher_of(points), len(planes)
    near = torch.zeros_like(before)
    blocks = blocks_of_a_cloud(launcher, len(points), clouds)
    sums = torch.empty((clouds, blocks, SUMS), dtype=torch.float64, device=points.device)
    asked = planes.float().to(points.device)
    launcher.launch_blocks(
        "pc_mark_near_plane",
        *(clouds * blocks, points, ptr, blocks, asked, float(distance), origins, before, near, sums),
    )
    host = sums.cpu()
    return near, torch.cat([host[..., :-1].sum(1), host[..., -1:].amax(1)], 1)


def _fitted(sums: Tensor, origins: Tensor) -> Tensor:
    """Return the least-squares planes (B, 4) of points summed up about origins; NaN for a line, or fewer than three."""
    count = sums[:, :1].clamp(min=1)
    mean = sums[:, 2:5] / count
    xx, xy, xz, yy, yz, zz = (sums[:, 5:11] / count).unbind(1)
    second = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], dim=1).reshape(-1, 3, 3)
    covariance = second - mean[:, :, None] * mean[:, None, :]
    planes = plane_of_moments(origins + mean, covariance, sums[:, 11])
    return planes.masked_fill(sums[:, :1] < 3, torch.nan)


def blocks_of_a_cloud(launcher: Launcher, rows: int, clouds: int) -> int:
    """Return how many blocks share each cloud: no more than keep the device busy."""
    busy = launcher.busy_threads() // BLOCK
    return max(1, min(-(-rows // (clouds * _ROWS_OF_A_BLOCK)), 8 * busy // clouds))
