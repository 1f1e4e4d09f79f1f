"""Weights that keep outliers from steering a least-squares fit."""

from __future__ import annotations

import torch
from torch import Tensor

from pcdata.errors import ConfigError, near_matches

KERNELS = ("tukey", "huber", "trimmed", "none")
_MAD_TO_SIGMA = 1.4826  # of a normal distribution
TUKEY_CUT = 4.685  # times sigma: 95 % efficiency on normal residuals (Holland & Welsch 1977)
_HUBER = 1.345  # likewise
_BISECTIONS = 10  # to a thousandth of the spread
_KEPT_BY_TRIMMING = 0.8  # the smaller residuals that a trimmed fit keeps (Chetverikov et al. 2002)


def robust_scale(residuals: Tensor) -> Tensor:  # (N,) -> () of the same dtype
    """Return the standard deviation of the central residuals about 0: 1.4826 times the median absolute value."""
    return _MAD_TO_SIGMA * residuals.abs().median() if len(residuals) else residuals.new_zeros(())


def unexplained_spread(residuals: Tensor, sigma: Tensor) -> Tensor:  # (N,), (N,) -> ()
    """Return the t that makes the central part of residuals / sqrt(sigma^2 + t^2) spread by 1; 0 where it spreads less.

    Where readings err by more than their noise, all err by about as much, however different their noise: t is added to
    each variance, so that readings expected to be nearly exact do not decide alone.

    Source: Paule & Mandel, Consensus values and weighting factors, 1982, with the median in the place of the mean.
    """
    low, high = residuals.new_zeros(()), robust_scale(residuals)
    if len(residuals) == 0 or bool(robust_scale(residuals / sigma) <= 1):
        return low
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        more = robust_scale(residuals / (sigma.square() + middle.square()).sqrt()) > 1
        low, high = torch.where(more, middle, low), torch.where(more, high, middle)
    return high


def robust_weights(residuals: Tensor, scale: Tensor, kernel: str) -> Tensor:  # (N,) in [0, 1]
    """Return each residual's weight: Tukey's biweight, Huber's, the smaller 80 per cent alone, or 1 for all.

    Args:
        residuals: (N,) in any unit.
        scale: their standard deviation, such as :func:`robust_scale`; 0 gives 1 to residuals of 0 and 0 to others.
        kernel: one of ``KERNELS``.

    Raises:
        ConfigError: an unknown kernel.
    """
    size = residuals.abs()
    if kernel == "none":
        return torch.ones_like(residuals)
    if kernel == "trimmed":
        if len(size) == 0:
            return size
        kept = max(1, round(_KEPT_BY_TRIMMING * len(size)))
        return (size <= size.kthvalue(kept).values).to(residuals.dtype)
    if kernel not in KERNELS:
        raise ConfigError(
            f"kernel {kernel!r} is unknown: use one of {', '.join(KERNELS)}{near_matches(kernel, KERNELS)}"
        )
    in_scales = torch.where(size > 0, size / scale.clamp(min=1e-300), 0.0)
    if kernel == "huber":
        return (_HUBER / in_scales.clamp(min=_HUBER)).to(residuals.dtype)
    return (1 - (in_scales / TUKEY_CUT).clamp(max=1).square()).square()
