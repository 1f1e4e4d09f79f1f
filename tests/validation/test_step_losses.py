"""The alarm: a step that drops more than is usual, and a capture that is an outlier of the rest."""

from __future__ import annotations

import numpy as np
import pytest

from pcdata.transforms.base import REGISTRY
from pcdata.validation.step_losses import USUAL, judge_step_losses, step_statistics


def counts(step, shares, *, start=10_000, seed=0, spread=0.02):
    """Histories of captures that keep these shares of about so many points."""
    generator = np.random.default_rng(seed)
    first = (start * np.exp(spread * generator.standard_normal(len(shares)))).astype(int)
    return {f"c{n}": [("Deproject", int(a)), (step, int(a * s))] for n, (a, s) in enumerate(zip(first, shares))}


@pytest.mark.parametrize(
    ("step", "usual", "unusual", "told"),
    [
        ("RemoveStatisticalOutliers", 0.97, 0.8, "loses 20.0%"),
        ("RemoveRadiusOutliers", 0.95, 0.5, "loses 50.0%"),
        ("RemovePlane", 0.03, 0.995, "loses 0.5%"),
        ("RemovePlane", 0.4, 0.004, "loses 99.6%"),
        ("CropWorkspace", 0.05, 0.005, "loses 99.5%"),
        ("ClusterObjects", 0.8, 0.2, "loses 80.0%"),
        ("FarthestPointSample", 0.001, 3.0, "66.7% are copies"),
        ("SomeStepOfYourOwn", 0.5, 0.001, "loses 99.9%"),
    ],
)
def test_a_median_loss_out_of_the_usual_range_warns(step, usual, unusual, told):
    many = 1_000_000  # so that rounding to whole points does not show
    assert judge_step_losses(counts(step, [usual] * 9, start=many)) == []
    (finding,) = judge_step_losses(counts(step, [unusual] * 9, start=many))
    assert finding.name == step
    assert told in finding.found
    assert finding.advice
    assert finding.verdict.value == "warn"


@pytest.mark.parametrize("share", [0.0, 0.3])
@pytest.mark.parametrize("size", [5, 12, 300])
def test_one_capture_that_loses_far_more_than_the_rest_is_named(size, share):
    shares = 0.9 + 0.03 * np.random.default_rng(1).standard_normal(size)
    assert judge_step_losses(counts("CropWorkspace", shares)) == []
    shares[2] = share
    (finding,) = judge_step_losses(counts("CropWorkspace", shares))
    assert f"1 of {size} captures are outliers of the rest: 'c2' keeps {share:.1%}" in finding.found.replace(
        "29.9", "30.0"
    )
    assert finding.value > finding.threshold


def test_a_capture_that_begins_with_next_to_nothing_is_named_once_and_where_it_begins():
    told = counts("RemoveStatisticalOutliers", [0.97] * 20)
    told["c7"] = [("Deproject", 40), ("RemoveStatisticalOutliers", 39)]
    (finding,) = judge_step_losses(told)
    assert finding.name == "Deproject"
    assert "'c7' keeps 40;" in finding.found


def test_a_tenth_of_outliers_does_not_hide_itself_and_the_worst_come_first():
    shares = np.full(100, 0.95)
    shares[::10] = np.linspace(0.5, 0.05, 10)
    (finding,) = judge_step_losses(counts("CropWorkspace", shares))
    assert "10 of 100 captures" in finding.found
    assert finding.found.index("'c90' keeps 5.0%") < finding.found.index("'c80'")
    assert "and 5 more" in finding.found


def test_captures_that_differ_throughout_are_no_outliers_of_each_other():
    shares = np.random.default_rng(3).uniform(0.1, 0.9, 200)
    assert judge_step_losses(counts("CropWorkspace", shares, spread=0.5)) == []


def test_of_a_few_captures_none_is_an_outlier_and_empty_ones_do_not_divide_by_zero():
    assert judge_step_losses(counts("CropWorkspace", [0.9, 0.9, 0.9, 0.1])) == []
    assert judge_step_losses({}) == []
    assert judge_step_losses({"a": []}) == []
    empty = {f"c{n}": [("Deproject", 0), ("CropWorkspace", 0)] for n in range(9)}
    assert judge_step_losses(empty) == []


def test_clouds_among_depth_images_are_judged_by_themselves():
    told = counts("CropWorkspace", [0.9] * 9)
    told |= {f"cloud{n}": [("CropWorkspace", 100)] for n in range(9)}
    assert judge_step_losses(told) == []
    assert [(one["step"], one["samples"]) for one in step_statistics(told)] == [
        ("Deproject", 9),
        ("CropWorkspace", 9),
        ("CropWorkspace", 9),
    ]


def test_statistics_are_whole_numbers_that_occurred():
    told = {f"c{n}": [("Deproject", n), ("Crop", n // 2)] for n in range(101)}
    first, second = step_statistics(told)
    counts = {"samples": 101, "min": 0, "p5": 5, "median": 50, "p95": 95, "max": 100}
    assert first == {"step": "Deproject", "before": None, **counts}
    assert (second["before"], second["median"], second["max"]) == (50, 25, 50)


def test_usual_ranges_are_of_steps_that_there_are():
    assert {*USUAL} <= {*REGISTRY}
