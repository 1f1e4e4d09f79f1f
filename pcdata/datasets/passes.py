"""Whether the data are gone through a second time in one epoch: then every random draw comes again."""

from __future__ import annotations

import warnings
from multiprocessing.context import get_spawning_popen

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.errors import PcdataWarning


class RepeatedEpochWarning(PcdataWarning):
    """A second pass over a dataset repeats the random draws of the first."""


class PassWatch:
    """Notice a second pass, in shared memory: whatever the number of workers, and however they were started.

    A pass reads (nearly) every sample once before it reads one again. What reads samples again earlier (sampling with
    replacement, looking at single samples) is no pass, and a few looks after a pass are no second one.
    """

    def __init__(self, size: int) -> None:
        self._seen = shared(torch.zeros(size, dtype=torch.bool, device="cpu"))
        self._again = shared(torch.zeros(size, dtype=torch.bool, device="cpu"))
        self._found = shared(torch.zeros((), dtype=torch.int64, device="cpu"))

    def restart(self) -> None:
        """Begin an epoch."""
        for tensor in (self._seen, self._again, self._found):
            tensor.zero_()

    @property
    def has_warned(self) -> bool:
        """Whether a second pass was noticed in this epoch."""
        return int(self._found) == _WARNED

    def note(self, index: int, what: str) -> None:
        """Note that a sample is read with random draws; warn once an epoch when half of a second pass is done."""
        if int(self._found) != _NOTHING:
            return
        seen, again = self._seen.numpy(), self._again.numpy()
        if not seen[index]:
            seen[index] = True
            return
        size = len(seen)
        if not again.any() and np.count_nonzero(seen) < (size if size < _FEW else _MOST * size):
            self._found.fill_(_NO_PASSES)
            return
        again[index] = True
        if np.count_nonzero(again) < max(2, (size + 1) // 2):
            return
        self._found.fill_(_WARNED)
        warnings.warn(
            f"{what}: a second pass in one epoch repeats every random draw of the first; call set_epoch(number) on the "
            "dataset before each pass (with the same number where the same draws are wanted), or give Lightning and "
            "Accelerate a loader with sampler=pcdata.CountedSampler(RandomSampler(dataset)); if it is to come several "
            "times in one epoch, as in ConcatDataset([dataset, dataset]), give it once, with repeats=2",
            RepeatedEpochWarning,
            stacklevel=4,
        )

    def note_all(self, indices: NDArray[np.int64], what: str) -> None:
        """Note that several samples are read, as :meth:`note` does one after another."""
        if int(self._found) != _NOTHING:
            return
        seen = self._seen.numpy()
        if len(np.unique(indices)) == len(indices) and not seen[indices].any():
            seen[indices] = True
            return
        for index in indices.tolist():
            self.note(index, what)

    def __getstate__(self) -> dict[str, Tensor]:
        """Workers share what was seen; any other copy (in a checkpoint, say) is of a dataset that nothing read yet.

        What its workers read ahead of the loop that stops would otherwise count as read in the process that goes on.
        """
        goes_to_a_process = get_spawning_popen() is not None
        return {name: of if goes_to_a_process else torch.zeros_like(of) for name, of in self.__dict__.items()}

    def __setstate__(self, state: dict[str, Tensor]) -> None:
        self.__dict__.update({name: shared(tensor) for name, tensor in state.items()})


# Of so many samples one after another a sampler with replacement gives most different ones by chance.
_FEW = 16
# A loader that drops its last batch leaves a part of a pass out.
_MOST = 0.75
_NOTHING, _NO_PASSES, _WARNED = range(3)


def shared(tensor: Tensor) -> Tensor:
    """Move a tensor to shared memory: workers that live through several epochs see the change too."""
    moved: Tensor = tensor.share_memory_()
    return moved
