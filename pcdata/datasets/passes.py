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
        self._again = shared(torch.zeros((), dtype=torch.int64, device="cpu"))  # reads again; negative: look no more

    def restart(self) -> None:
        """Begin an epoch."""
        self._seen.zero_()
        self._again.zero_()

    @property
    def has_warned(self) -> bool:
        """Whether a second pass was noticed in this epoch."""
        return int(self._again) == _WARNED

    def note(self, index: int, what: str) -> None:
        """Note that a sample is read with random draws; warn once an epoch when half of a second pass is done."""
        if int(self._again) < 0:
            return
        if not bool(self._seen[index]):
            self._seen[index] = True
            return
        size = len(self._seen)
        if int(self._again) == 0 and int(self._seen.sum()) < (size if size < _FEW else _MOST * size):
            self._again.fill_(_NO_PASSES)
            return
        self._again += 1  # a count that workers take from each other now and then only comes a little later
        if int(self._again) < max(2, (size + 1) // 2):
            return
        self._again.fill_(_WARNED)
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
        if int(self._again) < 0:
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
_NO_PASSES, _WARNED = -1, -2


def shared(tensor: Tensor) -> Tensor:
    """Move a tensor to shared memory: workers that live through several epochs see the change too."""
    moved: Tensor = tensor.share_memory_()
    return moved
