"""Builds beside other processes: nobody else's files are deleted, and what killed builds leave is found."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from pcdata import CachedCloudDataset
from pcdata.build import build_dataset
from pcdata.errors import CacheError, CaptureError
from pcdata.files import scratch, whole_folders
from tests.build.test_builder import Clouds, cloud, tree


@pytest.fixture(params=["exchange", "two renames"])
def way(request, monkeypatch):
    """Both ways to put a new folder where an old one is; not every file system can swap two names."""
    if request.param == "two renames":
        monkeypatch.setattr(whole_folders, "exchange", lambda one, other: False)


def meanwhile(action):
    """A callback that acts once, in the middle of a build."""
    return lambda done, total, name: action() if done == 1 else None


def make(folder: Path, name: str = "thesis.tex") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text("years")


# -- what somebody else makes during a build -----------------------------------------------------------------------


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_folder_made_under_the_name_during_a_build_keeps_its_files(tmp_path, source, configure, overwrite):
    with pytest.raises(CacheError, match="somebody else made"):
        build_dataset(
            configure(),
            source,
            tmp_path / "out",
            overwrite=overwrite,
            progress=meanwhile(lambda: make(tmp_path / "out")),
        )
    assert tree(tmp_path / "out") == {"thesis.tex": b"years"}
    (tmp_path / "out" / "thesis.tex").unlink()
    assert_continues(tmp_path, source, configure)


def assert_continues(tmp_path, source, configure) -> None:
    """What was finished is kept: the next build stores it without loading a capture."""
    build_dataset(configure(), source, tmp_path / "out", progress=lambda *news: pytest.fail("loaded again"))
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_file_made_under_the_name_during_a_build_stays(tmp_path, source, configure):
    with pytest.raises(CacheError, match="somebody else made"):
        build_dataset(
            configure(), source, tmp_path / "out", progress=meanwhile(lambda: (tmp_path / "out").write_text("years"))
        )
    assert (tmp_path / "out").read_bytes() == b"years"
    (tmp_path / "out").unlink()
    assert_continues(tmp_path, source, configure)


def test_a_folder_made_at_the_last_moment_keeps_its_files(tmp_path, source, configure, monkeypatch):
    rename = os.rename

    def late(a, b):
        if Path(b) == tmp_path / "out":
            make(tmp_path / "out")
        rename(a, b)

    monkeypatch.setattr("pcdata.files.whole_folders.os.rename", late)
    with pytest.raises(CacheError, match="somebody else made"):
        build_dataset(configure(), source, tmp_path / "out")
    assert tree(tmp_path / "out") == {"thesis.tex": b"years"}


SHARD = "shards/00000"
PLACES = [".", "index", "shards", *(f"{SHARD}/{place}" for place in ("", "clouds", "raw", "clouds/deeper"))]
PLACES += [f"{SHARD}/raw/0000/view0/depth"]


@pytest.mark.parametrize("place", PLACES)
def test_a_file_put_anywhere_into_a_dataset_stops_overwriting(tmp_path, source, configure, way, place):
    config = configure("output: {format: npz, keep_raw: true}")
    build_dataset(config, source, tmp_path / "out")
    make(tmp_path / "out" / place)
    before = tree(tmp_path)
    with pytest.raises(CacheError, match="also holds"):
        build_dataset(config, source, tmp_path / "out", overwrite=True)
    assert tree(tmp_path) == before


@pytest.mark.parametrize("place", [".", f"{SHARD}/clouds"])
def test_a_file_put_into_a_dataset_during_overwriting_stays_and_the_old_dataset_too(
    tmp_path, source, configure, way, place
):
    config = configure("output: {format: npz}")
    build_dataset(config, source, tmp_path / "out")
    before = tree(tmp_path / "out")
    with pytest.raises(CacheError, match=r"also holds|somebody else"):
        build_dataset(
            config,
            source,
            tmp_path / "out",
            overwrite=True,
            progress=meanwhile(lambda: make(tmp_path / "out" / place)),
        )
    assert tree(tmp_path / "out") == before | {os.path.normpath(f"{place}/thesis.tex"): b"years"}


def test_a_file_put_into_the_old_dataset_while_it_is_deleted_is_kept_and_told(tmp_path, source, configure, monkeypatch):
    config = configure("output: {format: npz}")
    build_dataset(config, source, tmp_path / "out")
    unlink = os.unlink

    def late(path, **how):
        if "replaced" in str(path):
            make(Path(path).parent)
        unlink(path, **how)

    monkeypatch.setattr("pcdata.files.whole_folders.os.unlink", late)
    report = build_dataset(config, source, tmp_path / "out", overwrite=True)
    assert len(CachedCloudDataset(tmp_path / "out")) == 3
    (kept,) = tmp_path.rglob("thesis.tex")
    assert any(str(kept.parent.parent) in note and "kept" in note for note in report.notes)


def test_a_dataset_that_another_build_put_there_meanwhile_is_not_replaced(tmp_path, source, configure, way):
    build_dataset(configure(), source, tmp_path / "out")
    build_dataset(configure(), Clouds({"theirs": cloud()}), tmp_path / "other")

    def replace() -> None:
        shutil.rmtree(tmp_path / "out")
        (tmp_path / "other").rename(tmp_path / "out")

    with pytest.raises(CacheError, match="somebody else"):
        build_dataset(configure(), source, tmp_path / "out", overwrite=True, progress=meanwhile(replace))
    assert CachedCloudDataset(tmp_path / "out").ids == ["theirs"]


def test_a_link_in_a_dataset_is_not_what_a_build_wrote(tmp_path, source, configure):
    config = configure("output: {format: npz}")
    build_dataset(config, source, tmp_path / "out")
    (tmp_path / "out" / SHARD / "clouds").rename(tmp_path / "big_disk")
    (tmp_path / "out" / SHARD / "clouds").symlink_to(tmp_path / "big_disk")
    with pytest.raises(CacheError, match="clouds"):
        build_dataset(config, source, tmp_path / "out", overwrite=True)
    assert len(list((tmp_path / "big_disk").iterdir())) == 3


# -- two builds into one folder ------------------------------------------------------------------------------------


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_second_build_into_a_folder_that_is_being_written_fails_at_its_start(tmp_path, source, configure, overwrite):
    loaded = []

    class Second(Clouds):
        def load(self, sample_id):
            loaded.append(sample_id)
            return super().load(sample_id)

    def second() -> None:
        with pytest.raises(CacheError, match=r"another process writes it now.*another folder"):
            build_dataset(configure(), Second({"a": cloud()}), tmp_path / "out", overwrite=overwrite)

    build_dataset(configure(), source, tmp_path / "out", progress=meanwhile(second))
    assert not loaded
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert CachedCloudDataset(tmp_path / "out").ids == source.ids


@pytest.mark.parametrize("overwrite", [False, True])
def test_of_builds_that_start_together_one_succeeds(tmp_path, configure, overwrite):
    if overwrite:
        build_dataset(configure(), Clouds({"old": cloud()}), tmp_path / "out")
    start, done = threading.Barrier(4), []

    def build(name: str) -> None:
        start.wait()
        try:
            build_dataset(configure(), Clouds({name: cloud()}), tmp_path / "out", overwrite=overwrite)
        except CacheError:
            pass
        else:
            done.append(name)

    threads = [threading.Thread(target=build, args=(f"build{n}",)) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    # One that starts after another has ended may overwrite that; without overwriting there is one at most.
    assert done if overwrite else len(done) == 1
    assert CachedCloudDataset(tmp_path / "out").ids[0] in done
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


# -- what killed builds leave --------------------------------------------------------------------------------------


def of_a_dead_process(folder: Path, what: str) -> Path:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    name = scratch.hidden_name(folder, what)
    return folder.with_name(name.replace(f"-{os.getpid()}-", f"-{process.pid}-"))


def test_a_dataset_set_aside_by_a_killed_overwrite_comes_back(tmp_path, source, configure):
    build_dataset(configure(), source, tmp_path / "out")
    before = tree(tmp_path)
    retired = of_a_dead_process(tmp_path / "out", "retired")
    (tmp_path / "out").rename(retired)
    with pytest.raises(CacheError, match="exists already"):
        build_dataset(configure(), Clouds({"a": cloud()}), tmp_path / "out")
    assert tree(tmp_path) == before
    (tmp_path / "out").rename(retired)
    report = build_dataset(configure(), Clouds({"a": cloud()}), tmp_path / "out", overwrite=True)
    assert any("restored" in note and retired.name in note for note in report.notes)
    assert CachedCloudDataset(tmp_path / "out").ids == ["a"]
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_opening_a_dataset_that_a_killed_overwrite_had_set_aside_says_where_it_is(tmp_path, source, configure):
    build_dataset(configure(), source, tmp_path / "out")
    retired = of_a_dead_process(tmp_path / "out", "retired")
    (tmp_path / "out").rename(retired)
    with pytest.raises(CacheError, match="rename it back") as caught:
        CachedCloudDataset(tmp_path / "out")
    assert str(retired) in str(caught.value)
    retired.rename(tmp_path / "out")
    assert len(CachedCloudDataset(tmp_path / "out")) == 3


@pytest.mark.parametrize("what", ["replaced", "retired"])
@pytest.mark.parametrize(
    "removed", [[], [f"{SHARD}/clouds.h5"], ["shards", "index/ids.npy", "load.py"]], ids=["whole", "in part", "mostly"]
)
def test_an_old_dataset_whose_removal_was_killed_is_removed_by_the_next_build(
    tmp_path, source, configure, what, removed
):
    build_dataset(configure(), source, tmp_path / "out")
    shutil.copytree(tmp_path / "out", old := of_a_dead_process(tmp_path / "out", what))
    for name in removed:
        shutil.rmtree(old / name) if (old / name).is_dir() else (old / name).unlink()
    report = build_dataset(configure(), source, tmp_path / "out", overwrite=True)
    assert any(old.name in note for note in report.notes)
    assert [path.name for path in tmp_path.iterdir()] == ["out"], report.notes


def test_a_set_aside_folder_with_somebody_s_file_is_told_and_kept(tmp_path, source, configure):
    retired = of_a_dead_process(tmp_path / "out", "replaced")
    build_dataset(configure(), source, retired)
    make(retired)
    report = build_dataset(configure(), source, tmp_path / "out")
    assert (retired / "thesis.tex").exists()
    assert any("thesis.tex" in note for note in report.notes)


@pytest.mark.parametrize("name", ["x" * 255, "ü" * 127, "with-dash", "[glob]*?"])
def test_names_of_any_length_can_be_written_and_overwritten(tmp_path, source, configure, way, name):
    build_dataset(configure(), source, tmp_path / name)
    build_dataset(configure(), Clouds({"a": cloud()}), tmp_path / name, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert CachedCloudDataset(tmp_path / name).ids == ["a"]


def test_a_name_that_is_too_long_is_a_cache_error(tmp_path, source, configure):
    with pytest.raises(CacheError, match="too long"):
        build_dataset(configure(), source, tmp_path / ("x" * 256))
    assert not list(tmp_path.iterdir())


def test_a_folder_whose_name_is_no_utf8_round_trips(tmp_path, source, configure):
    out = tmp_path / os.fsdecode(b"\xff\xfe-out")
    build_dataset(configure(), source, out)
    build_dataset(configure(), Clouds({"scan": cloud()}), out, overwrite=True)
    assert next(iter(CachedCloudDataset(out))).meta[0]["sample_id"] == "scan"


def test_a_sample_whose_name_is_no_utf8_is_refused_before_anything_is_written(tmp_path, source, configure):
    with pytest.raises(CaptureError, match="names must be UTF-8 text"):
        build_dataset(configure(), Clouds({os.fsdecode(b"scan\xff"): cloud()}), tmp_path / "out")
    assert not list(tmp_path.iterdir())
