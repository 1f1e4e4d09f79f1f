"""Lenses that bend by the angle off axis alone: OpenCV's fisheye (Kannala-Brandt) and RealSense's f-theta.

Both put a ray at radius r = tan(theta) at another radius of the image, in the same direction. Rays more than 89.4
degrees off axis are not theirs to see here: depth is measured along the axis.

Source: Kannala & Brandt, "A generic camera model and calibration method", 2006, in OpenCV's form with four
coefficients; Devernay & Faugeras, "Straight lines have to be straight", 2001, section 3 (the FOV model).
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

FARTHEST = 100.0  # the largest r: 89.4 degrees off axis
_LEAST = 1e-20  # of r^2: nearer to the axis nothing is bent
_MAX_STEPS = 100
_CONVERGED = 1e-15


def bend_radially(xy: Tensor, model: str, coefficients: Tensor) -> Tensor:
    """Bend normalized coordinates (..., 2) by one lens; first derivatives are right on the axis too."""
    r = xy.square().sum(-1).clamp(min=_LEAST).sqrt()
    return xy * (_bent_radius(r, model, coefficients) / r)[..., None]


def unbend_radially(xy: Tensor, model: str, coefficients: Tensor) -> Tensor:
    """Invert :func:`bend_radially`; NaN where no ray within :func:`radial_fold` is seen."""
    bent = xy.square().sum(-1).clamp(min=_LEAST).sqrt()
    fold = radial_fold(model, coefficients)
    if model == "f_theta":
        field = coefficients[0].abs().clamp(min=1e-9)
        angle = bent * field
        seen = angle < math.pi / 2
        r = torch.where(seen, angle, 0.0).tan() / (2 * (field / 2).tan())
        seen = seen & (r < fold)
    else:
        theta, seen = _angle(bent, coefficients, math.atan(fold))
        r = theta.tan()
    known = torch.where(seen, r / bent, 1.0)[..., None]
    return torch.where(seen[..., None], xy * known, torch.nan)


def radial_fold(model: str, coefficients: Tensor) -> float:
    """Return the largest radius r that the lens sees: where it stops growing, and :data:`FARTHEST` at most."""
    if model == "f_theta":
        return FARTHEST
    k1, k2, k3, k4 = coefficients.tolist()
    slope = np.polynomial.Polynomial([1.0, 3 * k1, 5 * k2, 7 * k3, 9 * k4]).trim()  # in theta^2
    roots: list[complex] = slope.roots().tolist()
    real = [math.sqrt(root.real) for root in roots if abs(root.imag) <= 1e-9 * abs(root) and root.real > 0]
    fold = min(real, default=math.inf)
    return FARTHEST if fold >= math.atan(FARTHEST) else math.tan(fold)


def _bent_radius(r: Tensor, model: str, coefficients: Tensor) -> Tensor:
    if model == "f_theta":
        field = coefficients[0].abs().clamp(min=1e-9)
        return (2 * r * (field / 2).tan()).atan() / field
    return _bent_angle(r.atan(), coefficients)


def _bent_angle(theta: Tensor, coefficients: Tensor) -> Tensor:
    k1, k2, k3, k4 = coefficients.unbind()
    t = theta * theta
    return theta * (1 + t * (k1 + t * (k2 + t * (k3 + t * k4))))


def _angle(bent: Tensor, coefficients: Tensor, largest: float) -> tuple[Tensor, Tensor]:
    """Return the angle that is bent to each value, and whether there is one up to the largest.

    Newton's method, kept between bounds that close in: the function grows up to the largest angle.
    """
    target, k = bent.detach(), coefficients.detach()
    seen = target <= _bent_angle(target.new_tensor(largest), k)
    target = torch.where(seen, target, 0.0)
    low, high = torch.zeros_like(target), torch.full_like(target, largest)
    theta = target.clamp(max=largest)
    for _ in range(_MAX_STEPS):
        error = _bent_angle(theta, k) - target
        if bool((error.abs() <= _CONVERGED).all()):
            break
        low, high = torch.where(error < 0, theta, low), torch.where(error > 0, theta, high)
        step = theta - error / _slope(theta, k)
        within = (step > low) & (step < high)
        moved = torch.where(within, step, (low + high) / 2)
        if bool((moved == theta).all()):
            break
        theta = torch.where(error == 0, theta, moved)
    # One more step with gradients: its derivative is that of the inverse, its value stays.
    change = (_bent_angle(theta, coefficients) - bent) / _slope(theta, k)
    change = torch.where(seen, change, 0.0)
    return theta - (change - change.detach()), seen


def _slope(theta: Tensor, k: Tensor) -> Tensor:
    k1, k2, k3, k4 = k.unbind()
    t = theta * theta
    return 1 + t * (3 * k1 + t * (5 * k2 + t * (7 * k3 + t * (9 * k4))))
