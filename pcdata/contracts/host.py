"""Fast answers about tensors in host memory: finite, negative, rising, how many.

On the CPU these work through NumPy, on one thread: the OpenMP threads that torch would wake spin for ten milliseconds
after every operation, and would take the cores from the kernel that is about to start.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from pcdata.contracts.known import FINITE, NOT_NEGATIVE, is_known
from pcdata.contracts.on_host import held, on_host, uploaded


def all_finite(values: Tensor) -> bool:
    """Say whether no value is NaN or infinite."""
    if values.device.type == "cpu":
        # Not .all(), which is Python that calls this.
        return bool(np.logical_and.reduce(np.isfinite(values.detach().numpy()), axis=None))
    if (copy := held(values)) is not None:
        return all_finite(copy)
    return is_known(FINITE, values) or bool(torch.isfinite(values).all())


def any_negative(values: Tensor) -> bool:
    """Say whether a value is below 0; NaN is not."""
    if values.device.type == "cpu":
        return bool(np.logical_or.reduce(values.detach().numpy() < 0, axis=None))
    if (copy := held(values)) is not None:
        return any_negative(copy)
    return not is_known(NOT_NEGATIVE, values) and bool((values < 0).any())


def any_above(values: Tensor, limit: int) -> bool:
    """Say whether a whole number is above a limit."""
    if values.device.type == "cpu":
        return bool(np.logical_or.reduce(values.numpy() > limit, axis=None))
    return bool((values > limit).any())


def count_true(mask: Tensor) -> int:
    """Count the true values of a mask."""
    return int(np.count_nonzero(mask.numpy())) if mask.device.type == "cpu" else int(mask.sum())


def negated(mask: Tensor) -> Tensor:
    """Return the mask that is true where this one is false."""
    return torch.from_numpy(~mask.numpy()) if mask.device.type == "cpu" else ~mask


def differing(a: Tensor, b: Tensor) -> Tensor:
    """Return the mask that is true where two masks differ."""
    return torch.from_numpy(a.numpy() != b.numpy()) if a.device.type == "cpu" else a != b


def rising(values: Tensor, ptr: Tensor) -> bool:
    """Say whether the (N,) values of every segment rise strictly."""
    starts = on_host(ptr)[1:-1]
    starts = starts[(starts > 0) & (starts < len(values))]
    if values.device.type == "cpu":
        array = values.numpy()
        rises = torch.from_numpy(array[1:] > array[:-1])
    else:
        rises = values[1:] > values[:-1]
    rises[uploaded(starts - 1, values.device)] = True
    return count_true(rises) == len(rises)
