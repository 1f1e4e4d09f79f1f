"""Folders that appear complete or not at all, and what killed writers leave behind."""

from __future__ import annotations

import multiprocessing
import os
import time
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from pcdata.files.whole_folders import complete_or_nothing, scratch_beside

pytest.importorskip("fcntl")


def hold_half(target: Path, ready: Connection) -> None:
    """Be in the middle of writing until killed."""
    with scratch_beside(target) as scratch:
        (scratch / "half").write_text("written")
        ready.send("ready")
        time.sleep(60)


@pytest.fixture
def writer(tmp_path):
    """A process that is in the middle of writing ``out``."""
    context = multiprocessing.get_context("fork")
    ready, told = context.Pipe()
    process = context.Process(target=hold_half, args=(tmp_path / "out", told))
    process.start()
    assert ready.recv() == "ready"
    yield process
    process.kill()
    process.join()
    ready.close()
    told.close()


def scratches(folder: Path) -> list[Path]:
    return list(folder.glob(".out.partial-*"))


def age(folder: Path, seconds: float) -> None:
    for scratch in scratches(folder):
        os.utime(scratch, (time.time() - seconds,) * 2)


def test_what_a_killed_writer_left_is_removed_by_the_next_one(tmp_path, writer):
    writer.kill()
    writer.join()
    assert len(scratches(tmp_path)) == 1
    age(tmp_path, 3600)
    with complete_or_nothing(tmp_path / "out") as partial:
        assert scratches(tmp_path) == [partial]
        (partial / "file").write_text("whole")
    assert [path.name for path in tmp_path.rglob("*")] == ["out", "file"]


def test_a_writer_that_lives_keeps_its_folder_however_old(tmp_path, writer):
    age(tmp_path, 3600)
    with scratch_beside(tmp_path / "out"):
        assert len(scratches(tmp_path)) == 2
    (left,) = scratches(tmp_path)
    assert (left / "half").read_text() == "written"


def test_a_fresh_folder_and_those_of_other_names_and_machines_are_left_alone(tmp_path):
    (tmp_path / ".out.partial-elsewhere-1-abc").mkdir()
    (tmp_path / f".other.partial-{os.uname().nodename}-1-abc").mkdir()
    for folder in tmp_path.iterdir():
        os.utime(folder, (0, 0))
    (tmp_path / f".out.partial-{os.uname().nodename}-1-abc").mkdir()
    before = sorted(tmp_path.iterdir())
    with scratch_beside(tmp_path / "out"):
        pass
    assert sorted(tmp_path.iterdir()) == before
