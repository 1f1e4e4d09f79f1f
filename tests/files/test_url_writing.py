"""Folders behind URLs: what is put there comes back, failures are tried again, and nothing is made by accident."""

from __future__ import annotations

import pytest

from pcdata.errors import CacheError, ConfigError
from pcdata.files import urls
from pcdata.files.url_writing import WritableUrl, is_missing


@pytest.fixture(params=["memory", "local"])
def folder(request, tmp_path, monkeypatch) -> WritableUrl:
    monkeypatch.setattr(urls, "_FIRST_WAIT", 0.0)
    return WritableUrl("here", f"{request.param}://{tmp_path}/bucket/set/")


def test_what_is_put_comes_back(folder, tmp_path):
    assert folder.sizes() == {}
    (tmp_path / "a").write_bytes(b"12345")
    folder.put({"x/a b.bin": tmp_path / "a", "c": tmp_path / "a"})
    folder.write("empty", b"")
    assert folder.sizes() == {"c": 5, "empty": 0, "x/a b.bin": 5}
    assert folder.below("x").sizes() == {"a b.bin": 5}
    assert folder.read_whole("empty", max_bytes=9) == b""
    folder.fetch({"x/a b.bin": tmp_path / "new" / "deep" / "b"})
    assert (tmp_path / "new" / "deep" / "b").read_bytes() == b"12345"
    other = folder.beside("other")
    other.copy(folder, {"y/z": "c"})
    assert other.read_each(["y/z", "none"], max_bytes=9) == {"y/z": b"12345"}
    folder.remove(["c", "none", "empty"])
    assert folder.sizes() == {"x/a b.bin": 5}


def test_a_file_that_is_not_there_is_told_from_one_that_cannot_be_had(folder, monkeypatch):
    with pytest.raises(CacheError, match="missing") as caught:
        folder.read_whole("a", max_bytes=9)
    assert is_missing(caught.value)
    folder.write("a", b"0123456789")
    with pytest.raises(CacheError, match="10 bytes, more than the limit of 9") as caught:
        folder.read_whole("a", max_bytes=9)
    assert not is_missing(caught.value)


def test_a_put_that_fails_is_tried_four_times_and_then_told(folder, tmp_path, monkeypatch):
    (tmp_path / "a").write_bytes(b"12345")
    files = type(folder.opened()[0])
    whole, tries = files.put_file, []

    def put_file(self, *args, **options):
        tries.append(args)
        if len(tries) < 4:
            raise ConnectionResetError("reset by peer")
        return whole(self, *args, **options)

    monkeypatch.setattr(files, "put_file", put_file)
    folder.put({"a": tmp_path / "a"})
    assert folder.sizes() == {"a": 5}
    assert len(tries) == 4
    tries.clear()
    monkeypatch.setattr(files, "put_file", lambda *_, **__: tries.append(1) or (_ for _ in ()).throw(OSError("reset")))
    with pytest.raises(CacheError, match=r"set/a: it cannot be written .*reset.*tried 4 times"):
        folder.put({"a": tmp_path / "a"})
    assert len(tries) == 4


@pytest.mark.parametrize("folder", ["memory"], indirect=True)
def test_a_store_that_cannot_copy_by_itself_is_copied_through_here(folder, monkeypatch):
    def cp_file(self, *args, **options):
        raise NotImplementedError

    monkeypatch.setattr(type(folder.opened()[0]), "cp_file", cp_file)
    folder.write("a", b"123")
    folder.beside("other").copy(folder, {"b": "a"})
    assert folder.beside("other").read_whole("b", max_bytes=9) == b"123"


@pytest.mark.parametrize("url", ["memory://", "memory:///"])
def test_a_url_that_names_no_folder_is_refused(url):
    with pytest.raises(ConfigError, match="names no folder"):
        WritableUrl("here", url)
