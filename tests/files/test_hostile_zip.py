"""Zip archives and .npy headers that claim what cannot be: told before anything is unpacked."""

from __future__ import annotations

import bz2
import io
import lzma
import struct
import zipfile
import zlib

import h5py
import numpy as np
import pytest

from pcdata.errors import CacheError
from pcdata.files.npz import write_npz
from pcdata.files.zip_archive import ZipArchive
from tests.io.forged import foreign, foreign_refused, npy, raw_deflate, refused, zip_of

# -- zip archives --------------------------------------------------------------------------------------------------


POINTS = npy(np.arange(12, dtype="<f4").reshape(4, 3))


def test_the_forged_archives_of_these_tests_are_ones_that_numpy_reads(tmp_path):
    crc = zlib.crc32(POINTS)
    path = zip_of(tmp_path / "a.npz", ("pc.npy", raw_deflate(POINTS), 8, len(POINTS), crc))
    assert np.array_equal(foreign(path), np.load(path)["pc"])


@pytest.mark.parametrize(
    ("method", "pack"), [(12, bz2.compress), (14, lzma.compress), (93, bytes), (9, bytes), (6, bytes)]
)
def test_members_packed_by_what_unpacks_without_a_bound_are_refused_unread(tmp_path, method, pack):
    zip_of(tmp_path / "clouds" / "a.npz", ("points.npy", pack(bytes(1 << 20)), method, 10_000, 0))
    assert f"method {method}" in refused(tmp_path, "npz")
    assert f"method {method}" in foreign_refused(zip_of(tmp_path / "a.npz", ("pc.npy", b"", method, 10_000, 0)))


def test_a_member_that_unpacks_to_more_than_it_claims_is_stopped(tmp_path):
    path = zip_of(tmp_path / "a.npz", ("pc.npy", raw_deflate(bytes(1 << 28)), 8, 10_000, 0))
    assert "unpacks to more" in foreign_refused(path)


@pytest.mark.parametrize("change", ["crc", "short", "after", "size", "name", "overlap", "cut", "more", "flags"])
def test_damage_that_the_structure_of_a_zip_tells_is_told(tmp_path, change):
    crc, deflated = zlib.crc32(POINTS), raw_deflate(POINTS)
    good = ("pc.npy", deflated, 8, len(POINTS), crc)
    path = zip_of(tmp_path / "a.npz", good, ("more.npy", POINTS, 0, len(POINTS), crc))
    content = bytearray(path.read_bytes())
    list_start = content.index(b"PK\1\2")
    if change == "crc":
        zip_of(path, ("pc.npy", deflated, 8, len(POINTS), crc ^ 1))
    elif change == "short":
        zip_of(path, ("pc.npy", raw_deflate(POINTS[:-4]), 8, len(POINTS), crc))
    elif change == "after":
        zip_of(path, ("pc.npy", deflated + b"hidden", 8, len(POINTS), crc))
    elif change == "size":
        zip_of(path, ("pc.npy", POINTS, 0, len(POINTS) - 4, crc))
    else:
        if change == "name":
            content[30] ^= 1
        elif change == "overlap":  # the second member is the first one's bytes once more
            second = content.index(b"PK\1\2", list_start + 4)
            content[second + 42 : second + 46] = bytes(4)
        elif change == "cut":
            content = content[:-1]
        elif change == "more":
            content += b"\0"
        elif change == "flags":
            content[list_start + 8] |= 1  # encrypted
        path.write_bytes(content)
    foreign_refused(path)


@pytest.mark.parametrize("names", [("pc.npy", "PC.npy"), ("pc.npy", "pc.npy"), ("pc", "pc.npy")])
def test_two_members_of_one_name_are_refused_whatever_their_case_or_ending(tmp_path, names):
    members = [(name, POINTS, 0, len(POINTS), zlib.crc32(POINTS)) for name in names]
    assert "one name" in foreign_refused(zip_of(tmp_path / "a.npz", *members))


def test_a_list_of_members_that_claims_more_than_the_file_is_refused(tmp_path):
    for count, length in ((65_534, 100), (1, 0x7FFFFFFF), (65_535, 0xFFFFFFFF)):
        (tmp_path / "a.npz").write_bytes(struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, count, count, length, 0, 0))
        foreign_refused(tmp_path / "a.npz")


def test_a_thousand_arrays_are_not_listed_in_a_message(tmp_path):
    with open(tmp_path / "a.npz", "wb") as file:
        write_npz(file, {f"array{number}": np.zeros(1) for number in range(1000)})
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for number in range(1000):
            file[f"array{number}"] = 0
    for name in ("a.npz", "a.h5"):
        assert "980 others" in foreign_refused(tmp_path / name)


@pytest.mark.parametrize("compressed", [False, True])
def test_npz_are_written_without_numpys_keyword_and_byte_for_byte_as_numpy_does(tmp_path, compressed):
    """Before NumPy 2.1, savez stores ``allow_pickle=False`` as an array of that name."""
    arrays = {"a": np.arange(6.0).reshape(2, 3), "b": np.array("text"), "c": np.zeros((0, 3), np.float32)}
    stream, other = io.BytesIO(), io.BytesIO()
    write_npz(stream, arrays, compressed=compressed)
    (np.savez_compressed if compressed else np.savez)(other, **arrays)
    assert stream.getvalue() == other.getvalue()
    with np.load(io.BytesIO(stream.getvalue())) as read:
        assert set(read.files) == set(arrays)
    with pytest.raises(ValueError, match="pickle"):
        write_npz(io.BytesIO(), {"objects": np.array([{}], dtype=object)})


def test_zip64_sizes_are_read(tmp_path):
    """As writers do that do not know a size when they begin, and as torch ends every file."""
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive, archive.open("pc.npy", "w", force_zip64=True) as stream:
        stream.write(POINTS)
    content = (tmp_path / "a.npz").read_bytes()
    count, _, length, begin = struct.unpack("<2H2I", content[-14:-2])
    end64 = struct.pack("<4sQ2H2I4Q", b"PK\6\6", 44, 45, 45, 0, 0, count, count, length, begin)
    locator = struct.pack("<4sIQI", b"PK\6\7", 0, len(content) - 22, 1)
    wide = struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, 0xFFFF, 0xFFFF, 0xFFFFFFFF, 0xFFFFFFFF, 0)
    (tmp_path / "b.npz").write_bytes(content[:-22] + end64 + locator + wide)
    assert np.array_equal(foreign(tmp_path / "b.npz"), np.load(tmp_path / "b.npz")["pc"])


def test_a_zip_archive_reads_members_in_pieces_and_checks_them_at_the_end(tmp_path):
    content = bytes(range(256)) * 40
    path = zip_of(
        tmp_path / "a", ("whole", content, 0, len(content), zlib.crc32(content)), ("bad", content, 0, len(content), 1)
    )
    with open(path, "rb") as file:
        archive = ZipArchive(file, path.stat().st_size)
        assert [len(piece) for piece in archive.pieces(archive.members["whole"], 100, 4096)] == [100, 4096, 4096, 1948]
        assert b"".join(archive.pieces(archive.members["whole"], 7, 11)) == content
        with pytest.raises(CacheError, match="checksum"):
            list(archive.pieces(archive.members["bad"], 100, 4096))


# -- npy headers ---------------------------------------------------------------------------------------------------


def with_header(text: str, body: bytes = bytes(48), version: int = 1) -> bytes:
    form = "<H" if version == 1 else "<I"
    return b"\x93NUMPY" + bytes([version, 0]) + struct.pack(form, len(text) + 1) + text.encode() + b"\n" + body


@pytest.mark.parametrize("version", [1, 2, 3])
@pytest.mark.parametrize(
    "text",
    [
        "{'descr': '<f4', 'fortran_order': False, 'shape': (4, 3), }",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (4, 3)}",
        "{'shape': (4L, 3L), 'fortran_order': False, 'descr': '<f4'}    ",
        "{ 'fortran_order':False,'descr':'<f4','shape':(4,3,) }",
    ],
)
def test_headers_of_other_writers_are_read(tmp_path, text, version):
    content = with_header(text, version=version)
    zip_of(tmp_path / "a.npz", ("pc.npy", content, 0, len(content), zlib.crc32(content)))
    assert foreign(tmp_path / "a.npz").shape == (4, 3)


@pytest.mark.parametrize(
    "text",
    [
        "{'descr': '<f4', 'fortran_order': False, 'shape': (2, 3), }",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (4, 4), }",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (99999999999999999999999, 3), }",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (4, -3), }",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (" + "0," * 40 + "), }",
        "{'descr': '|S0', 'fortran_order': False, 'shape': (999999999999,), }",
        "{'descr': '<f4', 'descr': '<f4', 'shape': (4, 3), }",
        "{'descr': [('x', '<f4')], 'fortran_order': False, 'shape': (12,), }",
        "{'descr': '|O', 'fortran_order': False, 'shape': (6,), }",
        "{'descr': '<f99', 'fortran_order': False, 'shape': (12,), }",
        "{'descr': '<f4', 'fortran_order': 0, 'shape': (4, 3), }",
        "[" * 5000,
        "-" * 9000 + "1",
        "",
    ],
    ids=range(14),
)
def test_headers_that_do_not_fit_their_bytes_are_refused(tmp_path, text):
    content = with_header(text)
    zip_of(tmp_path / "a.npz", ("pc.npy", content, 0, len(content), zlib.crc32(content)))
    foreign_refused(tmp_path / "a.npz")
