"""Packed chunks of recordings: unpacked as far as they claim, and no further."""

from __future__ import annotations

import bz2
import resource
import zlib
from collections.abc import Callable

import pytest

from pcdata.errors import CaptureError
from pcdata.io.messages.packing import MAX_CHUNK, unpacked


def packer_of(kind: str) -> Callable[[bytes], bytes]:
    if kind == "bz2":
        return bz2.compress
    if kind == "lz4":
        return pytest.importorskip("lz4.frame").compress
    from pcdata.io.messages.packing import _zstd

    try:
        zstd = _zstd()
    except CaptureError as error:
        pytest.skip(str(error))
    return zstd.compress


def bomb(kind: str) -> bytes:
    if kind == "bz2":
        packer = bz2.BZ2Compressor(9)
        return b"".join(packer.compress(bytes(1 << 20)) for _ in range(512)) + packer.flush()
    return packer_of(kind)(bytes(1 << 29))


@pytest.mark.parametrize("kind", ["bz2", "lz4", "zstd"])
def test_a_chunk_is_unpacked_no_further_than_it_claims(kind):
    content = bomb(kind)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for size in (0, 1000, 1 << 20):
        with pytest.raises(CaptureError, match="more than"):
            unpacked(content, kind, size)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100 << 10  # kB, of half a gigabyte


@pytest.mark.parametrize("kind", ["bz2", "lz4", "zstd"])
def test_a_chunk_that_is_short_or_damaged_is_refused(kind):
    whole = packer_of(kind)(b"words" * 100)
    assert unpacked(whole, kind, 500) == b"words" * 100
    for content, size in ((whole, 501), (whole[:-20], 500), (b"rubbish", 500), (b"", 500)):
        with pytest.raises(CaptureError, match="chunk"):
            unpacked(content, kind, size)


def test_a_checksum_and_a_limit_are_held() -> None:
    assert unpacked(b"abc", "none", 3, zlib.crc32(b"abc")) == b"abc"
    with pytest.raises(CaptureError, match="checksum"):
        unpacked(b"abd", "none", 3, zlib.crc32(b"abc"))
    with pytest.raises(CaptureError, match="limit"):
        unpacked(b"abc", "none", MAX_CHUNK + 1)
    with pytest.raises(CaptureError, match="packed with 'zip'"):
        unpacked(b"abc", "zip", 3)
