"""A named pipe: all bytes arrive; a full disk is told, and never holds who writes."""

from __future__ import annotations

import io

import pytest

from pcdata.files.pipes import piped
from tests.disk_limits import largest_file

DATA = bytes(range(256)) * 20_000  # more than a pipe holds


def test_all_bytes_arrive():
    file = io.BytesIO()
    with piped("here", file) as pipe, open(pipe, "wb") as stream:
        stream.write(DATA)
    assert file.getvalue() == DATA
    assert not pipe.parent.exists()


def test_a_file_that_cannot_be_written_is_told_at_the_end(tmp_path):
    with (
        open(tmp_path / "a", "wb", buffering=0) as file,
        largest_file(20_000),
        pytest.raises(OSError, match="too large"),
        piped("here", file) as pipe,
        open(pipe, "wb") as stream,
    ):
        stream.write(DATA)
    assert not pipe.parent.exists()


def test_what_fails_inside_is_raised_and_nothing_waits():
    with pytest.raises(KeyError), piped("here", io.BytesIO()) as unused:
        raise KeyError
    assert not unused.parent.exists()
