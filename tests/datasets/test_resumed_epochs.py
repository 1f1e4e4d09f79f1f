"""The samples of an epoch are the same whoever reads them: another process later, or several ranks at once."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Iterable

import pytest
import torch
from torch.utils.data import DataLoader, DistributedSampler

from pcdata import CachedCloudDataset, CountedSampler, PointCloud, collate_packed
from pcdata.datasets import RepeatedEpochWarning

ORDER = [5, 2, 0, 7, 3, 1, 6, 4]


def by_id(batches: Iterable[PointCloud]) -> list[tuple[str, list]]:
    return [(cloud.meta[0]["sample_id"], cloud.points.tolist()) for batch in batches for cloud in batch]


def loader(dataset, sampler, workers: int = 0) -> DataLoader:
    return DataLoader(dataset, batch_size=2, sampler=sampler, num_workers=workers, collate_fn=collate_packed)


@pytest.fixture
def dataset(caches) -> CachedCloudDataset:
    made = CachedCloudDataset(caches["packed"], seed=3)
    made.set_epoch(4)
    return made


def test_an_epoch_that_was_stopped_goes_on_in_another_process_with_the_same_samples(dataset):
    whole = by_id(loader(dataset, ORDER))
    dataset.set_epoch(4)
    first = iter(loader(dataset, ORDER, workers=1))
    begun = by_id([next(first), next(first)])
    resumed = pickle.loads(pickle.dumps(dataset))  # as a checkpoint keeps it
    assert begun + by_id(loader(resumed, ORDER[4:], workers=2)) == whole


@pytest.mark.parametrize("copied", [lambda dataset: pickle.loads(pickle.dumps(dataset)), copy.deepcopy])
def test_what_workers_read_ahead_is_not_read_in_a_copy_that_goes_on(dataset, copied):
    by_id(loader(dataset, ORDER))  # as two workers do while a loop is at its second batch
    by_id(loader(copied(dataset), ORDER, workers=2))
    with pytest.warns(RepeatedEpochWarning):
        by_id(loader(dataset, ORDER))


def test_samples_that_come_twice_keep_their_draws_where_the_count_goes_on(dataset):
    asked = list(CountedSampler([0, 1, 0, 2, 0, 1]))
    whole = by_id(loader(dataset, asked))
    assert by_id(loader(dataset, asked[:2])) + by_id(loader(dataset, asked[2:])) == whole
    assert len({str(points) for _, points in whole}) == 6


@pytest.mark.parametrize("workers", [0, 1])
def test_two_ranks_read_together_what_one_reads(dataset, workers):
    def of(ranks: int, rank: int) -> list[tuple[str, list]]:
        sampler = DistributedSampler(dataset, num_replicas=ranks, rank=rank, seed=1)
        sampler.set_epoch(4)
        dataset.set_epoch(4)
        return by_id(loader(dataset, sampler, workers))

    alone = of(1, 0)
    assert sorted(of(2, 0) + of(2, 1)) == sorted(alone)
    assert len({name for name, _ in alone}) == len(dataset)


@pytest.mark.filterwarnings("ignore:'set_vital' is deprecated")  # which torchdata calls
@pytest.mark.parametrize("ranks", [1, 2])
@pytest.mark.parametrize("workers", [0, 2])
def test_a_stateful_loader_goes_on_in_another_process_where_it_was(dataset, workers, ranks):
    """Shuffled or cut for ranks, with batches that are read and augmented at once."""
    stateful = pytest.importorskip("torchdata.stateful_dataloader", reason="pip install torchdata")

    def begin(data, rank=0):
        sampler = DistributedSampler(data, ranks, rank, seed=1) if ranks > 1 else None
        generator = torch.Generator().manual_seed(5)
        how = {"num_workers": workers, "generator": generator, "collate_fn": collate_packed, "shuffle": ranks == 1}
        return stateful.StatefulDataLoader(data, batch_size=2, sampler=sampler, **how)

    parts = []
    for rank in range(ranks):
        dataset.set_epoch(4)
        whole = by_id(begin(dataset, rank))
        dataset.set_epoch(4)
        stopped = begin(dataset, rank)
        batches = iter(stopped)
        begun = by_id([next(batches)])
        kept = pickle.dumps(stopped.state_dict())  # as a checkpoint keeps it
        anew = CachedCloudDataset(dataset.folder, seed=3)
        anew.set_epoch(4)
        resumed = begin(anew, rank)
        resumed.load_state_dict(pickle.loads(kept))
        assert begun + by_id(resumed) == whole
        parts += whole
    assert len({name for name, _ in parts}) == len(parts) == len(dataset)


def test_other_epochs_seeds_and_samples_have_other_draws(caches, dataset):
    def points(**changes) -> torch.Tensor:
        made = CachedCloudDataset(caches["packed"], **{"seed": 3, **changes.get("made", {})})
        made.set_epoch(changes.get("epoch", 4))
        return made[0].points

    assert torch.equal(points(), dataset[0].points)
    for change in ({"epoch": 5}, {"made": {"seed": 4}}):
        other = points(**change)
        assert other.shape != points().shape or not torch.equal(other, points())
