"""MixedCloudDataset: samples into which a second scene is mixed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from pcdata.datasets.cached import CachedCloudDataset
from pcdata.datasets.clouds import CloudDataset
from pcdata.datasets.samples import SampleDataset, runs_on_batches
from pcdata.errors import ConfigError, DTypeError, add_note
from pcdata.rng import Streams, sample_keys
from pcdata.structures import Episode, PointCloud, Signal
from pcdata.structures.unbatched import Unbatched
from pcdata.transforms import Transform
from pcdata.transforms.mixing import mix_scenes


class _Partner(NamedTuple):
    """What is mixed into a sample: a number among the partners, and the key of its draws; or nothing."""

    number: int
    key: int
    mixes: bool


class MixedCloudDataset(SampleDataset):
    """The samples of a dataset, into each of which, with a probability, another sample is mixed.

    Which one is drawn by (seed, epoch, sample id, copy) alone, as all that is random: so a sample is the same in any
    worker, of any batch, alone, and in a run that goes on at some epoch. A partner from the same batch, as Mix3D takes
    it, would be another with every batch size and order. The partner has its own draws: it is augmented otherwise than
    where it comes as a sample itself. A sample that nothing is mixed into is that of the dataset, bit for bit, but for
    the field ``scene`` (0; 1 of the partner).

    The history of every cloud tells, under the step ``mix_scenes``, the id of its ``partner`` and the ``stream`` of the
    partner's draws: ``dataset.transform(capture, generator=pcdata.rng.Streams([stream]))`` makes it again, and
    ``chain.replay`` with the chain of the dataset repeats what was decided about the sample before. On another field of
    the captures, mixed datasets of the same ids and seed mix alike.

    Args:
        dataset: a ``CloudDataset`` or ``CachedCloudDataset`` of clouds.
        partners: where the second scenes come from, such a dataset too; None = the others of ``dataset``.
        probability: that a sample gets a partner.
        apart: fields that number objects, see :func:`~pcdata.transforms.mix_scenes`; ``()`` for labels of classes.
        transform: steps on what was mixed, such as ``RandomSample``; random ones have draws of their own.

    Raises:
        DTypeError: a dataset of another kind.
        ConfigError: no probability, or nobody to mix with.
    """

    def __init__(
        self,
        dataset: SampleDataset,
        *,
        partners: SampleDataset | None = None,
        probability: float = 0.5,
        apart: Sequence[str] = ("labels",),
        transform: Transform | None = None,
    ) -> None:
        for one in (dataset, partners):
            if one is not None and not isinstance(one, CloudDataset | CachedCloudDataset):
                raise DTypeError(
                    f"MixedCloudDataset: takes a CloudDataset or CachedCloudDataset, got {type(one).__name__}; wrap "
                    "the mixed dataset into what else there is, such as a Subset"
                )
        if isinstance(probability, bool) or not isinstance(probability, int | float) or not 0 <= probability <= 1:
            raise ConfigError(f"MixedCloudDataset: probability must be a number from 0 to 1, got {probability!r}")
        if transform is not None and transform.takes is not PointCloud:
            raise DTypeError(f"MixedCloudDataset: transform gets clouds, but {type(transform).__name__} takes captures")
        self.dataset = dataset
        self.partners = dataset if partners is None else partners
        self._others = len(self.partners.ids) - (partners is None)  # than the sample itself
        if self._others < 1 and probability > 0:
            raise ConfigError("MixedCloudDataset: there is no other sample to mix with; give partners, or more samples")
        if isinstance(apart, str):
            raise DTypeError(f"MixedCloudDataset: apart is a sequence of names, got {apart!r}")
        self.probability = float(probability)
        self.apart = tuple(apart)
        super().__init__(dataset.ids, transform, dataset.seed, dataset.repeats)

    @property
    def is_random(self) -> bool:
        """Whether samples are drawn by the epoch."""
        return self.probability > 0 or super().is_random or _draws(self.dataset)

    @property
    def episodes(self) -> list[Episode]:
        """The episodes over ``ids``, as the dataset has them."""
        return self.dataset.episodes

    def signal_table(self) -> Mapping[str, Signal]:
        """Return the signals of all samples by name, as the dataset has them: those of the first scenes."""
        return self.dataset.signal_table()

    def set_epoch(self, epoch: int) -> None:
        """Change the random draws, of the mixing and of the datasets."""
        super().set_epoch(epoch)
        for one in {id(one): one for one in (self.dataset, self.partners)}.values():
            one.set_epoch(epoch)

    def _partners(self, numbers: Sequence[int], keys: Sequence[int]) -> list[_Partner]:
        """Draw what is mixed into samples, by the keys of their streams."""
        own = Streams(_keys(keys, b"partner"))
        drawn, seeds = own.uniform(0.0, 1.0, 2).tolist(), own.seeds().tolist()
        found = []
        for number, (chance, place), seed in zip(numbers, drawn, seeds, strict=True):
            partner = min(int(place * self._others), max(0, self._others - 1))
            partner += self.partners is self.dataset and partner >= number
            found.append(_Partner(partner, seed, chance < self.probability))
        return found

    def _told(self, partner: _Partner) -> dict[str, Any]:
        if not partner.mixes:
            return {"partner": None}
        return {"partner": self.partners.ids[partner.number], "stream": partner.key}

    def _made(self, number: int, streams: Streams) -> PointCloud:
        (partner,) = self._partners([number], streams.keys)
        first = self.dataset._made(number, Streams(streams.keys))
        if partner.mixes:
            try:
                second = self.partners._made(partner.number, Streams([partner.key]))
            except Exception as error:
                add_note(error, f"sample {self.partners.ids[partner.number]!r} of {self.partners!r}, to be mixed in")
                raise
        else:
            second = _without_points(first)
        mixed = mix_scenes(first, second, apart=self.apart, params=[self._told(partner)] * first.num_clouds)
        return self._transformed(mixed, self._of_transform(streams))

    def _made_at_once(self, numbers: NDArray[np.int64], streams: Streams | None) -> Unbatched | None:
        if streams is None:  # nothing is drawn
            streams = Streams([0] * len(numbers))
        if not runs_on_batches(self.transform):
            return None
        partners = self._partners(numbers.tolist(), streams.keys)
        others = [partner for partner in partners if partner.mixes]
        firsts = self.dataset._made_at_once(numbers, Streams(streams.keys))
        added: list[PointCloud] = []
        if others:
            which = np.array([partner.number for partner in others], dtype=np.int64)
            seconds = self.partners._made_at_once(which, Streams([partner.key for partner in others]))
            if seconds is None:
                return None
            added = [*seconds]
        if firsts is None:
            return None
        first = PointCloud.cat(firsts)
        second = [added.pop(0) if partner.mixes else _without_points(first[b]) for b, partner in enumerate(partners)]
        told = [self._told(partner) for partner in partners]
        scenes = mix_scenes(first, PointCloud.cat(second), apart=self.apart, params=told)
        return Unbatched([self._transformed(scenes, self._of_transform(streams))])

    def _of_transform(self, streams: Streams) -> Streams:
        return Streams(_keys(streams.keys, b"mixed"))

    def _load(self, index: int) -> PointCloud:
        raise DTypeError("MixedCloudDataset: a mixed sample is not loaded; give the dataset that it is made of")

    def __repr__(self) -> str:
        return f"MixedCloudDataset({self.dataset!r}, {len(self)} samples, probability={self.probability:g})"


def _keys(keys: Sequence[int], of: bytes) -> NDArray[np.int64]:
    """Return keys of other streams that belong to streams: the same for each, whatever stands beside it."""
    return np.concatenate([sample_keys(key, 0, [of], [0]) for key in keys] or [np.empty(0, np.int64)])


def _draws(dataset: SampleDataset) -> bool:
    return dataset.transform is not None and dataset.transform.is_random


def _without_points(cloud: PointCloud) -> PointCloud:
    nothing = torch.empty(0, dtype=torch.int64, device=cloud.device)
    return cloud.select(nothing, torch.zeros_like(cloud.ptr))
