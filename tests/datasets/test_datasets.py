"""Datasets: what a sample is depends on (seed, epoch, id) alone, and wrong files are errors that say where."""

from __future__ import annotations

import copy
import json
import pickle
import shutil

import numpy as np
import pytest
import torch
from torch.utils.data import Subset

from pcdata import CachedCloudDataset, CloudDataset, PointCloud
from pcdata.errors import CacheError, ConfigError, DTypeError, PcdataError
from pcdata.io.store.manifest import checksum_of
from pcdata.transforms import Compose, MaskDepth, RandomJitter, RemoveRadiusOutliers, VoxelDownsample
from tests.io.forged import edit_samples, first_shard
from tests.messages import told

FORMATS = ["hdf5", "npz", "packed", "pt", "webdataset"]


class FixedSource:
    """Clouds under given ids, or whatever else a test wants loaded."""

    def __init__(self, samples):
        self.samples = samples
        self.ids = list(samples)

    def load(self, sample_id):
        value = self.samples[sample_id]
        if isinstance(value, Exception):
            raise value
        return value


def cloud(value: float = 0.0) -> PointCloud:
    return PointCloud(points=torch.full((5, 3), value), frame_id="base")


def same(a: PointCloud, b: PointCloud) -> bool:
    return a.fields().keys() == b.fields().keys() and all(torch.equal(a.fields()[n], b.fields()[n]) for n in a.fields())


# -- the laws of randomness ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMATS)
def test_a_cached_sample_is_the_one_that_the_whole_pipeline_gives_on_the_fly(source, config, caches, form):
    live = CloudDataset(source, config.pipeline, seed=7)
    cached = CachedCloudDataset(caches[form], seed=7)
    assert cached.ids == live.ids
    for epoch in (0, 3):
        live.set_epoch(epoch)
        cached.set_epoch(epoch)
        for a, b in zip(cached, live, strict=True):
            assert same(a, b)
            assert torch.equal(a.source_from_cloud, b.source_from_cloud)
            assert json.loads(json.dumps([a.meta, a.history])) == json.loads(json.dumps([b.meta, b.history]))


def test_a_sample_depends_on_its_id_not_on_its_neighbors_or_the_order(source, config):
    whole = CloudDataset(source, config.pipeline)
    part = CloudDataset(FixedSource({name: source.load(name) for name in reversed(source.ids[2:5])}), config.pipeline)
    for index, name in enumerate(part.ids):
        assert same(part[index], whole[source.ids.index(name)])
    assert same(whole[3], whole[3])


def test_another_epoch_seed_or_id_draws_anew():
    jitter = RandomJitter(sigma=0.01, clip=0.05)
    base = CloudDataset(FixedSource({"a": cloud(), "b": cloud()}), jitter, seed=0)
    first = base[0].points
    assert not torch.equal(first, base[1].points)
    assert not torch.equal(first, CloudDataset(FixedSource({"a": cloud()}), jitter, seed=1)[0].points)
    base.set_epoch(1)
    assert not torch.equal(first, base[0].points)
    base.set_epoch(0)
    assert torch.equal(first, base[0].points)


def test_the_global_random_state_neither_matters_nor_changes(caches):
    dataset = CachedCloudDataset(caches["npz"])
    torch.manual_seed(1)
    first, state = dataset[0], torch.get_rng_state()
    torch.manual_seed(2)
    assert same(dataset[0], first)
    torch.manual_seed(1)
    assert torch.equal(torch.get_rng_state(), state)


# -- what runs on a cache ------------------------------------------------------------------------------------------


def test_augment_none_gives_the_stored_clouds_in_every_epoch(caches, source, config):
    dataset = CachedCloudDataset(caches["hdf5"], augment=None)
    stored = config.pipeline.split()[0](source.load(source.ids[0]))
    assert same(dataset[0], stored)
    dataset.set_epoch(9)
    assert same(dataset[0], stored)


def test_a_transform_of_ones_own_replaces_the_stored_suffix(caches):
    plain = CachedCloudDataset(caches["hdf5"], augment=None)[0]
    coarse = CachedCloudDataset(caches["hdf5"], augment=VoxelDownsample(voxel_size=10.0))[0]
    assert coarse.num_points < plain.num_points


@pytest.mark.parametrize("augment", ["none", "all", "Stored", ""])
def test_an_unknown_word_for_augment_is_refused(caches, augment):
    with pytest.raises(ConfigError, match="'stored', None or a transform"):
        CachedCloudDataset(caches["hdf5"], augment=augment)


def test_a_function_in_place_of_a_transform_is_refused_at_once(caches, source):
    with pytest.raises(DTypeError, match="Transform"):
        CachedCloudDataset(caches["hdf5"], augment=lambda data: data)
    with pytest.raises(DTypeError, match="Transform"):
        CloudDataset(source, lambda data: data)


# -- the fingerprint -----------------------------------------------------------------------------------------------


def test_the_pipeline_that_built_a_cache_opens_it(caches, config):
    assert len(CachedCloudDataset(caches["pt"], pipeline=config.pipeline)) == 8


def test_another_augmentation_opens_it_too_and_is_the_one_that_runs(caches, config):
    calm = config.pipeline.split()[0]
    dataset = CachedCloudDataset(caches["pt"], pipeline=calm)
    assert same(dataset[0], CachedCloudDataset(caches["pt"], augment=None)[0])


def test_other_deterministic_steps_are_refused_and_the_message_says_which(caches, config):
    other = Compose([MaskDepth(near=0.1, far=2.5), *list(config.pipeline.steps)[1:]])
    with pytest.raises(CacheError) as caught:
        CachedCloudDataset(caches["hdf5"], pipeline=other)
    message = str(caught.value)
    assert str(caches["hdf5"]) in message
    for part in ("step 1: ", "far=2.5", "far=3.0", "rebuild"):
        assert part in message


def test_a_missing_step_is_named(caches, config):
    shorter = Compose(list(config.pipeline.steps)[:3])
    with pytest.raises(CacheError, match=r"step 4: nothing here, FarthestPointSample"):
        CachedCloudDataset(caches["hdf5"], pipeline=shorter)


def test_a_cache_of_an_older_transform_version_is_refused(caches, monkeypatch):
    monkeypatch.setattr(MaskDepth, "version", 99)
    with pytest.raises(CacheError, match="version"):
        CachedCloudDataset(caches["hdf5"])


@pytest.mark.parametrize("wrong", ["config.yaml", {"depth": []}, 5])
def test_something_else_for_the_pipeline_says_how_to_get_one(caches, wrong):
    with pytest.raises(DTypeError, match="load_config"):
        CachedCloudDataset(caches["hdf5"], pipeline=wrong)


def test_the_whole_configuration_for_the_pipeline_says_how_to_get_it(caches, config):
    with pytest.raises(DTypeError, match=r"load_config\(path\)\.pipeline"):
        CachedCloudDataset(caches["hdf5"], pipeline=config)


# -- damaged datasets ----------------------------------------------------------------------------------------------


def edited(folder, tmp_path, edit):
    copied = tmp_path / "edited"
    shutil.copytree(folder, copied)
    content = json.loads((copied / "dataset.json").read_text())
    del content["checksum"]
    edit(content)
    # With a checksum that fits, so that what else is checked is reached.
    (copied / "dataset.json").write_text(json.dumps({**content, "checksum": checksum_of(content)}))
    return copied


def changed(folder, tmp_path, number=0, **told):
    """Copy a dataset whose index says something else of one sample."""
    shutil.copytree(folder, tmp_path / "changed")
    edit_samples(tmp_path / "changed", lambda each, sample: sample | (told if each == number else {}))
    return tmp_path / "changed"


@pytest.mark.parametrize("form", FORMATS)
def test_a_changed_digest_is_refused_and_names_file_and_sample(caches, tmp_path, form):
    folder = changed(caches[form], tmp_path, digest="0" * 64, number=2)
    dataset = CachedCloudDataset(folder)
    assert dataset[0].num_points
    with pytest.raises(CacheError, match=r"tabletop-0002.*differs") as caught:
        dataset[2]
    assert str(folder) in str(caught.value)


def test_a_changed_count_is_refused(caches, tmp_path):
    folder = changed(caches["npz"], tmp_path, num_points=65)
    with pytest.raises(CacheError, match="64 points, but the index says 65"):
        CachedCloudDataset(folder)[0]


def test_a_file_swapped_for_that_of_another_sample_is_refused(caches, tmp_path):
    folder = edited(caches["npz"], tmp_path, lambda c: None)
    clouds = first_shard(folder) / "clouds"
    (clouds / "tabletop-0001.npz").replace(clouds / "tabletop-0000.npz")
    dataset = CachedCloudDataset(folder)
    with pytest.raises(CacheError, match="differs"):
        dataset[0]
    with pytest.raises(CacheError, match="missing"):
        dataset[1]


def test_a_pipeline_with_an_unknown_transform_says_to_import_it(caches, tmp_path):
    folder = edited(caches["pt"], tmp_path, lambda c: c["pipeline"]["cloud"].append({"MyOwnStep": {}}))
    with pytest.raises(CacheError, match=r"dataset\.json.*MyOwnStep(.|\n)*import") as caught:
        CachedCloudDataset(folder)
    assert "os.system" not in str(caught.value)


@pytest.mark.parametrize(
    "pipeline", [{"depth": 5}, {"other": []}, {"cloud": [{"VoxelDownsample": {"voxel_size": -1}}]}, {"cloud": [[]]}]
)
def test_a_damaged_pipeline_is_a_cache_error(caches, tmp_path, pipeline):
    folder = edited(caches["pt"], tmp_path, lambda c: c.update(pipeline=pipeline))
    with pytest.raises(CacheError, match=r"dataset\.json"):
        CachedCloudDataset(folder)


def test_a_deeply_nested_pipeline_is_a_cache_error(caches, tmp_path):
    folder = edited(caches["pt"], tmp_path, lambda content: content["pipeline"].update(cloud=["HERE"]))
    deep = '{"Compose": {"steps": [' * 200 + '"MergeViews"' + "]}}" * 200
    text = (folder / "dataset.json").read_text().replace('"HERE"', deep)
    (folder / "dataset.json").write_text(text)
    with pytest.raises(CacheError, match=r"dataset\.json"):
        CachedCloudDataset(folder)


def test_a_folder_that_is_no_dataset_says_how_to_make_one(tmp_path):
    with pytest.raises(CacheError, match="pcdata build"):
        CachedCloudDataset(tmp_path)


# -- behaving like a list ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", ["cached", "live"])
def test_indices_behave_like_those_of_a_list(caches, source, config, make):
    dataset = CachedCloudDataset(caches["hdf5"]) if make == "cached" else CloudDataset(source, config.pipeline)
    assert len(dataset) == 8
    assert same(dataset[-1], dataset[7])
    assert same(dataset[-8], dataset[0])
    assert same(dataset[torch.tensor(3)], dataset[3])
    for index in (8, -9, 10**6):
        with pytest.raises(IndexError):
            dataset[index]
    with pytest.raises(DTypeError, match="Subset"):
        dataset[1:3]
    with pytest.raises(TypeError):
        dataset["tabletop-0000"]
    assert same(Subset(dataset, [5, 2])[1], dataset[2])


def test_an_index_error_inside_a_transform_does_not_end_the_iteration_quietly():
    dataset = CloudDataset(FixedSource({"a": cloud(), "b": IndexError("a bug"), "c": cloud()}))
    with pytest.raises(IndexError, match="a bug"):
        list(dataset)


def test_iterating_gives_every_sample_once():
    assert len(list(CloudDataset(FixedSource({"a": cloud(), "b": cloud()})))) == 2


# -- errors --------------------------------------------------------------------------------------------------------


def test_an_error_keeps_its_type_and_names_the_sample(source):
    class Mine(Exception):
        pass

    dataset = CloudDataset(FixedSource({"good": cloud(), "bad one": Mine("unreadable")}))
    assert dataset[0].num_points == 5
    with pytest.raises(Mine, match="unreadable") as caught:
        dataset[1]
    assert "'bad one'" in told(caught.value)


def test_a_step_that_fails_names_step_sample_and_cloud():
    dataset = CloudDataset(FixedSource({"s1": cloud()}), Compose([VoxelDownsample(voxel_size=1.0)]))
    assert dataset[0].num_points == 1
    normalized = PointCloud(points=torch.rand(5, 3), frame_id="base", unit="normalized")
    step = RemoveRadiusOutliers(radius=0.1, min_neighbors=2)
    dataset = CloudDataset(FixedSource({"s1": normalized}), Compose([step]))
    with pytest.raises(PcdataError, match="metres") as caught:
        dataset[0]
    notes = told(caught.value)
    assert "RemoveRadiusOutliers" in notes
    assert "'s1'" in notes


def test_a_pipeline_that_does_not_end_in_points_is_named(source):
    with pytest.raises(DTypeError, match="must end in a PointCloud"):
        CloudDataset(source, MaskDepth(near=0.1))[0]
    with pytest.raises(DTypeError, match="must end in a PointCloud"):
        CloudDataset(source)[0]


def test_a_path_for_the_source_says_to_open_it(tmp_path):
    with pytest.raises(DTypeError, match="open_source"):
        CloudDataset(str(tmp_path))


def test_ids_that_repeat_are_refused():
    twice = FixedSource({"a": cloud()})
    twice.ids = ["a", "a"]
    with pytest.raises(ConfigError, match="unique"):
        CloudDataset(twice)


@pytest.mark.parametrize("epoch", [1.5, "one", None])
def test_an_epoch_that_is_no_whole_number_is_refused(epoch):
    dataset = CloudDataset(FixedSource({"a": cloud()}))
    with pytest.raises(TypeError):
        dataset.set_epoch(epoch)
    assert dataset.epoch == 0


# -- copies --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda dataset: pickle.loads(pickle.dumps(dataset))])
def test_a_copy_has_an_epoch_of_its_own_that_workers_can_see(caches, clone):
    dataset = CachedCloudDataset(caches["hdf5"])
    dataset.set_epoch(4)
    dataset[0]  # the handle is open now
    copied = clone(dataset)
    assert copied.epoch == 4
    copied.set_epoch(5)
    assert dataset.epoch == 4
    assert copied._epoch.is_shared()
    dataset.set_epoch(5)
    assert same(copied[1], dataset[1])


def test_the_repr_tells_what_it_is(caches, source):
    assert "8 samples" in repr(CachedCloudDataset(caches["hdf5"]))
    assert "hdf5" in repr(CachedCloudDataset(caches["hdf5"]))
    assert "8 samples" in repr(CloudDataset(source))


# -- numbers that are none -----------------------------------------------------------------------------------------

NO_NUMBERS = ["s0", None, 1.5, True, np.True_, torch.tensor(True), [0, 1], torch.tensor([0, 1])]


@pytest.mark.parametrize("given", NO_NUMBERS, ids=repr)
def test_what_is_no_whole_number_is_neither_index_nor_seed_nor_epoch_nor_repeats(given, source, config):
    dataset = CloudDataset(source, config.pipeline)
    for wrong in (
        lambda: dataset[given],
        lambda: dataset.set_epoch(given),
        lambda: CloudDataset(source, config.pipeline, seed=given),
        lambda: CloudDataset(source, config.pipeline, repeats=given),
    ):
        with pytest.raises(DTypeError, match="must be a whole number, got"):
            wrong()


def test_whole_numbers_of_numpy_and_torch_are_those_of_python(source, config):
    wanted = CloudDataset(source, config.pipeline, seed=3)[1].points
    for number in (np.int64(3), np.uint8(3), torch.tensor(3)):
        dataset = CloudDataset(source, config.pipeline, seed=number, repeats=np.int32(1))
        dataset.set_epoch(number)
        dataset.set_epoch(np.int64(0))
        assert torch.equal(dataset[torch.tensor(1)].points, wanted)


def test_an_epoch_of_more_bits_than_are_kept_is_refused(source):
    with pytest.raises(ConfigError, match="epoch must be a number of 63 bits"):
        CloudDataset(source).set_epoch(1 << 63)
