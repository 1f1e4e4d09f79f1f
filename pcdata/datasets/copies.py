"""Samples that come several times in one epoch, each time with random draws of its own."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sized

from torch.utils.data import Sampler

from pcdata.errors import DTypeError


class CountedSampler(Sampler[tuple[int, int]]):
    """Say of every index that a sampler gives how often it came before in this pass.

    A dataset draws by (seed, epoch, sample id), so an index that comes again gives the same copy again. Around a
    sampler with replacement (``RandomSampler(replacement=True)``, ``WeightedRandomSampler``) this makes each copy
    another draw; the number of workers still changes nothing. ``repeats=`` of a dataset is the way without a sampler.

    Args:
        sampler: of indices into a :class:`~pcdata.SampleDataset`.
    """

    def __init__(self, sampler: Iterable[int]) -> None:
        self.sampler = sampler

    def __iter__(self) -> Iterator[tuple[int, int]]:
        before: Counter[int] = Counter()
        for index in self.sampler:
            yield int(index), before[int(index)]
            before[int(index)] += 1

    def __len__(self) -> int:
        if not isinstance(self.sampler, Sized):
            raise DTypeError(f"CountedSampler: {type(self.sampler).__name__} has no length")
        return len(self.sampler)
