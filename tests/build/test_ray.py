"""Builds on a Ray cluster of this machine: the same bytes, also where a worker is killed midway."""

from __future__ import annotations

import importlib.util
import os
import signal
from pathlib import Path

import pytest

from pcdata import CachedCloudDataset
from pcdata.build import build_dataset, config_from_yaml
from pcdata.build.engines.on_ray import _start
from pcdata.errors import CacheError, MissingExtraError
from tests.build.test_builder import Clouds, cloud, tree

CONFIG = "cloud: [Center]\noutput: {format: npz, shard_size: 2}"


class Killing(Clouds):
    """Ten clouds, one of which ends its process, and another one does so once; c8 cannot be read, c6 takes too long."""

    def __init__(self, folder: Path):
        super().__init__({f"c{n}": cloud(20 + n) for n in range(10)})
        self.folder = str(folder)

    def load(self, sample_id):
        first = Path(self.folder, f"loaded-{sample_id}")
        if sample_id == "c3" or (sample_id == "c5" and not first.exists()):
            first.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        if sample_id == "c6":
            signal.pause()
        if sample_id == "c8":
            raise OSError("bad sector")
        return super().load(sample_id)


class _Ray:
    """What is asked of Ray when one is started; the first so many starts fail."""

    def __init__(self, failing: int):
        self.failing, self.told = failing, []

    def init(self, **options):
        self.told.append("init")
        if len(self.told) <= 2 * self.failing:
            raise Exception("The current node timed out during startup.")

    def shutdown(self):
        self.told.append("shutdown")


def test_a_busy_machine_gets_several_tries_to_start_ray_and_a_cluster_one(monkeypatch):
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    slow, dead = _Ray(3), _Ray(99)
    _start(slow)
    assert slow.told == ["init", "shutdown"] * 3 + ["init"]
    with pytest.raises(CacheError, match="timed out during startup"):
        _start(dead)
    assert dead.told == ["init", "shutdown"] * 4
    monkeypatch.setenv("RAY_ADDRESS", "10.0.0.1:6379")
    dead = _Ray(99)
    with pytest.raises(CacheError, match="RAY_ADDRESS"):
        _start(dead)
    assert dead.told == ["init", "shutdown"]


def test_without_ray_the_command_that_installs_it_is_told(tmp_path, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == "ray" else find(name, *a))
    with pytest.raises(MissingExtraError, match=r"pcdata\[ray\]"):
        build_dataset(config_from_yaml(CONFIG), Clouds({"a": cloud()}), tmp_path / "out", engine="ray")
    assert not list(tmp_path.iterdir())


@pytest.mark.ray
@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed")
@pytest.mark.filterwarnings("ignore")
def test_tasks_of_ray_give_the_same_bytes_and_lose_what_ends_its_process(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).resolve().parents[2]))
    config = config_from_yaml(CONFIG)
    calm = Clouds({f"c{n}": cloud(20 + n) for n in range(10)})
    build_dataset(config, calm, tmp_path / "plain")
    news = []
    build_dataset(config, calm, tmp_path / "ray", engine="ray", workers=2, progress=lambda *one: news.append(one))
    assert tree(tmp_path / "ray") == tree(tmp_path / "plain")
    assert [one[0] for one in news] == [*range(1, 11)]
    (tmp_path / "marks").mkdir()
    report = build_dataset(config, Killing(tmp_path / "marks"), tmp_path / "hurt", engine="ray", workers=2, timeout=20)
    assert list(report.quarantined) == ["c3", "c6", "c8"]
    assert report.quarantined["c3"].startswith("ProcessEnded: ")
    assert report.quarantined["c6"] == "TimeoutError: took longer than 20 s"
    assert report.quarantined["c8"] == "OSError: bad sector"
    url = f"file://{tmp_path}/at_url"
    build_dataset(config, calm, url, engine="ray", workers=2)
    assert tree(tmp_path / "at_url") == tree(tmp_path / "plain")
    assert CachedCloudDataset(tmp_path / "hurt").ids == ["c0", "c1", "c2", "c4", "c5", "c7", "c9"]
