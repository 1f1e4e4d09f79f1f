"""Lenses: bending normalized image coordinates, and bending them back.

Normalized coordinates are (x/z, y/z) of a point in the camera frame. What a lens is in numbers, and which models there
are: :mod:`pcdata.geometry.lens_models`.

OpenCV's polynomial, ``k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tau_x tau_y]]]]``, bends in closed form and is inverted
step by step. RealSense's ``inverse_brown_conrady`` (k1 k2 p1 p2 k3) does too: its documentation calls it the model that
undistorts, but since 2021 its SDK projects in closed form and iterates to deproject. It differs from OpenCV's only in
that p1 and p2 act on what k1 k2 k3 have bent; with the coefficients of a D455 that is less than 0.05 pixel.

Source: OpenCV calib3d, "Detailed description"; the radial part is Brown (1966), the quotient Claus & Fitzgibbon (2005),
the tilted sensor Louhichi et al. (2007); librealsense, rs2_project_point_to_pixel.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner
from pcdata.errors import ShapeError
from pcdata.geometry.lens_models import LENS_MODELS, ROW, WIDEST_PLAIN, check_distortion, lens_facts
from pcdata.geometry.radial_lenses import bend_radially, radial_fold, unbend_radially
from pcdata.geometry.roots import square_root
from pcdata.threads import at_once

# Normalized units. With a focal length of 1000 pixels this is 1e-9 pixel, far below what float32 rays can hold.
CONVERGED = 1e-12
# Newton needs 4 to 6 steps on real lenses; only pixels beside the fold of the model, where it slows down, need more.
MAX_STEPS = 60
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
    after: bool = False  # p1 and p2 act on what the radial part has bent (inverse_brown_conrady)


class _Polynomial(NamedTuple):
    """One view's lens that is a polynomial."""

    twelve: Tensor  # (12,) float64
    tilt: Tensor | None  # (2,) tau_x, tau_y in radians
    after: bool

    def split(self, ndim: int) -> _Coefficients:
        return _split(self.twelve[None], ndim)._replace(after=self.after)


def distort_normalized(
    xy: Tensor,  # (V, ..., 2) normalized coordinates of undistorted rays
    distortion: Tensor,  # (V, D)
) -> Tensor:  # (V, ..., 2) float64
    """Bend normalized coordinates as each view's lens does (the forward model).

    Coordinates beyond :func:`fold_radius` come out too, folded back toward the image as the polynomial has it; whoever
    projects points must reject them.

    Raises:
        ShapeError: the views of the two differ.
        CaptureError: the number of coefficients is not one of a known lens.
    """
    _check_views("distort_normalized", xy, distortion)
    if distortion.shape[1] <= WIDEST_PLAIN:
        x, y = xy.double().unbind(-1)
        return torch.stack(_bend(x, y, _split(distortion, x.ndim)), dim=-1)
    if not len(xy):
        return xy.double()
    return torch.stack([_distort_view(one, row.double()) for one, row in zip(xy.double(), distortion)])


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
    if not len(xy):
        return xy.double()
    target = xy.double().flatten(1, -2) if xy.ndim > 2 else xy.double()[:, None]
    solved = [_undistort_view(one, row.double()) for one, row in zip(target, distortion)]
    return torch.stack(solved).reshape(xy.shape)


def _distort_view(xy: Tensor, row: Tensor) -> Tensor:
    """Bend (..., 2) coordinates by one lens of any model."""
    model, polynomial = _model_of(row)
    if polynomial is None:
        return bend_radially(xy, model, row[1 : 1 + LENS_MODELS[model][1][-1]])
    x, y = xy.unbind(-1)
    bent = torch.stack(_bend(x, y, polynomial.split(x.ndim)), dim=-1)
    return bent if polynomial.tilt is None else _through(_tilt(polynomial.tilt), bent)


def _undistort_view(target: Tensor, row: Tensor) -> Tensor:
    """Undistort (P, 2) coordinates of one lens of any model."""
    model, polynomial = _model_of(row)
    if polynomial is None:
        return unbend_radially(target, model, row[1 : 1 + LENS_MODELS[model][1][-1]])
    if polynomial.tilt is not None:
        target = _through(torch.linalg.inv(_tilt(polynomial.tilt)), target)
    with torch.no_grad():
        fold = float(fold_radius(row[None]))
        solved = unbent(target.detach(), _without_canceled_poles(polynomial.twelve.detach()), polynomial.after, fold)
    if torch.is_grad_enabled() and (target.requires_grad or row.requires_grad):
        solved = _with_gradient(solved, target, polynomial.split(1))
    return solved


def _model_of(row: Tensor) -> tuple[str, _Polynomial | None]:
    """Return the model of one lens (D,), and its parts where it is a polynomial."""
    model = "opencv"
    if len(row) == ROW:
        model, row = lens_facts(row.detach())[0], row[1:]
        if model not in ("opencv", "inverse_brown_conrady"):
            return model, None
    tilt = row[WIDEST_PLAIN : WIDEST_PLAIN + 2]
    is_tilted = len(tilt) == 2 and (tilt.requires_grad or bool((tilt != 0).any()))
    return model, _Polynomial(
        _padded(row[:WIDEST_PLAIN]), tilt if is_tilted else None, model == "inverse_brown_conrady"
    )


def _tilt(angles: Tensor) -> Tensor:  # (3, 3)
    """Return the homography of a sensor tilted by tau_x and tau_y (2,), as OpenCV has it."""
    (cx, cy), (sx, sy), one, zero = angles.cos(), angles.sin(), angles.new_ones(()), angles.new_zeros(())
    about_x = torch.stack([one, zero, zero, zero, cx, sx, zero, -sx, cx]).reshape(3, 3)
    about_y = torch.stack([cy, zero, -sy, zero, one, zero, sy, zero, cy]).reshape(3, 3)
    turn = about_y @ about_x
    onto = torch.stack([turn[2, 2], zero, -turn[0, 2], zero, turn[2, 2], -turn[1, 2], zero, zero, one]).reshape(3, 3)
    return onto @ turn


def _through(homography: Tensor, xy: Tensor) -> Tensor:
    """Move (..., 2) coordinates; NaN where they leave the front of the sensor's plane."""
    x, y, z = (xy @ homography[:, :2].T + homography[:, 2]).unbind(-1)
    front = z > 0
    return torch.where(front[..., None], torch.stack([x, y], -1) / torch.where(front, z, 1.0)[..., None], torch.nan)


def _with_gradient(solved: Tensor, target: Tensor, coefficients: _Coefficients) -> Tensor:
    """Attach the inverse function's derivative to its values (P, 2): that of one Newton step at the solution."""
    known = ~solved.isnan().any(-1, keepdim=True)
    at = torch.where(known, solved, 0.0)  # the center of the image stands in where there is no solution
    x, y = at.unbind(-1)
    with torch.no_grad():
        xx, xy, yx, yy = _jacobian(x, y, coefficients)
        determinant = xx * yy - xy * yx
    bent_x, bent_y = _bend(x, y, coefficients)
    error_x, error_y = bent_x - target[..., 0], bent_y - target[..., 1]
    step = torch.stack([yy * error_x - xy * error_y, xx * error_y - yx * error_x], -1) / determinant[..., None]
    step = torch.where(known, step, 0.0)
    return solved - (step - step.detach())  # the value keeps every bit


def plain_lenses(distortion: Tensor) -> Tensor | None:  # (V, 14) float64
    """Return lenses (V, D) as compiled bodies know them; None where one is no polynomial, or tilted.

    Twelve coefficients, not 0 for inverse Brown-Conrady, and the radius where the model folds back.
    """
    rows = []
    for row in distortion.detach():
        _, polynomial = _model_of(row.double())
        if polynomial is None or polynomial.tilt is not None:
            return None
        rows.append(torch.cat([polynomial.twelve, polynomial.twelve.new_tensor([float(polynomial.after)])]))
    if not rows:
        return None
    return torch.cat([torch.stack(rows), fold_radius(distortion)[:, None]], dim=1)


def fold_radius(distortion: Tensor) -> Tensor:
    """Return (V,) float64: the normalized radius at which each view's radial model stops growing, or infinity.

    Of a polynomial it is the first zero of d(r N/D)/dr, or the first pole that no zero cancels; with t = r^2 both are
    polynomials in t. A fisheye or f-theta lens ends at 89.4 degrees off axis at the latest.
    """
    radii = []
    for row in distortion.detach():
        model, polynomial = _model_of(row.double())
        if polynomial is None:
            radii.append(radial_fold(model, row.double()[1 : 1 + LENS_MODELS[model][1][-1]]))
            continue
        coefficients = polynomial.twelve
        numerator, denominator = _radial_parts(coefficients)
        t = np.polynomial.Polynomial([0.0, 1.0])
        slope = numerator * denominator + 2 * t * (numerator.deriv() * denominator - numerator * denominator.deriv())
        folds = [*_positive_roots(slope), *_positive_roots(denominator)]
        radii.append(min(folds, default=np.inf) ** 0.5)
    return torch.tensor(radii, dtype=torch.float64, device=distortion.device)


def _radial_parts(coefficients: Tensor) -> tuple[np.polynomial.Polynomial, np.polynomial.Polynomial]:
    """Return numerator and denominator of one view's radial quotient in t = r^2, without canceled poles."""
    k1, k2, _, _, k3, k4, k5, k6 = coefficients[:8].tolist()
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
    reduced = coefficients.clone()
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


@inner
def unbent(target: Tensor, twelve: Tensor, after: bool, fold: float) -> Tensor:
    """Undistort (P, 2) coordinates by one reduced polynomial (12,); NaN where it has no inverse within the fold."""
    coefficients = _Polynomial(twelve, None, after).split(1)
    chunks = [_invert(some, coefficients, fold) for some in target.split(at_once(target.device, _CHUNK))]
    return torch.cat(chunks) if chunks else target.clone()


def _invert(target: Tensor, coefficients: _Coefficients, fold: float) -> Tensor:
    """Undistort (P, 2) coordinates of one view; those that have converged drop out of each further step."""
    target_x, target_y = target.unbind(-1)
    x, y = target_x.clone(), target_y.clone()
    open_ = torch.arange(len(x), dtype=torch.int64, device=x.device)
    for _ in range(MAX_STEPS):
        px, py = x[open_], y[open_]
        bent_x, bent_y = _bend(px, py, coefficients)
        error_x, error_y = bent_x - target_x[open_], bent_y - target_y[open_]
        # Written so that a NaN stays open.
        unsolved = ~((error_x.abs() <= CONVERGED) & (error_y.abs() <= CONVERGED) & (px * px + py * py < fold * fold))
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
    squared, edge = new_x * new_x + new_y * new_y, 0.999 * fold
    over = squared > edge * edge
    new_x[over], new_y[over] = _onto(edge, new_x[over], new_y[over], squared[over])
    return new_x, new_y


def _onto(edge: float, x: Tensor, y: Tensor, squared: Tensor) -> tuple[Tensor, Tensor]:
    """Bring coordinates back to a radius."""
    shrink = edge / square_root(squared)
    return x * shrink, y * shrink


def _bend(x: Tensor, y: Tensor, c: _Coefficients) -> tuple[Tensor, Tensor]:
    r2 = x * x + y * y
    radial = _cubic(r2, c.k1, c.k2, c.k3) / _cubic(r2, c.k4, c.k5, c.k6)
    if c.after:
        a, b = x * radial, y * radial
        return a + 2 * c.p1 * a * b + c.p2 * (r2 + 2 * a * a), b + 2 * c.p2 * a * b + c.p1 * (r2 + 2 * b * b)
    bent_x = x * radial + 2 * c.p1 * x * y + c.p2 * (r2 + 2 * x * x) + (c.s1 + c.s2 * r2) * r2
    bent_y = y * radial + c.p1 * (r2 + 2 * y * y) + 2 * c.p2 * x * y + (c.s3 + c.s4 * r2) * r2
    return bent_x, bent_y


def _jacobian(x: Tensor, y: Tensor, c: _Coefficients) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return d(bent_x)/dx, d(bent_x)/dy, d(bent_y)/dx, d(bent_y)/dy."""
    r2 = x * x + y * y
    denominator = _cubic(r2, c.k4, c.k5, c.k6)
    radial = _cubic(r2, c.k1, c.k2, c.k3) / denominator
    slope = (_cubic_slope(r2, c.k1, c.k2, c.k3) - radial * _cubic_slope(r2, c.k4, c.k5, c.k6)) / denominator
    if c.after:
        return _jacobian_after(x, y, radial, slope, c)
    prism_x, prism_y = c.s1 + 2 * c.s2 * r2, c.s3 + 2 * c.s4 * r2
    mixed = 2 * (x * y * slope + c.p1 * x + c.p2 * y)
    xx = radial + 2 * x * x * slope + 2 * c.p1 * y + 6 * c.p2 * x + 2 * x * prism_x
    yy = radial + 2 * y * y * slope + 6 * c.p1 * y + 2 * c.p2 * x + 2 * y * prism_y
    return xx, mixed + 2 * y * prism_x, mixed + 2 * x * prism_y, yy


def _jacobian_after(
    x: Tensor, y: Tensor, radial: Tensor, slope: Tensor, c: _Coefficients
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the derivatives where p1 and p2 act on (a, b), what the radial part has bent."""
    a, b = x * radial, y * radial
    ax, both, by = radial + 2 * x * x * slope, 2 * x * y * slope, radial + 2 * y * y * slope
    x_of_a, x_of_b = 1 + 2 * c.p1 * b + 4 * c.p2 * a, 2 * c.p1 * a
    y_of_a, y_of_b = 2 * c.p2 * b, 1 + 2 * c.p2 * a + 4 * c.p1 * b
    xx = x_of_a * ax + x_of_b * both + 2 * x * c.p2
    xy = x_of_a * both + x_of_b * by + 2 * y * c.p2
    yx = y_of_a * ax + y_of_b * both + 2 * x * c.p1
    yy = y_of_a * both + y_of_b * by + 2 * y * c.p1
    return xx, xy, yx, yy


def _cubic(t: Tensor, a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    return 1 + t * (a + t * (b + t * c))


def _cubic_slope(t: Tensor, a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    return a + t * (2 * b + t * (3 * c))


def _padded(distortion: Tensor) -> Tensor:
    """Return (V, 12) float64 coefficients; those not given are 0."""
    return torch.nn.functional.pad(distortion.double(), (0, 12 - distortion.shape[-1]))


def _split(distortion: Tensor, ndim: int) -> _Coefficients:
    """Shape every (V,) coefficient to broadcast against (V, ...) coordinates of ``ndim`` dimensions."""
    columns = [column.reshape(-1, *[1] * (ndim - 1)) for column in _padded(distortion).unbind(-1)]
    return _Coefficients._make([*columns[:12], False])


def _check_views(where: str, xy: Tensor, distortion: Tensor) -> None:
    if xy.ndim < 2 or xy.shape[-1] != 2 or distortion.ndim != 2 or len(distortion) != len(xy):
        raise ShapeError(
            f"{where}: coordinates must be (V, ..., 2) and distortion (V, D) for the same V views, "
            f"got {tuple(xy.shape)} and {tuple(distortion.shape)}"
        )
    check_distortion(where, distortion)
