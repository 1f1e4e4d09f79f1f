"""Sources that are made of other sources: a part of one, and the base of all others."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar, Generic, TypeVar

from pcdata.errors import CaptureError, DTypeError, near_matches
from pcdata.files.sample_names import check_known, name_some
from pcdata.io.sources.capture_source import (
    CaptureSource,
    checked_ids,
    episodes_of,
    recordings_of,
    signals_of,
    skipped_of,
    unread_of,
)
from pcdata.structures import DepthFrame, Episode, PointCloud, Signal
from pcdata.structures.captures import Captures
from pcdata.structures.episodes import kept_episodes

Part = TypeVar("Part")


class Selectable(Captures, ABC, Generic[Part]):
    """A source of which a part can be taken, as :func:`open_source` returns it."""

    kind: ClassVar[str]  # of which layout or combinator it is
    opened: Mapping[str, Any] = MappingProxyType({})  # what open_source was told, where it returned this very source

    @property
    @abstractmethod
    def name(self) -> str:
        """What the captures are called together."""

    @property
    @abstractmethod
    def ids(self) -> list[str]:
        """The sample ids, unique and in a fixed order."""

    @abstractmethod
    def __len__(self) -> int:
        """Return how many there are."""

    @abstractmethod
    def load(self, sample_id: str) -> DepthFrame | PointCloud:
        """Load one sample.

        Raises:
            CaptureError, UnitError, PoseError, ShapeError: the sample is unknown or cannot be trusted, and why.
        """

    @property
    @abstractmethod
    def skipped(self) -> dict[str, str]:
        """What was left out: id -> why."""

    @abstractmethod
    def unread(self) -> list[str]:
        """Say in words what lies in the captures but is not read, one line for each; nothing of it is an error."""

    @abstractmethod
    def _part(self, ids: list[str], skipped: Mapping[str, str]) -> Part:
        """Return the same source with these of its samples only, and what was left out besides what was before."""

    def subset(self, ids: Iterable[str]) -> Part:
        """Return the same source with some of its samples only, in the order that they have here.

        Raises:
            CaptureError: one is no sample of this source, or there is none.
        """
        own, wanted = self.ids, self._listed("subset", ids)
        unknown = wanted.keys() - set(own)
        if unknown or not wanted:
            raise CaptureError(f"{self}: subset needs ids of this source, got {name_some(map(str, unknown)) or 'none'}")
        return self._part([sample_id for sample_id in own if sample_id in wanted], {})

    def without(self, ids: Iterable[str] | Mapping[str, str]) -> Part:
        """Return the same source without some of its samples; ``skipped`` tells which, and why.

        Args:
            ids: the samples to leave out, as from a list of bad frames, or with the reason of each, as
                :func:`refused_captures` returns them.

        Raises:
            CaptureError: one is no sample of this source, or none is left.
        """
        own, reasons = self.ids, self._listed("without", ids)
        known = set(own)
        unknown = [str(sample_id) for sample_id in reasons if sample_id not in known]
        if unknown:
            hint = near_matches(unknown[0], own)
            raise CaptureError(f"{self}: cannot leave out {name_some(unknown)}, which it does not have{hint}")
        left = [sample_id for sample_id in own if sample_id not in reasons]
        if not left:
            reason = next(iter(reasons.values()))
            raise CaptureError(f"{self}: nothing is left when {len(reasons)} samples are left out ({reason})")
        return self._part(left, reasons)

    def _listed(self, method: str, ids: Iterable[str] | Mapping[str, str]) -> dict[str, str]:
        """Return ids, each with the reason to leave it out."""
        if isinstance(ids, (str, bytes)):
            raise DTypeError(f"{self}: {method} takes a list of ids, got the text {ids!r:.100}; put it into a list")
        return {**ids} if isinstance(ids, Mapping) else dict.fromkeys(ids, "listed")


class CombinedSource(Selectable["SubsetSource"]):
    """Captures that are made of those of other sources; holds no capture, so it pickles as they do.

    A subclass says of which (:meth:`made_of`) and how (:meth:`load`).
    """

    over_time: ClassVar[bool] = False  # smooths over time, which two in a row would do twice

    @property
    @abstractmethod
    def sources(self) -> Sequence[CaptureSource]:
        """The sources that this one is made of."""

    @abstractmethod
    def made_of(self, sample_id: str) -> list[tuple[CaptureSource, str]]:
        """Return the captures that a sample is made of: source and id of each.

        Raises:
            CaptureError: no sample has this id.
        """

    @property
    def name(self) -> str:
        """The names of the sources."""
        return "+".join(str(getattr(source, "name", type(source).__name__)) for source in self.sources)

    @property
    def skipped(self) -> dict[str, str]:
        """What was left out of the sources: id -> why."""
        return {sample_id: why for source in self.sources for sample_id, why in skipped_of(source).items()}

    @property
    def episodes(self) -> list[Episode]:
        """The episodes of the source, as far as its samples are here; none where several sources or other ids are."""
        if len(self.sources) != 1:
            return []
        (source,) = self.sources
        episodes, own = episodes_of(source), set(self.ids)
        kept = [(place, name) for place, name in enumerate(source.ids) if name in own] if episodes else []
        is_part = [name for _, name in kept] == self.ids
        return kept_episodes(episodes, [place for place, _ in kept]) if is_part else []

    def signals(self, sample_id: str) -> Mapping[str, Signal]:
        """Return the signals of a sample without loading it: those of the first capture that it is made of.

        Raises:
            CaptureError: no sample has this id.
        """
        source, own = self.made_of(sample_id)[0]
        return signals_of(source, own)

    def recordings(self) -> list[list[str]]:
        """Return the ids by the recording that they are of: as the sources have them, where the ids are theirs."""
        own = set(self.ids)
        found = [[one for one in ids if one in own] for source in self.sources for ids in recordings_of(source)]
        return [ids for ids in found if ids] if sum(map(len, found)) == len(own) else [self.ids]

    def unread(self) -> list[str]:
        """Say in words what lies in the captures but is not read."""
        return [line for source in self.sources for line in unread_of(source)]

    def __len__(self) -> int:
        return len(self.ids)

    def _part(self, ids: list[str], skipped: Mapping[str, str]) -> SubsetSource:
        return SubsetSource(self, ids, skipped=skipped)


class DerivedSource(CombinedSource):
    """Captures that are made of those of one source, and called as they are unless a subclass says otherwise.

    A subclass that is a dataclass with the field ``source`` and plain fields can be registered, see
    :func:`register_combinator`.
    """

    source: CaptureSource

    @property
    def sources(self) -> tuple[CaptureSource]:
        """The source alone."""
        return (self.source,)

    @property
    def ids(self) -> list[str]:
        """The sample ids of the source."""
        return list(self.source.ids)


class SubsetSource(DerivedSource):
    """Some of the captures of a source, in its order."""

    kind = "subset"

    def __init__(self, source: CaptureSource, ids: Iterable[str], *, skipped: Mapping[str, str] | None = None) -> None:
        """Take the ids.

        Args:
            source: any source.
            ids: of the samples that remain.
            skipped: ids that were left out, with the reason of each.

        Raises:
            CaptureError: there is none, or one is no sample of the source.
        """
        self.source = source
        wanted = set(ids)
        self._ids = {sample_id: None for sample_id in checked_ids("SubsetSource", source) if sample_id in wanted}
        if not wanted or len(self._ids) < len(wanted):
            lost = name_some(map(str, wanted - self._ids.keys())) or "none"
            raise CaptureError(f"SubsetSource: needs ids of {source!r}, got {lost}")
        self._skipped = dict(skipped or {})

    @property
    def ids(self) -> list[str]:
        """The sample ids that remain."""
        return list(self._ids)

    @property
    def skipped(self) -> dict[str, str]:
        """What was left out, here and before: id -> why."""
        return {**super().skipped, **self._skipped}

    def made_of(self, sample_id: str) -> list[tuple[CaptureSource, str]]:
        """Return the capture that a sample is.

        Raises:
            CaptureError: no sample has this id.
        """
        check_known(str(self), sample_id, self._ids)
        return [(self.source, sample_id)]

    def load(self, sample_id: str) -> DepthFrame | PointCloud:
        """Load one sample, as its source has it.

        Raises:
            CaptureError, UnitError, PoseError, ShapeError: the sample is unknown or cannot be trusted, and why.
        """
        ((source, own),) = self.made_of(sample_id)
        return source.load(own)

    def __repr__(self) -> str:
        return f"SubsetSource({self.source!r}, {len(self)} samples)"

    def __str__(self) -> str:
        return f"a part of {self.source}"
