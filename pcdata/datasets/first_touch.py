"""Which records were compared with their digests, whichever worker read them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pcdata.datasets.passes import shared


class FirstTouch:
    """A mark for every record of one file, in shared memory: workers that start anew compare none again.

    The marks are of the file that :meth:`fresh` was asked about first; a process that meets another file under the name
    begins anew, for itself.
    """

    def __init__(self, size: int) -> None:
        self._seen = shared(torch.zeros(size, dtype=torch.bool, device="cpu"))
        self._file = shared(torch.zeros(4, dtype=torch.int64, device="cpu"))  # all zero: not known yet
        self._mine: tuple[int, ...] | None = None  # what this process has seen of the file

    def fresh(self, numbers: Sequence[int], identity: tuple[int, ...]) -> list[int]:
        """Return those of some records that nobody has compared yet."""
        if self._mine != identity:
            known = tuple(self._file.tolist())
            if known != identity and any(known):
                self._seen = torch.zeros_like(self._seen)
            else:
                self._file.copy_(torch.tensor(identity, dtype=torch.int64, device="cpu"))
            self._mine = identity
        seen = self._seen[torch.tensor(numbers, dtype=torch.int64, device="cpu")].tolist()
        return [number for number, is_seen in zip(numbers, seen, strict=True) if not is_seen]

    def note(self, number: int) -> None:
        """Note that a record is what was written."""
        self._seen[number] = True

    def __getstate__(self) -> dict[str, Tensor]:
        return {"_seen": self._seen, "_file": self._file}

    def __setstate__(self, state: dict[str, Tensor]) -> None:
        self.__dict__.update({name: shared(tensor) for name, tensor in state.items()})
        self._mine = None
