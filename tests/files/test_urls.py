"""URLs: read range by range, tried again where that may help, and told apart from paths."""

from __future__ import annotations

import importlib.util
import os
import pickle
from pathlib import Path

import fsspec
import pytest

from pcdata.errors import CacheError, ConfigError, MissingExtraError
from pcdata.files import urls
from pcdata.files.urls import UrlFolder, is_url, path_of
from tests.forks import ended, forked


@pytest.fixture
def folder(monkeypatch) -> UrlFolder:
    monkeypatch.setattr(urls, "_FIRST_WAIT", 0.0)
    with fsspec.open("memory://urls/set/a.bin", "wb") as file:
        file.write(bytes(range(100)))
    return UrlFolder("here", "memory://urls/set/", error=CacheError)


def failing(monkeypatch, folder: UrlFolder, times: int, error: Exception) -> list[tuple[int, int]]:
    """Let the first reads fail; return the ranges that are asked for."""
    system, _ = folder.opened()
    asked, whole = [], type(system).cat_file

    def cat_file(self, path, start=None, end=None, **options):
        asked.append((start, end))
        if len(asked) <= times:
            raise error
        return whole(self, path, start=start, end=end, **options)

    monkeypatch.setattr(type(system), "cat_file", cat_file)
    return asked


@pytest.mark.parametrize("place", ["s3://b/x", "memory://x", "simplecache::s3://b", "https://h/x"])
def test_a_url_is_no_path(place):
    assert is_url(place)


@pytest.mark.parametrize("place", ["/data/set", "C:\\set", "c:/set", "set", "a b://c", Path("s3:/x"), "file:///data"])
def test_a_path_is_no_url(place):
    assert not is_url(place)


def test_a_file_url_is_the_path_it_names():
    assert path_of("file:///data/a%20set") == Path("/data/a set")
    assert path_of("file://localhost/data") == path_of("/data") == Path("/data")


def test_a_range_of_a_file_is_read_and_its_size_told(folder):
    assert folder.read("a.bin", 10, 14) == bytes([10, 11, 12, 13])
    assert folder.read("a.bin", 5, 5) == b""
    status = folder.status("a.bin")
    assert status.size == 100
    assert status.identity == folder.status("a.bin").identity is not None
    with fsspec.open("memory://urls/set/a.bin", "wb") as file:
        file.write(bytes(100))
    assert folder.status("a.bin").identity != status.identity


def test_a_read_that_fails_is_tried_as_often_as_was_said(folder, monkeypatch):
    asked = failing(monkeypatch, folder, 3, TimeoutError("no answer"))
    assert folder.read("a.bin", 0, 4) == bytes(range(4))
    assert asked == [(0, 4)] * 4
    asked = failing(monkeypatch, folder, 9, TimeoutError("no answer"))
    with pytest.raises(CacheError, match=r"set/a.bin: its bytes 40 to 60 .*no answer.*tried 4 times") as caught:
        folder.read("a.bin", 40, 60)
    assert len(asked) == 4
    assert caught.value.path == "memory://urls/set/a.bin"


def test_a_read_that_gives_less_than_was_asked_for_is_an_error(folder):
    with pytest.raises(CacheError, match="10 bytes came"):
        folder.read("a.bin", 90, 200)


def test_what_cannot_help_is_not_tried_again(folder, monkeypatch):
    with pytest.raises(CacheError, match=r"set/b.bin: the file is missing"):
        folder.status("b.bin")
    asked = failing(monkeypatch, folder, 9, PermissionError("403"))
    with pytest.raises(CacheError, match="403"):
        folder.read("a.bin", 0, 4)
    assert len(asked) == 1
    with pytest.raises(CacheError, match="must be a file"):
        UrlFolder("here", "memory://urls", error=CacheError).status("set")


def test_it_travels_as_its_url_and_connects_anew(folder):
    copy = pickle.loads(pickle.dumps(folder))
    assert copy._opened is None
    assert copy.read("a.bin", 1, 2) == b"\1"

    def reads() -> int:
        folder.read("a.bin", 1, 2)
        return int(folder._opened[0] != os.getpid())

    assert ended(forked(reads)) == 0


def test_a_password_in_a_url_is_not_shown(folder):
    assert str(UrlFolder("here", "memory://me:secret@host/x", error=CacheError)) == "memory://***@host/x"


def test_an_unknown_kind_of_url_and_a_missing_package_are_told(monkeypatch):
    with pytest.raises(ConfigError, match="abc://x"):
        UrlFolder("here", "abc://x", error=CacheError)
    if importlib.util.find_spec("s3fs") is None:
        with pytest.raises(MissingExtraError, match=r"pcdata\[remote\]"):
            UrlFolder("here", "s3://bucket/x", error=CacheError)
