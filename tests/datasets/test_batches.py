"""A batch that is read and made at once is the batch of its samples: the same bits, draws, histories and errors."""

from __future__ import annotations

import gc
import json
import os
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader, Subset

from pcdata import (
    CachedCloudDataset,
    Compose,
    CountedSampler,
    EpisodeWindows,
    PointCloud,
    collate_fixed,
    collate_packed,
    collate_padded,
    collate_windows,
)
from pcdata.build import build_dataset, config_from_yaml
from pcdata.datasets import RepeatedEpochWarning, cached
from pcdata.errors import CacheError
from pcdata.io.store.shards import Shards
from pcdata.structures.read_later import Histories, StoredMeta, StoredSteps, StoredTexts
from pcdata.structures.unbatched import Unbatched
from pcdata.synthetic import TeleopSource
from pcdata.transforms import RandomJitter, RandomPointDropout, RandomRotation
from pcdata.transforms.families import SpatialTransform
from tests.io.forged import first_shard
from tests.io.store.test_stores import assert_same_cloud
from tests.loaders import packed_loader

PIPELINE = """
depth: [Deproject]
cloud: [ToFrame: {frame: base}, FarthestPointSample: {num_points: 16}]
augment: [RandomRotation: {degrees: 180}, RandomJitter: {sigma: 0.01}, RandomPointDropout: {low: 0.1, high: 0.5}]
"""
FORMATS = ("npz", "packed", "webdataset")  # one that reads records one by one, and two that read them as one


@pytest.fixture(scope="module")
def stores(tmp_path_factory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("batches")
    source = TeleopSource(num_episodes=2, num_views=1, size=(8, 10))
    for form in FORMATS:
        build_dataset(config_from_yaml(f"{PIPELINE}output: {{format: {form}, shard_size: 5}}\n"), source, root / form)
    return {form: root / form for form in FORMATS}


def datasets(folder: Path, **options) -> dict[str, tuple]:
    """The clouds, and windows over them, twice: to read at once, and one by one."""
    pair = [CachedCloudDataset(folder, seed=5, **options) for _ in range(2)]
    windows = [EpisodeWindows(CachedCloudDataset(folder, seed=5, **options), 2, 4) for _ in range(2)]
    return {"clouds": tuple(pair), "windows": tuple(windows)}


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("what", ["clouds", "windows"])
def test_a_batch_read_at_once_is_that_of_its_samples(stores, form, what):
    at_once, singly = datasets(stores[form], repeats=2)[what]
    last = len(at_once) - 1
    for asked in ([3, 0, 1, last, 2], [0], [1, 1, (1, 1), -1, (0, 2)]):
        batch = at_once.__getitems__(asked)
        assert isinstance(batch, Unbatched)
        singles = [singly[index] for index in asked]
        assert len(batch) == len(singles)
        for position, (made, single) in enumerate(zip(batch, singles, strict=True)):
            assert_same_cloud(made, single)
            assert_same_cloud(batch[position], single)
        assert_same_cloud(collate_packed(batch), collate_packed(singles))
        ours, theirs = collate_padded(batch), collate_padded(singles)
        assert torch.equal(ours.points, theirs.points)
        assert torch.equal(ours.mask, theirs.mask)


@pytest.mark.parametrize("form", FORMATS)
def test_windows_collated_at_once_are_those_collated_one_by_one(stores, form):
    at_once, singly = datasets(stores[form])["windows"]
    ours = collate_windows(at_once.__getitems__([4, 0, 9]))
    theirs = collate_windows([singly[index] for index in (4, 0, 9)])
    assert ours.signals.keys() == theirs.signals.keys()
    for name, values in ours.signals.items():
        assert torch.equal(values, theirs.signals[name]) if isinstance(values, torch.Tensor) else True
    assert torch.equal(ours.points, theirs.points)
    assert torch.equal(ours.action_mask, theirs.action_mask)
    assert ours.actions == theirs.actions


@pytest.mark.parametrize("what", ["clouds", "windows"])
def test_large_clouds_go_through_the_steps_in_parts(stores, what, monkeypatch):
    at_once, singly = datasets(stores["packed"])[what]
    monkeypatch.setattr(cached, "_MOST_POINTS", 40)
    batch = at_once.__getitems__([3, 0, 1, 5, 2])
    assert len(batch.batches) > 1
    for made, index in zip(batch, (3, 0, 1, 5, 2), strict=True):
        assert_same_cloud(made, singly[index])
    assert_same_cloud(batch[-1], singly[2])
    assert [cloud.num_points for cloud in batch[1:3]] == [singly[0].num_points, singly[1].num_points]
    collate = collate_windows if what == "windows" else collate_padded
    assert torch.equal(collate(batch).points, collate([singly[index] for index in (3, 0, 1, 5, 2)]).points)


@pytest.mark.parametrize(
    "augment",
    [None, RandomRotation(), RandomJitter(sigma=0.1), Compose([]), Compose([RandomPointDropout(low=0.2, high=0.4)])],
    ids=str,
)
def test_whatever_augments_is_drawn_as_for_single_samples(stores, augment):
    at_once, singly = (CachedCloudDataset(stores["packed"], augment=augment, seed=2) for _ in range(2))
    for made, index in zip(at_once.__getitems__([2, 7, 4]), (2, 7, 4), strict=True):
        assert_same_cloud(made, singly[index])


class ShiftsByTheFirst(SpatialTransform, abstract=True):
    """One's own step that takes all clouds for one."""

    def make_params(self, data, streams):
        matrix = torch.eye(4, dtype=torch.float64).repeat(data.num_clouds, 1, 1)
        matrix[:, :3, 3] = data.points[0].double()
        return {"matrix": matrix}


def test_ones_own_steps_see_one_sample_at_a_time(stores):
    at_once, singly = (CachedCloudDataset(stores["packed"], augment=ShiftsByTheFirst()) for _ in range(2))
    batch = at_once.__getitems__([2, 7, 4])
    assert isinstance(batch, list)
    for made, index in zip(batch, (2, 7, 4), strict=True):
        assert_same_cloud(made, singly[index])


def test_a_batch_of_one_size_is_collated_without_a_copy(stores):
    batch = CachedCloudDataset(stores["packed"], augment=RandomRotation()).__getitems__([1, 0, 2])
    assert collate_fixed(batch).points.data_ptr() == batch.batches[0].points.data_ptr()
    assert collate_packed(batch) is batch.batches[0]


@pytest.mark.filterwarnings("ignore:This DataLoader will create")
@pytest.mark.parametrize("start", ["fork", pytest.param("forkserver", marks=pytest.mark.slow)])
def test_workers_give_the_batches_of_single_samples(stores, start):
    dataset, singly = (CachedCloudDataset(stores["packed"], seed=1) for _ in range(2))
    order = [5, 2, 0, 7, 3, 1]
    loader = packed_loader(Subset(dataset, order), 2, start, batch_size=2)
    for epoch in (0, 1):
        dataset.set_epoch(epoch)
        singly.set_epoch(epoch)
        for place, batch in enumerate(loader):
            wanted = PointCloud.cat([singly[index] for index in order[2 * place : 2 * place + 2]])
            assert_same_cloud(batch, wanted)
    rows = np.array(order)
    assert dataset._touched.fresh(rows, dataset._shards.identities(rows)) == []  # the workers compared them, once


def test_a_history_that_nobody_read_crosses_to_another_process_and_is_read_there(stores):
    cloud, singly = CachedCloudDataset(stores["packed"])[0], CachedCloudDataset(stores["npz"])[0]
    assert isinstance(vars(cloud)["history"], Histories)
    there = pickle.loads(pickle.dumps(cloud))
    assert isinstance(vars(there)["history"], Histories)
    assert there.history == cloud.history == singly.history
    assert json.dumps(there.history) == json.dumps(singly.history)
    assert [step["step"] for step in there.history[0][-2:]] == ["RandomJitter", "RandomPointDropout"]


def test_a_history_that_is_none_is_told_when_it_is_read():
    for text in (b"{", b"{}", b"[1e999]", b"[{}]", b"[[], []]", b"[]"):
        cloud = PointCloud(points=torch.zeros(1, 3), frame_id="base", history=StoredSteps(StoredTexts.of([text])))
        with pytest.raises(CacheError, match="history"):
            cloud.history  # noqa: B018


def test_meta_that_is_none_is_told_when_it_is_read():
    for text in (
        b"{",
        b"[]",
        b"5",
        b"{}",
        b'{"meta":[]}',
        b'{"meta":[[]]}',
        b'{"meta":[{},{}]}',
        b'{"meta":[{"a":NaN}]}',
    ):
        cloud = PointCloud(points=torch.zeros(1, 3), frame_id="base", meta=StoredMeta(StoredTexts.of([text])))
        with pytest.raises(CacheError, match="meta"):
            cloud.meta  # noqa: B018


def test_counted_and_repeated_samples_keep_their_draws(stores):
    sampler = [0, 1, 0, 0, 1, 2]
    loader = DataLoader(
        CachedCloudDataset(stores["packed"]), batch_size=3, sampler=CountedSampler(sampler), collate_fn=list
    )
    singly, seen = CachedCloudDataset(stores["packed"]), [0, 0, 1, 2, 1, 0]
    made = [cloud for batch in loader for cloud in batch]
    for cloud, index, again in zip(made, sampler, seen, strict=True):
        assert_same_cloud(cloud, singly[index, again])


def test_a_second_pass_of_batches_in_one_epoch_warns_once(stores):
    dataset = CachedCloudDataset(stores["packed"])
    loader = DataLoader(dataset, batch_size=4, collate_fn=collate_packed)
    list(loader)
    with pytest.warns(RepeatedEpochWarning) as caught:
        list(loader)
    assert len(caught) == 1


# -- what is promised of damage ------------------------------------------------------------------------------------


def damaged(folder: Path, tmp_path: Path, sample: int) -> tuple[Path, int]:
    """Copy a packed dataset and flip a bit of one sample's points; return the folder and the place of the byte."""
    shutil.copytree(folder, tmp_path / "copy")
    dataset = CachedCloudDataset(folder, augment=None)
    path = first_shard(tmp_path / "copy") / "clouds.packed"
    content = bytearray(path.read_bytes())
    place = content.index(dataset[sample].points.numpy().tobytes())
    content[place] ^= 1
    path.write_bytes(content)
    return tmp_path / "copy", place


def test_a_flipped_bit_is_found_when_its_sample_is_first_read_and_the_sample_is_named(stores, tmp_path):
    folder, _ = damaged(stores["packed"], tmp_path, 2)
    dataset = CachedCloudDataset(folder)
    dataset.__getitems__([0, 1, 3])
    for read in (lambda: dataset.__getitems__([0, 2, 1]), lambda: dataset[2], lambda: dataset.__getitems__([2])):
        with pytest.raises(CacheError, match="differs from what was written") as caught:
            read()
        assert caught.value.sample_id == dataset.ids[2]
        assert caught.value.path == str(first_shard(folder) / "clouds.packed")
    with pytest.raises(CacheError, match="differs from what was written"):
        EpisodeWindows(CachedCloudDataset(folder), 2, 4).__getitems__([0, 2])


def test_a_sample_is_compared_once_for_a_file_and_again_for_another_file_of_its_name(stores, tmp_path, monkeypatch):
    folder = tmp_path / "data"
    shutil.copytree(stores["packed"], folder)
    dataset = CachedCloudDataset(folder)
    compared = []
    digest = Shards.digest
    monkeypatch.setattr(Shards, "digest", lambda own, number: compared.append(number) or digest(own, number))
    for _ in range(2):
        dataset.__getitems__([0, 1])
        dataset[1]
    copy = pickle.loads(pickle.dumps(dataset))
    copy[0]
    assert len(compared) == 2
    other, _ = damaged(stores["packed"], tmp_path, 1)
    (first_shard(folder) / "clouds.packed").unlink()
    shutil.copy(first_shard(other) / "clouds.packed", first_shard(folder))
    dataset[1]  # still mapped
    with pytest.raises(CacheError, match="differs from what was written"):
        pickle.loads(pickle.dumps(dataset))[1]


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="only Linux tells which files are open")
def test_shards_that_were_read_keep_no_file_open(stores):
    dataset = CachedCloudDataset(stores["packed"])
    assert dataset.manifest.index.num_shards > 3
    gc.collect()  # what earlier tests left
    before = len(os.listdir("/proc/self/fd"))
    dataset.__getitems__(range(len(dataset)))
    assert len(os.listdir("/proc/self/fd")) == before
