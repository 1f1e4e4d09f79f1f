"""The benchmark that trains a policy on windows, in small: what it feeds the two trainings, and that it runs."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest
import torch

from pcdata import collate_windows
from pcdata.synthetic.teleop import CUBE


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    return importlib.import_module("train_teleop")


def test_actions_that_move_point_at_the_cube_of_turned_clouds_and_recorded_ones_do_not(script):
    windows = script.demonstrations(1, (36, 48))
    batch = collate_windows([windows[number] for number in range(4)])  # on the way to the cube
    recorded = batch.clouds.recorded_signals["action"].values[1::2]

    def hits(action):
        clouds = zip(batch.points[:, -1], batch.field("labels")[:, -1], action[:, 1, :3])
        gaps = [(points[labels == CUBE] - target).norm(dim=1).amin() for points, labels, target in clouds]
        return sum(bool(0.02 < gap < 0.044) for gap in gaps)  # from its middle to its nearest corner or face

    assert hits(batch.signals["action"]) == 4
    assert hits(recorded) <= 1  # by chance, where a cloud is hardly turned


def test_a_policy_is_trained_and_tried(script, monkeypatch):
    monkeypatch.setattr(script, "MOST_STEPS", 2)
    windows = script.demonstrations(1, (24, 32))
    run = script.train(windows, moved=True, epochs=1, seed=0, trials=1, size=(24, 32))
    assert run.epochs == [0, 1]
    assert all(0.0 <= share <= 1.0 for share in run.success)
    assert len(run.error) == 1
    assert torch.isfinite(torch.tensor(run.error)).all()
