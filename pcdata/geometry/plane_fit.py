"""A plane through points: exactly through three, or by least squares; and how far points lie from it.

A plane is (nx, ny, nz, d) with a unit normal and n.p + d = 0.
"""

from __future__ import annotations

import torch
from torch import Tensor

# A triangle this flat, 8 float32 steps of its largest coordinate, cannot be told from a line.
FLAT = 8.0 * torch.finfo(torch.float32).eps


def plane_distance(
    points: Tensor,  # (N, 3) float32
    planes: Tensor,  # (P, 4)
    *,
    out: tuple[Tensor, Tensor] | None = None,  # two (P, N) float32 buffers; the first becomes the result
) -> Tensor:  # (P, N) float32
    """Return signed distances as ((nx*x + ny*y) + nz*z) + d.

    Separate float32 operations: nothing fuses them, so every backend and device gets the same bits.
    """
    x, y, z = points.unbind(-1)
    nx, ny, nz, d = planes.to(dtype=torch.float32, device=points.device)[..., None].unbind(1)
    total, product = out or (points.new_empty((len(planes), len(points))), None)
    torch.mul(nx, x, out=total)
    total += torch.mul(ny, y, out=product)
    total += torch.mul(nz, z, out=product)
    total += d
    return total


def fit_plane(points: Tensor) -> Tensor | None:
    """Return the (4,) float64 least-squares plane of (N, 3) points on the CPU, or None if they lie on a line.

    The normal is the eigenvector of the smallest eigenvalue of the covariance; its sign is arbitrary.
    """
    if len(points) < 3:
        return None
    wide = points.double()
    center = wide.mean(dim=0)
    centered = wide - center
    moments = center.cpu(), ((centered.T @ centered) / len(points)).cpu(), wide.abs().max().cpu()
    plane = plane_of_moments(*(moment[None] for moment in moments))[0]
    return None if bool(plane[0].isnan()) else plane


def plane_of_moments(
    center: Tensor,  # (B, 3) float64
    covariance: Tensor,  # (B, 3, 3) float64
    largest: Tensor,  # (B,) absolute coordinate
) -> Tensor:  # (B, 4) float64
    """Return the planes of :func:`fit_plane` from the moments of the points, all on the CPU; NaN for a line."""
    variance, directions = torch.linalg.eigh(covariance)
    on_line = variance[:, 1].clamp(min=0).sqrt() <= _flat_height(largest)
    normal = directions[:, :, 0]
    # Three products added in one order, whatever library multiplies matrices here.
    x, y, z = (normal * center).unbind(1)
    planes = torch.cat([normal, -((x + z) + y)[:, None]], dim=1)
    return planes.masked_fill(on_line[:, None], torch.nan)


def planes_through(corners: Tensor) -> Tensor:
    """Return the (..., 4) float64 planes through (..., 3, 3) points on the CPU; NaN for those on a line."""
    a, b, c = corners.double().unbind(-2)
    normal = torch.linalg.cross(b - a, c - a)
    length = normal.norm(dim=-1)
    longest = torch.stack([(b - a).norm(dim=-1), (c - a).norm(dim=-1), (c - b).norm(dim=-1)]).amax(0)
    collinear = ~(length > longest * _flat_height(corners.abs().amax(dim=(-1, -2)).double()))
    normal = normal / length[..., None]
    planes = torch.cat([normal, -(normal * a).sum(-1, keepdim=True)], dim=-1)
    return planes.masked_fill(collinear[..., None], torch.nan)


def through_origin(planes: Tensor, distance: float) -> Tensor:
    """Whether the origin is an inlier of planes (..., 4): then no side of it can be told by where the origin lies."""
    return planes[..., 3].abs() < distance


def _flat_height(largest: Tensor) -> Tensor:
    return FLAT * largest
