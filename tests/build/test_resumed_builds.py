"""Builds that are stopped go on, and give the same bytes whoever does which part of the work."""

from __future__ import annotations

import os
import random
import shutil
import signal
import time
from pathlib import Path

import pytest
import torch

from pcdata import CachedCloudDataset, open_source
from pcdata.build import build_dataset, config_from_yaml, outlook
from pcdata.build.building_folder import BuildingFolder
from pcdata.errors import CacheError, CaptureError
from pcdata.files import scratch
from pcdata.io.clouds.ply import write_ply
from pcdata.structures import Episode
from tests.build.test_builder import FORMATS, Clouds, cloud, tree
from tests.forks import ended, forked

SIZE = 2
CONFIG = "cloud: [Center]\noutput: {format: FORMAT, shard_size: 2}"


def config_of(form: str = "npz"):
    return config_from_yaml(CONFIG.replace("FORMAT", form))


class Counted(Clouds):
    """Eleven clouds with a signal and episodes; says how often it was loaded, and stops where it is told to."""

    def __init__(self, count: int = 11, stop_at: str = ""):
        one = torch.arange(3.0)[None]
        samples = {f"c{n:02d}": cloud(20 + n).with_signal("joints", one + n, "invariant") for n in range(count)}
        super().__init__(samples)
        self.stop_at, self.loaded = stop_at, []
        self.episodes = [Episode("a", 0, 4), Episode("b", 4, count - 4)]

    def __len__(self):
        return len(self.ids)

    def load(self, sample_id):
        self.loaded.append(sample_id)
        if sample_id == self.stop_at:
            raise KeyboardInterrupt
        return super().load(sample_id)

    def __getstate__(self):
        return {**self.__dict__, "loaded": [], "stop_at": ""}


def build(out: Path, form: str = "npz", source: Clouds | None = None, **how):
    return build_dataset(config_of(form), source or Counted(), out, **how)


@pytest.fixture(autouse=True)
def forks(monkeypatch):
    """Workers that need not load torch again."""
    monkeypatch.setattr("pcdata.build.engines.pool.START", "fork")
    torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def same_state(monkeypatch):
    """The state of a source is that of its samples, not of what a test counts."""
    monkeypatch.setattr(
        "pcdata.build.source_state._settings", lambda source: sorted(getattr(source, "samples", {"": 0})), raising=True
    )


# -- the same bytes ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMATS)
def test_the_bytes_are_the_same_whichever_way_a_dataset_was_built(tmp_path, form):
    build(tmp_path / "plain", form)
    wanted = tree(tmp_path / "plain")
    assert {name.split("/")[0] for name in wanted} == {
        "README.md", "croissant.json", "texts.sha256", "dataset.json", "pipeline.yaml", "load.py", "index", "shards",
        "signals",
    }  # fmt: skip
    for workers in (1, 2):
        build(tmp_path / f"pool{workers}", form, workers=workers)
        assert tree(tmp_path / f"pool{workers}") == wanted
    reports = [build(tmp_path / "parts", form, part=(k, 3)) for k in (2, 0, 1)]
    assert [report.is_complete for report in reports] == [False, False, True]
    assert tree(tmp_path / "parts") == wanted
    for stop in ("c01", "c02", "c07", "c10"):
        with pytest.raises(KeyboardInterrupt):
            build(tmp_path / "stopped", form, Counted(stop_at=stop))
    build(tmp_path / "stopped", form)
    assert tree(tmp_path / "stopped") == wanted
    assert sorted(path.name for path in tmp_path.iterdir()) == ["parts", "plain", "pool1", "pool2", "stopped"]
    data = CachedCloudDataset(tmp_path / "stopped")
    assert data.signal_table()["joints"].values[:, 0].tolist() == [float(n) for n in range(11)]
    assert [(one.id, one.length) for one in data.episodes] == [("a", 4), ("b", 7)]


# -- going on ------------------------------------------------------------------------------------------------------


def test_a_stopped_build_loads_what_is_left_and_says_what_it_found(tmp_path):
    with pytest.raises(KeyboardInterrupt) as caught:
        build(tmp_path / "out", source=Counted(stop_at="c05"))
    assert any("2 of 6 shards are finished" in note for note in getattr(caught.value, "__notes__", caught.value.args))
    assert sorted(os.listdir(tmp_path)) == [".out.building"]
    told, source, news = [], Counted(), []
    report = build(tmp_path / "out", source=source, note=told.append, progress=lambda *one: news.append(one))
    assert source.loaded == [f"c{n:02d}" for n in range(4, 11)]
    assert told == report.notes == ["2 of 6 shards were finished before"]
    assert news[0] == (5, 11, "c04")
    assert [sample.id for sample in report.samples] == source.ids
    assert os.listdir(tmp_path) == ["out"]


def test_another_build_in_the_way_is_refused_with_the_ways_out(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        build(tmp_path / "out", source=Counted(stop_at="c05"))
    before = tree(tmp_path)
    with pytest.raises(CacheError, match=r"2 finished shards.*differs in its output;.*another folder.*--restart"):
        build(tmp_path / "out", "pt")
    with pytest.raises(CacheError, match=r"differs in its source, captures \(11 there, 7 now\)"):
        build(tmp_path / "out", source=Counted(7))
    assert tree(tmp_path) == before
    report = build(tmp_path / "out", "pt", restart=True)
    assert any("deleted 2 finished shards" in note for note in report.notes)
    assert os.listdir(tmp_path) == ["out"]


def test_restart_begins_anew_with_the_same_settings_too(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        build(tmp_path / "out", source=Counted(stop_at="c05"))
    source = Counted()
    build(tmp_path / "out", source=source, restart=True)
    assert source.loaded == source.ids


def test_a_build_without_a_finished_shard_is_in_nobody_s_way(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        build(tmp_path / "out", source=Counted(stop_at="c01"))
    assert not os.listdir(tmp_path)
    (tmp_path / ".out.building" / "records").mkdir(parents=True)
    (tmp_path / ".out.building" / "plan.json").write_text("{")
    build(tmp_path / "out")
    assert os.listdir(tmp_path) == ["out"]


@pytest.mark.parametrize("harm", ["record", "file", "missing", "foreign"])
def test_what_is_damaged_is_built_anew(tmp_path, harm):
    build(tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        build(tmp_path / "out", source=Counted(stop_at="c05"))
    building = tmp_path / ".out.building"
    record, (shard,) = building / "records" / "00001.json", (building / "shards").glob("00001-*")
    if harm == "record":
        record.write_bytes(record.read_bytes().replace(b'"c02"', b'"c2"'))
    elif harm == "foreign":
        record.write_bytes((building / "records" / "00000.json").read_bytes())
    elif harm == "missing":
        shutil.rmtree(shard)
    else:
        file = next((shard / "shard").rglob("*.npz"))
        file.write_bytes(file.read_bytes()[:-1])
    source = Counted()
    build(tmp_path / "out", source=source)
    assert source.loaded == [f"c{n:02d}" for n in range(2, 11)]
    assert tree(tmp_path / "out") == tree(tmp_path / "whole")


def test_only_shards_of_captures_that_changed_are_built_anew(tmp_path):
    (tmp_path / "in").mkdir()
    for n in range(6):
        write_ply(tmp_path / "in" / f"c{n}.ply", cloud(30 + n))
    config = config_from_yaml("cloud: [Center]\noutput: {format: npz, shard_size: 2}")
    source = open_source(tmp_path / "in")

    def stop(done: int, total: int, name: str) -> None:
        if done == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build_dataset(config, source, tmp_path / "out", progress=stop)
    write_ply(tmp_path / "in" / "c1.ply", cloud(50))
    report = build_dataset(config, open_source(tmp_path / "in"), tmp_path / "out")
    assert report.notes == [
        "built anew: 1 finished shard, since a file of their captures has changed",
        "1 of 3 shards were finished before",
    ]
    assert CachedCloudDataset(tmp_path / "out")[1].num_points == 50


@pytest.mark.parametrize("hash_captures", [False, True])
def test_a_large_file_with_other_content_of_the_same_size_and_time_is_told_by_its_hash(tmp_path, hash_captures):
    (tmp_path / "in").mkdir()
    paths = [tmp_path / "in" / f"c{n}.ply" for n in range(3)]
    for path in paths:
        write_ply(path, cloud(9000))
    assert paths[0].stat().st_size > 1 << 16
    config = config_from_yaml("cloud: [Center]\noutput: {format: npz, shard_size: 1}")

    def stop(done: int, total: int, name: str) -> None:
        if done == 2:
            raise KeyboardInterrupt

    def go_on(**how):
        return build_dataset(config, open_source(tmp_path / "in"), tmp_path / "out", **how)

    with pytest.raises(KeyboardInterrupt):
        go_on(progress=stop, hash_captures=hash_captures)
    before = paths[0].stat()
    content = bytearray(paths[0].read_bytes())
    content[-12:] = bytes(12)
    paths[0].write_bytes(content)
    os.utime(paths[0], ns=(before.st_atime_ns, before.st_mtime_ns))
    with pytest.raises(CacheError, match="differs in its hash_captures"):
        go_on(hash_captures=not hash_captures)
    found = outlook(config, open_source(tmp_path / "in"), tmp_path / "out", hash_captures=hash_captures)
    assert found.num_finished == 1 - hash_captures
    told = "built anew: 1 finished shard, since a file of their captures has changed"
    assert (told in go_on(hash_captures=hash_captures).notes) is hash_captures


def test_captures_that_change_after_their_shard_was_finished_are_not_mixed(tmp_path):
    (tmp_path / "in").mkdir()
    for n in range(4):
        write_ply(tmp_path / "in" / f"c{n}.ply", cloud(30 + n))
    config = config_from_yaml("cloud: [Center]\noutput: {format: npz, shard_size: 2}")

    def change(done: int, total: int, name: str) -> None:
        if done == 3:
            write_ply(tmp_path / "in" / "c0.ply", cloud(50))

    with pytest.raises(CaptureError, match=r"captures 'c0' to 'c1' was changed"):
        build_dataset(config, open_source(tmp_path / "in"), tmp_path / "out", progress=change)
    build_dataset(config, open_source(tmp_path / "in"), tmp_path / "out")
    assert CachedCloudDataset(tmp_path / "out")[0].num_points == 50


# -- several processes ---------------------------------------------------------------------------------------------


def test_parts_are_put_into_place_by_finalize_only_when_all_are_there(tmp_path):
    assert not build(tmp_path / "out", part=(0, 2)).is_complete
    with pytest.raises(CacheError, match="3 of 6 shards are not finished; build them first"):
        build(tmp_path / "out", finalize=True)
    with BuildingFolder(tmp_path / "out").claim("finish", print):  # another process begins to, and ends
        report = build(tmp_path / "out", part=(1, 2))
    assert (report.num_finished, report.is_complete) == (6, False)
    assert report.notes == ["another process puts the dataset into place"]
    report = build(tmp_path / "out", finalize=True)
    assert report.is_complete
    assert len(report.samples) == 11


def test_the_same_part_twice_at_once_is_told_and_another_part_is_not(tmp_path):
    def meanwhile(done: int, total: int, name: str) -> None:
        if done == 1:
            with pytest.raises(CacheError, match=r"another process writes it now.*--shard-index"):
                build(tmp_path / "out", part=(0, 2))
            assert build(tmp_path / "out", part=(1, 2)).num_finished == 3

    assert build(tmp_path / "out", part=(0, 2), progress=meanwhile).is_complete
    assert os.listdir(tmp_path) == ["out"]


def test_a_part_and_the_whole_share_the_work(tmp_path):
    whole = Counted()

    def meanwhile(done: int, total: int, name: str) -> None:
        if done == 1:
            build(tmp_path / "out", part=(1, 2))

    assert build(tmp_path / "out", source=whole, progress=meanwhile).is_complete
    assert whole.loaded == [name for n, name in enumerate(whole.ids) if n // SIZE % 2 == 0]


@pytest.mark.parametrize("locks", [True, False])
def test_what_dead_processes_left_is_taken_over_with_locks_and_without(tmp_path, monkeypatch, locks):
    if not locks:  # as on some network file systems
        monkeypatch.setattr(scratch, "try_lock", lambda path: (None, False))
    build(tmp_path / "whole")

    def dies(done: int, *_: object) -> None:
        if done == 6:
            os.kill(os.getpid(), signal.SIGKILL)

    assert ended(forked(lambda: build(tmp_path / "out", progress=dies) and 1)) == -signal.SIGKILL
    left = [path.name for path in (tmp_path / ".out.building").rglob("*")]
    assert any(name.startswith("all.") for name in left)
    assert any(name.startswith(".00002.partial-") for name in left)
    build(tmp_path / "out")
    assert tree(tmp_path / "out") == tree(tmp_path / "whole")
    assert sorted(os.listdir(tmp_path)) == ["out", "whole"]


def test_a_process_that_lives_keeps_its_claim_without_locks_too(tmp_path, monkeypatch):
    monkeypatch.setattr(scratch, "try_lock", lambda path: (None, False))

    def meanwhile(done: int, total: int, name: str) -> None:
        if done == 1:
            with pytest.raises(CacheError, match="another process writes it now"):
                build(tmp_path / "out")

    build(tmp_path / "out", progress=meanwhile)


def test_builds_killed_at_any_moment_end_in_the_same_bytes(tmp_path):
    """benchmarks/kill_builds.py does the same fifty times, in more ways."""
    random.seed(0)
    build(tmp_path / "whole", source=_Slow())  # whose class is in the identity
    for workers in (0, 2):
        for _ in range(4):

            def builds(workers: int = workers) -> None:
                os.setpgid(0, 0)
                build(tmp_path / "out", workers=workers, source=_Slow(), overwrite=True)

            pid = forked(builds)
            time.sleep(random.uniform(0.02, 0.25))
            os.kill(pid, signal.SIGKILL)
            assert ended(pid) in (0, -signal.SIGKILL)  # 0: it was done before
            while scratch.living_claims(tmp_path / ".out.building" / "claims"):
                time.sleep(0.02)  # forked workers hold the lock of their parent, until they find that it is gone
        build(tmp_path / "out", workers=workers, source=_Slow(), overwrite=True)
        assert tree(tmp_path / "out") == tree(tmp_path / "whole")
        assert sorted(os.listdir(tmp_path)) == ["out", "whole"]
        shutil.rmtree(tmp_path / "out")


class _Slow(Counted):
    def load(self, sample_id):
        time.sleep(0.04)
        return super().load(sample_id)


# -- looking ahead -------------------------------------------------------------------------------------------------


def test_an_outlook_tells_what_is_finished_and_writes_nothing(tmp_path):
    told = outlook(config_of(), Counted(), tmp_path / "out")
    assert (told.num_samples, told.num_shards, told.num_finished, told.hindrances) == (11, 6, 0, [])
    assert not os.listdir(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        build(tmp_path / "out", source=Counted(stop_at="c05"))
    told = outlook(config_of(), Counted(), tmp_path / "out")
    assert told.num_finished == 2
    assert told.bytes_finished > 1000
    (hindrance,) = outlook(config_of("pt"), Counted(), tmp_path / "out").hindrances
    assert "differs in its output" in hindrance
    build(tmp_path / "out")
    assert outlook(config_of(), Counted(), tmp_path / "out").hindrances == [
        "a dataset is there; --overwrite replaces it"
    ]
