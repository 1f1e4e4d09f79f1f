"""Datasets whose files are none, lead elsewhere or were changed: told when they are read."""

from __future__ import annotations

import json
import os
import shutil

import pytest

from pcdata import CachedCloudDataset, read_volume
from pcdata.errors import CacheError, ConfigError
from pcdata.exports.episodes import read_episodes
from pcdata.io.store.cloud_record import Record, record_from_cloud
from pcdata.io.store.manifest import FILE_NAME, Manifest
from pcdata.io.store.sample_index import Sample
from pcdata.io.store.stores import STORES
from tests.io.forged import cloud, dataset, first_shard, foreign_refused, stored, write_manifest

FORMATS = list(STORES)


# -- files that are none -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMATS)
def test_a_fifo_in_place_of_a_file_is_refused_at_once(tmp_path, form):
    path = dataset(tmp_path, form)
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(CacheError, match="FIFO"):
        CachedCloudDataset(tmp_path)[0]


@pytest.mark.parametrize("suffix", [".npz", ".npy", ".h5", ".hdf5", ".zarr", ".other"])
def test_a_fifo_or_device_in_place_of_a_foreign_file_is_refused_at_once(tmp_path, suffix):
    os.mkfifo(tmp_path / f"a{suffix}")
    assert "FIFO" in foreign_refused(tmp_path / f"a{suffix}", "")
    (tmp_path / f"zero{suffix}").symlink_to("/dev/zero")
    assert "device" in foreign_refused(tmp_path / f"zero{suffix}", "")


def test_other_files_that_are_fifos_are_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "v.npz")
    with pytest.raises(CacheError, match="FIFO"):
        read_volume(tmp_path / "v.npz")
    with pytest.raises(ConfigError, match="FIFO"):
        list(read_episodes("dp3", tmp_path, ["v.npz"]))
    os.mkfifo(tmp_path / FILE_NAME)
    with pytest.raises(CacheError):
        Manifest.read(tmp_path)


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("part", ["file", "folder", "shard", "shards", "table"])
def test_a_dataset_whose_files_are_links_to_elsewhere_is_refused(tmp_path, form, part):
    folder, other = tmp_path / "dataset", tmp_path / "elsewhere"
    folder.mkdir()
    path = dataset(folder, form)
    shard = first_shard(folder)
    parts = {"folder": path.parent, "shard": shard, "shards": shard.parent, "table": shard / "files.tsv"}
    moved = parts.get(part, path)
    shutil.move(moved, other)
    moved.symlink_to(other)
    with pytest.raises(CacheError, match=r"link out of the dataset's folder|leads out of"):
        CachedCloudDataset(folder)[0]


# -- what is stored beside the arrays ------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("old_name", ["normals", "points"])
def test_a_field_under_another_name_is_no_extra_that_nothing_rotates(tmp_path, form, old_name):
    record = record_from_cloud(cloud())
    arrays = {("extra." + name if name == old_name else name): array for name, array in record.arrays.items()}
    store = STORES[form](first_shard(tmp_path))
    store.write("a", Record(arrays, record.info))
    store.close()
    write_manifest(tmp_path, form, [Sample("a", "a", 64, record.digest())])
    with pytest.raises(CacheError, match="differs from what was written"):
        CachedCloudDataset(tmp_path)[0]


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize(
    "text", ['{"x": NaN}', '{"x": 1e999}', '{"x": "\\ud800"}', "[" * 99_999, '{"x":[' + "[]," * 99_999 + "1]}"]
)
def test_facts_that_json_cannot_hold_or_that_swell_are_typed_errors(tmp_path, form, text):
    class Forged(Record):
        def info_text(self) -> str:
            return text

    record = record_from_cloud(cloud())
    store = STORES[form](first_shard(tmp_path))
    store.write("a", Forged(record.arrays, {**record.info}))
    store.close()
    write_manifest(tmp_path, form, [Sample("a", "a", 64, record.digest())])
    with pytest.raises(CacheError):
        CachedCloudDataset(tmp_path)[0]


@pytest.mark.parametrize("form", FORMATS)
def test_a_number_of_points_that_differs_from_the_manifest_is_told(tmp_path, form):
    record = record_from_cloud(cloud())
    stored(first_shard(tmp_path), form)
    write_manifest(tmp_path, form, [Sample("a", "a", 65, record.digest())])
    with pytest.raises(CacheError, match="has 64 points, but"):
        CachedCloudDataset(tmp_path)[0]


def test_a_manifest_that_was_edited_is_told_when_the_dataset_is_opened(tmp_path):
    dataset(tmp_path, "npz")
    CachedCloudDataset(tmp_path)
    content = json.loads((tmp_path / FILE_NAME).read_text())
    content["versions"] = {"pcdata": "9"}
    (tmp_path / FILE_NAME).write_text(json.dumps(content))
    with pytest.raises(CacheError, match="was changed after it was written"):
        CachedCloudDataset(tmp_path)
