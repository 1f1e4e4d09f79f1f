"""What the options of capture layouts must be: each may come from Python, a configuration or the command line."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any

from pcdata.errors import ConfigError


def check_invalid_values(where: str, values: Collection[int]) -> tuple[int, ...]:
    """Return stored values that mean "no reading"; they must be whole numbers in 0 .. 65535.

    Raises:
        ConfigError: they are not.
    """
    is_list = isinstance(values, Collection) and not isinstance(values, (str, bytes))
    if not is_list or not all(_is_whole(value) and 0 <= value <= 65535 for value in values):
        raise ConfigError(
            f"{where}: invalid_values must list whole numbers in 0 .. 65535, such as [65535], got {values!r:.200}"
        )
    return tuple(int(value) for value in values)


def check_label(where: str, label: int | None) -> int | None:
    """Return the label that means "no object": in 0 .. 65535, or None.

    Raises:
        ConfigError: it is not.
    """
    if label is not None and not (_is_whole(label) and 0 <= label <= 65535):
        raise ConfigError(f"{where}: background_label must be an id in 0 .. 65535, got {label!r:.200}")
    return label


def check_name(where: str, option: str, name: str | None) -> str | None:
    """Return a name: a text that is not empty, or None.

    Raises:
        ConfigError: it is not.
    """
    if name is not None and (not isinstance(name, str) or not name.strip()):
        raise ConfigError(f'{where}: {option} must be a name such as "base", got {name!r:.200}')
    return name


def check_seconds(where: str, option: str, seconds: float) -> float:
    """Return a time: a finite number above 0.

    Raises:
        ConfigError: it is not.
    """
    if not _is_number(seconds) or not 0 < seconds < math.inf:
        raise ConfigError(f"{where}: {option} must be positive seconds, got {seconds!r:.200}")
    return float(seconds)


def check_numbers(where: str, options: Any, *, whole: Collection[str], real: Collection[str]) -> None:
    """Require that attributes of an object are whole numbers, others numbers; infinity is one, NaN is none.

    Raises:
        ConfigError: names the first that is not.
    """
    for option in whole:
        if not _is_whole(value := getattr(options, option)):
            raise ConfigError(f"{where}: {option} must be a whole number, got {value!r:.200}")
    for option in real:
        value = getattr(options, option)
        if not _is_number(value) and value not in (math.inf, -math.inf):
            raise ConfigError(f"{where}: {option} must be a number, got {value!r:.200}")


def check_switch(where: str, option: str, value: bool) -> bool:
    """Return a switch.

    Raises:
        ConfigError: it is neither True nor False.
    """
    if not isinstance(value, bool):
        raise ConfigError(f"{where}: {option} must be true or false, got {value!r:.200}")
    return value


def check_pinhole(where: str, values: Collection[float]) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy.

    Raises:
        ConfigError: they are no four finite numbers.
    """
    if not isinstance(values, (list, tuple)) or len(values) != 4 or not all(map(_is_number, values)):
        raise ConfigError(f"{where}: intrinsics must be fx, fy, cx, cy, four numbers in pixels, got {values!r:.200}")
    fx, fy, cx, cy = (float(value) for value in values)
    return fx, fy, cx, cy


def _is_whole(value: Any) -> bool:
    return hasattr(value, "__index__") and not isinstance(value, bool)


def _is_number(value: Any) -> bool:
    try:
        return not isinstance(value, (bool, str, bytes)) and math.isfinite(value)
    except (TypeError, ValueError, OverflowError):
        return False
