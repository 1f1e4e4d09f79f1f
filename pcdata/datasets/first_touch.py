"""Which stored records were compared with their digests, whatever process did so."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.datasets.passes import shared
from pcdata.io.store.sample_index import SampleIndex


class FirstTouch:
    """Which records were compared with their digests, in shared memory: workers that start anew compare none again.

    The marks are of the files that :meth:`fresh` was asked about first; a process that meets another file under the
    name of one begins anew with its records, for itself.
    """

    def __init__(self, index: SampleIndex) -> None:
        self._index = index
        self._seen = shared(torch.zeros(len(index), dtype=torch.bool, device="cpu"))
        self._files = shared(torch.zeros(index.num_shards, 4, dtype=torch.int64, device="cpu"))  # 0: not known yet
        self._forget()

    def _forget(self) -> None:
        self._mine: dict[int, tuple[int, ...]] = {}  # what this process has seen of the files
        self._known = np.zeros(self._index.num_shards, bool)  # the shards that it has seen
        self._knows_all = False
        self._closed = 0

    def has_all(self, numbers: NDArray[np.int64], closed: int) -> bool:
        """Whether all of some records were compared, in files that this process has open.

        Args:
            numbers: of the records.
            closed: how many files this process has closed so far: it may meet others under their names.
        """
        if closed != self._closed:
            self._known[:] = False
            self._knows_all = False
            self._closed = closed
        if not self._seen.numpy()[numbers].all():
            return False
        if not self._knows_all:
            if not self._known[self._index.shards[numbers]].all():
                return False
            self._knows_all = bool(self._known.all())
        return True

    def fresh(self, numbers: NDArray[np.int64], files: Mapping[int, tuple[int, ...]]) -> list[int]:
        """Return those of some records that nobody has compared yet; ``files`` tells the files of their shards."""
        for shard, identity in files.items():
            if self._mine.get(shard) != identity:
                known = tuple(self._files[shard].tolist())
                if known != identity and any(known):
                    self._seen = self._seen.clone()
                    own = self._index.of_shard(shard)
                    self._seen[own.start : own.stop] = False
                else:
                    self._files[shard] = torch.tensor(identity, dtype=torch.int64, device="cpu")
                self._mine[shard] = identity
            self._known[shard] = True
        return [number for number in numbers.tolist() if not self._seen[number]]

    def note(self, number: int) -> None:
        """Note that a record is what was written."""
        self._seen[number] = True

    def __getstate__(self) -> dict[str, Any]:
        return {"_index": self._index, "_seen": self._seen, "_files": self._files}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update({name: shared(one) if isinstance(one, Tensor) else one for name, one in state.items()})
        self._forget()
