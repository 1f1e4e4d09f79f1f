"""What everything that has captures by name can do besides: going through them, and taking one by its place."""

from __future__ import annotations

from collections.abc import Iterator
from operator import index
from typing import Protocol

from pcdata.errors import DTypeError
from pcdata.structures.depth_frame import DepthFrame
from pcdata.structures.point_cloud import PointCloud


class _Named(Protocol):
    @property
    def ids(self) -> list[str]: ...
    def load(self, sample_id: str) -> DepthFrame | PointCloud: ...


class Captures:
    """What a source can do besides: ``for capture in source``, ``source[0]`` and ``source["frame-000180"]`` load."""

    def __iter__(self: _Named) -> Iterator[DepthFrame | PointCloud]:
        """Load one sample after another, in the order of the ids."""
        return map(self.load, self.ids)

    def __getitem__(self: _Named, which: int | str) -> DepthFrame | PointCloud:
        """Load a sample by its place, counted from the end below 0, or by its id.

        Raises:
            IndexError: there is no such place.
            DTypeError: it is neither; ``subset`` takes a part.
            CaptureError, UnitError, PoseError, ShapeError: the sample is unknown or cannot be trusted, and why.
        """
        if isinstance(which, str):
            return self.load(which)
        try:
            place = index(which)
        except TypeError:
            raise DTypeError(
                f"{self}: [] takes a place or an id, got {type(which).__name__}; a part of it is "
                "source.subset(source.ids[2:5])"
            ) from None
        ids = self.ids
        if not -len(ids) <= place < len(ids):
            raise IndexError(f"{self}: has {len(ids)} samples, none at place {place}")
        return self.load(ids[place])

    def __contains__(self: _Named, sample_id: object) -> bool:
        """Whether a sample has this id."""
        return sample_id in self.ids
