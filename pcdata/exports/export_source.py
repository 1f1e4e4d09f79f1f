"""What is exported: a path or an object, opened as the samples that a target takes."""

from __future__ import annotations

import functools
import os
from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np
import torch

from pcdata.datasets import CachedCloudDataset
from pcdata.datasets.samples import SampleDataset
from pcdata.datasets.splits import Splits
from pcdata.errors import ConfigError, DTypeError
from pcdata.exports.copies import copy_name
from pcdata.exports.kept_captures import captures_of, steps_not_run
from pcdata.exports.target import Target
from pcdata.files.sample_names import check_known
from pcdata.io import open_source
from pcdata.io.sources.capture_source import CaptureSource, checked_ids
from pcdata.io.sources.listing import absolute
from pcdata.io.store.manifest import FILE_NAME
from pcdata.rng import Streams, sample_key
from pcdata.structures import Episode, PointCloud, Signal
from pcdata.transforms import Compose, SpatialTransform, Transform


class DrawnClouds:
    """The clouds of a dataset by id, as its transform leaves them with the draws of one seed and epoch.

    With several copies every sample comes so often, each time with draws of its own: ``a``, ``a-copy1``, ``a-copy2``.

    Args:
        dataset: of clouds; of a built one the transform is the random end of its pipeline.
        seed: of the draws, together with the epoch, the sample and the copy; None = the dataset's.
        epoch: None = the dataset's.
        copies: None = as often as the dataset has every sample.
        by_episode: let the clouds of an episode share their draws, so that they stay in one place to each other.

    Raises:
        ConfigError: a seed, an epoch or copies are asked for where nothing is drawn, or are no such numbers.
    """

    def __init__(
        self,
        dataset: SampleDataset,
        *,
        seed: int | None = None,
        epoch: int | None = None,
        copies: int | None = None,
        by_episode: bool = False,
    ) -> None:
        for name, value, least in (("seed", seed, None), ("epoch", epoch, 0), ("copies", copies, 1)):
            number = (
                isinstance(value, (int, np.integer))
                and not isinstance(value, bool)
                and (least is None or value >= least)
            )
            if value is not None and not number:
                wanted = "a whole number" if least is None else f"a whole number, {least} or more"
                raise ConfigError(f"export: {name} must be {wanted}, got {value!r:.100}")
        self._dataset = dataset
        self.moved = False  # whether the transform moved the cloud that was loaded last
        self.seed = dataset.seed if seed is None else int(seed)
        self.epoch = dataset.epoch if epoch is None else int(epoch)
        self.copies = dataset.repeats if copies is None else int(copies)
        if not self.is_random and (copies or 1) > 1:
            raise ConfigError(f"export: {dataset!r} draws nothing, so {copies} copies would be alike; leave out copies")
        self._place = {
            copy_name(sample_id, copy): (number, copy)
            for copy in range(self.copies)
            for number, sample_id in enumerate(dataset.ids)
        }
        if len(self._place) != self.copies * len(dataset.ids):
            raise ConfigError(
                f"export: copies are called after their sample, as in {copy_name(dataset.ids[0], 1)!r}, and samples "
                f"of {dataset!r} have such names; rename those"
            )

        own = self._own_episodes()
        # Of captures, which have no coordinates before: whether anything moves clouds from the first random step on.
        parts = _random_end(dataset.transform).parts() if self.is_random and dataset.transform is not None else []
        self._may_move = any(isinstance(part, SpatialTransform) for part in parts)
        self._key = {step: one.id for one in own for step in one.steps} if by_episode else {}

    def _own_episodes(self) -> list[Episode]:
        return self._dataset.episodes

    @property
    def episodes(self) -> list[Episode]:
        """The episodes of the dataset, over the ids, those of every copy."""
        own, size = self._dataset.episodes, len(self._dataset.ids)
        return [
            replace(one, id=copy_name(one.id, copy), first=one.first + copy * size)
            for copy in range(self.copies)
            for one in own
        ]

    @property
    def is_random(self) -> bool:
        """Whether anything is drawn on the samples."""
        return self._dataset.transform is not None and self._dataset.transform.is_random

    @property
    def name(self) -> str:
        """The name of the dataset's folder, if it has one."""
        folder = getattr(self._dataset, "folder", None)
        return type(self._dataset).__name__ if folder is None else str(folder.name)

    @property
    def fingerprint(self) -> str | None:
        """Of what a built dataset stores."""
        return self._dataset.manifest.fingerprint if isinstance(self._dataset, CachedCloudDataset) else None

    @property
    def sources(self) -> tuple[CaptureSource, ...]:
        """The captures of a dataset that is made on the fly."""
        source = getattr(self._dataset, "source", None)
        return () if source is None else (source,)

    @property
    def ids(self) -> list[str]:
        """The sample ids, those of the first copies first."""
        return list(self._place)

    def __len__(self) -> int:
        return len(self._place)

    def signals(self, sample_id: str) -> Mapping[str, Signal]:
        """Return the signals of one sample without loading its cloud.

        Raises:
            CaptureError: no sample has this id. ShapeError: the samples have different ones.
        """
        check_known(repr(self), sample_id, self._place)
        number, _ = self._place[sample_id]
        return {name: signal.rows(slice(number, number + 1)) for name, signal in self._table.items()}

    @functools.cached_property
    def _table(self) -> Mapping[str, Signal]:
        return self._dataset.signal_table()

    def load(self, sample_id: str) -> PointCloud:
        """Read one cloud and run the transform on it.

        Raises:
            CaptureError: no sample has this id. CacheError: it is damaged.
        """
        check_known(repr(self), sample_id, self._place)
        number, copy = self._place[sample_id]
        data, transform = self._dataset._load(number), self._dataset.transform
        before = data.source_from_cloud if isinstance(data, PointCloud) else None
        if transform is not None:
            key = self._key.get(number, self._dataset.ids[number])
            data = transform(data, generator=Streams([sample_key(self.seed, self.epoch, key, copy=copy)]))
        if not isinstance(data, PointCloud):
            raise DTypeError(f"{self!r}: gives a {type(data).__name__}; clouds are exported, so end in Deproject")
        self.moved = self._may_move if before is None else not torch.equal(before, data.source_from_cloud)
        return data

    def draws(self) -> dict[str, Any]:
        """Return what makes the draws again: steps, seed, epoch and copies; nothing where nothing is drawn."""
        transform = self._dataset.transform
        if transform is None or not self.is_random:
            return {}
        steps = [step.to_config() for step in _steps(transform)]
        return {"steps": steps, "seed": self.seed, "epoch": self.epoch, "copies": self.copies}

    def note(self) -> str | None:
        """Say what was drawn, in words."""
        if self._dataset.transform is None or not self.is_random:
            return None
        names = ", ".join(type(step).__name__ for step in _steps(_random_end(self._dataset.transform)))
        copies = f", {self.copies} copies of each sample" if self.copies > 1 else ""
        return f"the random end of the pipeline ran: {names} (seed {self.seed}, epoch {self.epoch}{copies})"

    def __repr__(self) -> str:
        return repr(self._dataset)


def _random_end(transform: Transform) -> Transform:
    return transform.split()[1] if isinstance(transform, Compose) else transform


def _steps(transform: Transform) -> list[Transform]:
    return list(transform.steps) if isinstance(transform, Compose) else [transform]


def is_built(path: str | os.PathLike[str]) -> bool:
    """Say whether a path is a dataset that ``pcdata build`` wrote."""
    return (absolute(path) / FILE_NAME).is_file()


def open_for(target: Target, source: Any, **draws: int | None) -> tuple[CaptureSource, list[str]]:
    """Return the samples for a target, and what to note of them; paths are opened.

    Args:
        target: what they are for.
        source: a path, a dataset of clouds, or an object with ids and load.
        draws: seed, epoch and copies, as :class:`DrawnClouds` takes them.

    Raises:
        ConfigError: captures were given where clouds are exported, or clouds whose captures are not known where those
            are exported, or draws where nothing is drawn.
        CaptureError: there are no samples, or two have one id.
        DTypeError: neither a path nor something with ids and load.
    """
    given: Any = source
    if isinstance(source, str | os.PathLike):
        given = CachedCloudDataset(absolute(source)) if is_built(source) else open_source(source)
    note = None
    if isinstance(given, SampleDataset) and target.takes == "captures":
        note = steps_not_run(given)
        given = captures_of(target.name, given)
    if isinstance(given, SampleDataset):
        given = DrawnClouds(given, by_episode=target.of_episodes, **draws)
        note = given.note()
    elif stated := ", ".join(name for name, value in draws.items() if value is not None):
        raise ConfigError(
            f"export: {stated} is of the random end of a dataset's pipeline, which does not run on {source} for "
            f"{target.name}; leave it out"
        )
    checked_ids("export", given)
    opened: CaptureSource = given
    return opened, [] if note is None else [note]


def stated_by_model(source: Any, kind: type[Target]) -> dict[str, Any]:
    """Return the options of a target that the choices for its model, which a dataset was built for, state already."""
    given = source
    if isinstance(source, str | os.PathLike) and is_built(source):
        given = CachedCloudDataset(absolute(source))
    model: dict[str, Any] = dict(given.manifest.model) if isinstance(given, CachedCloudDataset) else {}
    return options_for_model(model.get("name"), model.get("choices", {}), kind)


def splits_of(source: Any) -> dict[str, str]:
    """Return the split of every sample and every episode of a built dataset, where it has splits; else nothing.

    Raises:
        CacheError: they are damaged, or not of these samples.
    """
    built = isinstance(source, str | os.PathLike) and is_built(source)
    given = CachedCloudDataset(absolute(source)) if built else source
    if not isinstance(given, CachedCloudDataset) or not (given.splits.is_file() or given.split):
        return {}
    ids = given.manifest.index.ids
    part_of = Splits.read(given.splits, ids).part_of()
    of_episodes = {one.id: part_of[ids[one.first]] for one in given.manifest.episodes}
    return {**of_episodes, **{sample_id: part_of[sample_id] for sample_id in ids}}


def options_for_model(name: str | None, choices: Mapping[str, Any], kind: type[Target]) -> dict[str, Any]:
    """Return the options of a target that the choices for a model state, where the target is of that model."""
    if name not in kind.models():
        return {}
    known = {field.name for field in fields(kind)}
    stated: dict[str, Any] = {name: choices.get(name) for name in {"frame", "num_points"} & known}
    if "colors" in known and (channels := choices.get("channels")):
        stated["colors"] = any(name.startswith("rgb") for name in channels)
    return {name: value for name, value in stated.items() if value is not None}


def identity_of(source: CaptureSource) -> str:
    """Return what a continued export must find unchanged: the fingerprint of a dataset, else the kind of source."""
    fingerprint = getattr(source, "fingerprint", None)
    return fingerprint if isinstance(fingerprint, str) else str(getattr(source, "kind", type(source).__name__))
