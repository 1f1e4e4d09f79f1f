"""What every dataset of clouds shares: ids, epochs, and draws that belong to the sample."""

from __future__ import annotations

import operator
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch.utils.data import Dataset

from pcdata.dispatch import warn_if_slow
from pcdata.errors import ConfigError, DTypeError, add_note
from pcdata.rng import generator_for
from pcdata.structures import PointCloud
from pcdata.transforms import Transform


class SampleDataset(Dataset[PointCloud]):
    """Samples by index; random steps draw from (seed, epoch, sample id) alone.

    So the same sample comes out of the main process, or of any worker of any number of workers.
    """

    gives: type = PointCloud  # what every sample must be in the end

    def __init__(self, ids: Sequence[str], transform: Transform | None, seed: int) -> None:
        if transform is not None and not isinstance(transform, Transform):
            raise DTypeError(f"a dataset's transform must be a pcdata Transform, not a {type(transform).__name__}")
        if len(set(ids)) != len(ids):
            raise ConfigError("a dataset's sample ids must be unique: they key the random draws")
        warn_if_slow()  # workers stay silent
        self.ids = list(ids)
        self.transform = transform
        self.seed = seed
        # Shared memory: workers that live through several epochs see the change too.
        self._epoch = _shared(torch.zeros((), dtype=torch.int64, device="cpu"))

    @property
    def epoch(self) -> int:
        """The epoch that random draws are keyed by."""
        return int(self._epoch)

    def set_epoch(self, epoch: int) -> None:
        """Change the random draws; call it before each epoch, also with persistent workers."""
        self._epoch.fill_(operator.index(epoch))

    def __len__(self) -> int:
        return len(self.ids)

    def __iter__(self) -> Iterator[PointCloud]:
        # Without this, Python would take an IndexError from inside a transform for the end.
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: int | slice) -> PointCloud:
        if isinstance(index, slice):
            raise DTypeError("a dataset gives one sample per index; for several use torch.utils.data.Subset")
        sample_id = self.ids[index]
        try:
            data = self._load(index)
            if self.transform is not None:
                data = self.transform(data, generator=generator_for(self.seed, self.epoch, sample_id))
            if not isinstance(data, self.gives):
                raise DTypeError(
                    f"the dataset gives a {type(data).__name__}; its transform must end in a {self.gives.__name__}"
                )
            return data  # type: ignore[return-value]
        except Exception as error:
            add_note(error, f"sample {sample_id!r} of {self!r}")
            raise

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._epoch = _shared(self._epoch)  # a copy or an unpickled dataset owns its own number

    def _load(self, index: int) -> Any:
        """Load the sample before the transform."""
        raise NotImplementedError


def _shared(number: torch.Tensor) -> torch.Tensor:
    shared: torch.Tensor = number.share_memory_()
    return shared
