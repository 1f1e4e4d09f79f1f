"""Captures that change while they are built or exported: an error that names the file, never a mixture."""

from __future__ import annotations

import os
import shutil

import pytest

from pcdata import AveragedSource, open_source
from pcdata.build import build_dataset
from pcdata.errors import CaptureError
from pcdata.exports import export_dataset
from pcdata.files.inputs import Inputs, recording
from pcdata.files.opening import open_input, read_text
from pcdata.io.writers.capture_folder import write_capture
from tests.build.test_builder import tree
from tests.build.test_shared_names import meanwhile


@pytest.fixture
def folder(tmp_path, source):
    """Four captures of one camera that stands still."""
    place = tmp_path / "captures"
    write_capture(source.load(source.ids[0]), tmp_path / "written")
    shutil.copytree(tmp_path / "written" / "view0", place)
    for role in ("depth", "color", "labels", "masks", "poses"):
        for file in list((place / role).iterdir()) if (place / role).is_dir() else []:
            for copy in "123":
                shutil.copy(file, file.with_stem(copy))
    return place


def touch(path) -> None:
    status = path.stat()
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns + 1))


def exchange(path) -> None:
    """As an editor saves: another file under the same name, of the same size and time."""
    status = path.stat()
    shutil.copy(path, path.with_suffix(".new"))
    os.utime(path.with_suffix(".new"), ns=(status.st_atime_ns, status.st_mtime_ns))
    path.with_suffix(".new").replace(path)


def rewrite(path) -> None:
    """Another content of the same size in the same file, and nothing in its times that says so."""
    status = path.stat()
    content = path.read_bytes()
    spot = max(place for place, byte in enumerate(content) if byte in b"0123456789")
    path.write_bytes(content[:spot] + (b"1" if content[spot : spot + 1] != b"1" else b"2") + content[spot + 1 :])
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))


def built_while(change, tmp_path, folder, configure) -> list[str]:
    """Build, and change the captures after the second of four; return the samples that were told."""
    told = []

    def progress(done: int, total: int, sample_id: str) -> None:
        told.append(sample_id)
        if done == 2:
            change()

    build_dataset(configure(), open_source(folder), tmp_path / "out", progress=progress)
    return told


@pytest.mark.parametrize("name", ["intrinsics.json", "depth/0.npy", "poses/0.txt", "poses/1.txt"])
@pytest.mark.parametrize("change", [rewrite, os.unlink], ids=["rewritten", "removed"])
def test_a_file_that_changes_after_it_was_read_stops_the_build(tmp_path, folder, configure, name, change):
    with pytest.raises(CaptureError, match=r"was (changed|removed) after it was first read") as caught:
        built_while(lambda: change(folder / name), tmp_path, folder, configure)
    assert str(folder / name) in str(caught.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("change", [touch, exchange], ids=["touched", "saved again"])
def test_a_small_file_saved_again_without_a_change_is_none(tmp_path, folder, configure, change):
    def act() -> None:
        for name in ("intrinsics.json", "poses/0.txt", "poses/3.txt"):
            change(folder / name)

    assert len(built_while(act, tmp_path, folder, configure)) == 4


@pytest.mark.parametrize("change", [touch, exchange, lambda path: path.write_bytes(bytes(70_001))])
def test_a_large_file_is_compared_by_size_time_and_inode(tmp_path, change):
    inputs, path = Inputs(), tmp_path / "image"
    path.write_bytes(bytes(70_000))
    with recording(inputs), open_input("here", path, max_bytes=1 << 20):
        inputs.check("here")
    change(path)
    with pytest.raises(CaptureError, match="was changed"):
        inputs.check("here")


def test_a_calibration_that_changes_between_opening_and_building_stops_the_build(tmp_path, folder, configure):
    source = open_source(folder)
    rewrite(folder / "intrinsics.json")
    for built in (source, AveragedSource(source=source, num_frames=2, min_count=1), source.subset(source.ids[:2])):
        with pytest.raises(CaptureError, match=r"intrinsics\.json was changed"):
            build_dataset(configure(), built, tmp_path / "out")
    build_dataset(configure(), open_source(folder), tmp_path / "out")


def test_captures_that_rest_are_built_and_files_nobody_reads_may_change(tmp_path, folder, configure):
    (folder / "notes.txt").write_text("before")
    build_dataset(
        configure(),
        open_source(folder),
        tmp_path / "out",
        progress=meanwhile(lambda: (folder / "notes.txt").write_text("after")),
    )
    assert (tmp_path / "out").exists()


def test_a_file_that_changes_stops_an_export(tmp_path, folder):
    before = tree(folder)
    with pytest.raises(CaptureError, match=r"intrinsics\.json was changed"):
        export_dataset(
            open_source(folder),
            "contact_graspnet",
            tmp_path / "out",
            label_offset=1,
            progress=meanwhile(lambda: rewrite(folder / "intrinsics.json")),
        )
    assert not (tmp_path / "out").exists()
    assert tree(folder).keys() == before.keys()


def test_what_was_read_is_remembered_as_it_was_first(tmp_path):
    inputs = Inputs()
    for text in ("a", "b"):
        (tmp_path / "file").write_text(text)
        with recording(inputs):
            assert read_text("here", tmp_path / "file") == text
    with pytest.raises(CaptureError, match="changed"):
        inputs.check_latest("here")
    with pytest.raises(CaptureError, match="changed"):
        inputs.check("here")
