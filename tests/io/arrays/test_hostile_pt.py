""".pt files that want to run code or fill the memory: PyTorch never sees them."""

from __future__ import annotations

import pickle
import zipfile
import zlib
from pathlib import Path

import pytest

from pcdata.io.store.cloud_record import record_from_cloud
from pcdata.io.store.stores import STORES
from tests.io.forged import cloud, refused, stored, zip_of

# -- .pt -----------------------------------------------------------------------------------------------------------


def pt_members(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def write_pt(path: Path, members: dict[str, bytes]) -> None:
    zip_of(path, *[(name, content, 0, len(content), zlib.crc32(content)) for name, content in members.items()])


class Allocation:
    def __reduce__(self):
        return bytearray, (3 << 30,)


def test_a_pt_whose_members_are_written_anew_is_read(tmp_path):
    path = stored(tmp_path, "pt")
    write_pt(path, pt_members(path))
    assert STORES["pt"](tmp_path).read("a").digest() == record_from_cloud(cloud()).digest()


@pytest.mark.parametrize(
    "name", ["DATA.PKL", "data.PKL", "other.pkl", "constants.pkl", "code/x.py", "data/x", "data.pkl/x"]
)
@pytest.mark.parametrize("first", [False, True])
def test_a_second_pickle_or_any_other_member_is_refused(tmp_path, name, first):
    """torch finds its pickle without regard to case."""
    path = stored(tmp_path, "pt")
    members = pt_members(path)
    folder = next(iter(members)).split("/")[0]
    more = {f"{folder}/{name}": pickle.dumps(Allocation(), 2)}
    write_pt(path, {**more, **members} if first else {**members, **more})
    refused(tmp_path, "pt")


@pytest.mark.parametrize("name", ["x/data/0", "/data/0", "../data/0"])
def test_members_in_other_folders_are_refused(tmp_path, name):
    path = stored(tmp_path, "pt")
    write_pt(path, {**pt_members(path), name: b""})
    assert "one folder" in refused(tmp_path, "pt")


NESTED = b"\x80\x02)" + b"q\0h\0h\0\x86" * 40  # a tuple of itself twice, 40 times: 2**40 when it is shown

PROGRAMS = {
    "three gigabytes": pickle.dumps(Allocation(), 2),
    "two million lists": b"\x80\x02(" + b"]" * 2_000_000 + b"l.",
    "two million dictionaries": b"\x80\x02(" + b"}" * 2_000_000 + b"t.",
    "a huge memo": b"\x80\x02)r\xff\xff\xff\xff.",
    "a huge text": b"\x80\x02X\xff\xff\xff\xff.",
    "a huge frame": b"\x80\x04\x95\xff\xff\xff\xff\xff\xff\xff\x7f.",
    "a huge bytearray": b"\x80\x05\x96\xff\xff\xff\xff\xff\0\0\0.",
    "a huge number": b"\x80\x02\x8b\xff\xff\xff\x7f.",
    "a nested tuple as a name": NESTED + b"}" + b"h\0)s.",
    "a dictionary in itself": b"\x80\x02}q\0X\1\0\0\0ah\0s.",
    "a call": b"\x80\x02cos\nsystem\n(X\4\0\0\0echot\x85R.",
    "an instance": b"\x80\x02(ios\nsystem\n.",
    "an extension": b"\x80\x02\x82\1.",
    "a class with a state": b"\x80\x02ccollections\nOrderedDict\n)R}b.",
    "another protocol": b"\x80\x04}.",
    "text protocol": b"(dp0\n.",
    "nothing left": b"\x80\x02R.",
    "no mark": b"\x80\x02t.",
    "no end": b"\x80\x02}",
    "more after the end": b"\x80\x02}..",
    "nothing": b"",
}


@pytest.mark.parametrize("program", PROGRAMS)
def test_a_pickle_that_is_no_dictionary_of_tensors_is_refused_and_takes_no_memory(tmp_path, program):
    path = stored(tmp_path, "pt")
    members = {name: content for name, content in pt_members(path).items() if "/data/" not in name}
    (pickled,) = [name for name in members if name.endswith("/data.pkl")]
    write_pt(path, {**members, pickled: PROGRAMS[program]})
    refused(tmp_path, "pt")


def test_a_tensor_needs_the_bytes_that_it_claims(tmp_path):
    path = stored(tmp_path, "pt")
    members = pt_members(path)
    (pickled,) = [name for name in members if name.endswith("/data.pkl")]
    for old, new in (
        (b"K\xc0", b"K\xff"),
        (b"K\x40K\3", b"K\x41K\3"),
        (b"K\3K\1", b"K\0K\0"),
        (b"K\0K\x40", b"K\1K\x40"),
    ):
        assert old in members[pickled], old
        write_pt(path, {**members, pickled: members[pickled].replace(old, new, 1)})
        refused(tmp_path, "pt")


def test_a_pt_of_the_other_byte_order_is_refused(tmp_path):
    path = stored(tmp_path, "pt")
    members = pt_members(path)
    (order,) = [name for name in members if name.endswith("/byteorder")]
    write_pt(path, {**members, order: b"big"})
    assert "byte order" in refused(tmp_path, "pt")
