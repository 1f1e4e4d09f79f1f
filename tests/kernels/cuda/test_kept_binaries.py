"""Compiled kernels on disk: found again, private, and never trusted when broken."""

from __future__ import annotations

import os

import pytest

from pcdata.kernels.cuda import compiling, kept_binaries


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "pcdata" / "kernels"


def test_what_is_kept_is_found_under_its_identity_alone(place):
    assert kept_binaries.load("one") is None
    kept_binaries.keep("one", b"code" * 1000)
    assert kept_binaries.load("one") == b"code" * 1000
    assert kept_binaries.load("two") is None
    assert place.stat().st_mode & 0o777 == 0o700
    assert len(list(place.iterdir())) == 1  # no part files


@pytest.mark.parametrize("damage", ["cut", "changed", "emptied", "folder"])
def test_a_broken_file_counts_as_absent_and_is_written_anew(place, damage):
    kept_binaries.keep("one", b"code" * 1000)
    (file,) = place.iterdir()
    content = file.read_bytes()
    if damage == "folder":
        file.unlink()
        file.mkdir()
        assert kept_binaries.load("one") is None
        return
    file.write_bytes({"cut": content[:-1], "changed": content[:-1] + b"x", "emptied": b""}[damage])
    assert kept_binaries.load("one") is None
    kept_binaries.keep("one", b"code")
    assert kept_binaries.load("one") == b"code"


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="there are no owners here")
def test_a_folder_that_others_write_to_is_not_used(place):
    kept_binaries.keep("one", b"code")
    place.chmod(0o777)
    assert kept_binaries.load("one") is None
    kept_binaries.keep("two", b"code")
    assert len(list(place.iterdir())) == 1


def test_without_a_folder_nothing_is_kept_and_nothing_fails(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    kept_binaries.keep("one", b"code")
    assert kept_binaries.load("one") is None


def test_kernels_are_compiled_once_for_one_compiler_and_source(monkeypatch):
    made = []

    class Nvrtc:
        version = (0, 13, 0)

        def nvrtcVersion(self):
            return self.version

    nvrtc = Nvrtc()
    monkeypatch.setattr(compiling, "_nvrtc", lambda: nvrtc)
    monkeypatch.setattr(compiling, "compile_theme", lambda *what: made.append(what) or repr(what).encode())
    for _ in range(2):
        assert compiling.compiled("radius", "sm_90", "cubin") == b"('radius', 'sm_90', 'cubin')"
    assert len(made) == 1
    compiling.compiled("radius", "sm_80", "cubin")
    nvrtc.version = (0, 13, 1)
    compiling.compiled("radius", "sm_90", "cubin")
    monkeypatch.setattr(compiling, "sources_digest", lambda: "changed")
    compiling.compiled("radius", "sm_90", "cubin")
    assert len(made) == 4
