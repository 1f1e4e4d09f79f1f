"""Captures that fail: tried once more, quarantined, named with their error; and when a build stops for them."""

from __future__ import annotations

import json
import os
import signal
import time
from contextlib import nullcontext
from types import SimpleNamespace

import pytest
import torch

from pcdata import CachedCloudDataset
from pcdata.build import build_dataset, config_from_yaml
from pcdata.build.tally import most_bad
from pcdata.errors import (
    CacheError,
    CaptureError,
    ConfigError,
    FrameError,
    PcdataError,
    TooFewPointsError,
    VolumeTooLargeError,
    is_out_of_memory,
)
from pcdata.io.store.manifest import Manifest
from tests.build.test_builder import FORMATS, Clouds, cloud, tree

CONFIG = "cloud: [FarthestPointSample: {num_points: 8}]\noutput: {format: npz, shard_size: 3}"


class Moody(Clouds):
    """Clouds, some of which do something else first: raise, hang, or end their process.

    How often each was loaded is kept in files, so that it is known in whichever process.
    """

    def __init__(self, samples, moods, folder):
        super().__init__(samples)
        self.moods, self.folder = SimpleNamespace(of=moods), folder  # no setting, so that a build does not depend on it

    def load(self, sample_id):
        with open(self.folder / sample_id, "a") as file:
            file.write(".")
        moods = self.moods.of.get(sample_id, [])
        mood = moods[min(self.times(sample_id), len(moods)) - 1] if moods else ""
        if isinstance(mood, BaseException):
            raise mood
        if mood == "hang":
            time.sleep(60)
        if mood == "exit":
            os._exit(7)
        if mood == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        return super().load(sample_id)

    def times(self, sample_id):
        return len((self.folder / sample_id).read_text())

    def __getstate__(self):
        return self.__dict__


@pytest.fixture(autouse=True)
def same_identity(monkeypatch):
    """Moods are no settings of a source, so that builds with them are to be the same as without."""
    of = "pcdata.build.source_state._settings"
    monkeypatch.setattr(of, lambda source: sorted(getattr(source, "samples", ())), raising=True)


@pytest.fixture
def moody(tmp_path):
    """Return a function from moods to ten clouds that have them."""

    def make(**moods) -> Moody:
        folder = tmp_path / "times"
        folder.mkdir(exist_ok=True)
        return Moody({f"c{n}": cloud(20 + n) for n in range(10)}, moods, folder)

    return make


@pytest.fixture(autouse=True)
def forks(monkeypatch):
    """Workers that need not load torch again; tests/build/test_engines.py spawns them as builds do."""
    monkeypatch.setattr("pcdata.build.engines.pool.START", "fork")
    torch.set_num_threads(1)


@pytest.mark.parametrize("form", FORMATS)
def test_a_capture_that_raises_is_left_out_and_named_with_its_error(tmp_path, form):
    config = config_from_yaml(CONFIG.replace("npz", form))
    samples = {"ok": cloud(), "few": cloud(3), "odd": cloud(meta=[{"score": float("nan")}]), "last": cloud()}
    samples["bad"] = OSError(5, "bad sector")
    report = build_dataset(config, Clouds(samples), tmp_path / "out")
    assert list(report.quarantined) == ["few", "odd", "bad"]
    assert report.quarantined["few"].startswith("TooFewPointsError in FarthestPointSample: ")
    assert report.quarantined["bad"] == "OSError: [Errno 5] bad sector"
    assert Manifest.read(tmp_path / "out").quarantined == report.quarantined
    assert CachedCloudDataset(tmp_path / "out").ids == ["ok", "last"] == [sample.id for sample in report.samples]
    assert report.is_complete


@pytest.mark.parametrize("workers", [0, 1])
def test_what_succeeds_the_second_time_is_stored_in_its_place(tmp_path, moody, workers):
    config = config_from_yaml(CONFIG)
    build_dataset(config, moody(), tmp_path / "calm")
    flaky = moody(c1=[OSError("busy"), ""], c4=[RuntimeError("once"), ""], c5=[RuntimeError("again"), ""])
    for file in flaky.folder.iterdir():
        file.unlink()
    report = build_dataset(config, flaky, tmp_path / "out", workers=workers)
    assert not report.quarantined
    assert tree(tmp_path / "out") == tree(tmp_path / "calm")


def test_a_capture_that_fails_is_loaded_twice_and_others_of_its_shard_once(tmp_path, moody):
    source = moody(c4=[RuntimeError("no")])
    build_dataset(config_from_yaml(CONFIG), source, tmp_path / "out")
    assert {name: source.times(name) for name in source.ids} == {name: 1 + (name == "c4") for name in source.ids}


def test_what_ends_or_blocks_its_process_is_tried_alone_and_quarantined(tmp_path, moody):
    source = moody(c1=["kill"], c4=["exit"], c5=["hang"], c8=[RuntimeError("no")], c9=["kill", ""])
    report = build_dataset(config_from_yaml(CONFIG), source, tmp_path / "out", workers=2, timeout=1)
    assert report.quarantined == {
        "c1": "ProcessEnded: its process ended by SIGKILL",
        "c4": "ProcessEnded: its process ended by exit code 7",
        "c5": "TimeoutError: took longer than 1 s",
        "c8": "RuntimeError: no",
    }
    assert CachedCloudDataset(tmp_path / "out").ids == ["c0", "c2", "c3", "c6", "c7", "c9"]
    assert sorted(path.name for path in tmp_path.iterdir()) == [".out.kept", "out", "times"]
    assert all(source.times(name) == 2 for name in ("c1", "c4", "c5", "c8"))


@pytest.mark.parametrize("workers", [0, 1])
def test_the_first_eight_failing_stop_the_build_with_the_type_of_their_error(tmp_path, moody, workers):
    source = moody(**{f"c{n}": [FrameError("camera, not base")] for n in range(8)})
    with pytest.raises(FrameError, match=r"all of the first 8 captures failed.*'c0': FrameError: camera, not base"):
        build_dataset(config_from_yaml(CONFIG), source, tmp_path / "out", workers=workers)
    assert workers or not (source.folder / "c8").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["times"]


def test_the_first_eight_that_end_their_process_stop_the_build(tmp_path, moody):
    source = moody(**{f"c{n}": ["exit"] for n in range(10)})
    with pytest.raises(CaptureError, match=r"all of the first 8 captures failed.* exit code 7"):
        build_dataset(config_from_yaml(CONFIG.replace("3}", "10}")), source, tmp_path / "out", workers=1)
    assert not (tmp_path / "out").exists()


def test_seven_that_fail_first_do_not_stop_it(tmp_path, moody):
    source = moody(**{f"c{n}": [FrameError("camera")] for n in range(7)})
    report = build_dataset(config_from_yaml(CONFIG), source, tmp_path / "out")
    assert len(report.quarantined) == 7


def test_captures_that_all_fail_leave_nothing_and_raise_what_they_raise(tmp_path):
    with pytest.raises(TooFewPointsError, match=r"all 2 captures failed.*'a': TooFewPointsError in FarthestPoint"):
        build_dataset(config_from_yaml(CONFIG), Clouds({"a": cloud(2), "b": cloud(3)}), tmp_path / "out")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("workers", [0, 1])
@pytest.mark.parametrize(("max_bad", "stops"), [(1, True), ("19%", True), (2, False), ("20%", False), (0, True)])
def test_more_than_max_bad_stop_the_build_which_goes_on_when_more_are_allowed(tmp_path, moody, workers, max_bad, stops):
    source = moody(c4=[RuntimeError("no")], c8=[RuntimeError("no")])
    config = config_from_yaml(CONFIG)
    if stops:
        with pytest.raises(CaptureError, match=r"of 10 captures failed, and at most \d may.*--max-bad") as caught:
            build_dataset(config, source, tmp_path / "out", workers=workers, max_bad=max_bad)
        assert "kept" in str(getattr(caught.value, "__notes__", caught.value))
        assert not (tmp_path / "out").exists()
        with pytest.raises(CaptureError, match="at most"):  # at once
            build_dataset(config, source, tmp_path / "out", workers=workers, max_bad=max_bad)
        assert source.times("c0") == 1
    report = build_dataset(config, source, tmp_path / "out", workers=workers, max_bad=2)
    assert list(report.quarantined) == ["c4", "c8"]
    assert source.times("c0") == 1


def test_max_bad_is_a_count_or_a_share():
    assert [most_bad(one, 250) for one in (None, 3, "3", "1%", "0.5%", "0", "100%")] == [None, 3, 3, 2, 1, 0, 250]
    for wrong in ("1 %", "x", -1, 0.5, True, "-1%", "1.5", "%", "101%", ""):
        with pytest.raises(ConfigError, match="max_bad"):
            most_bad(wrong, 250)


def test_the_text_of_an_error_is_one_line(tmp_path, moody):
    source = moody(c1=[ValueError("one\ntwo\n" + "x" * 10_000)], c2=[AssertionError()])
    report = build_dataset(config_from_yaml(CONFIG), source, tmp_path / "out")
    assert report.quarantined == {"c1": "ValueError: one", "c2": "AssertionError"}
    assert json.loads((tmp_path / "out" / "dataset.json").read_text())["quarantined"] == report.quarantined


def test_a_worker_that_cannot_get_the_source_says_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setattr("pcdata.build.engines.pool.START", "spawn")
    source = Clouds({"a": cloud()})
    source.lock = (lambda: None,)
    with pytest.raises(ConfigError, match="workers=0"):
        build_dataset(config_from_yaml(CONFIG), source, tmp_path / "out", workers=1)
    assert not list(tmp_path.iterdir())


class Killed:
    """Kills the process that unpickles it, but the one that it was made in."""

    def __init__(self, maker):
        self.maker = maker

    def __reduce__(self):
        return _killed, (self.maker,)


def _killed(maker):
    if os.getpid() != maker:
        os.kill(os.getpid(), signal.SIGKILL)
    return Killed(maker)


def test_a_worker_killed_while_it_gets_its_job_blocks_nothing(tmp_path):
    source = Clouds({"a": cloud()})
    source.fate, source.long = Killed(os.getpid()), os.urandom(1 << 20)  # more than a pipe holds
    with pytest.raises(CacheError, match=r"ended twice between two captures .*SIGKILL"):
        build_dataset(config_from_yaml(CONFIG), source, tmp_path / "out", workers=1)
    assert not list(tmp_path.iterdir())


def test_ways_that_do_not_fit_together_are_refused(tmp_path):
    source, config = Clouds({"a": cloud()}), config_from_yaml(CONFIG)
    both = {"part": (0, 1), "finalize": True}
    for wrong in ({"timeout": 1.0}, {"timeout": 0, "workers": 1}, {"workers": -1}, {"workers": True}, both,
                  {"engine": "dask"}, {"part": (2, 2)}):  # fmt: skip
        with pytest.raises(ConfigError, match="build_dataset"):
            build_dataset(config, source, tmp_path / "out", **wrong)
    assert not list(tmp_path.iterdir())


def test_errors_of_every_kind_keep_it(tmp_path, moody):
    source = moody(**{f"c{n}": [KeyError("x")] for n in range(10)})
    with pytest.raises(PcdataError, match="'c0': KeyError: 'x'"):
        build_dataset(config_from_yaml(CONFIG), source, tmp_path / "out")


def torch_error() -> RuntimeError:
    """What PyTorch raises where memory does not suffice."""
    with pytest.raises(RuntimeError) as caught:
        torch.zeros(1 << 42)
    return RuntimeError(str(caught.value))  # without its traceback


@pytest.mark.parametrize("starved", [MemoryError, torch_error])
def test_three_captures_that_lack_memory_stop_the_build_and_are_tried_again(tmp_path, moody, starved):
    config, ids = config_from_yaml(CONFIG), [f"c{n}" for n in range(10)]
    build_dataset(config, moody(), tmp_path / "calm")
    source = moody(**{name: [starved(), starved(), ""] for name in ids[5:9]})
    for file in source.folder.iterdir():
        file.unlink()
    with pytest.raises(CacheError, match="memory does not suffice for 'c8'"):
        build_dataset(config, source, tmp_path / "out")
    report = build_dataset(config, source, tmp_path / "out")
    assert not report.quarantined
    assert any("built anew: " in note and "captures of them ran out of memory" in note for note in report.notes)
    assert tree(tmp_path / "out") == tree(tmp_path / "calm")


def test_one_capture_that_lacks_memory_is_quarantined(tmp_path, moody):
    report = build_dataset(config_from_yaml(CONFIG), moody(c4=[MemoryError()], c5=[torch_error()]), tmp_path / "out")
    assert report.quarantined["c4"] == "MemoryError"
    assert report.quarantined["c5"].startswith("MemoryError: ")
    assert "tried to allocate" in report.quarantined["c5"]


def test_what_torch_raises_where_memory_is_short_is_told_from_other_errors():
    assert is_out_of_memory(torch_error())
    assert is_out_of_memory(MemoryError())
    assert not is_out_of_memory(RuntimeError("shapes do not fit"))
    assert not is_out_of_memory(VolumeTooLargeError("more than the limit"))


def test_quarantined_captures_are_tried_again_and_the_other_shards_kept(tmp_path, moody):
    config = config_from_yaml(CONFIG)
    build_dataset(config, moody(), tmp_path / "calm")
    for file in (tmp_path / "times").iterdir():
        file.unlink()
    source = moody(c4=[ValueError("x"), ValueError("x"), ""])
    assert list(build_dataset(config, source, tmp_path / "out").quarantined) == ["c4"]
    for stop in (KeyboardInterrupt, None):  # a retry that is stopped goes on
        for name in {*source.ids} - {"c4"}:
            (source.folder / name).unlink(missing_ok=True)

        def progress(*told, stop=stop):
            if stop is not None:
                raise stop

        with pytest.raises(stop) if stop else nullcontext():
            report = build_dataset(config, source, tmp_path / "out", retry_quarantined=True, progress=progress)
        assert {*os.listdir(source.folder)} <= {"c3", "c4", "c5"}
    assert (report.quarantined, report.is_complete) == ({}, True)
    assert tree(tmp_path / "out") == tree(tmp_path / "calm")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["calm", "out", "times"]
    with pytest.raises(CacheError, match="no captures of it are quarantined"):
        build_dataset(config, source, tmp_path / "out", retry_quarantined=True)


def test_only_the_same_build_tries_again_and_a_plain_one_begins_anew(tmp_path, moody):
    source, other = moody(c4=[ValueError("x")]), config_from_yaml(CONFIG.replace("8", "9"))
    build_dataset(config_from_yaml(CONFIG), source, tmp_path / "out")
    was = tree(tmp_path / "out")
    with pytest.raises(CacheError, match="differs in its steps"):
        build_dataset(other, source, tmp_path / "out", retry_quarantined=True)
    with pytest.raises(ConfigError, match="without restart, finalize, part"):
        build_dataset(other, source, tmp_path / "out", retry_quarantined=True, part=(0, 2))
    report = build_dataset(config_from_yaml(CONFIG), source, tmp_path / "out", retry_quarantined=True)
    assert list(report.quarantined) == ["c4"]
    assert tree(tmp_path / "out") == was
    report = build_dataset(other, moody(), tmp_path / "out", overwrite=True)
    assert report.notes == []
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "times"]
