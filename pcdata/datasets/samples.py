"""What every dataset of clouds shares: ids, epochs, and draws that belong to the sample."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset, get_worker_info

from pcdata.contracts.dispatch import warn_if_slow
from pcdata.contracts.numbers import whole_number
from pcdata.datasets.errors_in_workers import for_the_parent
from pcdata.datasets.passes import PassWatch, shared
from pcdata.datasets.split_drawing import split_episodes
from pcdata.errors import ConfigError, DTypeError, add_note
from pcdata.imports import ImportedFile, imported_files
from pcdata.io.store.sample_index import SampleIds
from pcdata.rng import GeneratorLike, Streams, sample_keys
from pcdata.structures import Episode, PointCloud, Signal
from pcdata.structures.unbatched import Unbatched
from pcdata.transforms import Transform

DRAWS = "stream"  # in the meta of a cloud: the key of its random draws


class _Asked(NamedTuple):
    """What K indices mean, (K,) each."""

    places: NDArray[np.int64]  # among the samples and their repeats
    numbers: NDArray[np.int64]  # of the samples
    copies: NDArray[np.int64]  # which of their draws
    again: NDArray[np.int64]  # how often a sampler has asked for each before


class SampleDataset(Dataset[PointCloud]):
    """Samples by index; random steps draw from (seed, epoch, sample id, copy) alone.

    So the same sample comes out of the main process, or of any worker of any number of workers. With ``repeats`` every
    sample is in the dataset so often: index ``i + copy * len(ids)`` is copy number ``copy`` of sample ``i``, with draws
    of its own, which those of ``ConcatDataset([dataset, dataset])`` do not have. ``dataset[index, copy]``, which
    :class:`~pcdata.datasets.CountedSampler` asks for, counts on from there.
    """

    gives: type = PointCloud  # what every sample must be in the end

    def __init__(self, ids: Sequence[str], transform: Transform | None, seed: int, repeats: int = 1) -> None:
        if transform is not None and not isinstance(transform, Transform):
            raise DTypeError(f"a dataset's transform must be a pcdata Transform, not a {type(transform).__name__}")
        if not isinstance(ids, SampleIds):  # which are
            ids = list(ids)
        if isinstance(ids, list) and len(set(ids)) != len(ids):
            raise ConfigError("a dataset's sample ids must be unique: they key the random draws")
        if not (type(seed) is type(repeats) is int):  # of NumPy, or no numbers at all
            where = type(self).__name__
            seed, repeats = whole_number(where, "seed", seed), whole_number(where, "repeats", repeats)
        if repeats < 1:
            raise ConfigError(f"repeats must be how often every sample is in the dataset, 1 or more, got {repeats!r}")
        warn_if_slow()  # workers stay silent
        self.ids: list[str] | SampleIds = ids
        self.repeats = repeats
        self.transform = transform
        self.seed = seed
        self.notes_draws = False  # whether samples say in their meta which stream is theirs: see DevicePipeline
        self._epoch = shared(torch.zeros((), dtype=torch.int64, device="cpu"))
        self._passes = PassWatch(len(self))

    @property
    def epoch(self) -> int:
        """The epoch that random draws are keyed by."""
        return int(self._epoch)

    def set_epoch(self, epoch: int) -> None:
        """Change the random draws; call it before each pass over the data, also with persistent workers.

        A second pass without it repeats the draws of the first and warns once (:class:`RepeatedEpochWarning`).

        Raises:
            DTypeError, ConfigError: it is no whole number, or one of more than 63 bits.
        """
        number = whole_number("set_epoch", "epoch", epoch)
        if not -(1 << 63) <= number < 1 << 63:
            raise ConfigError(f"set_epoch: epoch must be a number of 63 bits, got {number:.6g}")
        self._epoch.fill_(number)
        self._passes.restart()

    @property
    def episodes(self) -> list[Episode]:
        """The episodes over ``ids``, in order; none where nothing says that samples follow each other."""
        return []

    def signal_table(self) -> Mapping[str, Signal]:
        """Return the signals of all samples by name, (S, ...) in the order of ``ids``, as recorded; no cloud is loaded.

        Raises:
            ShapeError, FrameError, DTypeError: not all samples have the same signals.
        """
        raise NotImplementedError

    def split_episodes(self, parts: Mapping[str, float | int | None], seed: int = 0) -> dict[str, list[Episode]]:
        """Draw episodes into parts that share none, for :class:`EpisodeWindows` or to choose samples by.

        Which part an episode is in depends on the seed and the episodes' ids, not on their order. What remains of one
        recorded episode after steps were left out stays together. Each part is in the order of the samples.

        Args:
            parts: by name how much: a whole number of episodes, a share of all (0.1; one at least), or None for one
                part that takes the rest.
            seed: of the draw.

        Raises:
            ConfigError: there are no episodes or too few, or the parts leave some out without saying so.
        """
        return split_episodes(repr(self), self.episodes, parts, seed)

    @property
    def is_random(self) -> bool:
        """Whether samples are drawn by the epoch."""
        return self.transform is not None and self.transform.is_random

    def __len__(self) -> int:
        return len(self.ids) * self.repeats

    def __iter__(self) -> Iterator[PointCloud]:
        # Without this, Python would take an IndexError from inside a transform for the end.
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: int | tuple[int, int] | slice) -> PointCloud:
        if isinstance(index, slice):
            raise DTypeError("a dataset gives one sample per index; for several use torch.utils.data.Subset")
        asked = self._asked([index])
        number = int(asked.numbers[0])
        sample_id = self.ids[number]
        try:
            if not asked.again[0] and self.is_random:
                self._passes.note(int(asked.places[0]), repr(self))
            made = self._made(number, self._streams(asked))
            return _noted(made, self._keys_of(made, self._streams(asked))) if self.notes_draws else made
        except Exception as error:
            add_note(error, f"sample {sample_id!r} of {self!r}", sample_id=sample_id)
            if get_worker_info() is not None:
                raise for_the_parent(error) from error.__cause__
            raise

    def _place(self, index: Any) -> int:
        """Return an index as one from 0.

        Raises:
            DTypeError: it is no whole number.
            IndexError: there is no such sample.
        """
        place = whole_number(type(self).__name__, "the index of a sample (ids names them in order)", index)
        if not -len(self) <= place < len(self):
            raise IndexError(f"there is no sample {place}: {self!r} has indices 0 to {len(self) - 1}")
        return place % len(self)

    def __getitems__(self, indices: Sequence[int | tuple[int, int]]) -> Sequence[PointCloud]:
        """Return several samples, as a ``DataLoader`` asks for those of a batch: the same as one by one.

        Stored clouds are read at once and go through the steps as one batch, each with its own draws.
        """
        asked = self._asked(indices)
        is_random = self.is_random
        try:
            made = self._made_at_once(asked.numbers, self._streams(asked) if is_random else None)
        except Exception:  # a sample is at fault: read by itself, it is named
            made = None
        if made is None:
            return [self[index] for index in indices]
        if is_random and not asked.again.all():
            self._passes.note_all(asked.places[asked.again == 0], repr(self))
        if self.notes_draws:  # clouds of one sample that is made at once share its draws
            keys = [key for key in self._of_transform(self._streams(asked)).keys for _ in range(made.each)]
            ends = [0, *itertools.accumulate(batch.num_clouds for batch in made.batches)]
            cut = [keys[begin:end] for begin, end in itertools.pairwise(ends)]
            return Unbatched([_noted(one, own) for one, own in zip(made.batches, cut, strict=True)], made.each)
        return made

    def _asked(self, indices: Sequence[int | tuple[int, int]]) -> _Asked:
        """Return what indices mean; most are plain numbers, of which a batch has many."""
        given: Any = indices
        again = np.zeros(len(indices), np.int64)
        if {*map(type, indices)} != {int}:
            pairs = [index if isinstance(index, tuple) else (index, 0) for index in indices]
            given = [self._place(index) for index, _ in pairs]
            again[:] = [times for _, times in pairs]
        try:
            places = np.array(given, dtype=np.int64)
        except OverflowError:  # no sample has so large a number: see below
            places = np.full(len(given), -1)
        if len(places) and places.view(np.uint64).max() >= len(self):  # as which the negative ones are large
            places = np.array([self._place(index) for index in given], dtype=np.int64)
        if self.repeats == 1:
            return _Asked(places, places, again, again)
        copies, numbers = np.divmod(places, max(1, len(self.ids)))
        return _Asked(places, numbers, copies + again * self.repeats, again)

    def _streams(self, asked: _Asked) -> Streams:
        """Return the stream of each sample."""
        if isinstance(self.ids, SampleIds):
            ids = self.ids.encoded(asked.numbers)
        else:
            ids = [self.ids[number].encode(errors="surrogatepass") for number in asked.numbers.tolist()]
        return Streams(sample_keys(self.seed, self.epoch, ids, asked.copies.tolist()))

    def _keys_of(self, made: PointCloud, streams: Streams) -> list[int]:
        """Return the key of the stream that random steps would draw from for each cloud of a sample."""
        return Streams.of(self._of_transform(streams), made.num_clouds).keys

    def _of_transform(self, streams: Streams) -> Streams:
        """Return the streams that the transform draws from, given those of some samples."""
        return streams

    def _made_at_once(self, numbers: NDArray[np.int64], streams: Streams | None) -> Unbatched | None:
        """Return what :meth:`_made` does for each, or None where that must be done; None = nothing is drawn."""
        return None

    def _made(self, number: int, streams: Streams) -> PointCloud:
        """Load a sample and run the transform on it."""
        return self._transformed(self._load(number), streams)

    def _transformed(self, data: Any, generator: GeneratorLike | None) -> PointCloud:
        if self.transform is not None:
            data = self.transform(data, generator=generator)
        if not isinstance(data, self.gives):
            raise DTypeError(
                f"the dataset gives a {type(data).__name__}; its transform must end in a {self.gives.__name__}"
            )
        return data  # type: ignore[return-value]

    def __reduce__(self) -> tuple[Any, ...]:
        # Files with classes of one's own come first, so that a worker that is spawned knows those when it meets them.
        return _empty, (imported_files(), type(self)), self.__dict__

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._epoch = shared(self._epoch)  # a copy or an unpickled dataset owns its own number

    def _load(self, index: int) -> Any:
        """Load the sample before the transform."""
        raise NotImplementedError


def _noted(made: PointCloud, keys: Sequence[int]) -> PointCloud:
    """Note in every cloud's meta the key of its stream."""
    return made.with_meta([{DRAWS: key} for key in keys])


def runs_on_batches(transform: Transform | None) -> bool:
    """Whether a batch is known to come out as its samples would: the laws of pcdata's own steps say so."""
    return transform is None or (
        transform.gives is PointCloud
        and all(part.keeps_clouds and type(part).__module__.startswith("pcdata.") for part in transform.parts())
    )


def _empty(files: tuple[ImportedFile, ...], cls: type[SampleDataset]) -> SampleDataset:
    """Return a dataset without its state; the files were run when they were unpickled."""
    return cls.__new__(cls)
