"""StreamedCloudDataset: a stored dataset gone through shard by shard, shuffled within a window, also at a URL."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import IterableDataset, get_worker_info

from pcdata.contracts.numbers import whole_number
from pcdata.datasets.cached import CachedCloudDataset
from pcdata.datasets.errors_in_workers import for_the_parent
from pcdata.errors import CacheError, ConfigError, DTypeError
from pcdata.rng import Streams, sample_key

_GROUP = 32  # samples that are made at once where they are given one by one
_DRAWS = 1024  # that are made at once


class _Output(NamedTuple):
    """A sample that is given, and how far the samples must have been read before."""

    place: int
    read: int


class StreamedCloudDataset(IterableDataset[Any]):
    """Go through a dataset in the order of its files: what an object store is fast at, and a disk that turns.

    In every epoch the shards come in another order, and samples are shuffled within a window. Each has the draws that
    the dataset gives it in this epoch, whatever reads it. In a training loop::

        stream = StreamedCloudDataset(CachedCloudDataset("s3://bucket/set", seed=0), batch_size=64)
        loader = DataLoader(stream, batch_size=None, num_workers=4, collate_fn=collate_packed)
        for epoch in range(10):
            pcdata.set_epoch(loader, epoch)
            for batch in loader:

    The samples, in the epoch's order of shards, are cut into parts of one size, one for each worker of each rank: none
    comes twice and none is lost, and where there are fewer shards than workers, several read parts of one. Ranks differ
    by one sample at most; with ``drop_last`` all give equally many batches, and leave out what is over.

    Args:
        dataset: what is gone through, of any format from a folder, of ``webdataset`` from a URL. Its seed, epoch and
            ``augment`` make the samples.
        batch_size: of batches that are read and made at once; the ``DataLoader`` gets ``batch_size=None``. None = one
            sample at a time.
        shuffle_buffer: the samples of the window, which each worker keeps in memory where they come from a URL (beside
            one answer of at most 8 MiB, or a sample); 1 = only the shards are shuffled; 0 = the stored order.
        drop_last: whether every worker of every rank gives the same number of whole batches, or of samples.
        rank: of this process; None = what ``torch.distributed`` or ``RANK`` says, or 0.
        num_replicas: how many ranks share the samples; None = what ``torch.distributed`` or ``WORLD_SIZE`` says, or 1.

    Raises:
        DTypeError: the dataset is no :class:`CachedCloudDataset`.
        ConfigError: a number is out of its range.
    """

    def __init__(
        self,
        dataset: CachedCloudDataset,
        *,
        batch_size: int | None = None,
        shuffle_buffer: int = 1000,
        drop_last: bool = False,
        rank: int | None = None,
        num_replicas: int | None = None,
    ) -> None:
        where = type(self).__name__
        if not isinstance(dataset, CachedCloudDataset):
            raise DTypeError(f"{where}: dataset must be a CachedCloudDataset, got {type(dataset).__name__}")
        self.dataset = dataset
        self.batch_size = None if batch_size is None else _at_least(where, "batch_size", batch_size, 1)
        self.shuffle_buffer = _at_least(where, "shuffle_buffer", shuffle_buffer, 0)
        self.drop_last = drop_last
        own_rank, ranks = _told_ranks()
        self.num_replicas = _at_least(where, "num_replicas", ranks if num_replicas is None else num_replicas, 1)
        self.rank = _at_least(where, "rank", own_rank if rank is None else rank, 0)
        if self.rank >= self.num_replicas:
            raise ConfigError(f"{where}: rank must be below num_replicas {self.num_replicas}, got {self.rank}")
        index = dataset.manifest.index
        shards = index.shards[dataset._rows_of(np.arange(len(dataset.ids)))]
        starts = np.flatnonzero(np.diff(shards, prepend=-1))  # of each shard, its first sample
        self._starts: NDArray[np.int64] = starts.astype(np.int64)
        self._counts: NDArray[np.int64] = np.diff(starts, append=len(shards)).astype(np.int64)
        self._done = 0  # samples that were given in this pass
        self._resumed: Mapping[str, Any] | None = None

    @property
    def epoch(self) -> int:
        """The epoch that the order and the random draws are keyed by."""
        return self.dataset.epoch

    def set_epoch(self, epoch: int) -> None:
        """Change the order and the random draws; call it before each pass, also with persistent workers."""
        self.dataset.set_epoch(epoch)

    def state_dict(self) -> dict[str, Any]:
        """Return how far this process is: what :meth:`load_state_dict` goes on from.

        torchdata's ``StatefulDataLoader`` asks every worker for its own.
        """
        if self._resumed is not None:
            return dict(self._resumed)
        return {"epoch": self.epoch, "done": self._done, **self._settings()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Let the next pass go on where a state was taken; its epoch is set too.

        Raises:
            ConfigError: it was taken of other samples, with other settings, or of another worker.
        """
        where = f"{type(self).__name__}.load_state_dict"
        settings = self._settings()
        different = [name for name, value in settings.items() if state.get(name) != value]
        if different:
            told = ", ".join(f"{name} {state.get(name)!r:.100}, here {settings[name]!r:.100}" for name in different)
            raise ConfigError(f"{where}: the state is of another stream: {told}; give it the same dataset and settings")
        epoch = whole_number(where, "epoch", state.get("epoch"))
        self._resumed = {**settings, "epoch": epoch, "done": _at_least(where, "done", state.get("done"), 0)}
        self.dataset.set_epoch(epoch)

    def __iter__(self) -> Iterator[Any]:
        """Give batches, as a collate function takes them, or samples."""
        state, self._resumed = self._resumed, None
        if state is None:
            self._done = 0
        else:
            self._done = state["done"]
        part, order = self._part(), self._order()
        outputs = self._outputs(part)
        reading = _Reading(self, part, order, [one.place for one in itertools.islice(outputs, self._done)])
        size = self.batch_size or _GROUP
        while group := list(itertools.islice(outputs, size)):
            indices = [self._index(order, one.place) for one in group]
            reading.read_to(group[-1].read)
            made = self.dataset.__getitems__(indices)
            reading.forget(indices)
            if self.batch_size is not None:
                self._done += len(group)
                yield made
                continue
            for one in made:
                self._done += 1
                yield one

    @property
    def num_samples(self) -> int:
        """How many samples the workers of this rank give together; with ``drop_last`` and workers it may be fewer."""
        first, stop = (len(self.dataset) * rank // self.num_replicas for rank in (self.rank, self.rank + 1))
        return stop - first

    def __repr__(self) -> str:
        batches = "" if self.batch_size is None else f", batches of {self.batch_size}"
        return (
            f"StreamedCloudDataset({self.dataset!r}{batches}, window of {self.shuffle_buffer}, rank {self.rank} of "
            f"{self.num_replicas})"
        )

    # -- which samples, in which order -----------------------------------------------------------------------------

    def _settings(self) -> dict[str, Any]:
        """Return what decides the order of the samples, and whose part it is."""
        part, manifest = self._part(), self.dataset.manifest
        return {
            "pipeline": manifest.fingerprint,
            "samples": len(self.dataset),
            "shards": len(self._starts),
            "split": self.dataset.split,
            "seed": self.dataset.seed,
            "shuffle_buffer": self.shuffle_buffer,
            "part": [part.start, part.stop],
        }

    def _part(self) -> range:
        """Return which places of the epoch's order are this worker's."""
        info = get_worker_info()
        worker, workers = (0, 1) if info is None else (info.id, info.num_workers)
        number, parts = self.rank * workers + worker, self.num_replicas * workers
        total = len(self.dataset)
        if not self.drop_last:
            return range(total * number // parts, total * (number + 1) // parts)
        size = total // parts
        return range(number * size, number * size + size - size % (self.batch_size or 1))

    def _order(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the shards in the order of this epoch, and how many places there are up to the end of each."""
        shards = np.arange(len(self._starts))
        if self.shuffle_buffer:
            key = sample_key(self.dataset.seed, self.epoch, "\0order of shards")
            shards = np.argsort(Streams([key]).uniform(0, 1, len(shards))[0].numpy(), kind="stable")
        return shards, np.cumsum(self._counts[shards] * self.dataset.repeats)

    def _index(self, order: tuple[NDArray[np.int64], NDArray[np.int64]], place: int) -> int:
        """Return the index of the dataset at a place of the epoch's order; copies of a sample follow each other."""
        shards, ends = order
        which = int(np.searchsorted(ends, place, "right"))
        inside, copy = divmod(place - (int(ends[which - 1]) if which else 0), self.dataset.repeats)
        return int(self._starts[shards[which]]) + inside + copy * len(self.dataset.ids)

    def _outputs(self, part: range) -> Iterator[_Output]:
        """Give the places of a part as they come out of the window."""
        if self.shuffle_buffer <= 1:
            yield from (_Output(place, place + 1) for place in part)
            return
        draws = self._draws(part)
        window: list[int] = []
        for place in part:
            if len(window) < self.shuffle_buffer:
                window.append(place)
                continue
            chosen = int(next(draws) * len(window))
            yield _Output(window[chosen], place + 1)
            window[chosen] = place
        while window:
            chosen = int(next(draws) * len(window))
            window[chosen], window[-1] = window[-1], window[chosen]
            yield _Output(window.pop(), part.stop)

    def _draws(self, part: range) -> Iterator[float]:
        streams = Streams([sample_key(self.dataset.seed, self.epoch, f"\0window\0{part.start}\0{part.stop}")])
        while True:
            yield from streams.uniform(0, 1, _DRAWS)[0].tolist()


class _Reading:
    """What was read ahead of a part: from a URL samples are kept from when they are read until they are given."""

    def __init__(
        self,
        stream: StreamedCloudDataset,
        part: range,
        order: tuple[NDArray[np.int64], NDArray[np.int64]],
        given: list[int],
    ) -> None:
        self._stream, self._part, self._order = stream, part, order
        self._shards = stream.dataset._shards
        self._given = {*given}
        self._read = part.start

    def read_to(self, stop: int) -> None:
        """Read what was not given yet, up to a place."""
        if not self._shards.reads_ahead:
            return
        places = [place for place in range(self._read, stop) if place not in self._given]
        self._given = {place for place in self._given if place >= stop}
        self._read = max(self._read, stop)
        ends = self._order[1]
        for which, own in itertools.groupby(places, lambda place: int(np.searchsorted(ends, place, "right"))):
            last = min(int(ends[which]), self._part.stop) - 1
            try:
                *rows, last_row = self._rows([*own, last])
                self._shards.hold(rows, until=last_row)
            except CacheError as error:
                if get_worker_info() is not None:
                    raise for_the_parent(error) from error.__cause__
                raise

    def forget(self, indices: list[int]) -> None:
        """Let go of samples that were given."""
        if self._shards.reads_ahead:
            self._shards.let_go(self._rows_of(indices))

    def _rows(self, places: list[int]) -> list[int]:
        return self._rows_of([self._stream._index(self._order, place) for place in places])

    def _rows_of(self, indices: list[int]) -> list[int]:
        dataset = self._stream.dataset
        return dataset._rows_of(np.array(indices, dtype=np.int64) % len(dataset.ids)).tolist()


def _at_least(where: str, name: str, value: Any, least: int) -> int:
    number = whole_number(where, name, value)
    if number < least:
        raise ConfigError(f"{where}: {name} must be {least} or more, got {number}")
    return number


def _told_ranks() -> tuple[int, int]:
    """Return the rank of this process and how many there are."""
    distributed = torch.distributed
    if distributed.is_available() and distributed.is_initialized():
        return distributed.get_rank(), distributed.get_world_size()
    try:
        return int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))
    except ValueError as error:
        raise ConfigError(f"StreamedCloudDataset: RANK and WORLD_SIZE must be whole numbers: {error}") from error
