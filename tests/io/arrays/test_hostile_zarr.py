"""Zarr directories that want to run code, leave their folder, fill the memory or lose data: none gets through."""

from __future__ import annotations

import bz2
import gzip
import json
import lzma
import os
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from pcdata.errors import CacheError, PcdataError
from pcdata.io.arrays.stored_arrays import stored_arrays
from pcdata.io.arrays.zarr_codecs import COMPRESSORS, FILTERS, decoder_of
from tests.io.memory import memory_limit

ARRAY = np.arange(48, dtype="<f4").reshape(4, 4, 3)


def zarr(folder: Path, *, chunk: bytes | None = None, name: str = "0.0.0", **change: object) -> Path:
    """One array in one chunk."""
    (folder / "pc").mkdir(parents=True, exist_ok=True)
    header = {"zarr_format": 2, "shape": [4, 4, 3], "chunks": [4, 4, 3], "dtype": "<f4", "order": "C", "fill_value": 0}
    header |= {"compressor": None, "filters": None, **change}
    (folder / "pc" / ".zarray").write_text(json.dumps(header))
    place = folder / "pc" / name
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_bytes(ARRAY.tobytes() if chunk is None else chunk)
    return folder


def read(folder: Path) -> np.ndarray:
    with stored_arrays(folder, ["pc"]) as stored:
        return stored["pc"][...]


def refused(folder: Path) -> str:
    with memory_limit(512 * 2**20), pytest.raises(PcdataError) as caught:
        read(folder)
    assert str(folder) in str(caught.value)
    assert len(str(caught.value)) < 3000
    return str(caught.value)


@pytest.mark.parametrize("separator", [".", "/"])
def test_the_two_separators_of_the_format_are_read(tmp_path, separator):
    name = separator.join("000")
    assert np.array_equal(read(zarr(tmp_path, name=name, dimension_separator=separator)), ARRAY)


@pytest.mark.parametrize("name", ["pickle", "json2", "msgpack2", "categorize", "vlen-utf8", "vlen-bytes", "vlen-array"])
@pytest.mark.parametrize("where", ["compressor", "filters"])
def test_codecs_that_are_not_on_the_list_are_refused_by_name_before_numcodecs_sees_them(tmp_path, where, name):
    config = {"id": name}
    folder = zarr(tmp_path, **{where: config if where == "compressor" else [config]})
    assert f"'{name}' is none that arrays of numbers need" in refused(folder)


@pytest.mark.parametrize(
    "config", [5, [], {}, {"id": 5}, {"id": "PICKLE"}, {"id": "pickle\0"}, {"id": ["zlib"]}, "zlib"]
)
def test_a_codec_without_a_known_name_is_refused(tmp_path, config):
    assert "is none that arrays of numbers need" in refused(zarr(tmp_path, compressor=config))


@pytest.mark.parametrize(
    "config",
    [
        {"id": "delta", "dtype": "|O"},
        {"id": "delta", "dtype": "<U999999999"},
        {"id": "delta", "dtype": "f4,f4"},
        {"id": "astype", "encode_dtype": "<f4", "decode_dtype": "(1000000,)f4"},
        {"id": "shuffle", "elementsize": 2**40},
        {"id": "fixedscaleoffset", "scale": "x"},
        {"id": "quantize", "digits": -5, "dtype": "<f4"},
        {"id": "crc32", "location": "__import__"},
        {"id": "shuffle", "unknown": 1},
    ],
    ids=str,
)
def test_filters_have_only_the_settings_that_they_can_have(config):
    with pytest.raises(CacheError, match="cannot have"):
        decoder_of(None, [config])


@pytest.mark.parametrize("separator", ["/../../../secret/", "/", ",", "", "..", "\\", "/../", ["."], 5, None, "\0"])
def test_no_separator_leads_out_of_the_folder_or_to_zeros(tmp_path, separator):
    (tmp_path / "secret").mkdir()
    (tmp_path / "secret" / "0").write_bytes(ARRAY.tobytes())
    refused(zarr(tmp_path / "a.zarr", dimension_separator=separator))


def test_links_that_leave_the_folder_are_refused_and_those_inside_are_followed(tmp_path):
    (tmp_path / "secret").write_bytes(ARRAY.tobytes())
    folder = zarr(tmp_path / "a.zarr")
    (folder / "pc" / "0.0.0").rename(folder / "kept")
    (folder / "pc" / "0.0.0").symlink_to(folder / "kept")
    assert np.array_equal(read(folder), ARRAY)
    (folder / "pc" / "0.0.0").unlink()
    (folder / "pc" / "0.0.0").symlink_to(tmp_path / "secret")
    assert "leads out of" in refused(folder)


def test_headers_and_arrays_that_are_links_to_elsewhere_are_refused(tmp_path):
    elsewhere = zarr(tmp_path / "elsewhere")
    folder = zarr(tmp_path / "a.zarr")
    (folder / "pc" / ".zarray").unlink()
    (folder / "pc" / ".zarray").symlink_to(elsewhere / "pc" / ".zarray")
    assert "leads out of" in refused(folder)
    other = zarr(tmp_path / "b.zarr")
    (other / "pc").rename(other / "own")
    (other / "pc").symlink_to(elsewhere / "pc")
    assert "leads out of" in refused(other)


@pytest.mark.parametrize("place", ["0.0.0", ".zarray"])
def test_a_fifo_in_place_of_a_file_is_refused_at_once(tmp_path, place):
    folder = zarr(tmp_path)
    (folder / "pc" / place).unlink()
    os.mkfifo(folder / "pc" / place)
    assert "FIFO" in refused(folder)


PACKED_ZEROS = {
    "zlib": lambda size: zlib.compress(bytes(size), 9),
    "gzip": lambda size: gzip.compress(bytes(size), 9),
    "bz2": lambda size: bz2.compress(bytes(size), 9),
    "lzma": lambda size: lzma.compress(bytes(size)),
    "zstd": lambda size: pytest.importorskip("numcodecs").Zstd(19).encode(bytes(size)),
    "blosc": lambda size: pytest.importorskip("numcodecs").Blosc("zstd", 9).encode(bytes(size)),
    "lz4": lambda size: pytest.importorskip("numcodecs").LZ4().encode(bytes(size)),
}


@pytest.mark.parametrize("packer", PACKED_ZEROS)
def test_a_chunk_unpacks_to_its_own_size_and_to_no_more(tmp_path, packer):
    right = bytes(PACKED_ZEROS[packer](ARRAY.nbytes))
    assert not read(zarr(tmp_path / "right", chunk=right, compressor={"id": packer})).any()
    bomb = bytes(PACKED_ZEROS[packer](1 << 26))
    assert "are its size" in refused(zarr(tmp_path / "bomb", chunk=bomb, compressor={"id": packer}))
    short = bytes(PACKED_ZEROS[packer](ARRAY.nbytes - 4))
    assert "are its size" in refused(zarr(tmp_path / "short", chunk=short, compressor={"id": packer}))


@pytest.mark.parametrize("packer", PACKED_ZEROS)
def test_a_chunk_that_is_cut_or_continued_is_refused(tmp_path, packer):
    right = bytes(PACKED_ZEROS[packer](ARRAY.nbytes))
    for name, content in {"cut": right[:-1], "more": right + b"\0", "half": right[: len(right) // 2]}.items():
        refused(zarr(tmp_path / name, chunk=content, compressor={"id": packer}))
    refused(zarr(tmp_path / "empty", chunk=b"", compressor={"id": packer}))


def test_a_zstd_frame_must_say_its_size_and_be_the_only_one(tmp_path):
    codecs = pytest.importorskip("numcodecs")
    frame = bytes(codecs.Zstd().encode(ARRAY.tobytes()))
    # A block of one byte, repeated 128 KiB times, in a frame that does not say how much there is.
    silent = struct.pack("<IBB", 0xFD2FB528, 0, 0x50) + (1 << 17 << 3 | 3).to_bytes(3, "little") + b"\0"
    for name, content in {
        "silent": silent,
        "two": frame + frame,
        "skip": b"\x50\x2a\x4d\x18\4\0\0\0abcd" + frame,
    }.items():
        refused(zarr(tmp_path / name, chunk=content, compressor={"id": "zstd"}))
    assert np.array_equal(read(zarr(tmp_path / "right", chunk=frame, compressor={"id": "zstd"})), ARRAY)


def test_a_chunk_far_larger_than_its_array_is_not_unpacked(tmp_path):
    size = 1 << 28
    content = zlib.compress(bytes(4 * size + 4), 1)
    folder = zarr(tmp_path, chunk=content, name="0", shape=[4], chunks=[size + 1], compressor={"id": "zlib"})
    assert "claims" in refused(folder)


@pytest.mark.parametrize(
    ("change", "names"),
    [
        ({"shape": [8, 4, 3]}, ["0.0.0"]),
        ({"chunks": [2, 4, 3]}, ["0.0.0"]),
        ({"shape": [2, 4, 3], "chunks": [2, 4, 3]}, ["0.0.0", "1.0.0"]),
        ({}, ["0,0,0"]),
        ({}, ["0.0"]),
        ({}, ["0.0.0", "0.0.1"]),
        ({}, ["0.0.0", "notes.txt"]),
        ({}, []),
        ({"shape": [10**9, 4, 3], "chunks": [1, 1, 1]}, ["0.0.0"]),
        ({"dimension_separator": "/"}, ["0.0.0"]),
    ],
    ids=str,
)
def test_chunks_that_do_not_fit_the_header_are_named_not_read_as_zeros(tmp_path, change, names):
    folder = zarr(tmp_path, **change)
    (folder / "pc" / "0.0.0").unlink()
    for name in names:
        (folder / "pc" / name).write_bytes(ARRAY.tobytes()[: 96 if change.get("chunks") == [2, 4, 3] else 192])
    assert "chunk" in refused(folder)


@pytest.mark.parametrize(
    "change",
    [
        {"shape": [4, 4, True]},
        {"shape": [4, 4, 3.0]},
        {"shape": 5},
        {"shape": [1 << 70, 4, 3]},
        {"chunks": [0, 4, 3]},
        {"order": ["C"]},
        {"order": "A"},
        {"zarr_format": 3},
        {"dtype": 5},
        {"dtype": "f4,f4"},
        {"dtype": "(9999999,)f4"},
        {"dtype": [["x", "<f4"]]},
        {"dtype": "|O"},
        {"filters": {}},
        {"filters": [{"id": "delta", "dtype": "<f4"}] * 99},
    ],
    ids=str,
)
def test_headers_that_cannot_be_true_are_typed_errors(tmp_path, change):
    refused(zarr(tmp_path, **change))


@pytest.mark.parametrize(
    "text", ["", "{", "[1]", "null", "[" * 60_000, '{"a":' * 10_000, "\ud800", "1" * 5000, " " * 70_000]
)
def test_headers_that_are_no_object_are_typed_errors(tmp_path, text):
    folder = zarr(tmp_path)
    (folder / "pc" / ".zarray").write_bytes(text.encode("utf-8", "surrogatepass"))
    refused(folder)


def test_a_message_does_not_list_thousands_of_arrays(tmp_path):
    for number in range(300):
        (tmp_path / f"array{number:05}").mkdir()
        (tmp_path / f"array{number:05}" / ".zarray").write_text("{}")
    assert "280 others" in refused(tmp_path)


def test_every_codec_of_the_list_reads_what_numcodecs_writes():
    codecs = pytest.importorskip("numcodecs")
    values = np.arange(64, dtype="<f4")
    made = {
        "delta": codecs.Delta("<f4"),
        "fixedscaleoffset": codecs.FixedScaleOffset(0, 1, "<f4", "<i4"),
        "quantize": codecs.Quantize(3, "<f4"),
        "astype": codecs.AsType("<f8", "<f4"),
        "shuffle": codecs.Shuffle(4),
        "crc32": codecs.CRC32(),
        "adler32": codecs.Adler32(),
    }
    if hasattr(codecs, "BitRound"):
        made["bitround"] = codecs.BitRound(20)
    if hasattr(codecs, "Fletcher32"):
        made["fletcher32"] = codecs.Fletcher32()
    for name, codec in made.items():
        packed = zlib.compress(np.ascontiguousarray(codec.encode(values.copy())).tobytes())
        decode = decoder_of({"id": "zlib"}, [codec.get_config()])
        assert np.array_equal(np.frombuffer(decode(packed, values.nbytes), "<f4"), values), name
    bits = np.arange(64) % 3 == 0
    packed = bytes(codecs.PackBits().encode(bits))
    assert np.array_equal(np.frombuffer(decoder_of(None, [{"id": "packbits"}])(packed, 64), "?"), bits)
    assert made.keys() | {"packbits"} >= FILTERS.keys() - {"bitround", "fletcher32"}
    assert set(COMPRESSORS) == set(PACKED_ZEROS)
