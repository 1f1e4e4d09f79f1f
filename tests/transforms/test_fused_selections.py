"""Selections run together give exactly what they give one after another, on captures and on clouds."""

from __future__ import annotations

import dataclasses
import pickle
import warnings
from collections.abc import Callable
from typing import Any

import pytest
import torch

from pcdata.contracts.dispatch import why_unavailable
from pcdata.errors import ConfigError, TooFewPointsError
from pcdata.functional.plane_surfaces import plane_surfaces
from pcdata.functional.rows import pick_rows, ptr_after_mask
from pcdata.rng import Streams
from pcdata.structures import DepthFrame, Kind, PointCloud
from pcdata.synthetic import tabletop
from pcdata.transforms import (
    Compose,
    CropPolygon,
    CropWorkspace,
    Deproject,
    DropNonFinite,
    EstimateNormals,
    FarthestPointSample,
    KeepValues,
    MaskDepth,
    MergeViews,
    RandomPointDropout,
    RemoveDuplicates,
    RemovePlane,
    RemoveRadiusOutliers,
    RemoveStatisticalOutliers,
    SelectTransform,
    ToFrame,
)
from pcdata.transforms import fused_selections as fused
from pcdata.transforms.base import REGISTRY, sample_name
from tests.factories import assert_same
from tests.transforms.examples import ALL, NAMES

SCENE = tabletop(2, num_objects=3, num_views=2, size=(36, 48)).frame
FULL = dataclasses.replace(
    SCENE,
    confidence=(torch.arange(2 * 36 * 48).reshape(2, 36, 48) % 3 + 1).to(torch.uint8),
    sample_id="scene",
    provenance={"history": [{"step": "Earlier"}]},
)
CROP = CropWorkspace(frame="camera", lower=(-0.3, -0.2, 0.2), upper=(0.25, 0.3, 1.5))
SQUARE = ((-0.2, -0.2), (0.2, -0.2), (0.2, 0.2), (-0.2, 0.2))
USUAL = [
    RemoveStatisticalOutliers(num_neighbors=8),
    RemoveRadiusOutliers(min_neighbors=2, radius=0.05),
    RemovePlane(num_hypotheses=50),
]
CHAINS: dict[str, list[Any]] = {
    "usual": [MaskDepth(far=2.0), Deproject(), CROP, *USUAL, FarthestPointSample(num_points=64)],
    "nothing behind": [Deproject(), CROP, *USUAL],
    "more behind": [Deproject(), CROP, *USUAL, EstimateNormals(radius=0.1), RemoveRadiusOutliers(radius=0.1)],
    "in the base": [
        Deproject(),
        ToFrame(frame="base"),
        CropWorkspace(frame="base", lower=(-0.3, -0.3, -0.1), upper=(0.3, 0.3, 0.5)),
        CropPolygon(frame="base", polygon=SQUARE),
        RemoveDuplicates(),
    ],
    "merged": [
        Deproject(),
        ToFrame(frame="base"),
        MergeViews(),
        CropWorkspace(frame="base", lower=(-0.3, -0.3, -0.1), upper=(0.3, 0.3, 0.5)),
        RemovePlane(num_hypotheses=50, keep="above", cut="measured", up=(0, 0, 1), frame="base"),
        RemoveRadiusOutliers(min_neighbors=2, radius=0.05),
    ],
    "twice by radius": [
        Deproject(),
        CROP,
        RemoveDuplicates(),
        *[RemoveRadiusOutliers(radius=0.06, min_neighbors=3)] * 3,
    ],
    "few, then by radius": [
        Deproject(),
        CROP,
        CropPolygon(frame="camera", polygon=((-0.1, -0.1), (0.1, -0.1), (0.1, 0.1))),
        RemoveRadiusOutliers(radius=0.06, min_neighbors=3),
    ],
    "by labels": [Deproject(), CROP, KeepValues(values=(0, 1, 2)), RemoveRadiusOutliers(min_neighbors=2, radius=0.05)],
    "by confidence": [Deproject(), CROP, KeepValues(field="confidence", low=2), DropNonFinite(fields=("confidence",))],
    "by color": [Deproject(), CROP, FarthestPointSample(num_points=32, color_weight=0.3)],
    "balanced": [Deproject(), CROP, FarthestPointSample(num_points=32, balance_labels=True)],
    "short": [Deproject(), CROP, FarthestPointSample(num_points=20_000, if_short="tile")],
    "zeros": [Deproject(), CROP, RemoveDuplicates(), FarthestPointSample(num_points=20_000, if_short="zeros")],
    "random within": [Deproject(), CROP, *USUAL[:2], RandomPointDropout(), *USUAL[:2]],
}

SELECTIONS = {
    name: example
    for name, example in zip(NAMES, ALL)
    if isinstance(example.transform, SelectTransform) and example.transform.looks_at() is not None
}


def frames() -> dict[str, DepthFrame]:
    return {
        "full": FULL,
        "without colors": dataclasses.replace(FULL, colors=None),
        "without anything": dataclasses.replace(SCENE, colors=None, labels=None),
        "one view": FULL.view(1),
    }


def fits(chain: str, frame: DepthFrame) -> bool:
    return not (
        (chain == "by color" and frame.colors is None)
        or (chain in ("by labels", "balanced") and frame.labels is None)
        or (chain == "by confidence" and frame.confidence is None)
    )


def step_by_step(chain: Compose, data: Any) -> PointCloud:
    *_, (_, cloud) = chain.step_through(data, generator=torch.Generator().manual_seed(0))
    return cloud


def run(chain: Compose, data: Any) -> PointCloud:
    return chain(data, generator=torch.Generator().manual_seed(0))


@pytest.fixture(autouse=True)
def small_ones_too(monkeypatch):
    monkeypatch.setattr(fused, "_MIN_ROWS", 1)


@pytest.fixture(params=["kernels", "references"])
def bodies(request, monkeypatch) -> None:
    """Once with the compiled kernels and once without."""
    if request.param == "references":
        monkeypatch.setattr("pcdata.contracts.dispatch.AUTO_ORDER", {})
    elif why_unavailable("cpu") is not None:
        pytest.skip(str(why_unavailable("cpu")))


@pytest.fixture
def together(monkeypatch) -> list[list[str]]:
    """The steps of each run of selections that came to its end."""
    found: list[list[str]] = []

    def noted(steps, positions, *others):
        cloud, stop = fused.run_selections(steps, positions, *others)
        if stop == positions.stop:
            found.append([type(steps[position]).__name__ for position in positions])
        return cloud, stop

    monkeypatch.setattr("pcdata.transforms.passes.run_selections", noted)
    return found


@pytest.mark.usefixtures("bodies")
@pytest.mark.parametrize("frame", ["full", "without colors", "without anything", "one view"])
@pytest.mark.parametrize("chain", CHAINS)
def test_captures_come_to_what_the_steps_give(chain, frame):
    steps, capture = Compose(CHAINS[chain]), frames()[frame]
    if fits(chain, capture):
        expected = step_by_step(steps, capture)
        result = run(steps, capture)
        assert_same(result, expected)
        assert list(result.fields()) == list(expected.fields())
        assert result.num_points > 0


def whole_cloud() -> PointCloud:
    cloud = EstimateNormals(radius=0.1)(run(Compose([Deproject(), CROP]), FULL))
    weight = torch.linspace(0, 1, cloud.num_points, dtype=torch.float64)
    return cloud.with_extra("weight", weight, Kind.INVARIANT).with_extra("seen", cloud.points * 2, Kind.POSITION)


@pytest.mark.usefixtures("bodies")
@pytest.mark.parametrize(
    "chain",
    [
        *("usual", "by labels", "by confidence", "by color", "balanced", "short", "zeros"),
        *("twice by radius", "few, then by radius"),
    ],
)
def test_clouds_come_to_what_the_steps_give(chain, together):
    steps = Compose([step for step in CHAINS[chain] if isinstance(step, SelectTransform)])
    cloud = whole_cloud()
    expected = step_by_step(steps, cloud)
    result = run(steps, cloud)
    assert_same(result, expected)
    assert list(result.fields()) == list(expected.fields())
    assert len(together) == 1
    assert_same(cloud, whole_cloud())


@pytest.fixture
def picked(monkeypatch) -> list[int]:
    """How many rows of a mask each picking of rows copied."""
    found: list[int] = []

    def noted(fields, rows, **options):
        result = pick_rows(fields, rows, **options)
        if rows.dtype is torch.bool:
            found.append(len(result["points"]))
        return result

    monkeypatch.setattr("pcdata.structures.point_cloud.pick_rows", noted)
    return found


@pytest.mark.parametrize("fields", [("colors", "labels"), ()])
@pytest.mark.skipif(why_unavailable("cpu") is not None, reason="its reference picks the rows")
def test_rows_are_picked_once_where_the_next_step_decides_among_them(fields, picked):
    cloud = whole_cloud()
    cloud = cloud.with_fields(**dict.fromkeys({*cloud.fields()} - {"points", "source_index", *fields}))
    both, few = CHAINS["twice by radius"][2:], CHAINS["few, then by radius"][2:]
    result = Compose(both)(cloud)
    assert picked == [result.num_points]
    assert [step["points"] for step in result.history[0][-4:]] == sorted(
        (step["points"] for step in result.history[0][-4:]), reverse=True
    )
    picked.clear()
    result = Compose(few)(cloud)
    assert picked[1:] == [result.num_points]
    assert 0 < picked[0] < cloud.num_points / 2


@pytest.mark.parametrize("if_short", ["error", "repeat", "tile", "keep"])
@pytest.mark.usefixtures("bodies")
def test_points_behind_a_plane_are_sampled_among_the_rows_as_they_lie(if_short, picked):
    cloud = whole_cloud()
    steps = [RemovePlane(num_hypotheses=50), FarthestPointSample(num_points=60, if_short=if_short)]
    expected = step_by_step(Compose(steps), cloud)
    picked.clear()
    result = Compose(steps)(cloud)
    assert_same(result, expected)
    assert not picked or why_unavailable("cpu") is not None
    few = Compose([steps[0], FarthestPointSample(num_points=cloud.num_points, if_short=if_short)])
    if if_short == "error":
        assert said_by(lambda: few(cloud)) == said_by(lambda: step_by_step(few, cloud))
    else:
        assert_same(few(cloud), step_by_step(few, cloud))


@pytest.mark.usefixtures("bodies")
@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_points_that_are_no_numbers_are_refused_by_the_step_that_cannot_take_them(value, together):
    cloud = whole_cloud()
    spoilt = dataclasses.replace(cloud, points=cloud.points.index_fill(0, torch.tensor([3]), value), layout=None)
    chain = Compose([KeepValues(values=(0, 1, 2, -1)), RemoveRadiusOutliers(min_neighbors=2, radius=0.05)])
    assert said_by(lambda: run(chain, spoilt)) == said_by(lambda: step_by_step(chain, spoilt))
    chain = Compose([DropNonFinite(), *chain.steps])
    assert_same(run(chain, spoilt), step_by_step(chain, spoilt))


def test_the_usual_steps_run_together_and_are_told_pass_by_pass(together):
    told = []
    chain = Compose(CHAINS["usual"])
    chain.run_in_passes(FULL, after=lambda steps, cloud: told.append((steps, cloud.num_points, sorted(cloud.fields()))))
    assert together == [[type(step).__name__ for step in CHAINS["usual"][3:]]]
    lean = ["points", "source_index"]
    history = step_by_step(chain, FULL).history
    points = [sum(of_cloud[-6 + step]["points"] for of_cloud in history) for step in (1, 3, 5)]
    positions = [range(3), range(3, 5), range(5, 7)]
    assert told == [(steps, count, lean) for steps, count in zip(positions, points, strict=True)]


@pytest.fixture
def surfaces_found(monkeypatch) -> list[int]:
    """Of how many points the surface of a plane was looked for."""
    found: list[int] = []

    def noted(points, *others):
        found.append(len(points))
        return plane_surfaces(points, *others)

    monkeypatch.setattr("pcdata.transforms.planes.plane_surfaces", noted)
    return found


def test_where_the_surface_of_a_plane_ends_is_found_out_when_somebody_reads_it(surfaces_found):
    expected = step_by_step(Compose(CHAINS["usual"]), FULL)
    surfaces_found.clear()
    result = run(Compose(CHAINS["usual"]), FULL)
    assert not surfaces_found
    assert result.meta == expected.meta
    assert result.meta[0]["planes"][0]["hull"]
    assert surfaces_found == [sum(of_cloud[-2]["points_before"] for of_cloud in expected.history)]
    again = run(Compose(CHAINS["usual"]), FULL)
    assert [sample_name(again, b) for b in range(2)] == [" (sample 'scene')"] * 2
    assert len(surfaces_found) == 1
    assert pickle.loads(pickle.dumps(again)).meta == expected.meta


def test_clouds_that_stay_hold_no_more_points_of_others_than_a_few(surfaces_found):
    clouds = [run(Compose(CHAINS["usual"]), FULL) for _ in range(10)]
    assert 6 <= len(surfaces_found) < 10
    assert all(cloud.meta == clouds[0].meta for cloud in clouds)
    assert len(surfaces_found) == 10


def test_of_clouds_of_others_all_is_found_out_at_once(surfaces_found):
    cloud = whole_cloud()
    expected = RemovePlane(num_hypotheses=50)(whole_cloud()).meta
    for steps in (USUAL[2:], [*USUAL[2:], FarthestPointSample(num_points=8)]):
        surfaces_found.clear()
        result = Compose(steps)(cloud)
        assert surfaces_found == [cloud.num_points]
        cloud.points.mul_(3)
        assert result.meta == expected
        cloud.points.copy_(whole_cloud().points)


def refusals() -> dict[str, list[Any]]:
    far = CropPolygon(frame="camera", polygon=((5, 5), (6, 5), (6, 6)))
    return {
        "nothing left": [Deproject(), CROP, RemoveDuplicates(), far, *USUAL],
        "nothing has company": [Deproject(), CROP, RemoveDuplicates(), RemoveRadiusOutliers(radius=1e-5)],
        "too small a radius": [Deproject(), CROP, RemoveDuplicates(), RemoveRadiusOutliers(radius=1e-13)],
        "too many without company": [
            *(Deproject(), CROP, RemoveDuplicates()),
            RemoveRadiusOutliers(radius=0.05, min_neighbors=8, max_drop=1e-6),
        ],
        "too few": [Deproject(), CROP, RemoveDuplicates(), FarthestPointSample(num_points=10**6)],
        "a limit": [Deproject(), CROP, RemovePlane(num_hypotheses=20, max_drop=0.01), RemoveDuplicates()],
        "another frame": [
            Deproject(),
            CROP,
            RemoveDuplicates(),
            RemovePlane(up=(0, 0, 1), frame="camera", keep="above"),
        ],
    }


def said_by(call: Callable[[], Any]) -> list[str]:
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - its text is what is compared
        call()
    return [type(caught.value).__name__, str(caught.value), *getattr(caught.value, "__notes__", [])]


@pytest.mark.usefixtures("bodies")
@pytest.mark.parametrize(
    "case",
    [
        *("nothing left", "too few", "a limit"),
        *("nothing has company", "too small a radius", "too many without company"),
    ],
)
@pytest.mark.parametrize("given", ["capture", "cloud"])
def test_the_step_that_refuses_says_so_itself(case, given, together):
    steps = refusals()[case]
    chain, data = Compose(steps), FULL
    if given == "cloud":
        chain, data = Compose([step for step in steps if isinstance(step, SelectTransform)]), whole_cloud()
    said = said_by(lambda: run(chain, data))
    assert said == said_by(lambda: step_by_step(chain, data))
    assert any("colors" in line for line in said)  # the note tells all fields
    assert not together


def test_a_warning_that_is_an_error_comes_from_the_step_itself(together):
    chain = Compose([Deproject(), CROP, RemoveDuplicates(), RemovePlane(max_drop=0.01, drop_alarm="warn")])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(Warning, match="are removed") as caught:
            chain(FULL)
        assert any("colors" in line for line in caught.value.__notes__)
    assert not together
    with pytest.warns(Warning, match="are removed"):
        assert_same(chain(FULL), chain(FULL))


@pytest.mark.parametrize("given", ["capture", "cloud", "few points"])
def test_what_ran_before_a_step_refuses_does_not_run_again(given):
    steps = [
        RemoveDuplicates(),
        RemoveStatisticalOutliers(num_neighbors=5, std_ratio=0.5, max_drop=0.0, drop_alarm="warn"),
        RemoveRadiusOutliers(radius=0.001, min_neighbors=50, max_drop=0.01),
    ]
    chain, data = Compose([Deproject(), CROP, *steps] if given == "capture" else steps), FULL
    if given != "capture":
        data = whole_cloud()
    if given == "few points":
        keep = torch.arange(data.num_points) % 9 == 0
        data = data.select(keep, ptr_after_mask(keep, data.ptr))
    heard = []
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        with pytest.raises(TooFewPointsError, match=r"^RemoveRadiusOutliers: (.|\n)*are removed"):
            chain.run_in_passes(data, after=lambda positions, cloud: heard.extend(positions))
    assert len(warned) == len({str(one.message) for one in warned}) == 2  # one for each cloud
    assert heard == list(range(len(chain.steps) - 1))


def test_a_subclass_or_a_hook_is_not_passed_over(together):
    class Reddish(RemoveDuplicates):
        def pick(self, cloud, streams):
            keep = cloud.colors[:, 0] > 0.5
            return keep, ptr_after_mask(keep, cloud.ptr)

    del REGISTRY["Reddish"]
    chain = Compose([Deproject(), CROP, Reddish(), RemoveDuplicates(), RemoveDuplicates()])
    assert_same(chain(FULL), step_by_step(chain, FULL))
    assert together == [["RemoveDuplicates", "RemoveDuplicates"]]
    seen = []
    watched = Compose([Deproject(), CROP, RemoveDuplicates(), RemoveDuplicates()])
    watched.steps[2].register_forward_hook(lambda step, given, cloud: seen.append(sorted(cloud.fields())))
    watched(FULL)
    assert seen == [["colors", "confidence", "labels", "points", "source_index"]]


@pytest.mark.parametrize("example", SELECTIONS.values(), ids=SELECTIONS.keys())
def test_a_selection_looks_at_no_field_that_it_does_not_name(example):
    step, cloud = example.transform, example.make((120, 90))
    named = step.looks_at()
    gone = {name: None for name in ("colors", "normals", "labels", "source_index") if name not in named}
    kept = {name: value for name, value in cloud.extra.items() if name in named}
    kinds = {name: cloud.kinds[name] for name in kept}
    lean = dataclasses.replace(cloud, **gone, extra=kept, kinds=kinds)
    streams = (Streams.of(torch.Generator().manual_seed(0), 2) if step.is_random else step.no_streams for _ in range(2))
    whole, part = (step.make_params(data, own) for data, own in zip((cloud, lean), streams))
    assert whole.keys() == part.keys()
    for name, value in whole.items():
        assert torch.equal(value, part[name]), name


def test_memory_that_requires_a_gradient_is_picked_with_it():
    cloud = dataclasses.replace(whole_cloud(), colors=whole_cloud().colors.clone().requires_grad_())
    chain = Compose([RemoveDuplicates(), RemoveRadiusOutliers(min_neighbors=2, radius=0.05)])
    result = chain(cloud)
    result.colors.sum().backward()
    assert int((cloud.colors.grad == 1).sum()) == 3 * result.num_points


def test_a_field_of_the_number_cannot_be_anybodys():
    with pytest.raises((ConfigError, TypeError), match="cannot name"):
        whole_cloud().with_extra(fused._NUMBER, torch.zeros(whole_cloud().num_points), Kind.INVARIANT)
