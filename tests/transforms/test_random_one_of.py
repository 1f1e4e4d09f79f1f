"""RandomOneOf: one of several steps, drawn by weights."""

from __future__ import annotations

import json
import math

import pytest
import torch

from pcdata import transforms as T
from pcdata.errors import ConfigError, ReplayError
from pcdata.rng import Streams, seeded
from tests.factories import assert_same, cloud_in_base
from tests.messages import told as message

MANY = 600


def chosen(step: T.RandomOneOf, count: int = MANY) -> list[int]:
    cloud = cloud_in_base((1,) * count)
    return step.make_params(cloud, Streams.of(seeded(0), count))["chosen"].tolist()


def test_steps_are_drawn_by_their_weights():
    steps = [T.RandomFlip(), T.RandomScale(), T.RandomRotation(), T.RandomShear()]
    weights = (0.0, 3.0, 1.0, 0.0)
    for given in (weights, tuple(1e-6 * one for one in weights), tuple(1e6 * one for one in weights)):
        counts = torch.bincount(torch.tensor(chosen(T.RandomOneOf(steps=steps, weights=given))), minlength=4)
        assert counts[0] == counts[3] == 0
        assert abs(int(counts[1]) / MANY - 0.75) < 4 * math.sqrt(0.75 * 0.25 / MANY)
    counts = torch.bincount(torch.tensor(chosen(T.RandomOneOf(steps=steps))), minlength=4)
    assert bool((counts - MANY / 4).abs().lt(4 * math.sqrt(MANY * 0.25 * 0.75)).all())


def test_each_cloud_is_what_its_step_makes_of_it():
    cloud = cloud_in_base((30,) * 20)
    inner = [T.RandomFlip(probability=(1, 0, 0)), T.RandomFlip(probability=(0, 1, 0)), T.Compose([])]
    result = T.RandomOneOf(steps=inner)(cloud, generator=seeded(1))
    seen = set()
    for before, after in zip(cloud.unbatch(), result.unbatch()):
        number = after.history[0][-1]["params"]["chosen"]
        seen.add(number)
        signs = torch.tensor([[-1.0, 1, 1], [1, -1, 1], [1, 1, 1]])[number]
        torch.testing.assert_close(after.points, before.points * signs)
        names = [entry["step"] for entry in after.history[0]]
        assert names == ["Recorded", *["RandomFlip"] * (number < 2), "RandomOneOf"]
    assert seen == {0, 1, 2}


def test_which_step_is_drawn_shifts_no_later_draw():
    factors = []
    for weights in ((1.0, 0.0), (0.0, 1.0)):
        chain = T.Compose([T.RandomOneOf(steps=[T.RandomFlip(), T.RandomJitter()], weights=weights), T.RandomScale()])
        result = chain(cloud_in_base((20,)), generator=seeded(5))
        factors.append(result.history[0][-1]["params"]["matrix"])
    assert factors[0] == factors[1]


def test_choices_within_choices_are_repeated():
    inner = T.RandomOneOf(steps=[T.RandomFlip(), T.Compose([T.RandomScale(), T.RandomPointDropout()]), T.Compose([])])
    chain = T.Compose([T.RandomApply(step=inner, probability=0.8), T.RandomOneOf(steps=[inner, T.RandomJitter()])])
    data = cloud_in_base((60, 40, 50, 30))
    for seed in range(6):
        result = chain(data, generator=seeded(seed))
        history = json.loads(json.dumps(list(result.history)))
        assert_same(chain.replay(data, history), result)
        assert_same(T.Compose.from_yaml(chain.to_yaml()).replay(data, history), result)


@pytest.mark.parametrize("wrong", [-1, 2, True, 0.5, None, "0", [0]])
def test_a_damaged_choice_is_refused(wrong):
    step = T.RandomOneOf(steps=[T.RandomFlip(), T.RandomScale()])
    cloud = cloud_in_base((50,))
    history = json.loads(json.dumps(list(step(cloud, generator=seeded(0)).history)))[0]
    history[-1]["params"]["chosen"] = wrong
    with pytest.raises(ReplayError, match="RandomOneOf"):
        step.replay(cloud, history)


def test_a_step_that_changes_the_frame_or_the_unit_is_refused():
    for step, why in (
        (T.Center(), "Center leads to frame 'a frame/centered'"),
        (T.ToFrame(frame="base"), "ToFrame leads to frame 'base'"),
        (T.NormalizeUnitSphere(), "NormalizeUnitSphere changes the unit"),
        (T.Compose([T.RandomFlip(), T.Center()]), "Compose leads to frame"),
    ):
        with pytest.raises(ConfigError, match=f"RandomOneOf: {why}"):
            T.RandomOneOf(steps=[T.RandomFlip(), step])
    crop = T.CropWorkspace(frame="base", lower=(-1, -1, -1), upper=(1, 1, 1))
    T.RandomOneOf(steps=[crop, T.RandomFlip()])


def test_what_cannot_be_drawn_from_is_refused():
    flip = T.RandomFlip()
    with pytest.raises(ConfigError, match="steps must name steps"):
        T.RandomOneOf(steps=[])
    for weights in ((1.0,), (0.0, 0.0), (1.0, 2.0, 3.0)):
        with pytest.raises(ConfigError, match="weights must be 2 numbers"):
            T.RandomOneOf(steps=[flip, flip], weights=weights)
    with pytest.raises(ConfigError, match=r"weights\.1"):
        T.RandomOneOf(steps=[flip, flip], weights=(1.0, -1.0))
    with pytest.raises(ConfigError, match="RandomOneOf: RandomFlip does not turn captures into captures"):
        T.RandomOneOf(steps=[T.MaskDepth(), flip])
    with pytest.raises(ConfigError, match="RandomOneOf: RandomFlip does not turn captures into captures"):
        T.RandomOneOf(steps=[flip, T.Deproject()])


def test_an_error_names_the_step_that_was_drawn():
    far = T.CropWorkspace(frame="base", lower=(8, 8, 8), upper=(9, 9, 9))
    with pytest.raises(Exception, match="nothing is left") as caught:
        T.RandomOneOf(steps=[T.RandomFlip(), far], weights=(0, 1))(cloud_in_base((9,)), generator=seeded(0))
    assert "in CropWorkspace(" in message(caught.value)
    assert "in RandomOneOf(" in message(caught.value)
