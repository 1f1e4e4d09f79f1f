"""What is known of a dataset: read from it, nothing guessed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pcdata.build.card_answers import UNKNOWN, CardAnswers
from pcdata.datasets.splits import FILE_NAME as SPLITS
from pcdata.datasets.splits import Splits
from pcdata.io.store.cloud_record import cloud_from_record
from pcdata.io.store.manifest import FILE_NAME, Manifest
from pcdata.io.store.shards import Shards, hash_of
from pcdata.structures import PointCloud
from pcdata.validation.step_losses import PERCENTILES

_SENSOR = ("sensor", "sensor_name", "serial", "registered_to")  # in the provenance of a capture
_DEPTH_ERROR = "depth_error_mm"  # there too: what a codec may have changed

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
            f"{len(self.manifest.samples):,} samples of point clouds ({fields}) in the frame {self.first.frame_id} "
            f"[{self.first.unit}], made by pcdata {self.manifest.versions.get('pcdata', UNKNOWN)}."
        )

    @property
    def sensor(self) -> str:
        """The depth camera: as somebody said, else as the first capture tells."""
        said = self.provenance
        told = ", ".join(f"{name} {said[name]}" for name in _SENSOR if said.get(name) is not None)
        return self.answers.sensor or told or UNKNOWN

    @property
    def depth_error(self) -> str:
        """What the way from the sensor to here may have changed in the depth."""
        bound = self.provenance.get(_DEPTH_ERROR)
        return f"at most {bound} mm (as the codec of the source states)" if bound is not None else UNKNOWN

    @property
    def provenance(self) -> Mapping[str, Any]:
        """What the first capture says of its origin."""
        found = self.first.meta[0].get("provenance") if self.first.meta else None
        return found if isinstance(found, dict) else {}

    def missing(self) -> list[str]:
        """Name what is not known, each with the way to say it."""
        known = {**vars(self.answers), "sensor": None if self.sensor == UNKNOWN else self.sensor}
        return [f"  {name}: {how}, or {name} in card.yaml" for name, how in _ASKED.items() if known[name] is None]
