"""The samples of a batch, for functions that take a list of samples."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, overload

if TYPE_CHECKING:
    from pcdata.structures.point_cloud import PointCloud


class Unbatched(Sequence["PointCloud"]):
    """Samples that were made at once, ``each`` clouds a sample: each is cut out when it is asked for.

    It shares the memory of its batch. ``PointCloud.cat`` and the collate functions take the batches as they are.
    """

    def __init__(self, batches: Sequence[PointCloud], each: int = 1) -> None:
        self.batches = list(batches)
        self.each = each

    def __len__(self) -> int:
        return sum(batch.num_clouds for batch in self.batches) // self.each

    @overload
    def __getitem__(self, which: int) -> PointCloud: ...
    @overload
    def __getitem__(self, which: slice) -> list[PointCloud]: ...
    def __getitem__(self, which: int | slice) -> PointCloud | list[PointCloud]:
        if isinstance(which, slice):
            return [self[number] for number in range(*which.indices(len(self)))]
        number = range(len(self))[which] * self.each
        for batch in self.batches:
            if number < batch.num_clouds:
                return batch[number : number + self.each]
            number -= batch.num_clouds
        raise AssertionError("a batch has changed its number of clouds")

    def __iter__(self) -> Iterator[PointCloud]:
        for batch in self.batches:
            if self.each == 1:
                yield from batch
            else:
                yield from (batch[first : first + self.each] for first in range(0, batch.num_clouds, self.each))
