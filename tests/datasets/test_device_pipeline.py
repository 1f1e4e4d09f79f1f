"""DevicePipeline: the same clouds as the dataset gives, wherever the random steps run."""

from __future__ import annotations

import pytest
import torch
from torch.utils.data import DataLoader, Dataset

from pcdata import CachedCloudDataset, CountedSampler, DevicePipeline, PaddedClouds, collate_packed, collate_padded
from pcdata.datasets import device_pipeline
from pcdata.errors import ConfigError, DTypeError


def steps_of(caches):
    return CachedCloudDataset(caches["packed"]).pipeline.split()[1]


@pytest.mark.parametrize("form", ["packed", "npz"])
def test_steps_after_the_loader_draw_what_the_dataset_would(caches, form):
    inside = CachedCloudDataset(caches[form], repeats=2)
    outside = CachedCloudDataset(caches[form], augment=None, repeats=2)
    loader = DataLoader(outside, batch_size=3, collate_fn=collate_packed)
    pipeline = DevicePipeline(loader, steps_of(caches), device="cpu")
    for epoch in range(2):
        inside.set_epoch(epoch)
        outside.set_epoch(epoch)
        for given, wanted in zip(pipeline, DataLoader(inside, batch_size=3, collate_fn=collate_packed), strict=True):
            assert torch.equal(given.points, wanted.points)
            assert torch.equal(given.ptr, wanted.ptr)
    assert len(pipeline) == len(loader)


def test_copies_that_a_sampler_asks_for_have_draws_of_their_own(caches):
    def batches(augment):
        dataset = CachedCloudDataset(caches["packed"], augment=augment)
        return DataLoader(dataset, batch_size=4, sampler=CountedSampler([0, 1, 0, 0, 1, 2]), collate_fn=collate_packed)

    pipeline = DevicePipeline(batches(None), steps_of(caches), device="cpu")
    for given, wanted in zip(pipeline, batches("stored"), strict=True):
        assert torch.equal(given.points, wanted.points)


def test_clouds_are_collated_after_the_steps(caches):
    loader = DataLoader(CachedCloudDataset(caches["packed"], augment=None), batch_size=3, collate_fn=collate_packed)
    batch = next(iter(DevicePipeline(loader, steps_of(caches), device="cpu", collate=collate_padded)))
    assert isinstance(batch, PaddedClouds)


def test_what_would_draw_twice_or_cannot_run_is_refused(caches):
    loader = DataLoader(CachedCloudDataset(caches["packed"]), collate_fn=collate_packed)
    with pytest.raises(ConfigError, match="augment=None"):
        DevicePipeline(loader, steps_of(caches), device="cpu")
    with pytest.raises(DTypeError, match="dataset of pcdata"):
        DevicePipeline(DataLoader([1, 2]), steps_of(caches), device="cpu")
    plain = DataLoader(CachedCloudDataset(caches["packed"], augment=None), batch_size=2, collate_fn=collate_padded)
    with pytest.raises(DTypeError, match="collate_packed"):
        next(iter(DevicePipeline(plain, steps_of(caches), device="cpu")))


class _MakesOneInside(Dataset):
    def __init__(self, loader, steps):
        self.loader, self.steps = loader, steps

    def __len__(self):
        return 1

    def __getitem__(self, index):
        return DevicePipeline(self.loader, self.steps, device="cpu")


def test_a_worker_may_not_use_the_device(caches):
    loader = DataLoader(CachedCloudDataset(caches["packed"], augment=None), collate_fn=collate_packed)
    with pytest.raises(ConfigError, match="not in a worker"):
        next(iter(DataLoader(_MakesOneInside(loader, steps_of(caches)), num_workers=1, collate_fn=list)))


def test_the_next_batch_begins_before_this_one_is_given():
    told = []

    class Side:
        def begin(self, make, batch):
            told.append(f"begin {batch}")
            return make(batch), "event"

        def hand_over(self, made, event):
            told.append(f"give {made}")
            return made

    given = device_pipeline._one_ahead(iter([1, 2, 3]), lambda batch: batch * 10, Side())
    assert next(given) == 10
    assert told == ["begin 1", "begin 2", "give 10"]
    assert list(given) == [20, 30]
    assert list(device_pipeline._one_ahead(iter([]), abs, Side())) == []
