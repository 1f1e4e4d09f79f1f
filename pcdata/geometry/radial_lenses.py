"""Lenses that bend by the angle off axis alone: OpenCV's fisheye (Kannala-Brandt), RealSense's and NVIDIA's f-theta.

All put a ray at radius r = tan(theta) at another radius of the image, in the same direction. Rays more than 89.4
degrees off axis are not theirs to see here: depth is measured along the axis.

Source: Kannala & Brandt, "A generic camera model and calibration method", 2006, in OpenCV's form with four
coefficients; Devernay & Faugeras, "Straight lines have to be straight", 2001, section 3 (the FOV model); NVIDIA
DriveWorks, dwFThetaCameraConfig: a polynomial from angles to distances in the image, or the other way.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner

FARTHEST = 100.0  # the largest r: 89.4 degrees off axis
_LEAST = 1e-20  # of r^2: nearer to the axis nothing is bent
MAX_STEPS = 100
CONVERGED = 1e-15


class _Curve(NamedTuple):
    """A function that grows from 0 on, the derivative of it, and how far it grows."""

    value: Callable[[Tensor, Tensor], Tensor]  # of places and coefficients
    slope: Callable[[Tensor, Tensor], Tensor]
    largest: float


def bend_radially(xy: Tensor, model: str, coefficients: Tensor) -> Tensor:
    """Bend normalized coordinates (..., 2) by one lens; first derivatives are right on the axis too."""
    r = xy.square().sum(-1).clamp(min=_LEAST).sqrt()
    return xy * (_bent_radius(r, model, coefficients) / r)[..., None]


def unbend_radially(xy: Tensor, model: str, coefficients: Tensor) -> Tensor:
    """Invert :func:`bend_radially`; NaN where no ray within :func:`radial_fold` is seen."""
    fold = radial_fold(model, coefficients)
    if model == "fisheye":
        return _unbent_fisheye(xy, coefficients, math.atan(fold))
    bent = xy.square().sum(-1).clamp(min=_LEAST).sqrt()
    if model == "f_theta":
        field = coefficients[0].abs().clamp(min=1e-9)
        angle = bent * field
        seen = angle < math.pi / 2
        r = torch.where(seen, angle, 0.0).tan() / (2 * (field / 2).tan())
        seen = seen & (r < fold)
    elif model == "inverse_f_theta_polynomial":
        seen = bent <= _radius_curve(coefficients).largest
        theta = _polynomial(torch.where(seen, bent, 0.0), coefficients)
        seen = seen & (theta <= math.atan(fold))
        r = torch.where(seen, theta, 0.0).tan()
    else:
        theta, seen = _solved(bent, _angle_curve(model, fold), coefficients)
        r = theta.tan()
    known = torch.where(seen, r / bent, 1.0)[..., None]
    return torch.where(seen[..., None], xy * known, torch.nan)


def radial_fold(model: str, coefficients: Tensor) -> float:
    """Return the largest radius r that the lens sees: where it stops growing, and :data:`FARTHEST` at most."""
    if model == "f_theta":
        return FARTHEST
    values: list[float] = coefficients.tolist()
    if model == "fisheye":
        k1, k2, k3, k4 = values
        fold = min(map(math.sqrt, _positive_roots([1.0, 3 * k1, 5 * k2, 7 * k3, 9 * k4])), default=math.inf)
    elif model == "f_theta_polynomial":
        fold = _fold_of_polynomial(values)
    else:
        largest = torch.tensor(_radius_curve(coefficients).largest, dtype=torch.float64, device="cpu")
        fold = float(_polynomial(largest, coefficients.detach().double().cpu()))
    return FARTHEST if fold >= math.atan(FARTHEST) else math.tan(fold)


def _positive_roots(slope: list[float]) -> list[float]:
    """Return the real roots above 0 of a polynomial, lowest power first."""
    roots: list[complex] = np.polynomial.Polynomial(slope).trim().roots().tolist()
    return [root.real for root in roots if abs(root.imag) <= 1e-9 * abs(root) and root.real > 0]


def _fold_of_polynomial(values: list[float]) -> float:
    slope = [1.0, *(power * value for power, value in enumerate(values, start=2))]
    return min(_positive_roots(slope), default=math.inf)


def _bent_radius(r: Tensor, model: str, coefficients: Tensor) -> Tensor:
    if model == "f_theta":
        field = coefficients[0].abs().clamp(min=1e-9)
        return (2 * r * (field / 2).tan()).atan() / field
    if model == "inverse_f_theta_polynomial":
        radius, seen = _solved(r.atan(), _radius_curve(coefficients), coefficients)
        return torch.where(seen, radius, torch.nan)
    return _angle_curve(model, FARTHEST).value(r.atan(), coefficients)


def _angle_curve(model: str, fold: float) -> _Curve:
    """The radius in the image of every angle off axis."""
    if model == "fisheye":
        return _Curve(_bent_angle, _slope, math.atan(fold))
    return _Curve(_polynomial, _polynomial_slope, math.atan(fold))


def _radius_curve(coefficients: Tensor) -> _Curve:
    """The angle off axis of every radius in the image, up to where it stops growing or reaches 89.4 degrees."""
    values: list[float] = coefficients.tolist()
    fold = _fold_of_polynomial(values)
    curve = np.polynomial.Polynomial([-math.atan(FARTHEST), 1.0, *values])
    largest = min([fold, *_positive_roots(curve.coef.tolist())])
    return _Curve(_polynomial, _polynomial_slope, largest)


def _polynomial(x: Tensor, coefficients: Tensor) -> Tensor:
    c2, c3, c4, c5 = coefficients.unbind()
    return x * (1 + x * (c2 + x * (c3 + x * (c4 + x * c5))))


def _polynomial_slope(x: Tensor, coefficients: Tensor) -> Tensor:
    c2, c3, c4, c5 = coefficients.unbind()
    return 1 + x * (2 * c2 + x * (3 * c3 + x * (4 * c4 + x * (5 * c5))))


def _bent_angle(theta: Tensor, coefficients: Tensor) -> Tensor:
    k1, k2, k3, k4 = coefficients.unbind()
    t = theta * theta
    return theta * (1 + t * (k1 + t * (k2 + t * (k3 + t * k4))))


def _unbent_fisheye(xy: Tensor, coefficients: Tensor, largest: float) -> Tensor:
    """Invert a fisheye lens up to the largest angle; the gradient is that of the inverse function."""
    solved = fisheye_rays(xy.detach().reshape(-1, 2), coefficients.detach(), largest).reshape(xy.shape)
    if not torch.is_grad_enabled() or not (xy.requires_grad or coefficients.requires_grad):
        return solved
    seen = ~solved.isnan().any(-1)
    bent = torch.where(seen[..., None], xy, 1.0).square().sum(-1).clamp(min=_LEAST).sqrt()
    theta = torch.where(seen, solved.detach().square().sum(-1).sqrt().atan(), 0.0)
    # One more step with gradients: its derivative is that of the inverse, its value stays.
    change = (_bent_angle(theta, coefficients) - bent) / _slope(theta, coefficients)
    theta = torch.where(seen, theta - (change - change.detach()), 0.0)
    moved = torch.where(seen[..., None], xy * (theta.tan() / bent)[..., None], 0.0)
    return solved + (moved - moved.detach())


@inner
def fisheye_rays(
    xy: Tensor,  # (P, 2) float64 bent coordinates
    coefficients: Tensor,  # (4,) float64
    largest: float,
    *,
    backend: str = "auto",
) -> Tensor:  # (P, 2) float64
    """Return the rays that a fisheye lens bends to coordinates; NaN where there is none up to the largest angle.

    The angle is found by Newton's method, between bounds that close in: what it is bent to grows up to the largest. It
    stays once it is within 1e-15 or a step leaves it where it is.
    """
    squared = xy.square().sum(-1).clamp(min=_LEAST)
    bent = torch.from_numpy(np.sqrt(squared.cpu().numpy())).to(xy.device)  # correctly rounded, as torch's need not be
    seen = bent <= _bent_angle(bent.new_tensor(largest), coefficients)
    target = torch.where(seen, bent, 0.0)
    low, high = torch.zeros_like(target), torch.full_like(target, largest)
    theta = target.clamp(max=largest)
    open_ = torch.ones_like(target, dtype=torch.bool)
    for _ in range(MAX_STEPS):
        error = _bent_angle(theta, coefficients) - target
        low, high = torch.where(error < 0, theta, low), torch.where(error > 0, theta, high)
        step = theta - error / _slope(theta, coefficients)
        moved = torch.where((step > low) & (step < high), step, (low + high) / 2)
        open_ = open_ & (error.abs() > CONVERGED) & (moved != theta)
        if not bool(open_.any()):
            break
        theta = torch.where(open_, moved, theta)
    return torch.where(seen[:, None], xy * (_tangent(theta) / bent)[:, None], torch.nan)


def _tangent(theta: Tensor) -> Tensor:
    """Return the tangent of 0 to just below a quarter turn, to 5e-16 of it: the same bits on every backend.

    Source: Cephes, tan.
    """
    far = theta > math.pi / 4
    x = torch.where(far, (theta - math.pi / 2) - 6.123233995736766e-17, theta)
    z = x * x
    above = (-1.30936939181383734205e4 * z + 1.15351664838587416140e6) * z + -1.79565251976484877988e7
    below = ((z + 1.36812963470692954678e4) * z + -1.32089234440210967447e6) * z + 2.50083801823357915839e7
    near = x + x * (z * above / (below * z + -5.38695755929454629881e7))
    return torch.where(far, -1.0 / near, near)


def _slope(theta: Tensor, k: Tensor) -> Tensor:
    k1, k2, k3, k4 = k.unbind()
    t = theta * theta
    return 1 + t * (3 * k1 + t * (5 * k2 + t * (7 * k3 + t * (9 * k4))))


def _solved(values: Tensor, curve: _Curve, coefficients: Tensor) -> tuple[Tensor, Tensor]:
    """Return the place where a curve has each value, and whether there is one up to the largest.

    Newton's method, kept between bounds that close in: the function grows up to the largest place.
    """
    target, k = values.detach(), coefficients.detach()
    seen = target <= curve.value(target.new_tensor(curve.largest), k)
    target = torch.where(seen, target, 0.0)
    low, high = torch.zeros_like(target), torch.full_like(target, curve.largest)
    place = target.clamp(max=curve.largest)
    for _ in range(MAX_STEPS):
        error = curve.value(place, k) - target
        if bool((error.abs() <= CONVERGED).all()):
            break
        low, high = torch.where(error < 0, place, low), torch.where(error > 0, place, high)
        step = place - error / curve.slope(place, k)
        within = (step > low) & (step < high)
        moved = torch.where(within, step, (low + high) / 2)
        if bool((moved == place).all()):
            break
        place = torch.where(error == 0, place, moved)
    # One more step with gradients: its derivative is that of the inverse, its value stays.
    change = (curve.value(place, coefficients) - values) / curve.slope(place, k)
    change = torch.where(seen, change, 0.0)
    return place - (change - change.detach()), seen
