"""What is known of a dataset: read from it, nothing guessed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pcdata.build.card_answers import UNKNOWN, CardAnswers
from pcdata.build.origins import OTHERS
from pcdata.datasets.splits import FILE_NAME as SPLITS
from pcdata.datasets.splits import Splits
from pcdata.files.sample_names import counted
from pcdata.io.store.cloud_record import cloud_from_record
from pcdata.io.store.manifest import FILE_NAME, Manifest
from pcdata.io.store.shards import Shards, hash_of
from pcdata.structures import PointCloud
from pcdata.validation.step_losses import PERCENTILES

# What people must say, and how.
_ASKED = {
    "license": "the license of the source data: --license cc-by-4.0",
    "sensor": 'the depth camera: --sensor "RealSense D435, serial 123, preset High Accuracy"',
    "conditions": 'lighting, surfaces, working range: --conditions "daylight, matte boxes, 0.4 to 0.9 m"',
    "creator": 'who made the data: --creator "Name"',
    "url": "where it is at home: --url https://...",
    "date_published": "when it was published: --date-published 2026-01-29",
}


@dataclass(frozen=True)
class CardFacts:
    """What both files of a card tell."""

    folder: Path
    title: str
    manifest: Manifest
    answers: CardAnswers
    first: PointCloud  # the first stored cloud
    splits: Splits | None
    points: Mapping[str, int]  # of the stored samples: smallest, percentiles, largest
    num_empty: int

    @classmethod
    def of(cls, folder: Path, manifest: Manifest, answers: CardAnswers) -> CardFacts:
        """Read a dataset; without a title it is called by its contents, which are the same under any name.

        Raises:
            CacheError: it is damaged.
        """
        ids, counts = manifest.index.ids, np.asarray(manifest.index.num_points)
        shards = Shards(folder, manifest.format, manifest.index)
        try:
            first = cloud_from_record(shards.read(0))
        finally:
            shards.close()
        splits = Splits.read(folder, ids) if (folder / SPLITS).is_file() else None
        found = np.percentile(counts, list(PERCENTILES.values()), method="nearest")
        points = dict(zip(PERCENTILES, map(int, found)))
        title = answers.title or f"Point clouds {hash_of(folder / FILE_NAME)[1][:8]}"
        return cls(folder, title, manifest, answers, first, splits, points, int((counts == 0).sum()))

    @property
    def description(self) -> str:
        """One sentence that says what it is."""
        if self.answers.description:
            return self.answers.description
        fields = ", ".join(self.first.fields())
        return (
            f"{counted(len(self.manifest.samples), 'sample')} of point clouds ({fields}) in the frame "
            f"{self.first.frame_id} [{self.first.unit}], "
            f"made by pcdata {self.manifest.versions.get('pcdata', UNKNOWN)}."
        )

    @property
    def sensor(self) -> str:
        """The depth camera: as somebody said, else as the captures tell, with counts where they differ."""
        return self.answers.sensor or self.told("sensor")

    @property
    def depth_error(self) -> str:
        """What the way from the sensor to here may have changed in the depth."""
        return self.told("depth")

    def told(self, fact: str) -> str:
        """Return what the captures say of one fact, with the number of samples where they differ."""
        counts: dict[str, int] = {}
        for origin in self.manifest.origins:
            words = str(origin.get(fact) or UNKNOWN) if OTHERS not in origin else f"{origin[OTHERS]} other kinds"
            counts[words] = counts.get(words, 0) + int(origin.get("samples", 0))
        if len(counts) < 2:
            return next(iter(counts), UNKNOWN)
        return "; ".join(f"{words} ({counted(count, 'sample')})" for words, count in counts.items())

    def missing(self) -> list[str]:
        """Name what is not known, each with the way to say it."""
        known = {**vars(self.answers), "sensor": None if UNKNOWN in self.sensor else self.sensor}
        return [f"  {name}: {how}, or {name} in card.yaml" for name, how in _ASKED.items() if known[name] is None]
