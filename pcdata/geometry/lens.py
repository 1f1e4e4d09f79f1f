"""The OpenCV lens model: bending normalized image coordinates, and bending them back.

Normalized coordinates are (x/z, y/z) of a point in the camera frame. Coefficients come in OpenCV's order,
``k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4]]]``: 4, 5, 8 or 12 of them.

Source: OpenCV calib3d, "Detailed description"; the radial part is Brown (1966), the quotient Claus & Fitzgibbon (2005).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from pcdata.errors import CaptureError, ShapeError

COEFFICIENT_COUNTS = (4, 5, 8, 12)

# Normalized units. With a focal length of 1000 pixels this is 1e-9 pixel, far below what float32 rays can hold.
_CONVERGED = 1e-12
# Newton needs 4 to 6 steps on real lenses; only pixels beside the fold of the model, where it slows down, need more.
_MAX_STEPS = 60
# Coordinates inverted at once: the dozens of intermediate tensors stay in a CPU core's cache.
_CHUNK = 16384
# A zero this near a pole, as a share of it, takes it away: a fit with coefficients to spare makes such pairs. Together
# they bend rays by less than 1e-3 of their radius but within 1 % of the pole, where no lens does what they say.
_CANCELS = 1e-5
# Largest r^2 of a ray that any pinhole image holds: 89.4 degrees off axis.
_FAR = 1e4


class _Coefficients(NamedTuple):
    """The twelve coefficients, each shaped to broadcast against coordinates."""

    k1: Tensor
    k2: Tensor
    p1: Tensor
    p2: Tensor
    k3: Tensor
    k4: Tensor
    k5: Tensor
    k6: Tensor
    s1: Tensor
    s2: Tensor
    s3: Tensor
    s4: Tensor


def check_distortion(where: str, distortion: Tensor) -> None:
    """Require (..., D) coefficients with D one of 4, 5, 8, 12.

    Raises:
        CaptureError: any other number; 14 (a tilted sensor) is refused by name.
    """
    count = distortion.shape[-1] if distortion.ndim else 0
    if count == 14:
        raise CaptureError(
            f"{where}: 14 distortion coefficients describe a tilted sensor, which is not supported; "
            "if tau_x and tau_y (the last two) are 0, pass the first 12"
        )
    if count not in COEFFICIENT_COUNTS:
        raise CaptureError(
            f"{where}: distortion must hold 4, 5, 8 or 12 coefficients per view in OpenCV's order "
            f"(k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4), got {count}; pass None for a lens without distortion"
        )


def distort_normalized(
    xy: Tensor,  # (V, ..., 2) normalized coordinates of undistorted rays
    distortion: Tensor,  # (V, D)
) -> Tensor:  # (V, ..., 2) float64
    """Bend normalized coordinates as each view's lens does (the forward model).

    Coordinates beyond :func:`fold_radius` come out too, folded back toward the image as the polynomial has it; whoever
    projects points must reject them.

    Raises:
        ShapeError: the views of the two differ.
        CaptureError: the number of coefficients is not one of OpenCV's.
    """
    _check_views("distort_normalized", xy, distortion)
    x, y = xy.double().unbind(-1)
    return torch.stack(_bend(x, y, _split(distortion, x.ndim)), dim=-1)


def undistort_normalized(
    xy: Tensor,  # (V, ..., 2) normalized coordinates as seen in the image
    distortion: Tensor,  # (V, D)
) -> Tensor:  # (V, ..., 2) float64
    """Invert :func:`distort_normalized` to 1e-12; NaN where the lens model has no inverse.

    Newton's method from the distorted position, kept inside :func:`fold_radius`: beyond it the model folds back over
    itself and a second solution exists that no ray took. A pole that a zero cancels (to 1e-5 of its place) is taken out
    with it. First derivatives are those of the inverse function, none where there is no inverse.

    Raises:
        ShapeError, CaptureError: as :func:`distort_normalized`.
    """
    _check_views("undistort_normalized", xy, distortion)
    target = xy.double().reshape(len(xy), -1, 2)
    with torch.no_grad():
        solved = torch.empty_like(target)
        for view, coefficients in enumerate(distortion):
            fold = float(fold_radius(coefficients[None]))
            split = _split(_without_canceled_poles(coefficients)[None], 1)
            for begin in range(0, target.shape[1], _CHUNK):
                some = slice(begin, begin + _CHUNK)
                solved[view, some] = _invert(target[view, some], split, fold)
    if torch.is_grad_enabled() and (xy.requires_grad or distortion.requires_grad):
        solved = _with_gradient(solved, target, distortion)
    return solved.reshape(xy.shape)


def _with_gradient(solved: Tensor, target: Tensor, distortion: Tensor) -> Tensor:
    """Attach the inverse function's derivative to its values (V, P, 2): that of one Newton step at the solution."""
    known = ~solved.isnan().any(-1, keepdim=True)
    at = torch.where(known, solved, 0.0)  # the center of the image stands in where there is no solution
    x, y = at.unbind(-1)
    coefficients = _split(distortion, 2)
    with torch.no_grad():
        xx, xy, yx, yy = _jacobian(x, y, coefficients)
        determinant = xx * yy - xy * yx
    bent_x, bent_y = _bend(x, y, coefficients)
    error_x, error_y = bent_x - target[..., 0], bent_y - target[..., 1]
    step = torch.stack([yy * error_x - xy * error_y, xx * error_y - yx * error_x], -1) / determinant[..., None]
    step = torch.where(known, step, 0.0)
    return solved - (step - step.detach())  # the value keeps every bit


def fold_radius(distortion: Tensor) -> Tensor:
    """Return (V,) float64: the normalized radius at which each view's radial model stops growing, or infinity.

    It is the first zero of d(r N/D)/dr, or the first pole that no zero cancels; with t = r^2 both are polynomials in t.
    """
    radii = []
    for coefficients in _padded(distortion):
        numerator, denominator = _radial_parts(coefficients)
        t = np.polynomial.Polynomial([0.0, 1.0])
        slope = numerator * denominator + 2 * t * (numerator.deriv() * denominator - numerator * denominator.deriv())
        folds = [*_positive_roots(slope), *_positive_roots(denominator)]
        radii.append(min(folds, default=np.inf) ** 0.5)
    return torch.tensor(radii, dtype=torch.float64, device=distortion.device)


def _radial_parts(coefficients: Tensor) -> tuple[np.polynomial.Polynomial, np.polynomial.Polynomial]:
    """Return numerator and denominator of one view's radial quotient in t = r^2, without canceled poles."""
    k1, k2, _, _, k3, k4, k5, k6 = _padded(coefficients)[:8].tolist()
    numerator = np.polynomial.Polynomial([1.0, k1, k2, k3])
    denominator = np.polynomial.Polynomial([1.0, k4, k5, k6])
    for pole in _positive_roots(denominator):
        zero = min(_positive_roots(numerator), key=lambda root: abs(root - pole), default=np.inf)
        if abs(zero - pole) <= _CANCELS * pole:
            numerator //= np.polynomial.Polynomial([1.0, -1.0 / zero])
            denominator //= np.polynomial.Polynomial([1.0, -1.0 / pole])
    return numerator, denominator


def _without_canceled_poles(coefficients: Tensor) -> Tensor:
    """Return (12,) float64 coefficients of the same lens whose radial quotient is reduced."""
    reduced = _padded(coefficients)
    for part, places in zip(_radial_parts(coefficients), ([0, 1, 4], [5, 6, 7])):
        given = part.coef[1:4].tolist()
        reduced[places] = reduced.new_tensor([*given, *[0.0] * (3 - len(given))])
    return reduced


def _positive_roots(polynomial: np.polynomial.Polynomial) -> list[float]:
    """Return the real roots in (0, _FAR]; leading terms too small to matter there are dropped first."""
    coefficients = polynomial.coef
    matters = np.abs(coefficients) * _FAR ** np.arange(len(coefficients)) > 1e-12
    roots: list[complex] = np.polynomial.Polynomial(coefficients[: np.flatnonzero(matters)[-1] + 1]).roots().tolist()
    return [root.real for root in roots if abs(root.imag) <= 1e-9 * abs(root) and 0 < root.real <= _FAR]


def _invert(target: Tensor, coefficients: _Coefficients, fold: float) -> Tensor:
    """Undistort (P, 2) coordinates of one view; those that have converged drop out of each further step."""
    target_x, target_y = target.unbind(-1)
    x, y = target_x.clone(), target_y.clone()
    open_ = torch.arange(len(x), dtype=torch.int64, device=x.device)
    for _ in range(_MAX_STEPS):
        px, py = x[open_], y[open_]
        bent_x, bent_y = _bend(px, py, coefficients)
        error_x, error_y = bent_x - target_x[open_], bent_y - target_y[open_]
        # Written so that a NaN stays open.
        unsolved = ~((error_x.abs() <= _CONVERGED) & (error_y.abs() <= _CONVERGED) & (px * px + py * py < fold * fold))
        if not bool(unsolved.any()):
            return torch.stack([x, y], dim=-1)
        open_, px, py = open_[unsolved], px[unsolved], py[unsolved]
        x[open_], y[open_] = _newton_step(px, py, error_x[unsolved], error_y[unsolved], coefficients, fold)
    x[open_] = y[open_] = torch.nan
    return torch.stack([x, y], dim=-1)


def _newton_step(
    x: Tensor, y: Tensor, error_x: Tensor, error_y: Tensor, coefficients: _Coefficients, fold: float
) -> tuple[Tensor, Tensor]:
    xx, xy, yx, yy = _jacobian(x, y, coefficients)
    determinant = xx * yy - xy * yx
    new_x = x - (yy * error_x - xy * error_y) / determinant
    new_y = y - (xx * error_y - yx * error_x) / determinant
    # A step over the fold comes back to just inside it; a singular Jacobian (NaN) is left to fail.
    shrink = (0.999 * fold / torch.hypot(new_x, new_y)).clamp(max=1.0)
    return new_x * shrink, new_y * shrink


def _bend(x: Tensor, y: Tensor, c: _Coefficients) -> tuple[Tensor, Tensor]:
    r2 = x * x + y * y
    radial = _cubic(r2, c.k1, c.k2, c.k3) / _cubic(r2, c.k4, c.k5, c.k6)
    bent_x = x * radial + 2 * c.p1 * x * y + c.p2 * (r2 + 2 * x * x) + (c.s1 + c.s2 * r2) * r2
    bent_y = y * radial + c.p1 * (r2 + 2 * y * y) + 2 * c.p2 * x * y + (c.s3 + c.s4 * r2) * r2
    return bent_x, bent_y


def _jacobian(x: Tensor, y: Tensor, c: _Coefficients) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return d(bent_x)/dx, d(bent_x)/dy, d(bent_y)/dx, d(bent_y)/dy."""
    r2 = x * x + y * y
    denominator = _cubic(r2, c.k4, c.k5, c.k6)
    radial = _cubic(r2, c.k1, c.k2, c.k3) / denominator
    slope = (_cubic_slope(r2, c.k1, c.k2, c.k3) - radial * _cubic_slope(r2, c.k4, c.k5, c.k6)) / denominator
    prism_x, prism_y = c.s1 + 2 * c.s2 * r2, c.s3 + 2 * c.s4 * r2
    mixed = 2 * (x * y * slope + c.p1 * x + c.p2 * y)
    xx = radial + 2 * x * x * slope + 2 * c.p1 * y + 6 * c.p2 * x + 2 * x * prism_x
    yy = radial + 2 * y * y * slope + 6 * c.p1 * y + 2 * c.p2 * x + 2 * y * prism_y
    return xx, mixed + 2 * y * prism_x, mixed + 2 * x * prism_y, yy


def _cubic(t: Tensor, a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    return 1 + t * (a + t * (b + t * c))


def _cubic_slope(t: Tensor, a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    return a + t * (2 * b + t * (3 * c))


def _padded(distortion: Tensor) -> Tensor:
    """Return (V, 12) float64 coefficients; those not given are 0."""
    return torch.nn.functional.pad(distortion.double(), (0, 12 - distortion.shape[-1]))


def _split(distortion: Tensor, ndim: int) -> _Coefficients:
    """Shape every (V,) coefficient to broadcast against (V, ...) coordinates of ``ndim`` dimensions."""
    return _Coefficients(*(column.reshape(-1, *[1] * (ndim - 1)) for column in _padded(distortion).unbind(-1)))


def _check_views(where: str, xy: Tensor, distortion: Tensor) -> None:
    if xy.ndim < 2 or xy.shape[-1] != 2 or distortion.ndim != 2 or len(distortion) != len(xy):
        raise ShapeError(
            f"{where}: coordinates must be (V, ..., 2) and distortion (V, D) for the same V views, "
            f"got {tuple(xy.shape)} and {tuple(distortion.shape)}"
        )
    check_distortion(where, distortion)
