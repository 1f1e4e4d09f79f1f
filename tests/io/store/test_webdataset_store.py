"""Tar shards: WebDataset reads them as they are, samples are read without the others, and hostile ones are refused."""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import torch

from pcdata import PointCloud
from pcdata.errors import CacheError
from pcdata.files import tar_members
from pcdata.files.tar_members import BLOCK, END, member_head, padded, read_members
from pcdata.io.store import tar_shard
from pcdata.io.store.cloud_record import cloud_from_record, record_from_cloud
from pcdata.io.store.stores import STORES
from pcdata.io.store.tar_shard import TarShard, TarWriter
from pcdata.io.store.text_table import TextTable
from tests.io.store.test_stores import assert_same_cloud, full_cloud, refused

KEYS = ("scene.7", "b", "%2Ehidden", "long" * 40)


def written(folder: Path) -> Path:
    with closing(STORES["webdataset"](folder)) as store:
        for number, key in enumerate(KEYS):
            store.write(key, record_from_cloud(full_cloud(number)))
    return store.path_of("")


def member(name: str, content: bytes) -> bytes:
    return member_head(name, len(content)) + content + bytes(-len(content) % BLOCK)


# -- what other readers see ----------------------------------------------------------------------------------------


def test_tarfile_reads_a_shard_with_the_samples_in_their_order_and_nothing_of_the_machine(tmp_path):
    path = written(tmp_path)
    with tarfile.open(path) as tar:
        members = tar.getmembers()
        assert {(one.mtime, one.uid, one.gid, one.uname, one.mode, one.type) for one in members} == {
            (0, 0, 0, "", 0o644, tarfile.REGTYPE)
        }
        assert members[-1].name == "__index__"
        keys = [name.split(".")[0] for name in tar.getnames()]
        assert [*dict.fromkeys(keys)] == ["scene%2E7", "b", "%2Ehidden", "long" * 40, "__index__"]
        info = json.load(tar.extractfile("scene%2E7.json"))
        assert (info["frame_id"], info["unit"]) == ("robot/base", "normalized")
        points = np.load(io.BytesIO(tar.extractfile("b.points.npy").read()))
        assert np.array_equal(points, full_cloud(1).points.numpy())


@pytest.mark.filterwarnings("ignore")  # it leaves its files to the garbage collector
def test_webdataset_itself_decodes_a_shard(tmp_path):
    webdataset = pytest.importorskip("webdataset", reason="pip install webdataset")
    path = written(tmp_path)
    samples = list(webdataset.WebDataset(str(path), shardshuffle=False).decode())
    assert [one["__key__"] for one in samples] == ["scene%2E7", "b", "%2Ehidden", "long" * 40]
    for number, sample in enumerate(samples):
        cloud = full_cloud(number)
        assert np.array_equal(sample["points.npy"], cloud.points.numpy())
        assert sample["labels.npy"].dtype == np.int32
        assert sample["json"]["frame_id"] == "robot/base"
        assert sample["history.json"] == [list(steps) for steps in cloud.history]
        assert np.array_equal(sample["extra.feature.npy"], cloud.extra["feature"].numpy())


def test_names_that_differ_by_case_alone_stay_apart_for_readers_that_ignore_it(tmp_path):
    extra = {"Flow": torch.rand(2, 3), "flow": torch.rand(2, 3)}
    cloud = PointCloud(points=torch.rand(2, 3), frame_id="base", extra=extra, kinds=dict.fromkeys(extra, "invariant"))
    with closing(STORES["webdataset"](tmp_path)) as store:
        store.write("a", record_from_cloud(cloud))
    with tarfile.open(store.path_of("a")) as tar:
        assert len({name.casefold() for name in tar.getnames()}) == len(tar.getnames())
    assert_same_cloud(cloud_from_record(STORES["webdataset"](tmp_path).read("a")), cloud)


# -- reading -------------------------------------------------------------------------------------------------------


def test_samples_are_read_in_any_order_and_together(tmp_path):
    written(tmp_path)
    store = STORES["webdataset"](tmp_path)
    for number in (2, 0, 3, 1):
        assert_same_cloud(cloud_from_record(store.read(KEYS[number])), full_cloud(number))
    reader = store.batch_reader()
    joined = reader.read(reader.places(store, TextTable.of([KEYS[2], KEYS[0]])))
    assert_same_cloud(cloud_from_record(joined), PointCloud.cat([full_cloud(2), full_cloud(0)]))


def test_an_archive_of_a_server_is_read_ahead_with_few_requests(tmp_path, monkeypatch):
    content = written(tmp_path).read_bytes()
    asked: list[tuple[int, int]] = []

    def ranges(begin: int, end: int) -> bytes:
        asked.append((begin, end))
        return content[begin:end]

    monkeypatch.setattr(tar_shard, "_AT_END", 4096)
    shard = TarShard(len(content), ranges, None, is_mapped=False)
    assert len(asked) == 1
    shard.hold(KEYS[:3])
    assert len(asked) == 2
    assert bytes(shard.sample("b")) == content[asked[1][0] :][len(shard.sample(KEYS[0])) :][: len(shard.sample("b"))]
    assert len(asked) == 2
    shard.let_go(KEYS[:3])
    shard.sample("b")
    assert len(asked) == 3
    monkeypatch.setattr(tar_shard, "_AT_END", BLOCK * 3)
    assert len(TarShard(len(content), ranges, None).sample("b")) == len(shard.sample("b"))


def test_bytes_that_change_on_their_way_are_told(tmp_path):
    content = bytearray(written(tmp_path).read_bytes())
    shard = TarShard(len(content), lambda begin, end: bytes(content[begin:end]), None, is_mapped=False)
    content[BLOCK * 3] ^= 1
    with pytest.raises(CacheError, match="bytes 0 to"):
        shard.hold(KEYS)


# -- hostile archives ----------------------------------------------------------------------------------------------


def forged(folder: Path, key: str, members: bytes) -> Path:
    """An archive whose index is right, around members that nobody checks."""
    writer = TarWriter(folder / "clouds.tar")
    writer.add("first", [("first.json", b"{}")])
    begin = writer._ends[-1]
    writer.add(key, [("x", bytes(len(members) - BLOCK))])
    writer.finish()
    content = bytearray((folder / "clouds.tar").read_bytes())
    content[begin : begin + len(members)] = members
    (folder / "clouds.tar").write_bytes(content)
    return folder / "clouds.tar"


def python_tar(name: str, kind: bytes = tarfile.REGTYPE, content: bytes = b"", **fields) -> bytes:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w", format=tarfile.PAX_FORMAT) as tar:
        info = tarfile.TarInfo(name)
        info.type, info.size = kind, len(content)
        for field, value in fields.items():
            setattr(info, field, value)
        tar.addfile(info, io.BytesIO(content))
    return stream.getvalue()[: -(-len(content) // BLOCK) * BLOCK + BLOCK]


def without_check(name: bytes, content: bytes) -> bytes:
    return tar_members._header(name, len(content), b"0") + content + bytes(-len(content) % BLOCK)


ARRAY = (
    np.lib.format.magic(1, 0) + b"v\0{'descr': '<f4', 'fortran_order': False, 'shape': (4,), }".ljust(120) + bytes(16)
)
HOSTILE: dict[str, tuple[Callable[[], bytes], str]] = {
    "a name that climbs": (lambda: without_check(b"../a.json", b"{}"), "leads elsewhere"),
    "an absolute name": (lambda: without_check(b"/etc/passwd", b"{}"), "leads elsewhere"),
    "a name in a folder": (lambda: without_check(b"x/a.json", b"{}"), "leads elsewhere"),
    "a symbolic link": (lambda: python_tar("a.json", tarfile.SYMTYPE, linkname="/etc/passwd"), "a link"),
    "a hard link": (lambda: python_tar("a.json", tarfile.LNKTYPE, linkname="first.json"), "a link"),
    "a device": (lambda: python_tar("a.json", tarfile.CHRTYPE, devmajor=1, devminor=5), "a device"),
    "a FIFO": (lambda: python_tar("a.json", tarfile.FIFOTYPE), "a FIFO"),
    "a folder": (lambda: python_tar("a.json", tarfile.DIRTYPE), "a folder"),
    "a sparse file": (lambda: python_tar("a.json", b"S"), "a sparse file"),
    "a global header": (lambda: python_tar("a.json", b"g"), "a header for other members"),
    "an owner": (lambda: python_tar("a.json", content=b"{}", uid=7), "damaged, or written by other means"),
    "a time": (lambda: python_tar("a.json", content=b"{}", mtime=7), "damaged, or written by other means"),
    "rights": (lambda: python_tar("a.json", content=b"{}", mode=0o4755), "damaged, or written by other means"),
    "a size beyond the end": (lambda: tar_members._header(b"a.json", 10**9, b"0"), "ends before"),
    "a size of eight gigabytes": (lambda: tar_members._header(b"a.json", 8**11 - 1, b"0"), "ends before"),
    "two of one name": (lambda: 2 * member("a.json", b"{}"), "comes twice"),
    "two of one array": (lambda: member("a.%78.npy", ARRAY) + member("a.x.npy", ARRAY), "has already"),
    "members of another sample": (lambda: member("b.json", b"{}"), "in the place of one of 'a'"),
    "no facts": (lambda: member("a.points.npy", ARRAY), "has no member 'a.json'"),
    "something else": (lambda: member("a.json", b"{}") + member("a.pickle", b"x"), "no array of a record"),
    "something behind a member": (lambda: member("a.json", b"{}")[:-1] + b"x", "behind its end"),
    "an array that claims more": (lambda: member("a.json", b"{}") + member("a.x.npy", ARRAY[:-4]), "claims shape"),
    "facts that are no JSON": (lambda: member("a.json", b"{"), "JSON"),
    "a history twice": (lambda: member("a.history.json", b"[]") + member("a.json", b'{"history": []}'), "its history"),
    "a long name of no member": (lambda: member_head("a" * 200, 0)[: 2 * BLOCK], "belongs to no member"),
    "a long name that lies": (
        lambda: member_head("a" * 200, 0)[: 2 * BLOCK] + tar_members._header(b"b" * 100, 0, b"0"),
        "long name of another",
    ),
    "a header with more than a name": (
        lambda: tar_members._header(b"@PaxHeader", 15, b"x") + b"15 size=999999\n".ljust(BLOCK, b"\0"),
        "says something else",
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", HOSTILE)
def test_a_hostile_sample_is_refused_and_the_others_are_read(tmp_path, what):
    make, words = HOSTILE[what]
    path = forged(tmp_path, "a", make())
    message = refused(tmp_path, "webdataset", path)
    assert words in message
    assert list(tmp_path.iterdir()) == [path]
    assert bytes(STORES["webdataset"](tmp_path).opened().sample("first"))[:10] == b"first.json"


def test_a_sample_of_a_tar_that_climbs_under_a_long_name_is_refused(tmp_path):
    name = b"../" * 50 + b"a.json"
    record = tar_members._pax_record(name)
    head = tar_members._header(b"@PaxHeader", len(record), b"x") + record.ljust(padded(len(record)), b"\0")
    assert "leads elsewhere" in refused(
        tmp_path, "webdataset", forged(tmp_path, "a", head + without_check(name[:100], b"{}"))
    )


def index_of(keys: bytes, ends: list[int], count: int | None = None, length: int | None = None) -> bytes:
    """The last members of an archive, with a hash that fits, whatever they say."""
    content = keys + bytes(-len(keys) % 8) + np.array(ends, "<i8").tobytes() + bytes(4 * len(ends))
    content += bytes(-(len(content) + 64) % BLOCK)
    told = len(ends) if count is None else count, len(keys) if length is None else length
    trailer = tar_shard._TRAILER.pack(*told, tar_shard.hashlib.sha256(content).digest(), tar_shard._MAGIC)
    return member("__index__", content + trailer) + END


@pytest.mark.parametrize(
    ("index", "words"),
    [
        (index_of(b"a\na", [1024, 2048]), "one key"),
        (index_of(b"a\n", [1024, 2048]), "one key, or one has none"),
        (index_of(b"a\nb", [1024, 4096]), "cannot"),
        (index_of(b"a\nb", [2048, 2048]), "cannot"),
        (index_of(b"a\nb", [3072, 2048]), "cannot"),
        (index_of(b"a\nb", [-512, 2048]), "cannot"),
        (index_of(b"a\nb", [1000, 2048]), "no member can"),
        (index_of(b"a", [1024, 2048]), "cannot"),
        (index_of(b"a\nb", [1024, 2048], count=2**40), "cannot be"),
        (index_of(b"a\nb", [1024, 2048], length=2**62), "cannot be"),
        (index_of(b"\xff\xff\xff", [1024, 2048]), "cannot be read"),
        (index_of(b"a\nb", [1024, 2048]) + bytes(512), "does not end"),
        (b"x" + index_of(b"a\nb", [1024, 2048])[1:], "no member"),
    ],
)
def test_an_index_that_lies_is_refused(tmp_path, index, words):
    samples = member("a.json", b"{}") + member("b.json", b"{}")
    assert len(samples) == 2048
    (tmp_path / "clouds.tar").write_bytes(samples + index)
    assert words in refused(tmp_path, "webdataset", tmp_path / "clouds.tar")


@pytest.mark.parametrize("name", ["", "a/b", "..", ".hidden", "a b", "a\nb", "é", "a" * 5000])
def test_a_name_that_leads_elsewhere_is_not_written(name):
    with pytest.raises(CacheError, match="name"):
        member_head(name, 1)


@pytest.mark.parametrize("length", [1, 85, 99, 100, 101, 110, 255, 900, 990])
def test_names_of_any_length_come_back(length):
    content = member("n" * length, b"abc")
    assert [(name, bytes(one)) for name, one in read_members(memoryview(content))] == [("n" * length, b"abc")]
    with tarfile.open(fileobj=io.BytesIO(content + END)) as tar:
        assert tar.getnames() == ["n" * length]


def test_a_member_that_tar_cannot_hold_is_refused():
    with pytest.raises(CacheError, match="at most"):
        member_head("a", 8**11)
