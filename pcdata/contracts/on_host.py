"""What the host holds of values that lie on another device, so that it waits for them once.

To read a value of a GPU the host waits until all work before it is done. So what is small and read often (row pointers,
cameras, poses) is copied once, and what the host itself has made and sent is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from itertools import pairwise
from operator import sub
from typing import Any

import torch
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from pcdata.contracts.known import is_known, note

SMALL = 4096  # numbers that are kept on the host

# Tensor on another device -> its version, and a copy.
_copies: WeakIdKeyDictionary = WeakIdKeyDictionary()


def held(tensor: Tensor) -> Tensor | None:
    """Return the host's copy of a tensor on another device, None where there is none."""
    entry: tuple[int, Tensor] | None = _copies.get(tensor)
    if entry is None or tensor.is_inference() or entry[0] != tensor._version:
        return None
    return entry[1]


def hold(tensor: Tensor, copy: Tensor) -> None:
    """Keep the values of a small tensor on another device; nobody may change the copy afterwards."""
    if tensor.device.type != "cpu" and copy.numel() <= SMALL and not tensor.is_inference():
        _copies[tensor] = tensor._version, copy


def on_host(tensor: Tensor) -> Tensor:
    """Return the values in host memory, not to be changed; of a small tensor the host waits for them once."""
    if tensor.is_cpu:
        return tensor.detach() if tensor.requires_grad else tensor
    copy = held(tensor)
    if copy is None:
        copy = tensor.detach().cpu()
        hold(tensor, copy)
    return copy


def uploaded(values: Tensor, device: torch.device) -> Tensor:
    """Move values that the host has made, and keeps as they are, to a device; it does not wait, and knows them there.

    Small copies from pageable memory are staged before the call returns: the host may let go of its own.
    """
    if device.type == "cpu":
        return values
    there = values.to(device, non_blocking=True)
    hold(there, values)
    return there


def taken(tensor: Tensor, index: int | slice) -> Tensor:
    """Return a part of a tensor; the host knows of it what it knows of the whole."""
    part, copy = tensor[index], held(tensor)
    if copy is not None:
        hold(part, copy[index])
    return part


def bounds_of(ptr: Tensor) -> list[int]:
    """Return row pointers as a list."""
    bounds: list[int] = (ptr if ptr.is_cpu else on_host(ptr)).tolist()
    return bounds


def counts_of(ptr: Tensor) -> list[int]:
    """Return the number of rows of every cloud as a list."""
    bounds: list[int] = (ptr if ptr.is_cpu else on_host(ptr)).tolist()
    return [*map(sub, bounds[1:], bounds)]


def read_together(tensors: Sequence[Tensor]) -> list[list[Any]]:
    """Return whole numbers and masks of one device as flat lists; the host waits for all of them once."""
    if not tensors:
        return []
    flat = [tensor.reshape(-1).long() for tensor in tensors]
    if tensors[0].is_cpu or len(flat) == 1:
        return [values.tolist() for values in flat]
    whole = torch.cat(flat).tolist()
    ends = [0]
    for values in flat:
        ends.append(ends[-1] + len(values))
    return [whole[start:stop] for start, stop in pairwise(ends)]


def look(tensor: Tensor, answers: Mapping[Hashable, Callable[[], Tensor]]) -> None:
    """Find out together which facts hold of a tensor on another device that are not known to, and note those."""
    if tensor.device.type == "cpu":
        return
    asked = [fact for fact in answers if not is_known(fact, tensor)]
    for fact, (holds,) in zip(asked, read_together([answers[fact]() for fact in asked])):
        if holds:
            note(fact, tensor)
