from __future__ import annotations

import os

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pcdata.errors import CaptureError
from pcdata.io.clouds import lzf


def decode_by_the_book(stream: bytes) -> bytes:
    """The format in ten lines of Python, as the oracle."""
    out, i = bytearray(), 0
    while i < len(stream):
        control, i = stream[i], i + 1
        if control < 32:
            if i + control + 1 > len(stream):
                raise IndexError
            out += stream[i : i + control + 1]
            i += control + 1
            continue
        length = control >> 5
        if length == 7:
            length, i = length + stream[i], i + 1
        start = len(out) - ((control & 31) << 8 | stream[i]) - 1
        i += 1
        if start < 0:
            raise IndexError
        for k in range(length + 2):
            out.append(out[start + k])
    return bytes(out)


BYTES = st.one_of(
    st.binary(max_size=2000),
    st.builds(lambda piece, n: piece * n, st.binary(min_size=1, max_size=40), st.integers(1, 500)),
)


@given(BYTES)
@settings(deadline=None)
def test_what_is_compressed_unpacks_to_the_same_bytes_here_and_by_the_book(data: bytes) -> None:
    stream = lzf.compress(data)
    assert decode_by_the_book(stream) == data
    assert lzf.decompress(stream, len(data)).tobytes() == data


def test_random_bytes_survive_though_they_do_not_compress() -> None:
    data = os.urandom(100_001)
    assert lzf.decompress(lzf.compress(data), len(data)).tobytes() == data


@given(st.binary(max_size=200), st.integers(0, 400))
@settings(max_examples=300, deadline=None)
def test_any_stream_gives_what_the_book_says_or_a_typed_error(stream: bytes, size: int) -> None:
    try:
        expected = decode_by_the_book(stream)
    except IndexError:
        expected = None
    if expected is not None and len(expected) == size:
        assert lzf.decompress(stream, size).tobytes() == expected
    else:
        with pytest.raises(CaptureError, match=r"lzf\.decompress"):
            lzf.decompress(stream, size)


@given(st.binary(min_size=40, max_size=500), st.data())
@settings(deadline=None)
def test_a_cut_stream_is_noticed(data: bytes, draw: st.DataObject) -> None:
    stream = lzf.compress(data)
    with pytest.raises(CaptureError):
        lzf.decompress(stream[: draw.draw(st.integers(0, len(stream) - 1))], len(data))


@pytest.mark.parametrize("error", [-1, 1])
def test_a_stream_of_other_length_than_declared_is_noticed(error: int) -> None:
    data = b"tabletop" * 1000
    with pytest.raises(CaptureError, match=r"declared|damaged"):
        lzf.decompress(lzf.compress(data), len(data) + error)


def test_a_size_that_the_stream_cannot_reach_is_refused_before_allocation() -> None:
    with pytest.raises(CaptureError, match="can yield at most 264"):
        lzf.decompress(b"abc", 1 << 31)
