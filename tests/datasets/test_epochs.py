"""A forgotten set_epoch is said once, and a sample that comes several times comes with draws of its own."""

from __future__ import annotations

import copy
import pickle
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from torch.utils.data import ConcatDataset, DataLoader, DistributedSampler, RandomSampler, Subset, WeightedRandomSampler

from pcdata import CloudDataset, CountedSampler, PointCloud, collate_packed, set_epoch
from pcdata.datasets import RepeatedEpochWarning
from pcdata.datasets.passes import PassWatch
from pcdata.errors import ConfigError, DTypeError
from pcdata.transforms import Center, RandomJitter, Transform
from tests.loaders import packed_loader

pytestmark = pytest.mark.filterwarnings("ignore:This DataLoader will create")


class Clouds:
    """A source of small clouds."""

    def __init__(self, count: int) -> None:
        self.ids = [f"s{number}" for number in range(count)]

    def load(self, sample_id: str) -> PointCloud:
        return PointCloud(points=torch.full((5, 3), float(sample_id[1:])), frame_id="base")


def dataset_of(count: int = 24, transform: Transform | None = None, **options) -> CloudDataset:
    return CloudDataset(Clouds(count), transform or RandomJitter(sigma=0.1), **options)


def read(dataset, order) -> None:
    for index in order:
        dataset[index]


def shuffled(count: int, seed: int) -> list[int]:
    return torch.randperm(count, generator=torch.Generator().manual_seed(seed)).tolist()


@pytest.mark.parametrize("count", [2, 5, 24, 100])
def test_a_second_pass_in_one_epoch_is_said_once(count):
    dataset = dataset_of(count)
    read(dataset, range(count))
    with pytest.warns(RepeatedEpochWarning, match=r"second pass in one epoch .* call set_epoch\(number\)") as caught:
        read(dataset, [place for seed in range(4) for place in shuffled(count, seed)])
    assert len(caught) == 1
    dataset.set_epoch(0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read(dataset, range(count))


def test_a_dataset_beside_itself_gives_the_same_copies_which_repeats_does_not():
    dataset = dataset_of(8)
    both = ConcatDataset([dataset, dataset])
    with pytest.warns(RepeatedEpochWarning, match=r"ConcatDataset.*repeats=2"):
        found = [both[index].points for index in range(16)]
    assert all(torch.equal(found[index], found[index + 8]) for index in range(8))
    twice = dataset_of(8, repeats=2)
    found = [twice[index].points for index in range(16)]
    assert not any(torch.equal(found[index], found[index + 8]) for index in range(8))


def test_passes_with_their_own_epochs_say_nothing():
    dataset = dataset_of()
    for epoch in range(4):
        dataset.set_epoch(epoch)
        read(dataset, range(24))
    assert not dataset._passes.has_warned


@pytest.mark.parametrize(
    "order",
    [
        [*range(24), 0, 23, 5, 0],  # a look at some samples afterwards
        [3, 3, *range(24), *range(24)],  # single samples first
        [0, 0, 0, 0, 0],
        [*range(24), *range(8)],
        [*range(10)] * 5,  # a part of the data
        torch.randint(24, (100,), generator=torch.Generator().manual_seed(0)).tolist(),
    ],
)
def test_reading_samples_again_is_no_second_pass(order):
    read(dataset_of(), order)


@pytest.mark.parametrize("count", [4, 8, 24, 200])
def test_sampling_with_replacement_is_no_second_pass(count):
    said = 0
    for seed in range(30 if count < 100 else 6):
        dataset = dataset_of(count)
        sampler = RandomSampler(
            range(count), replacement=True, num_samples=count, generator=torch.Generator().manual_seed(seed)
        )
        read(dataset, sampler)
        said += dataset._passes.has_warned
    assert said == 0


def test_without_random_steps_nothing_is_said():
    dataset = dataset_of(transform=Center())
    read(dataset, [*range(24)] * 3)


@pytest.mark.parametrize(
    ("workers", "start", "keep"),
    [
        (0, None, False),
        (2, "fork", False),
        (2, "fork", True),
        (2, "forkserver", False),
        (2, "forkserver", True),
    ],
)
@pytest.mark.filterwarnings("ignore::pcdata.datasets.RepeatedEpochWarning")
def test_workers_notice_a_second_pass_however_they_start(workers, start, keep):
    dataset = dataset_of(26)
    loader = packed_loader(dataset, workers, start, batch_size=4, shuffle=True, drop_last=True, persistent_workers=keep)
    for epoch in range(2):
        dataset.set_epoch(epoch)
        list(loader)
        assert not dataset._passes.has_warned
    list(loader)
    assert dataset._passes.has_warned


def test_a_copy_of_the_dataset_watches_for_itself():
    dataset = dataset_of()
    read(dataset, range(24))
    for twin in (copy.deepcopy(dataset), pickle.loads(pickle.dumps(dataset))):
        twin.set_epoch(0)
        read(twin, range(24))
    assert not dataset._passes.has_warned


def test_repeats_are_draws_of_their_own_and_the_first_is_the_old_one():
    once, thrice = dataset_of(6), dataset_of(6, repeats=3)
    assert len(thrice) == 18
    points = [thrice[index].points for index in range(18)]
    for sample in range(6):
        assert torch.equal(points[sample], once[sample].points)
        copies = [points[sample + 6 * number] for number in range(3)]
        assert all(not torch.equal(copies[a], copies[b]) for a, b in ((0, 1), (0, 2), (1, 2)))
        assert all(torch.allclose(one, copies[0], atol=2.0) for one in copies)
    assert torch.equal(thrice[-1].points, thrice[17].points)
    for outside in (18, -19):
        with pytest.raises(IndexError, match=f"there is no sample {outside}"):
            thrice[outside]
    assert torch.equal(dataset_of(6, repeats=3)[13].points, points[13])


@pytest.mark.parametrize("repeats", [0, -1])
def test_repeats_that_are_no_count_are_refused(repeats):
    with pytest.raises(ConfigError, match="repeats must be how often"):
        dataset_of(6, repeats=repeats)


@pytest.mark.parametrize("workers", [0, 2])
def test_a_counted_sampler_makes_each_copy_another_draw(workers):
    weights = [10.0, 1.0, 1.0, 1.0]

    def sampler() -> CountedSampler:
        draws = torch.Generator().manual_seed(3)
        return CountedSampler(WeightedRandomSampler(weights, 12, replacement=True, generator=draws))

    dataset = dataset_of(4)
    loader = DataLoader(dataset, batch_size=1, sampler=sampler(), num_workers=workers, collate_fn=collate_packed)
    points = [batch.points for batch in loader]
    pairs = [given if isinstance(given, tuple) else (given, 0) for given in sampler()]
    assert len(loader) == len(set(pairs)) == 12
    assert max(copy for _, copy in pairs) >= 3
    for pair, one in zip(pairs, points):
        assert torch.equal(one, dataset_of(4)[pair].points)
    assert len({one.numpy().tobytes() for one in points}) == 12


def test_copies_of_a_sampler_continue_those_of_the_dataset():
    dataset = dataset_of(4, repeats=2)
    four = [dataset[index].points for index in (1, 5, (1, 1), (5, 1))]
    assert len({one.numpy().tobytes() for one in four}) == 4
    assert torch.equal(dataset_of(4, repeats=3)[9].points, four[2])  # copy 2 of sample 1 either way


def test_a_subset_of_repeats_keeps_its_draws():
    dataset = dataset_of(6, repeats=3)
    assert torch.equal(Subset(dataset, [13])[0].points, dataset[13].points)


# -- how others set the epoch --------------------------------------------------------------------------------------


def lightning_sets(loader: DataLoader, epoch: int) -> None:
    """As Lightning does before each pass: the samplers alone, ``lightning.fabric.utilities.data``."""
    for one in (loader.sampler, loader.batch_sampler, getattr(loader.batch_sampler, "sampler", None)):
        if callable(tell := getattr(one, "set_epoch", None)):
            tell(epoch)


def accelerate_sets(loader: DataLoader, epoch: int, *, sharded: bool) -> None:
    """As the loaders of Accelerate do: the dataset is told unless a sharded batch sampler's own sampler can be."""
    batches = loader.batch_sampler
    if callable(tell := getattr(batches.sampler, "set_epoch", None)):
        tell(epoch)
    if sharded and hasattr(batches.sampler, "set_epoch"):
        return
    if hasattr(loader.dataset, "set_epoch"):
        loader.dataset.set_epoch(epoch)


WAYS = {
    "lightning": lightning_sets,
    "accelerate": lambda loader, epoch: accelerate_sets(loader, epoch, sharded=False),
    "accelerate on many": lambda loader, epoch: accelerate_sets(loader, epoch, sharded=True),
    "set_epoch": set_epoch,
    "set_epoch of several": lambda loader, epoch: set_epoch([loader], epoch),
}
WRAPPED = {
    "bare": lambda dataset: dataset,
    "subset": lambda dataset: Subset(dataset, [3, 1]),
    "concat": lambda dataset: ConcatDataset([Subset(dataset, [2]), dataset_of(2), dataset]),
}


@pytest.mark.parametrize("wrapped", WRAPPED)
@pytest.mark.parametrize("way", WAYS)
def test_the_epoch_reaches_the_dataset_as_trainers_set_it(way, wrapped):
    dataset = dataset_of(4)
    data = WRAPPED[wrapped](dataset)
    sampler = DistributedSampler(data, num_replicas=1, rank=0)
    loader = DataLoader(data, batch_size=2, sampler=CountedSampler(sampler), collate_fn=collate_packed)
    WAYS[way](loader, 7)
    assert dataset.epoch == 7
    assert sampler.epoch == 7
    assert sum(len(batch) for batch in loader) == len(data)


def test_a_sampler_that_does_not_know_its_dataset_is_told_it():
    dataset, weights = dataset_of(4), WeightedRandomSampler([1.0] * 4, 4)
    with pytest.raises(DTypeError, match=r"CountedSampler\(sampler, dataset\)"):
        CountedSampler(weights).set_epoch(1)
    CountedSampler(weights, dataset).set_epoch(1)
    assert dataset.epoch == 1
    with pytest.raises(DTypeError, match="no dataset of clouds in this list"):
        set_epoch([1, 2, 3], 1)


class AccelerateLoader:
    """As Accelerate's: it counts passes, and tells its number before each."""

    def __init__(self, loader: DataLoader) -> None:
        self.base_dataloader, self.iteration = loader, 0

    def __getattr__(self, name: str):
        return getattr(self.base_dataloader, name)

    def set_epoch(self, epoch: int) -> None:
        self.iteration = epoch
        accelerate_sets(self.base_dataloader, epoch, sharded=False)

    def __iter__(self):
        self.set_epoch(self.iteration)
        yield from self.base_dataloader
        self.iteration += 1


class FabricLoader:
    """As Fabric's: it takes over what the loader holds, counts passes, and tells its samplers the number."""

    def __init__(self, loader: DataLoader) -> None:
        self.__dict__.update(loader.__dict__)
        self._dataloader, self._num_iter_calls = loader, 0

    def __iter__(self):
        lightning_sets(self._dataloader, self._num_iter_calls)
        self._num_iter_calls += 1
        yield from self._dataloader


@pytest.mark.parametrize("counted", [False, True])
@pytest.mark.parametrize("kind", [AccelerateLoader, FabricLoader])
def test_a_loader_that_counts_passes_goes_on_from_the_epoch_that_is_set(kind, counted):
    dataset = dataset_of(4)
    sampler = RandomSampler(dataset)
    loader = kind(
        DataLoader(dataset, sampler=CountedSampler(sampler) if counted else sampler, collate_fn=collate_packed)
    )
    told = []
    for epoch in (5, 6, 6):  # resumed, and one pass again
        set_epoch(loader, epoch)
        told += [dataset.epoch for _ in loader]
    assert told == [5] * 4 + [6] * 8


def test_a_loader_whose_method_calls_the_function_is_not_called_for_ever():
    class Own(DataLoader):
        def set_epoch(self, epoch: int) -> None:
            set_epoch(self, epoch)

    dataset = dataset_of(4)
    Own(dataset).set_epoch(3)
    assert dataset.epoch == 3


@pytest.mark.filterwarnings("ignore::pcdata.datasets.RepeatedEpochWarning")
def test_workers_that_write_at_once_take_nothing_from_each_other():
    watch = PassWatch(64)
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        for _ in range(40):
            watch.restart()
            for _ in range(2):
                with ThreadPoolExecutor(4) as workers:
                    list(workers.map(watch.note, range(64), ["dataset"] * 64))
            assert watch.has_warned
    finally:
        sys.setswitchinterval(interval)
