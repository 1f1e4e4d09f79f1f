"""The index of a dataset and the tables of its shards: arrays that lie, however well their hashes fit, are refused."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from pcdata import CachedCloudDataset
from pcdata.build import verify_dataset
from pcdata.build.written_texts import write_new_texts
from pcdata.errors import CacheError
from pcdata.io.store.manifest import FILE_NAME, Manifest, checksum_of
from pcdata.io.store.sample_index import Sample, SampleIndex
from pcdata.io.store.sample_keys import key_of
from pcdata.io.store.shards import TABLE, seal_shard, shard_folder, shard_size_of
from tests.io.forged import dataset, first_shard
from tests.io.memory import memory_limit

IDS = ["a", "bü", "ccc", "d", "e"]


def fit_again(folder: Path, **changes) -> None:
    """Let what ``dataset.json`` says of the index, and of itself, fit what is there."""
    content = json.loads((folder / FILE_NAME).read_text()) | changes
    for name in content["index"]:
        raw = (folder / "index" / name).read_bytes()
        content["index"][name] = {"bytes": len(raw), "sha256": hashlib.sha256(raw).hexdigest()}
    del content["checksum"]
    (folder / FILE_NAME).write_text(json.dumps({**content, "checksum": checksum_of(content)}))


@pytest.fixture
def folder(tmp_path) -> Path:
    """A manifest of five samples in three shards."""
    for shard in range(3):
        seal_shard(shard_folder(tmp_path, shard))
    samples = [Sample(name, key_of(name), number, f"{number:064x}", number // 2) for number, name in enumerate(IDS)]
    Manifest("npz", "none", "f" * 64, {"depth": [], "cloud": [], "augment": []}, samples).write(tmp_path)
    return tmp_path


def text(*ids: str) -> dict[str, np.ndarray]:
    raw = [one.encode("utf-8", "surrogatepass") for one in ids]
    return {"ids": np.frombuffer(b"".join(raw), np.uint8), "id_ends": np.cumsum([len(one) for one in raw])}


ENDS = np.array([1, 4, 7, 8, 9])
LIES = {
    "ends that fall": ({"id_ends": ENDS[[0, 2, 1, 3, 4]]}, "do not rise"),
    "an empty id": ({"id_ends": ENDS[[0, 0, 2, 3, 4]]}, "do not rise"),
    "ends before the first byte": ({"id_ends": ENDS - 9}, "do not rise"),
    "ends beyond the bytes": ({"id_ends": ENDS + 1}, "do not rise"),
    "an end that wraps": ({"id_ends": np.array([1, 4, 2**63 - 1, -(2**63) + 8, 9])}, "do not rise"),
    "bytes that belong to none": ({"id_ends": ENDS - np.array([0, 0, 0, 0, 1])}, "do not rise"),
    "more bytes": ({"ids": np.zeros(99, np.uint8)}, "do not fill"),
    "an id cut inside a letter": ({"id_ends": ENDS - np.array([0, 1, 0, 0, 0])}, "cut inside a letter"),
    "an id that is no UTF-8": ({"ids": np.frombuffer(b"a\xffbcccded"[:9], np.uint8)}, "no text"),
    "an id of two lines": (text("a", "b\nü"[:3], "ccc", "d", "e"), "one line"),
    "an id of two lines, beyond ASCII": (text("a", "b\u2028", "ccc", "d", "e"), "one line"),
    "two that are the same": (text("a", "bü", "ccc", "a", "e"), "two samples have the id 'a'"),
    "one that is too long": (text("a" * 70_000, "bü", "ccc", "d", "e"), "too long"),
    "shards that fall": ({"shards": np.array([0, 1, 0, 1, 2], "<i4")}, "order of their shards"),
    "a negative shard": ({"shards": np.array([-1, 0, 0, 1, 2], "<i4")}, "order of their shards"),
    "a shard that is not there": ({"shards": np.array([0, 0, 1, 1, 3], "<i4")}, "lies in shard 3, but there are 3"),
    "a shard that wraps": ({"shards": np.array([-(2**31), 0, 1, 1, 2**31 - 1], "<i4")}, "order of their shards"),
    "a negative count": ({"num_points": np.array([0, 1, -1, 3, 4])}, "num_points must be from 0"),
    "a count beyond all memory": ({"num_points": np.array([0, 1, 2**62, 3, 4])}, "num_points must be from 0"),
    "fewer counts": ({"num_points": np.arange(4)}, "different numbers of samples"),
    "fewer digests": ({"digests": np.zeros((4, 32), np.uint8)}, "different numbers of samples"),
    "short digests": ({"digests": np.zeros((5, 16), np.uint8)}, r"must be \|u1 \(S, 32\)"),
    "digests by columns": ({"digests": np.asfortranarray(np.ones((5, 32), np.uint8))}, r"must be \|u1"),
    "floats": ({"num_points": np.arange(5.0)}, "must be <i8"),
    "other bytes first": ({"num_points": np.arange(5).astype(">i8")}, "must be <i8"),
    "more axes": ({"num_points": np.zeros((5, 1), np.int64)}, "must be <i8"),
    "a scalar": ({"num_points": np.array(5)}, "must be <i8"),
    "objects": ({"num_points": np.array([{}] * 5, object)}, "never unpickled"),
    "no shards": ({"shard_tables": np.zeros((0, 32), np.uint8)}, "it has no shards"),
    "no samples": (
        {
            **{name: np.zeros(0, "<i8") for name in ("id_ends", "num_points")},
            **{"shards": np.zeros(0, "<i4"), "ids": np.zeros(0, np.uint8), "digests": np.zeros((0, 32), np.uint8)},
        },
        "no samples",
    ),
}


@pytest.mark.parametrize("case", LIES)
def test_an_index_that_lies_is_refused_though_its_hashes_fit(folder, case):
    arrays, what = LIES[case]
    for name, array in arrays.items():
        np.save(folder / "index" / f"{name}.npy", array, allow_pickle=True)
    fit_again(folder)
    with memory_limit(256 * 2**20), pytest.raises(CacheError, match=what) as caught:
        Manifest.read(folder)
    assert str(folder / FILE_NAME) in str(caught.value)


def test_a_header_that_claims_more_than_the_file_holds_takes_no_memory(folder):
    path = folder / "index" / "num_points.npy"
    path.write_bytes(path.read_bytes().replace(b"(5,)", b"(1000000000000,)").replace(b" " * 12 + b"\n", b"\n"))
    fit_again(folder)
    with memory_limit(256 * 2**20), pytest.raises(CacheError, match="claims shape"):
        Manifest.read(folder)


@pytest.mark.parametrize("name", ["ids.npy", "id_ends.npy", "num_points.npy", "digests.npy", "shards.npy"])
@pytest.mark.parametrize("how", ["flipped", "cut", "longer", "missing", "a link", "a folder"])
def test_an_index_that_is_not_what_was_written_is_refused_and_its_file_named(folder, name, how):
    path = folder / "index" / name
    content = bytearray(path.read_bytes())
    path.unlink()
    if how == "flipped":
        content[-1] ^= 1
        path.write_bytes(content)
    elif how in ("cut", "longer"):
        path.write_bytes(content[:-1] if how == "cut" else content + b"\0")
    elif how == "a link":
        (folder.parent / f"{folder.name}-outside").write_bytes(content)
        path.symlink_to(folder.parent / f"{folder.name}-outside")
    elif how == "a folder":
        path.mkdir()
    with pytest.raises(CacheError) as caught:
        Manifest.read(folder)
    assert name in str(caught.value)
    assert caught.value.path == str(path)


def test_ids_whose_hashes_agree_are_told_apart():
    ids = ["a", "a\0", "a\0\0", "b"]  # a zero adds nothing to the hash
    index = SampleIndex(ids, [1] * 4, ["0" * 64] * 4, [0] * 4)
    assert [index.ids.place_of(name) for name in [*ids, "a\0\0\0"]] == [0, 1, 2, 3, None]
    with pytest.raises(CacheError, match="two samples have the id"):
        SampleIndex([*ids, "a\0"], [1] * 5, ["0" * 64] * 5, [0] * 5)


def test_many_ids_of_all_lengths_are_found_and_come_in_order():
    ids = [f"{'é' * (number % 97)}{number}" for number in range(5000)]  # several parts of what is looked at together
    index = SampleIndex(ids, range(5000), ["0" * 64] * 5000, np.arange(5000) // 32)
    assert index.ids == ids
    assert [index.ids.index(ids[number]) for number in range(0, 5000, 499)] == [*range(0, 5000, 499)]
    assert index.ids[4999] == index.ids[-1] == ids[-1]
    assert index.ids[10:14] == ids[10:14]
    assert "nobody" not in index.ids
    with pytest.raises(ValueError, match="no sample has the id"):
        index.ids.index("nobody")
    with pytest.raises(IndexError):
        index[5000]


def test_shards_are_a_thousand_at_most_and_never_tiny():
    assert [shard_size_of(count) for count in (1, 32_000, 32_001, 10_000_000)] == [32, 32, 33, 10_000]
    assert shard_size_of(10, 3) == 3


# -- tables of shards ----------------------------------------------------------------------------------------------

ZEROS = "0" * 64


@pytest.mark.parametrize(
    "line",
    [
        f"{ZEROS}\t5\t../../secret",
        f"{ZEROS}\t5\t/etc/passwd",
        f"{ZEROS}\t5\tclouds/../../../x",
        f"{ZEROS}\t5\t",
        f"{ZEROS}\t-5\tx",
        f"{ZEROS}\t{10**30}\tx",
        f"{ZEROS}\t5\tx\n{ZEROS}\t5\tx",
        f"{ZEROS}\t5\ta//b",
        f"{ZEROS}\t5\ta\0b",
        "nothing of the kind",
    ],
)
def test_a_table_that_leads_out_of_its_shard_or_is_none_is_refused_though_its_hash_fits(tmp_path, line):
    dataset(tmp_path, "packed")
    write_new_texts(tmp_path, {"load.py": ""})
    table = first_shard(tmp_path) / TABLE
    table.write_text(line + "\n")
    tables = np.frombuffer(hashlib.sha256(table.read_bytes()).digest(), np.uint8)[None]
    np.save(tmp_path / "index" / "shard_tables.npy", tables)
    fit_again(tmp_path)
    with pytest.raises(CacheError, match="tells of no file of the shard"):
        CachedCloudDataset(tmp_path)[0]
    assert [(fault.path, fault.kind) for fault in verify_dataset(tmp_path).faults] == [
        ("shards/00000/files.tsv", "damaged")
    ]


def test_hashes_of_files_elsewhere_are_not_looked_up(tmp_path):
    dataset(tmp_path, "npz")
    write_new_texts(tmp_path, {"load.py": ""})
    told = {"../../etc/passwd": {"bytes": 1, "sha256": ZEROS}}
    fit_again(tmp_path, signals_files=told, signals={"digest": ZEROS})
    assert [fault.path for fault in verify_dataset(tmp_path).faults] == ["signals"]


@pytest.mark.parametrize("form", ["hdf5", "packed"])
def test_a_file_of_another_size_is_refused_before_it_is_opened(tmp_path, form):
    path = dataset(tmp_path, form)
    with open(path, "ab") as file:
        file.write(b"more")
    with pytest.raises(CacheError, match=r"bytes, but .* were written") as caught:
        CachedCloudDataset(tmp_path)[0]
    assert caught.value.path == str(path)


def test_a_shard_that_is_gone_is_told_when_it_is_read_not_before(tmp_path):
    dataset(tmp_path, "packed")
    data = CachedCloudDataset(tmp_path)
    shutil.rmtree(first_shard(tmp_path))
    assert CachedCloudDataset(tmp_path).ids == ["a"]
    with pytest.raises(CacheError, match="the file is missing"):
        data[0]


class _Mark:
    """Leaves a file behind where it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = str(path)

    def __reduce__(self) -> tuple:
        return open, (self.path, "w")


@pytest.mark.parametrize("form", ["npz", "pt"])
def test_nothing_of_a_dataset_is_unpickled(tmp_path, form):
    path, mark = dataset(tmp_path, form), _Mark(tmp_path / "mark")
    if form == "pt":
        torch.save({"points": mark, "pcdata": "{}"}, path)
    else:
        np.savez(path, points=np.array([mark], object), pcdata=np.array("{}"))
    for seal in (True, False):
        if seal:
            (first_shard(tmp_path) / TABLE).unlink()
            sealed = seal_shard(first_shard(tmp_path))
            np.save(tmp_path / "index" / "shard_tables.npy", np.frombuffer(bytes.fromhex(sealed), np.uint8)[None])
            fit_again(tmp_path)
        else:
            np.save(tmp_path / "index" / "num_points.npy", np.array([mark], object), allow_pickle=True)
            fit_again(tmp_path)
        with pytest.raises(CacheError):
            CachedCloudDataset(tmp_path)[0]
        assert verify_dataset(tmp_path).faults or seal
    assert not (tmp_path / "mark").exists()
