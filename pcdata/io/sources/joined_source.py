"""Several sources in a row as one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from pcdata.errors import CaptureError, DTypeError, PcdataError, add_note
from pcdata.files.sample_names import check_known, check_text, name_some
from pcdata.io.sources.capture_source import (
    CaptureSource,
    checked_ids,
    episodes_of,
    recordings_of,
    skipped_of,
    unread_of,
)
from pcdata.io.sources.combine import CombinedSource
from pcdata.structures import DepthFrame, Episode, PointCloud
from pcdata.structures.episodes import joined_episodes


class JoinedSource(CombinedSource):
    """The captures of several sources in a row; the sample ``NAME/ID`` is the capture ``ID`` of the source ``NAME``."""

    kind = "joined"

    def __init__(self, sources: Mapping[str, CaptureSource]) -> None:
        """Take the sources.

        Args:
            sources: by the name that goes before the ids, in the order that they shall have.

        Raises:
            CaptureError: there is none, one has no samples, or two samples would have one id.
        """
        if not isinstance(sources, Mapping):
            raise DTypeError(f"JoinedSource: sources must map names to sources, got {type(sources).__name__}")
        check_text("JoinedSource", sources)
        self._sources = dict(sources)
        self._place: dict[str, tuple[str, str]] = {}  # id -> name and id of the capture
        for name, source in self._sources.items():
            for sample_id in checked_ids(f"JoinedSource: {name}", source):
                joined = f"{name}/{sample_id}"
                if joined in self._place:
                    raise CaptureError(
                        f"JoinedSource: {joined!r} would be a sample of {self._place[joined][0]!r} and of {name!r}; "
                        "join them under other names"
                    )
                self._place[joined] = name, sample_id
        if not self._place:
            raise CaptureError("JoinedSource: there is no source to join")

    @property
    def sources(self) -> tuple[CaptureSource, ...]:
        """The sources in their order."""
        return tuple(self._sources.values())

    @property
    def ids(self) -> list[str]:
        """The sample ids, those of the first source first."""
        return list(self._place)

    @property
    def skipped(self) -> dict[str, str]:
        """What was left out of each source: ``NAME/ID`` -> why."""
        return {
            f"{name}/{sample_id}": why
            for name, source in self._sources.items()
            for sample_id, why in skipped_of(source).items()
        }

    @property
    def episodes(self) -> list[Episode]:
        """The episodes of all sources, ``NAME/ID`` each."""
        return joined_episodes((name, len(source), episodes_of(source)) for name, source in self._sources.items())

    def recordings(self) -> list[list[str]]:
        """Return the ids by the recording that they are of, one or more for each source."""
        return [
            [f"{name}/{sample_id}" for sample_id in ids]
            for name, source in self._sources.items()
            for ids in recordings_of(source)
        ]

    def unread(self) -> list[str]:
        """Say in words what lies in each of the captures but is not read."""
        return [f"{name}/{line}" for name, source in self._sources.items() for line in unread_of(source)]

    def made_of(self, sample_id: str) -> list[tuple[CaptureSource, str]]:
        """Return the capture that a sample is.

        Raises:
            CaptureError: no sample has this id.
        """
        check_known(str(self), sample_id, self._place)
        name, own = self._place[sample_id]
        return [(self._sources[name], own)]

    def load(self, sample_id: str) -> DepthFrame | PointCloud:
        """Load one sample, as its source has it.

        Raises:
            CaptureError, UnitError, PoseError, ShapeError: the sample is unknown or cannot be trusted, and why.
        """
        ((source, own),) = self.made_of(sample_id)
        try:
            return _called(source.load(own), sample_id)
        except PcdataError as error:
            add_note(error, f"while loading sample {sample_id!r} of {self}", sample_id=sample_id)
            raise

    def __repr__(self) -> str:
        return f"JoinedSource({name_some(self._sources)}: {len(self)} samples)"

    def __str__(self) -> str:
        return f"joined source {name_some(self._sources)}"


def _called(capture: DepthFrame | PointCloud, sample_id: str) -> DepthFrame | PointCloud:
    if isinstance(capture, DepthFrame):
        return replace(capture, sample_id=sample_id)
    return capture.with_meta([{"sample_id": sample_id}] * capture.num_clouds)
