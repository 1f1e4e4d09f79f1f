"""Captures as a LeRobot dataset, version 3.0, that keeps what depth means: lossless, with its unit, cameras and poses.

The package lerobot opens it as it is. What the format has no place for stands beside it: depth as lossless videos that
are no feature (``depth.CAMERA``), and ``meta/pcdata.json``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from pcdata.io.writers.lerobot_dataset import GrowingDataset
from pcdata.io.writers.lerobot_options import LeRobotOptions
from pcdata.io.writers.registry import register_writer
from pcdata.io.writers.writer import KEPT, Captures
from pcdata.structures import Episode


@register_writer
@dataclass(frozen=True, kw_only=True)
class _LeRobotWriter(LeRobotOptions):
    """LeRobot v3.0."""

    kind: ClassVar[str] = "lerobot"
    layout: ClassVar[str] = "LeRobot v3.0: Parquet, videos, and depth without loss; needs pyarrow and av"
    keeps: ClassVar[frozenset[str]] = frozenset(KEPT) - {"sensor"}

    def write(self, captures: Captures, folder: Path) -> None:
        """Write all captures, episode after episode; captures of no episode become episodes between them."""
        written: GrowingDataset | None = None
        parts = _parts(captures)
        try:
            for episode in parts:
                ids = captures.ids[episode.first : episode.first + episode.length]
                for sample_id, frame in captures.read(ids):
                    if written is None:
                        written = GrowingDataset(self, captures, folder, sample_id, frame, parts)
                    if sample_id == ids[0]:
                        written.begin(episode)
                    written.add(sample_id, frame)
                if written is not None:
                    written.end(episode)
            if written is not None:
                written.close()
        except BaseException:
            if written is not None:
                written.abandon()
            raise


def _parts(captures: Captures) -> list[Episode]:
    """Return the episodes, and what lies before, between and after them as episodes too."""
    found: list[Episode] = []
    end = 0
    for one in [*captures.episodes, None]:
        first = len(captures.ids) if one is None else one.first
        if first > end:
            found.append(Episode(f"captures-{len(found)}", end, first - end))
        if one is not None:
            found.append(one)
            end = one.first + one.length
    return found
