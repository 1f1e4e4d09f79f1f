"""Builds: all or nothing, nobody's files are touched, and what was built is what the pipeline gives."""

from __future__ import annotations

import dataclasses
import hashlib
import inspect
import json
import os

import h5py
import numpy as np
import pytest
import torch

from pcdata import CachedCloudDataset, PointCloud, open_source
from pcdata.build import build_dataset, config_from_yaml, outlook
from pcdata.build.request import BuildRequest
from pcdata.errors import CacheError, CaptureError, ConfigError, DTypeError
from pcdata.io.store.manifest import Manifest
from pcdata.io.store.sample_keys import key_of
from pcdata.synthetic import SyntheticSource
from tests.io.forged import first_shard

FORMATS = ["hdf5", "npz", "packed", "pt", "webdataset"]


class Clouds:
    """Clouds, or exceptions, under given ids."""

    def __init__(self, samples):
        self.samples = samples
        self.ids = list(samples)

    def __repr__(self):
        return "Clouds()"

    def load(self, sample_id):
        value = self.samples[sample_id]
        if isinstance(value, BaseException):
            raise value
        return value


def cloud(count: int = 40, **changes: object) -> PointCloud:
    points = torch.rand(count, 3, generator=torch.Generator().manual_seed(count))
    here = torch.eye(4, dtype=torch.float64)[None]
    fields = {"points": points, "frame_id": "base", "frames": {"base": here}}
    return PointCloud(**(fields | changes))


def tree(folder) -> dict[str, bytes | None]:
    """Everything below a folder, hidden names too."""
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


# -- what is built -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMATS)
def test_a_dataset_holds_what_the_deterministic_steps_give(tmp_path, source, configure, form):
    config = configure(f"output: {{format: {form}}}")
    report = build_dataset(config, source, tmp_path / "out")
    assert [sample.id for sample in report.samples] == source.ids
    prefix = config.pipeline.split()[0]
    dataset = CachedCloudDataset(tmp_path / "out", augment=None)
    for stored, name in zip(dataset, source.ids, strict=True):
        wanted = prefix(source.load(name))
        assert stored.fields().keys() == wanted.fields().keys()
        assert all(torch.equal(stored.fields()[field], wanted.fields()[field]) for field in wanted.fields())
        assert torch.equal(stored.source_from_cloud, wanted.source_from_cloud)
        assert {entry["sample_id"] for entry in stored.meta} == {name}


def test_the_fingerprint_stored_is_that_of_the_prefix(tmp_path, source, configure):
    config = configure()
    build_dataset(config, source, tmp_path / "out")
    manifest = Manifest.read(tmp_path / "out")
    prefix, _ = config.pipeline.split()
    assert manifest.fingerprint == config.pipeline.stored_fingerprint() == prefix.stored_fingerprint()
    assert manifest.pipeline == config.pipeline.sections()
    assert set(manifest.versions) == {"pcdata", "torch", "numpy", "python"}


@pytest.mark.parametrize("settings", ["hdf5", "hdf5, compression: gzip", "npz", "pt"])
def test_building_twice_gives_the_same_bytes(tmp_path, source, configure, settings):
    for name in ("one", "two"):
        build_dataset(configure(f"output: {{format: {settings}, keep_raw: true}}"), source, tmp_path / name)
    assert tree(tmp_path / "one") == tree(tmp_path / "two")


def test_counts_are_told_per_step_and_captures_that_are_clouds_say_so(tmp_path, source, configure):
    report = build_dataset(configure(), source, tmp_path / "out")
    sample = report.samples[0]
    assert sample.entered_at == "depth"
    assert [step for step, _ in sample.counts] == ["Deproject", "ToFrame", "FarthestPointSample"]
    assert sample.counts[-1][1] == 2 * 32  # both views
    depth = source.load(sample.id).depth
    assert sample.counts[0][1] == int(((depth >= 0.1) & (depth <= 3.0)).sum())
    assert build_dataset(configure(), Clouds({"a": cloud()}), tmp_path / "b").samples[0].entered_at == "cloud"


@pytest.mark.parametrize("merged", ["", "  - MergeViews: {}\n"])
def test_what_came_before_objects_were_split_is_counted_once(tmp_path, merged):
    source = SyntheticSource(num_scenes=1, num_views=2, size=(60, 80))
    text = f"depth:\n  - Deproject: {{}}\n  - ToFrame: {{frame: base}}\n{merged}  - SplitObjects: {{}}\n"
    config = config_from_yaml(text + "  - FarthestPointSample: {num_points: 16, if_short: repeat}\n", name="split")
    report = build_dataset(config, source, tmp_path / "out")
    steps = config.pipeline.split()[0].step_through(source.load(source.ids[0]))
    assert report.samples[0].counts == [(type(step).__name__, cloud.num_points) for step, cloud in steps]
    split, sampled = report.samples[0].counts[-2:]
    assert split[1] < report.samples[0].counts[0][1] <= 2 * 60 * 80  # no more points than pixels
    assert sampled[1] == 16 * CachedCloudDataset(tmp_path / "out")[0].num_clouds


def test_progress_is_told_after_every_sample(tmp_path, source, configure):
    told = []
    build_dataset(configure(), source, tmp_path / "out", progress=lambda *news: told.append(news))
    assert told == [(i + 1, 3, name) for i, name in enumerate(source.ids)]


@pytest.mark.parametrize("form", FORMATS)
def test_any_sample_id_can_be_stored(tmp_path, configure, form):
    ids = ["a/b/c", "../up", "..", ".hidden", "with space", "ünïcode-点", "x" * 300, "%2F", "a.b.c", "~"]
    build_dataset(configure(f"output: {{format: {form}}}"), Clouds({name: cloud() for name in ids}), tmp_path / "out")
    dataset = CachedCloudDataset(tmp_path / "out", augment=None)
    assert dataset.ids == ids
    assert [one.meta[0]["sample_id"] for one in dataset] == ids
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_the_dataset_can_be_moved(tmp_path, source, configure):
    build_dataset(configure(), source, tmp_path / "here")
    (tmp_path / "here").rename(tmp_path / "there")
    assert len(list(CachedCloudDataset(tmp_path / "there"))) == 3


def test_missing_parents_of_the_folder_are_made(tmp_path, source, configure):
    build_dataset(configure(), source, tmp_path / "a" / "b" / "out")
    assert len(CachedCloudDataset(tmp_path / "a" / "b" / "out")) == 3


# -- keep_raw ------------------------------------------------------------------------------------------------------


def test_keep_raw_delivers_captures_that_open_source_reads_back(tmp_path, source, configure):
    build_dataset(configure("output: {format: npz, keep_raw: true}"), source, tmp_path / "out")
    for name in source.ids:
        frame = source.load(name)
        for v in range(2):
            raw = open_source(first_shard(tmp_path / "out") / "raw" / key_of(name) / f"view{v}")
            read = raw.load(raw.ids[0])
            assert torch.equal(read.depth[0], frame.depth[v])
            assert torch.equal(read.colors[0], frame.colors[v])
            assert torch.equal(read.world_from_camera[0], frame.world_from_camera[v])
            assert torch.equal(read.camera.intrinsics[0], frame.camera.intrinsics[v])
            assert read.frame_id == frame.frame_id


def test_keep_raw_of_clouds_is_refused(tmp_path, configure):
    with pytest.raises(CaptureError, match="keep_raw"):
        build_dataset(configure("output: {keep_raw: true}"), Clouds({"a": cloud()}), tmp_path / "out")
    assert not list(tmp_path.iterdir())


# -- all or nothing ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("fault", [KeyboardInterrupt(), SystemExit(3)], ids=repr)
def test_an_end_in_the_middle_of_the_first_shard_leaves_nothing(tmp_path, configure, form, fault):
    samples = {"good": cloud(), "bad one": fault, "later": cloud()}
    with pytest.raises(type(fault)):
        build_dataset(configure(f"output: {{format: {form}}}"), Clouds(samples), tmp_path / "deep" / "er" / "out")
    assert not list(tmp_path.iterdir())


def test_progress_that_raises_leaves_nothing(tmp_path, source, configure):
    def progress(done: int, total: int, name: str) -> None:
        raise RuntimeError("closed window")

    with pytest.raises(RuntimeError, match="closed window"):
        build_dataset(configure(), source, tmp_path / "out", progress=progress)
    assert not list(tmp_path.iterdir())


def test_a_source_without_captures_is_refused(tmp_path, configure):
    with pytest.raises(CaptureError, match="no samples"):
        build_dataset(configure(), Clouds({}), tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_ids_that_repeat_are_refused_before_any_work(tmp_path, configure):
    twice = Clouds({"a": RuntimeError("must not be loaded")})
    twice.ids = ["a", "a"]
    with pytest.raises(CaptureError, match="'a' comes more than once"):
        build_dataset(configure(), twice, tmp_path / "out")


def test_wrong_arguments_say_how_to_get_the_right_ones(tmp_path, source, configure):
    with pytest.raises(DTypeError, match="load_config"):
        build_dataset("config.yaml", source, tmp_path / "out")
    with pytest.raises(DTypeError, match="load_config"):
        build_dataset(configure().pipeline, source, tmp_path / "out")
    with pytest.raises(DTypeError, match="open_source"):
        build_dataset(configure(), "captures/", tmp_path / "out")


def test_a_pipeline_without_deprojection_is_refused(tmp_path, source):
    from pcdata.build import config_from_yaml

    with pytest.raises(ConfigError, match="Deproject"):
        build_dataset(config_from_yaml("cloud: []"), source, tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_a_build_and_an_outlook_take_the_same_options(tmp_path, source, configure):
    own = inspect.signature(build_dataset).parameters
    options = {name: one.default for name, one in own.items() if one.kind is one.KEYWORD_ONLY}
    assert options.pop("progress") is options.pop("note") is None
    assert options == {one.name: one.default for one in dataclasses.fields(BuildRequest)}
    assert outlook(configure(), source, tmp_path / "out", **options).num_samples == 3
    for call in (build_dataset, outlook):
        with pytest.raises(TypeError, match="worker"):
            call(configure(), source, tmp_path / "out", worker=2)
        with pytest.raises(ConfigError, match="workers must be a whole number"):
            call(configure(), source, tmp_path / "out", workers=-1)


# -- what is there already -----------------------------------------------------------------------------------------


def test_random_noise_on_the_depth_is_refused_since_no_cloud_could_be_stored(tmp_path, source):
    noisy = config_from_yaml("depth: [RandomSensorNoise: {sensor: realsense_d435}, Deproject]\ncloud: []\n")
    with pytest.raises(ConfigError, match=r"RandomSensorNoise.*CloudDataset"):
        build_dataset(noisy, source, tmp_path / "dataset")
    assert not (tmp_path / "dataset").exists()


def test_an_existing_folder_is_refused_with_the_ways_out_that_there_are(tmp_path, source, configure):
    build_dataset(configure(), source, tmp_path / "set")
    with pytest.raises(CacheError, match=r"exists already.*another folder.*--overwrite"):
        build_dataset(configure(), source, tmp_path / "set")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("years")
    for place in (tmp_path / "out", tmp_path / "out" / "thesis.tex"):  # --overwrite would not help
        with pytest.raises(CacheError, match=r"is not a pcdata dataset.*choose another folder$"):
            build_dataset(configure(), source, place)
    assert (tmp_path / "out" / "thesis.tex").read_text() == "years"


def test_an_existing_empty_folder_is_used(tmp_path, source, configure):
    (tmp_path / "out").mkdir()
    build_dataset(configure(), source, tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert len(CachedCloudDataset(tmp_path / "out")) == 3


def test_overwrite_never_replaces_what_is_no_dataset(tmp_path, source, configure):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("years")
    (tmp_path / "file").write_text("more")
    for name in ("out", "file"):
        with pytest.raises(CacheError, match="not a pcdata dataset, so it is not overwritten"):
            build_dataset(configure(), source, tmp_path / name, overwrite=True)
    assert (tmp_path / "out" / "thesis.tex").read_text() == "years"
    assert (tmp_path / "file").read_text() == "more"


def test_overwrite_never_deletes_a_file_somebody_put_into_a_dataset(tmp_path, source, configure):
    build_dataset(configure(), source, tmp_path / "out")
    (tmp_path / "out" / "checkpoint.pt").write_bytes(b"a week of training")
    before = tree(tmp_path)
    with pytest.raises(CacheError, match=r"checkpoint\.pt"):
        build_dataset(configure(), source, tmp_path / "out", overwrite=True)
    assert tree(tmp_path) == before


def test_overwrite_never_replaces_a_folder_with_somebody_else_s_dataset_json(tmp_path, source, configure):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "dataset.json").write_text('{"my": "own"}')
    with pytest.raises(CacheError, match="schema"):
        build_dataset(configure(), source, tmp_path / "out", overwrite=True)
    assert (tmp_path / "out" / "dataset.json").exists()


def test_overwrite_replaces_a_dataset_whole(tmp_path, source, configure):
    build_dataset(configure("output: {format: npz}"), source, tmp_path / "out")
    build_dataset(configure("output: {format: pt}"), Clouds({"a": cloud()}), tmp_path / "out", overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert CachedCloudDataset(tmp_path / "out").ids == ["a"]
    assert not list((tmp_path / "out").rglob("*.npz"))


@pytest.mark.parametrize("fault", [CaptureError("bad"), KeyboardInterrupt()], ids=repr)
def test_a_failed_overwrite_leaves_the_old_dataset_untouched(tmp_path, source, configure, fault):
    build_dataset(configure(), source, tmp_path / "out")
    before = tree(tmp_path)
    with pytest.raises(type(fault)):
        build_dataset(configure(), Clouds({"a": fault, "b": fault}), tmp_path / "out", overwrite=True)
    assert tree(tmp_path) == before


@pytest.mark.parametrize("fault", [OSError(28, "No space left on device"), KeyboardInterrupt()], ids=repr)
@pytest.mark.parametrize(("swaps", "failing_rename"), [(True, 1), (False, 1), (False, 2)])
def test_a_failure_while_the_datasets_are_swapped_brings_the_old_one_back(
    tmp_path, source, configure, monkeypatch, fault, swaps, failing_rename
):
    build_dataset(configure(), source, tmp_path / "out")
    before = tree(tmp_path / "out")
    calls = []
    rename = os.rename

    def failing(a, b):
        calls.append(b)
        if len(calls) == failing_rename:
            raise fault
        rename(a, b)

    monkeypatch.setattr("pcdata.files.whole_folders.os.rename", failing)
    if not swaps:
        monkeypatch.setattr("pcdata.files.whole_folders.exchange", lambda one, other: False)
    with pytest.raises((CacheError, KeyboardInterrupt)):
        build_dataset(configure(), Clouds({"a": cloud()}), tmp_path / "out", overwrite=True)
    assert len(calls) >= failing_rename
    monkeypatch.undo()
    assert tree(tmp_path / "out") == before
    build_dataset(configure(), Clouds({"a": cloud()}), tmp_path / "out", overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_link_to_a_dataset_leads_to_the_new_one_after_overwriting(tmp_path, source, configure):
    build_dataset(configure(), source, tmp_path / "disk" / "out")
    (tmp_path / "link").symlink_to(tmp_path / "disk" / "out")
    build_dataset(configure(), Clouds({"a": cloud()}), tmp_path / "link", overwrite=True)
    assert (tmp_path / "link").is_symlink()
    assert CachedCloudDataset(tmp_path / "link").ids == ["a"]
    assert sorted(path.name for path in tmp_path.rglob("*") if "." in path.name[:1]) == []


def test_the_current_folder_can_be_the_target(tmp_path, source, configure, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    build_dataset(configure(), source, ".")
    assert len(CachedCloudDataset(tmp_path / "here")) == 3


def test_a_target_below_a_file_is_a_cache_error(tmp_path, source, configure):
    (tmp_path / "file").write_text("x")
    with pytest.raises(CacheError, match="cannot"):
        build_dataset(configure(), source, tmp_path / "file" / "out")
    assert tree(tmp_path) == {"file": b"x"}


# -- what other tools see ------------------------------------------------------------------------------------------


def test_a_shard_of_an_hdf5_dataset_is_one_file_with_a_group_per_scene(tmp_path, source, configure):
    build_dataset(configure(), source, tmp_path / "out")
    assert sorted(os.listdir(tmp_path / "out")) == [
        "README.md", "croissant.json", "dataset.json", "index", "load.py", "pipeline.yaml", "shards", "texts.sha256",
    ]  # fmt: skip
    assert sorted(os.listdir(first_shard(tmp_path / "out"))) == ["clouds.h5", "files.tsv"]
    with h5py.File(first_shard(tmp_path / "out") / "clouds.h5", "r") as file:
        assert list(file) == source.ids
        frame = source.load(source.ids[0])
        group = file[source.ids[0]]
        assert np.array_equal(group["intrinsics"][()], frame.camera.intrinsics.numpy())
        assert np.array_equal(group["extrinsics"][()], frame.world_from_camera.numpy())
        assert group["points"].shape == group["colors"].shape == (64, 3)
        assert 0 <= group["colors"][()].min() <= group["colors"][()].max() <= 1


def test_the_manifest_is_readable_by_people_and_other_programs(tmp_path, source, configure):
    build_dataset(configure("output: {format: npz, compression: gzip}"), source, tmp_path / "out")
    content = json.loads((tmp_path / "out" / "dataset.json").read_text())
    assert (content["format"], content["compression"]) == ("npz", "gzip")
    assert content["num_samples"] == len(source.ids)
    index = {name: np.load(tmp_path / "out" / "index" / name) for name in content["index"]}
    assert bytes(index["ids.npy"]).decode() == "".join(source.ids)
    assert [*index["id_ends.npy"]] == [*np.cumsum([len(sample_id) for sample_id in source.ids])]
    assert index["digests.npy"].shape == (3, 32)
    for name, written in content["index"].items():
        content = (tmp_path / "out" / "index" / name).read_bytes()
        assert (len(content), hashlib.sha256(content).hexdigest()) == (written["bytes"], written["sha256"])


def test_the_stored_yaml_makes_the_same_pipeline(tmp_path, source, configure):
    from pcdata.transforms import Compose

    config = configure()
    build_dataset(config, source, tmp_path / "out")
    again = Compose.load(str(tmp_path / "out" / "pipeline.yaml"))
    assert again.sections() == config.pipeline.sections()
