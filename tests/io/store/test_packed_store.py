"""The packed store: groups of columns, records read as one, and no forged index that leads out of the file."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import pickle
import struct
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import torch

from pcdata import PointCloud
from pcdata.errors import CacheError
from pcdata.io.store import packed_writer
from pcdata.io.store.cloud_record import Record, cloud_from_record, record_from_cloud
from pcdata.io.store.stores import STORES
from pcdata.io.store.text_table import TextTable
from tests.io.memory import memory_limit
from tests.io.store.test_stores import assert_same_cloud, full_cloud

END = struct.Struct("<QQ32s16s")


def write(folder: Path, clouds: list[PointCloud]) -> Path:
    with closing(STORES["packed"](folder)) as store:
        for number, cloud in enumerate(clouds):
            store.write(f"k{number}", record_from_cloud(cloud))
    return store.path


def joined(store, keys):
    reader = type(store).batch_reader()
    return reader.read(reader.places(store, TextTable.of(keys)))


def plain(count: int, seed: int = 0) -> PointCloud:
    draw = torch.Generator().manual_seed(seed)
    return PointCloud(points=torch.rand(count, 3, generator=draw), frame_id="base", meta=[{"sample_id": str(seed)}])


def forged(path: Path, edit) -> None:
    """Write the index again as ``edit`` leaves it, with a hash that fits."""
    content = path.read_bytes()
    begin, length, _, magic = END.unpack(content[-END.size :])
    place = len(content) - END.size - length
    index = json.loads(content[place : place + length])
    edit(index)
    text = json.dumps(index).encode()
    tail = content[begin:place] + text
    path.write_bytes(content[:begin] + tail + END.pack(begin, len(text), hashlib.sha256(tail).digest(), magic))


def refused(path: Path, key: str = "k0") -> str:
    with memory_limit(512 * 2**20), pytest.raises(CacheError) as caught:
        STORES["packed"](path.parent).read(key)
    assert str(path) in str(caught.value)
    assert len(str(caught.value)) < 2000
    return str(caught.value)


# -- records of many groups and forms ------------------------------------------------------------------------------


@pytest.mark.parametrize("group", [1, 3_000, 1 << 20])
def test_records_come_back_whichever_group_they_fall_in(tmp_path, monkeypatch, group):
    monkeypatch.setattr(packed_writer, "_GROUP", group)
    clouds = [full_cloud(0), plain(5, 1), plain(0, 2), full_cloud(3), plain(7, 4), plain(5, 5)]
    write(tmp_path, clouds)
    store = STORES["packed"](tmp_path)
    for number in (5, 0, 3, 2, 4, 1):
        assert_same_cloud(cloud_from_record(store.read(f"k{number}")), clouds[number])
        assert store.digest(f"k{number}") == record_from_cloud(clouds[number]).digest()


@pytest.mark.parametrize("group", [1, 1 << 20])
@pytest.mark.parametrize("which", [[0], [0, 1], [3, 0, 0, 2, 1], [2, 2]])
def test_records_read_as_one_are_the_batch_of_their_clouds(tmp_path, monkeypatch, group, which):
    monkeypatch.setattr(packed_writer, "_GROUP", group)
    clouds = [full_cloud(0), full_cloud(1), full_cloud(2)[0], full_cloud(3)[1:]]
    write(tmp_path, clouds)
    record = joined(STORES["packed"](tmp_path), [f"k{number}" for number in which])
    assert_same_cloud(cloud_from_record(record), PointCloud.cat([clouds[number] for number in which]))


def test_records_that_cannot_share_a_batch_are_not_read_as_one(tmp_path):
    other_frame = PointCloud(points=torch.zeros(2, 3), frame_id="camera")
    with_labels = PointCloud(points=torch.zeros(2, 3), frame_id="base", labels=torch.zeros(2, dtype=torch.int64))
    write(tmp_path, [plain(4), other_frame, with_labels, plain(3, 1)])
    store = STORES["packed"](tmp_path)
    assert joined(store, ["k0", "k3"]) is not None
    assert joined(store, ["k0", "k1"]) is None
    assert joined(store, ["k2", "k0"]) is None


@pytest.mark.parametrize(
    ("ptr", "told"),
    [([0, 3], "ends"), ([1, 4], "begins"), ([4], "cuts none"), ([0, 1, 4], "two clouds, one of which is told")],
    ids=str,
)
def test_records_whose_pointers_fit_their_neighbors_rows_alone_are_not_read_as_one(tmp_path, ptr, told):
    record = record_from_cloud(plain(4))
    with closing(STORES["packed"](tmp_path)) as store:
        store.write("k0", Record({**record.arrays, "ptr": np.array(ptr)}, record.info))
        store.write("k1", record)
    assert joined(store, ["k0", "k1"]) is None


def test_what_is_read_is_the_readers_own(tmp_path):
    write(tmp_path, [plain(4), plain(4, 1)])
    store = STORES["packed"](tmp_path)
    for _ in range(2):
        for read in (store.read("k0"), joined(store, ["k0", "k1"]), joined(store, ["k0"])):
            cloud = cloud_from_record(read)
            assert torch.equal(cloud.points[:4], plain(4).points)
            cloud.points.add_(1.0)


def test_the_writer_keeps_what_it_was_given_and_not_what_becomes_of_it(tmp_path):
    cloud, store = plain(4), STORES["packed"](tmp_path)
    store.write("k0", record_from_cloud(cloud))
    cloud.points.zero_()
    with pytest.raises(CacheError, match="close the store"):
        store.read("k0")
    store.close()
    assert torch.equal(cloud_from_record(store.read("k0")).points, plain(4).points)


def test_a_key_is_written_once_and_a_file_too(tmp_path):
    store = STORES["packed"](tmp_path)
    store.write("k0", record_from_cloud(plain(4)))
    with pytest.raises(CacheError, match=r"clouds.packed: has a record 'k0' already"):
        store.write("k0", record_from_cloud(plain(4)))
    with pytest.raises(CacheError, match="cannot be written"):
        STORES["packed"](tmp_path).write("k1", record_from_cloud(plain(4)))


def test_a_file_that_was_never_closed_is_told(tmp_path):
    STORES["packed"](tmp_path).write("k0", record_from_cloud(plain(4)))
    assert "bytes do not begin" in refused(tmp_path / "clouds.packed")


# -- processes -----------------------------------------------------------------------------------------------------


def _read(store, key: str) -> torch.Tensor:
    return cloud_from_record(store.read(key)).points


def test_a_forked_child_reads_what_its_parent_has_mapped(tmp_path):
    write(tmp_path, [plain(4), plain(5, 1)])
    store = STORES["packed"](tmp_path)
    store.read("k0")
    with multiprocessing.get_context("fork").Pool(1) as pool:
        assert torch.equal(pool.apply(_read, (store, "k1")), plain(5, 1).points)
    assert torch.equal(_read(pickle.loads(pickle.dumps(store)), "k1"), plain(5, 1).points)


# -- hostile -------------------------------------------------------------------------------------------------------


def _set(place: str, value):
    def edit(index) -> None:
        where = index["groups"][0]
        *path, last = place.split(".")
        for name in path:
            where = where[int(name) if name.isdigit() else name]
        where[int(last) if last.isdigit() else last] = value

    return edit


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ("columns.0.begin", 1 << 40),
        ("columns.0.begin", -64),
        ("columns.0.begin", 65),
        ("columns.0.begin", True),
        ("columns.1.begin", 64),
        ("columns.0.row", [1 << 40]),
        ("columns.0.row", [-3]),
        ("columns.0.row", [1.5]),
        ("columns.0.row", [1] * 64),
        ("columns.0.row", None),
        ("columns.0.row", "3"),
        ("columns.0.dtype", "|O"),
        ("columns.0.dtype", "<U9"),
        ("columns.0.dtype", "<c8"),
        ("columns.0.dtype", ["<f4"]),
        ("columns.0.rows", {"each": 1 << 60}),
        ("columns.0.rows", {"table": 7}),
        ("columns.0.rows", {"each": 1, "table": 0}),
        ("columns.0.rows", 5),
        ("columns.0.name", "ptr"),
        ("columns.0.name", 5),
        ("columns.0", 5),
        ("columns", {}),
        ("keys", [0, 5]),
        ("keys", [1 << 50, 5]),
        ("keys", 5),
        ("tables.0", [0, 24]),
        ("tables.0", None),
        ("tables", []),
        ("records", 0),
        ("records", 1),
        ("records", 1 << 60),
        ("records", "2"),
    ],
    ids=str,
)
def test_an_index_that_claims_what_cannot_be_is_refused_before_anything_is_read(tmp_path, place, value):
    path = write(tmp_path, [plain(4), plain(5, 1)])
    forged(path, lambda index: None)
    STORES["packed"](tmp_path).read("k0")  # forging alone is not what is refused
    forged(path, _set(place, value))
    refused(path)


@pytest.mark.parametrize("index", [{}, {"groups": []}, {"schema": "pcdata.packed/2"}, {"groups": 5}, {"groups": [5]}])
def test_an_index_of_another_form_is_refused(tmp_path, index):
    path = write(tmp_path, [plain(4)])

    def replace(found) -> None:
        schema = found["schema"]
        found.clear()
        found.update({"schema": schema, **index})

    forged(path, replace)
    refused(path)


def test_row_pointers_that_fall_are_refused(tmp_path):
    path = write(tmp_path, [plain(4), plain(5, 1), plain(6, 2)])
    content = path.read_bytes()
    pointers = np.array([0, 4, 9, 15], "<i8").tobytes()
    path.write_bytes(content.replace(pointers, np.array([0, 9, 4, 15], "<i8").tobytes()))
    assert "not what was written" in refused(path)
    forged(path, lambda index: None)
    assert "never fall" in refused(path)


def test_the_end_of_another_file_does_not_fit(tmp_path):
    path = write(tmp_path / "a", [plain(4), plain(5, 1)])
    other = write(tmp_path / "b", [plain(4, 2), plain(5, 3), plain(6, 4)])
    content, foreign = path.read_bytes(), other.read_bytes()
    path.write_bytes(content[: -END.size] + foreign[-END.size :])
    refused(path)
    path.write_bytes(content + content)
    refused(path)
    path.write_bytes(content + b"\0")
    assert "appended" in refused(path)


def test_one_key_of_two_records_is_refused(tmp_path):
    path = write(tmp_path, [plain(4), plain(5, 1)])
    content = path.read_bytes()
    path.write_bytes(content.replace(b"k0\nk1", b"k0\nk0"))
    forged(path, lambda index: None)
    assert "one key" in refused(path)
