"""Checks on the plain numbers that operations take beside tensors."""

from __future__ import annotations

import math

from pcdata.errors import ConfigError, DTypeError


def require_count(where: str, name: str, value: int, *, minimum: int = 1) -> None:
    """Require a whole number of at least ``minimum``."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise DTypeError(f"{where}: {name} must be an int, not {type(value).__name__}")
    if value < minimum:
        raise ConfigError(f"{where}: {name} must be at least {minimum}, got {value}")


def require_length(where: str, name: str, value: float) -> None:
    """Require a positive, finite length whose square is still positive in float32 (about 1e-22 or more)."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise DTypeError(f"{where}: {name} must be a number in the unit of the points, not {type(value).__name__}")
    if not math.isfinite(value) or not 1e-22 <= value <= 1e19:
        raise ConfigError(f"{where}: {name} must be a length in the unit of the points, 1e-22 to 1e19, got {value}")


def require_positive(where: str, name: str, value: float) -> None:
    """Require a finite number above 0."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise DTypeError(f"{where}: {name} must be a number, not {type(value).__name__}")
    if not math.isfinite(value) or value <= 0:
        raise ConfigError(f"{where}: {name} must be finite and more than 0, got {value}")
