"""The epoch that random draws are keyed by, told to every dataset within a loader, however it is wrapped."""

from __future__ import annotations

from typing import Any

from pcdata.datasets.samples import SampleDataset
from pcdata.errors import DTypeError

# Where torch's loaders, samplers and datasets, and those of Accelerate and Lightning, keep what they are made of.
_WITHIN = ("dataset", "_dataset", "datasets", "data_source", "sampler", "batch_sampler", "base_dataloader")

_PASSES_OF_FABRIC = "_num_iter_calls"  # of its loaders, which have no method for it


def set_epoch(data: Any, epoch: int) -> None:
    """Set the epoch of every dataset of clouds in a loader, a sampler, or a dataset such as Subset or ConcatDataset.

    Samplers with an epoch of their own (``DistributedSampler``) are told too, and so are the loaders of Accelerate and
    Fabric, which count passes and would begin the next one with their own number: after a restart that is 0.

    Args:
        data: of torch, Lightning or Accelerate, or a list of such.
        epoch: as :meth:`SampleDataset.set_epoch` takes it.

    Raises:
        DTypeError: there is no dataset of clouds within.
    """
    within = _all_within(data)
    if not any(isinstance(one, SampleDataset) for one in within):
        raise DTypeError(f"set_epoch: there is no dataset of clouds in this {type(data).__name__}")
    for one in within:
        own = getattr(one, "__dict__", {})
        # Of loaders those of Accelerate alone are told: one of the user's own may call this function in its method.
        is_told = not hasattr(one, "collate_fn") or "base_dataloader" in own
        if is_told and callable(tell := getattr(one, "set_epoch", None)):
            tell(epoch)
        if _PASSES_OF_FABRIC in own:
            own[_PASSES_OF_FABRIC] = epoch


def _all_within(data: Any) -> list[Any]:
    found: dict[int, Any] = {}
    waiting = [data]
    while waiting:
        one = waiting.pop()
        if id(one) in found:
            continue
        found[id(one)] = one
        if isinstance(one, (list, tuple)):
            waiting += [inner for inner in one if hasattr(inner, "__dict__")]  # numbers are no datasets
        waiting += [inner for name in _WITHIN if (inner := getattr(one, "__dict__", {}).get(name)) is not None]
    return list(found.values())
