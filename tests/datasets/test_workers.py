"""DataLoader: neither the number of workers, nor how they start, nor the order changes a sample."""

from __future__ import annotations

import gc
import os
import pickle
import shutil

import pytest
import torch
from torch.utils.data import DataLoader

from pcdata import CachedCloudDataset, CloudDataset, PointCloud, collate_fixed, collate_packed, collate_padded
from pcdata.errors import CacheError, CaptureError, ShapeError
from pcdata.io.store.cloud_record import record_from_cloud
from pcdata.io.store.sample_index import Sample
from pcdata.io.store.stores import STORES
from pcdata.transforms import Compose, RandomJitter
from tests.forks import ended, forked
from tests.io.forged import edit_samples, first_shard, write_manifest
from tests.loaders import packed_loader

# Workers are counted against the cores of the machine; here there must be more workers than some machines have cores.
pytestmark = pytest.mark.filterwarnings("ignore:This DataLoader will create")

ORDER = [5, 0, 7, 3, 3, 1, 6, 2, 4]


def points_by_id(loader: DataLoader) -> list[tuple[str, torch.Tensor]]:
    return [(one.meta[0]["sample_id"], one.points.clone()) for batch in loader for one in batch.unbatch()]


def expected(dataset, order=ORDER) -> list[tuple[str, torch.Tensor]]:
    dataset.set_epoch(dataset.epoch)  # the same draws once more, on purpose
    return [(dataset.ids[index], dataset[index].points) for index in order]


def assert_equal(given, wanted) -> None:
    assert [name for name, _ in given] == [name for name, _ in wanted]
    for (name, a), (_, b) in zip(given, wanted, strict=True):
        assert torch.equal(a, b), name


@pytest.fixture(params=["hdf5", "npz", "packed", "pt", "on the fly"])
def dataset(request, source, config, caches):
    if request.param == "on the fly":
        return CloudDataset(source, config.pipeline, seed=3)
    return CachedCloudDataset(caches[request.param], seed=3)


@pytest.mark.parametrize("num_workers", [0, 3])
def test_any_number_of_workers_gives_the_same_samples_in_any_order(dataset, num_workers):
    dataset.set_epoch(2)
    loader = packed_loader(dataset, num_workers, batch_size=2, sampler=ORDER)
    assert_equal(points_by_id(loader), expected(dataset))


@pytest.mark.slow
@pytest.mark.parametrize(("start_method", "num_workers"), [("forkserver", 2), ("spawn", 1)])
def test_any_start_method_gives_the_same_samples_and_sees_new_epochs(caches, start_method, num_workers):
    dataset = CachedCloudDataset(caches["hdf5"], seed=3)
    dataset[0]  # an open handle must not travel
    loader = packed_loader(dataset, num_workers, start_method, batch_size=3, sampler=ORDER, persistent_workers=True)
    for epoch in (0, 5):
        dataset.set_epoch(epoch)
        assert_equal(points_by_id(loader), expected(dataset))


def test_persistent_workers_see_every_new_epoch(dataset):
    loader = packed_loader(dataset, 2, batch_size=4, persistent_workers=True)
    seen = []
    for epoch in range(3):
        dataset.set_epoch(epoch)
        given = points_by_id(loader)
        assert_equal(given, expected(dataset, range(8)))
        seen.append(given[0][1])
    assert not torch.equal(seen[0], seen[1])
    assert not torch.equal(seen[1], seen[2])


def test_an_unpickled_dataset_tells_forked_workers_of_new_epochs_too(caches):
    dataset = pickle.loads(pickle.dumps(CachedCloudDataset(caches["npz"])))
    loader = packed_loader(dataset, 1, batch_size=8, persistent_workers=True)
    for epoch in range(2):
        dataset.set_epoch(epoch)
        assert_equal(points_by_id(loader), expected(dataset, range(8)))


def test_a_shuffling_loader_gives_the_same_samples_in_another_order(caches):
    dataset = CachedCloudDataset(caches["hdf5"])
    loader = DataLoader(dataset, batch_size=3, shuffle=True, num_workers=2, collate_fn=collate_packed)
    wanted = dict(expected(dataset, range(8)))
    orders = []
    for seed in range(3):
        torch.manual_seed(seed)
        dataset.set_epoch(0)
        given = points_by_id(loader)
        orders.append([name for name, _ in given])
        assert sorted(orders[-1]) == sorted(wanted)
        assert all(torch.equal(points, wanted[name]) for name, points in given)
    assert len({tuple(order) for order in orders}) > 1


def test_padded_and_fixed_batches_come_through_workers_whole(caches):
    for collate, augment in ((collate_padded, "stored"), (collate_fixed, None)):
        dataset = CachedCloudDataset(caches["npz"], augment=augment)
        loader = DataLoader(dataset, batch_size=4, num_workers=2, collate_fn=collate)
        rows = [(points, mask) for batch in loader for points, mask in zip(batch.points, batch.mask, strict=True)]
        assert len(rows) == 8
        dataset.set_epoch(0)
        for (points, mask), one in zip(rows, dataset, strict=True):
            assert torch.equal(points[mask], one.points)


@pytest.fixture(scope="module")
def big_h5(tmp_path_factory):
    """Enough bytes that a file position shared between processes would mix them up."""
    folder = tmp_path_factory.mktemp("big") / "dataset"
    store, samples = STORES["hdf5"](first_shard(folder), "lzf"), []
    for number in range(24):
        draw = torch.Generator().manual_seed(number)
        cloud = PointCloud(
            points=torch.rand(20_000, 3, generator=draw), frame_id="base", meta=[{"sample_id": f"s{number}"}]
        )
        record = record_from_cloud(cloud)
        store.write(f"s{number}", record)
        samples.append(Sample(f"s{number}", f"s{number}", 20_000, record.digest()))
    store.close()
    pipeline = Compose([RandomJitter(sigma=0.001)])
    write_manifest(folder, "hdf5", samples, compression="lzf", pipeline=pipeline)
    return folder


def test_an_hdf5_handle_opened_before_the_fork_corrupts_nothing(big_h5):
    dataset = CachedCloudDataset(big_h5, augment=None)
    wanted = expected(dataset, range(24))  # opens the handle here
    loader = packed_loader(dataset, 2, batch_size=2)
    for _ in range(2):
        given = []
        for number, batch in enumerate(loader):
            given += [(one.meta[0]["sample_id"], one.points.clone()) for one in batch.unbatch()]
            assert torch.equal(dataset[number].points, wanted[number][1])  # this process reads on meanwhile
        assert_equal(given, wanted)


def test_a_child_that_closes_an_inherited_handle_leaves_the_parent_s_alone(caches):
    dataset = CachedCloudDataset(caches["hdf5"], augment=None)
    wanted = dataset[0].points

    def closes() -> int:
        dataset._shards.close()
        dataset._shards.close()
        return int(not torch.equal(dataset[0].points, wanted))

    assert ended(forked(closes)) == 0
    assert torch.equal(dataset[0].points, wanted)
    assert dataset[5].num_points == 64


@pytest.mark.parametrize("num_workers", [0, 2])
def test_many_epochs_leave_no_open_files_behind(caches, num_workers):
    def open_files() -> int:
        gc.collect()
        return len(os.listdir("/proc/self/fd"))

    dataset = CachedCloudDataset(caches["hdf5"])
    loader = DataLoader(dataset, batch_size=4, num_workers=num_workers, collate_fn=collate_packed)
    for epoch in range(3):  # the first worker processes open what stays open: a sentinel, a shared-memory socket
        dataset.set_epoch(epoch)
        points_by_id(loader)
    before = open_files()
    for epoch in range(12 if num_workers == 0 else 6):
        dataset.set_epoch(epoch)
        points_by_id(loader)
    assert open_files() <= before + 2  # what the last few batches still hold


def test_many_datasets_opened_and_dropped_leave_no_open_files_behind(caches):
    gc.collect()
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(20):
        CachedCloudDataset(caches["hdf5"])[0]
    gc.collect()
    assert len(os.listdir("/proc/self/fd")) <= before


def error_of(loader: DataLoader) -> tuple[type, str]:
    """Return what iterating raises, as type and text."""
    batches = iter(loader)
    try:
        list(batches)
    except Exception as error:
        found = type(error), str(error) + "".join(getattr(error, "__notes__", []))
    if loader.num_workers:
        batches._shutdown_workers()  # left to the garbage collector, torch waits 5 s for every worker
    return found


@pytest.mark.parametrize("num_workers", [0, 2])
def test_a_damaged_sample_keeps_its_error_type_and_names_itself(caches, tmp_path, num_workers):
    shutil.copytree(caches["npz"], tmp_path / "copy")
    edit_samples(tmp_path / "copy", lambda number, told: told | ({"digest": "0" * 64} if number == 5 else {}))
    dataset = CachedCloudDataset(tmp_path / "copy")
    kind, text = error_of(DataLoader(dataset, num_workers=num_workers, collate_fn=collate_packed))
    assert kind is CacheError
    assert "'tabletop-0005' differs" in text


@pytest.mark.parametrize("num_workers", [0, 1])
def test_an_error_of_source_or_collate_keeps_its_type(source, config, caches, num_workers):
    dataset = CloudDataset(source, config.pipeline)
    dataset.ids[2] = "tabletop-9999"
    kind, text = error_of(DataLoader(dataset, num_workers=num_workers, collate_fn=collate_packed))
    assert kind is CaptureError
    assert "sample 'tabletop-9999' of CloudDataset" in text  # the note travels too
    ragged = CachedCloudDataset(caches["pt"])
    kind, text = error_of(DataLoader(ragged, batch_size=8, num_workers=num_workers, collate_fn=collate_fixed))
    assert kind is ShapeError
    assert "collate_padded" in text
