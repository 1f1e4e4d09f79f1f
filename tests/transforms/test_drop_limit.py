"""Every step that removes points or readings has a limit to how much, and holds it."""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any

import pytest
import torch

from pcdata import transforms as T
from pcdata.errors import PcdataError, TooFewPointsError
from pcdata.rng import seeded
from pcdata.structures import DepthFrame, PointCloud
from pcdata.transforms.families import DropLimit
from tests.factories import tabletop_frame
from tests.transforms.examples import ALL, EXAMPLES, Example

COUNTS = (120, 90)
# They give as many as they say, or as their grid has cells, or are made of steps that have the limit.
BY_NUMBER = {
    *("FarthestPointSample", "RandomFarthestPointSample", "RandomPointCount", "RandomPointDropout", "RandomSample"),
    *("DecimateDepth", "RandomVoxelSample", "ResizeDepth", "Undistort", "VoxelDownsample", "VoxelSample"),
    *("Compose", "RandomApply", "RandomOneOf"),
}
SEEDS = range(4)


def run(step: T.Transform, data: Any, seed: int) -> Any:
    return step(data, generator=seeded(seed) if step.is_random else None)


def counts_of(step: T.Transform, data: Any, result: Any) -> tuple[list[int], list[int]]:
    """The points of each cloud, or the readings of each view, that went in and that came out."""
    if isinstance(data, DepthFrame) and isinstance(result, DepthFrame):
        return tuple((one.depth > 0).flatten(1).sum(1).tolist() for one in (data, result))
    if not isinstance(data, PointCloud):
        return [], []
    if step.keeps_clouds:
        return data.counts.tolist(), result.counts.tolist()
    if isinstance(step, T.SplitObjects):
        owner = torch.repeat_interleave(torch.arange(data.num_clouds), data.counts)
        return data.counts.tolist(), torch.bincount(owner[result.extra["row"]], minlength=data.num_clouds).tolist()
    return [data.num_points], [result.num_points]


def part_lost(step: T.Transform, data: Any, result: Any) -> float:
    before, after = counts_of(step, data, result)
    return max((1 - count / had for had, count in zip(before, after) if had), default=0.0)


def with_limit(step: T.Transform, **limit: Any) -> T.Transform:
    return type(step)(**{**step.config_fields(), "max_drop": None, "drop_alarm": "error", **limit})


def losses(example: Example) -> list[tuple[int, float]]:
    """The part that the example loses, seed by seed."""
    step, data = example.transform, example.make(COUNTS)
    step = with_limit(step) if isinstance(step, DropLimit) else step
    return [(seed, part_lost(step, data, run(step, data, seed))) for seed in (SEEDS if step.is_random else [0])]


@pytest.mark.parametrize("name", EXAMPLES)
def test_whoever_loses_points_or_readings_has_a_limit_or_loses_as_many_as_it_says(name):
    loses = any(part > 0 for example in EXAMPLES[name] for _, part in losses(example))
    assert loses == (issubclass(T.REGISTRY[name], DropLimit) or name in BY_NUMBER)


@pytest.mark.parametrize("name", [name for name in EXAMPLES if issubclass(T.REGISTRY[name], DropLimit)])
def test_losing_more_than_the_limit_is_an_error_or_a_warning(name):
    tried = 0
    for example in EXAMPLES[name]:
        data = example.make(COUNTS)
        for seed, part in losses(example):
            if not part:
                continue
            tried += 1
            step = example.transform
            expected = run(with_limit(step), data, seed)
            within = run(with_limit(step, max_drop=min(1.0, part + 1e-6)), data, seed)
            text = rf"{name}: \d+ of the \d+ (points of cloud|readings of view) \d.*, {part:.1%}, more than max_drop="
            with pytest.raises(TooFewPointsError, match=text):
                run(with_limit(step, max_drop=part - 1e-6), data, seed)
            with pytest.warns(T.LeftOutWarning, match=text):
                warned = run(with_limit(step, max_drop=part - 1e-6, drop_alarm="warn"), data, seed)
            for result in (within, warned):
                assert counts_of(step, data, result) == counts_of(step, data, expected)
    assert tried


def test_a_new_step_that_loses_points_without_a_limit_is_found():
    class FirstHalf(T.SelectTransform, abstract=True):
        def pick(self, cloud, streams):
            keep = torch.arange(cloud.num_points) % 2 == 0
            return keep, torch.nn.functional.pad(keep.cumsum(0), (1, 0))[cloud.ptr]

    example = dataclasses.replace(ALL[0], transform=FirstHalf())
    assert any(part > 0 for _, part in losses(example))
    assert not issubclass(FirstHalf, DropLimit)


def test_a_limit_of_a_mask_holds_where_steps_run_together():
    frame = tabletop_frame(2)
    crop = T.CropWorkspace(frame="camera", lower=(-1.0, -1.0, 0.0), upper=(1.0, 1.0, 5.0))
    far = float(frame.depth[frame.depth > 0].median())
    plain, limited = (
        T.Compose([T.MaskDepth(far=far, **limit), T.Deproject(), crop]) for limit in ({}, {"max_drop": 0.1})
    )
    assert plain(frame).num_points > 0
    with pytest.raises(TooFewPointsError, match=r"MaskDepth: \d+ of the \d+ readings of view 0 .*max_drop=0\.1"):
        limited(frame)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        kept = T.Compose([T.MaskDepth(far=far, max_drop=0.99), T.Deproject(), crop])(frame)
    assert torch.equal(kept.points, plain(frame).points)


def test_the_limit_is_held_when_decisions_are_repeated_on_other_data():
    frame = tabletop_frame(1)
    near = float(frame.depth[frame.depth > 0].min())
    step = T.MaskDepth(far=near + 0.5, max_drop=0.5)
    history = step(frame).provenance["history"]
    farther = dataclasses.replace(frame, depth=frame.depth + (frame.depth > 0) * 2.0)
    with pytest.raises(TooFewPointsError, match="more than max_drop"):
        step.replay(farther, history)


def test_views_without_a_reading_lose_nothing():
    frame = tabletop_frame(2)
    blind = dataclasses.replace(frame, depth=frame.depth * torch.tensor([1.0, 0.0])[:, None, None])
    T.MaskDepth(near=0.01, max_drop=0.0)(blind)


def test_the_limit_is_a_part():
    for wrong in (-0.1, 1.5, "x"):
        with pytest.raises(PcdataError, match="max_drop"):
            T.MaskDepth(max_drop=wrong)
