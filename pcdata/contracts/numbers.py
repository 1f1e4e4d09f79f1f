"""Specs of the plain values that operations take beside tensors: checked once, for every backend.

``@op`` takes one per argument, beside the tensor contracts: ``k=checked_count``, or
``partial(checked_count, maximum=8)`` where it has bounds of its own. A spec is a function that raises where a value
breaks it, and returns what the bodies get: mostly the value itself. None is fine where it is the default. A spec that
belongs to one operation alone stands beside that operation.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from pcdata.contracts.on_host import bounds_of, on_host, uploaded
from pcdata.errors import ConfigError, DTypeError, ShapeError, TooFewPointsError, near_matches

_SHORTEST = 1e-15

# Returns ``arguments[name]`` as bodies get it; tensors, row pointers among them, are checked already. ``where`` is the
# operation, which its errors name.
Spec = Callable[[str, str, Mapping[str, Any]], Any]


def checked_count(
    where: str, name: str, arguments: Mapping[str, Any], *, minimum: int = 1, maximum: int | None = None
) -> int:
    """Require a whole number from ``minimum`` to ``maximum``."""
    value: int = arguments[name]
    require_count(where, name, value, minimum=minimum, maximum=maximum)
    return value


def checked_length(where: str, name: str, arguments: Mapping[str, Any]) -> float:
    """Require a positive, finite length in the unit of the points."""
    require_length(where, name, arguments[name])
    return float(arguments[name])


def checked_positive(where: str, name: str, arguments: Mapping[str, Any], *, finite: bool = True) -> float:
    """Require a number above 0, finite unless said otherwise."""
    value = arguments[name]
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise DTypeError(f"{where}: {name} must be a number, not {type(value).__name__}")
    if not value > 0 or (finite and not math.isfinite(value)):
        raise ConfigError(f"{where}: {name} must be {'finite and ' if finite else ''}more than 0, got {value}")
    return float(value)


def checked_fraction(where: str, name: str, arguments: Mapping[str, Any]) -> float:
    """Require a number above 0 and at most 1."""
    value = checked_positive(where, name, arguments)
    if value > 1:
        raise ConfigError(f"{where}: {name} must be more than 0 and at most 1, got {arguments[name]}")
    return value


def checked_word(where: str, name: str, arguments: Mapping[str, Any], *, words: tuple[str, ...]) -> str:
    """Require one of a few words."""
    value = arguments[name]
    if value not in words:
        raise ConfigError(
            f"{where}: {name} must be one of {', '.join(map(repr, words))}, got {value!r}"
            f"{near_matches(str(value), words)}"
        )
    return str(value)


def checked_image_size(where: str, name: str, arguments: Mapping[str, Any]) -> tuple[int, int]:
    """Require the (height, width) of an image of at least one pixel."""
    size = tuple(arguments[name])
    if len(size) != 2 or min(size) < 1:
        raise ConfigError(f"{where}: {name} must be (height, width) of at least one pixel, got {arguments[name]}")
    return size


def checked_counts(where: str, name: str, arguments: Mapping[str, Any]) -> list[int]:
    """Require one count for every cloud, or one per cloud (B,), of rows that the cloud has; bodies get a list of B."""
    wanted = counts_per_cloud(where, arguments[name], arguments["ptr"])
    require_rows(where, wanted, arguments["ptr"])
    return wanted


def checked_lengths(where: str, name: str, arguments: Mapping[str, Any]) -> Tensor:
    """Require one positive length for every cloud, or one per cloud (B,); bodies get (B,) float64."""
    ptr: Tensor = arguments["ptr"]
    lengths = numbers_on_host(arguments[name])
    num_clouds = ptr.shape[0] - 1
    if lengths.ndim == 0:
        lengths = lengths.expand(num_clouds)
    if lengths.shape != (num_clouds,):
        raise ShapeError(f"{where}: {name} must be one number or ({num_clouds},), got {tuple(lengths.shape)}")
    if not bool((torch.isfinite(lengths) & (lengths > 0)).all()):
        raise ConfigError(f"{where}: {name} must be positive, got {lengths.tolist()}")
    return uploaded(lengths, ptr.device)


def checked_edges(where: str, name: str, arguments: Mapping[str, Any]) -> Tensor:
    """Require lengths as :func:`checked_lengths`, or one per axis too, (1 or B, 3): bodies get (B,) or (B, 3)."""
    ptr: Tensor = arguments["ptr"]
    edges = numbers_on_host(arguments[name])
    num_clouds = ptr.shape[0] - 1
    if edges.ndim != 2:
        return checked_lengths(where, name, arguments)
    if edges.shape not in {(1, 3), (num_clouds, 3)}:
        raise ShapeError(f"{where}: {name} per axis must be (1, 3) or ({num_clouds}, 3), got {tuple(edges.shape)}")
    if not bool((torch.isfinite(edges) & (edges > 0)).all()):
        raise ConfigError(f"{where}: {name} must be positive, got {edges.tolist()}")
    return uploaded(edges.expand(num_clouds, 3), ptr.device)


def checked_places(where: str, name: str, arguments: Mapping[str, Any]) -> Tensor:
    """Require one finite point (3,) for every cloud, or one per cloud (B, 3); bodies get (B, 3) float64."""
    ptr: Tensor = arguments["ptr"]
    places = numbers_on_host(arguments[name])
    num_clouds = ptr.shape[0] - 1
    if places.shape not in {(3,), (num_clouds, 3)}:
        raise ShapeError(f"{where}: {name} must be (3,) or ({num_clouds}, 3), got {tuple(places.shape)}")
    if not bool(torch.isfinite(places).all()):
        raise ConfigError(f"{where}: {name} must be finite, got {places.tolist()}")
    return uploaded(places.expand(num_clouds, 3), ptr.device)


def numbers_on_host(numbers: Any) -> Tensor:
    """Return a few numbers as float64 of the host's own: nobody changes what is known of their copy elsewhere."""
    if isinstance(numbers, Tensor):
        numbers = on_host(numbers)
        return numbers.double() if numbers.dtype is not torch.float64 else numbers.clone()
    return torch.as_tensor(numbers, dtype=torch.float64, device="cpu").detach()


def counts_per_cloud(where: str, num_samples: int | Sequence[int] | Tensor, ptr: Tensor) -> list[int]:
    """Return one count per cloud from one number or (B,) numbers.

    Raises:
        DTypeError: a count that is not an int.
        ShapeError: the number of counts is not the number of clouds.
        ConfigError: a negative count.
    """
    num_clouds = ptr.shape[0] - 1
    given = num_samples.tolist() if isinstance(num_samples, Tensor) else num_samples
    counts = list(given) if isinstance(given, Sequence) else [given] * num_clouds
    for count in counts:
        if not isinstance(count, int):
            raise DTypeError(
                f"{where}: the number of samples must be an int, or a sequence or tensor of ints, got {given}"
            )
    if len(counts) != num_clouds:
        raise ShapeError(f"{where}: {len(counts)} counts were given for {num_clouds} clouds")
    if min(counts) < 0:
        raise ConfigError(f"{where}: the number of samples must not be negative, got {min(counts)}")
    return counts


def require_rows(where: str, wanted: Sequence[int], ptr: Tensor) -> None:
    """Require that every cloud has the rows wanted from it.

    Raises:
        TooFewPointsError: the first cloud that has not.
    """
    bounds = bounds_of(ptr)
    for cloud, count in enumerate(wanted):
        available = bounds[cloud + 1] - bounds[cloud]
        if count > available:
            raise TooFewPointsError(f"{where}: {count} points were asked of cloud {cloud}, which has {available}")


def require_count(where: str, name: str, value: int, *, minimum: int = 1, maximum: int | None = None) -> None:
    """Require a whole number from ``minimum`` to ``maximum``."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise DTypeError(f"{where}: {name} must be an int, not {type(value).__name__}")
    if value < minimum or (maximum is not None and value > maximum):
        allowed = f"at least {minimum}" if maximum is None else f"{minimum} to {maximum}"
        raise ConfigError(f"{where}: {name} must be {allowed}, got {value}")


def whole_number(where: str, name: str, value: Any) -> int:
    """Return a whole number of Python, NumPy or torch as an int; a boolean is none.

    Raises:
        DTypeError: it is none.
    """
    is_flag = isinstance(value, bool) or str(getattr(value, "dtype", "")) in ("bool", "torch.bool")
    try:
        if not is_flag:
            return operator.index(value)
    except TypeError:
        pass
    raise DTypeError(f"{where}: {name} must be a whole number, got {value!r:.100}")


def require_length(where: str, name: str, value: float) -> None:
    """Require a positive, finite length whose square keeps all its digits in float32.

    Squares below about 1e-38 lose digits, or are 0 where torch flushes them: a thousandth of 1e-15 is far from that.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise DTypeError(f"{where}: {name} must be a number in the unit of the points, not {type(value).__name__}")
    if not math.isfinite(value) or not _SHORTEST <= value <= 1e19:
        raise ConfigError(
            f"{where}: {name} must be a length in the unit of the points, {_SHORTEST:g} to 1e19, got {value}"
        )
