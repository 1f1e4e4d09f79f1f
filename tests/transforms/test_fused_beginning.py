"""The usual beginning of a chain run as one pass gives exactly what its steps give one after another."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import pytest
import torch

from pcdata.contracts.dispatch import why_unavailable
from pcdata.structures import Camera, DepthFrame, PointCloud
from pcdata.synthetic import tabletop
from pcdata.transforms import (
    Compose,
    CropWorkspace,
    Deproject,
    MaskDepth,
    RandomJitter,
    RemoveFlyingPixels,
    ToFrame,
)
from pcdata.transforms import fused_beginning as fused
from tests.factories import assert_same, frame_with_counts

SCENE = tabletop(2, num_objects=3, num_views=3, size=(60, 80)).frame
MASK = torch.arange(80).expand(3, 60, 80) % 7 != 3
FULL = dataclasses.replace(
    SCENE,
    mask=MASK,
    confidence=(torch.arange(3 * 60 * 80).reshape(3, 60, 80) % 4).to(torch.uint8),
    sample_id="scene",
    provenance={"history": [{"step": "Earlier"}], "sensor": "made up"},
)
IN_CAMERA = CropWorkspace(frame="camera", lower=(-0.3, -0.2, 0.2), upper=(0.25, 0.3, 1.5))
IN_BASE = CropWorkspace(frame="base", lower=(-0.2, -0.25, 0.005), upper=(0.3, 0.2, 0.5))
MATRIX = ((0.0, -1.0, 0.0, 0.1), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, -0.5), (0.0, 0.0, 0.0, 1.0))

CHAINS: dict[str, list[Any]] = {
    "crop": [Deproject(), IN_CAMERA],
    "mask, crop": [MaskDepth(near=0.3, far=1.2), Deproject(), IN_CAMERA],
    "mask, move, crop": [MaskDepth(far=1.4, drop_labels=[0]), Deproject(), ToFrame(frame="base"), IN_BASE],
    "flying, crop": [RemoveFlyingPixels(tolerance=0.01), Deproject(), IN_CAMERA],
    "mask, flying, move, crop": [
        MaskDepth(near=0.3, far=1.4, min_confidence="completed"),
        RemoveFlyingPixels(min_neighbors=5),
        Deproject(),
        ToFrame(frame="base"),
        IN_BASE,
    ],
    "flying, mask": [RemoveFlyingPixels(), MaskDepth(far=1.2), Deproject(), IN_CAMERA],
    "trusted only": [MaskDepth(min_confidence="reliable"), Deproject(), IN_CAMERA],
    "moved by a matrix": [
        MaskDepth(use_mask=False),
        Deproject(),
        ToFrame(frame="table", matrix=MATRIX, start="camera"),
        CropWorkspace(frame="table", lower=(-0.5, -0.5, -0.5), upper=(0.5, 0.5, 0.5)),
    ],
    "with steps around": [MaskDepth(), MaskDepth(near=0.25), Deproject(), IN_CAMERA, RandomJitter()],
}


def frames() -> dict[str, DepthFrame]:
    lens = torch.tensor([[0.1, -0.05, 0.001, 0.0, 0.0]], dtype=torch.float64).repeat(3, 1)
    camera = Camera(intrinsics=SCENE.camera.intrinsics, size=SCENE.size, distortion=lens)
    return {
        "full": FULL,
        "bare": dataclasses.replace(SCENE, colors=None, confidence=FULL.confidence),
        "one view": FULL.view(1),
        "lens": dataclasses.replace(FULL, camera=camera),
    }


def step_by_step(chain: Compose, frame: DepthFrame) -> PointCloud:
    *_, (_, cloud) = chain.step_through(frame, generator=torch.Generator().manual_seed(0))
    return cloud


@pytest.fixture(params=["kernels", "references"])
def bodies(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Once with the compiled kernels and once without."""
    if request.param == "references":
        monkeypatch.setattr("pcdata.contracts.dispatch.AUTO_ORDER", {})
    elif why_unavailable("cpu") is not None:
        pytest.skip(str(why_unavailable("cpu")))


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> list[PointCloud | None]:
    """What the runs in one pass gave, None where the steps had to run."""
    given: list[PointCloud | None] = []

    def noted(*args: Any, **options: Any) -> Any:
        done = fused.run_beginning(*args, **options)
        given.append(None if done is None else done[0])
        return done

    monkeypatch.setattr("pcdata.transforms.passes.run_beginning", noted)
    return given


@pytest.mark.usefixtures("bodies")
@pytest.mark.parametrize("frame", ["full", "bare", "one view", "lens"])
@pytest.mark.parametrize("chain", CHAINS)
def test_one_pass_gives_what_the_steps_give(chain, frame, runs):
    steps, capture = Compose(CHAINS[chain]), frames()[frame]
    expected = step_by_step(steps, capture)
    assert not runs
    assert_same(steps(capture, generator=torch.Generator().manual_seed(0)), expected)
    assert isinstance(runs[0], PointCloud)
    assert 0 < expected.num_points < int((capture.depth > 0).sum())


def refusals() -> dict[str, tuple[list[Any], DepthFrame]]:
    far_away = CropWorkspace(frame="camera", lower=(5.0, 5.0, 5.0), upper=(6.0, 6.0, 6.0))
    return {
        "nothing in the box": ([MaskDepth(), Deproject(), far_away], FULL),
        "a view without a reading": ([Deproject(), IN_CAMERA], frame_with_counts((20, 0))),
        "no mask": ([MaskDepth(require_mask=True), Deproject(), IN_CAMERA], SCENE),
        "no labels": ([MaskDepth(drop_labels=[1]), Deproject(), IN_CAMERA], dataclasses.replace(FULL, labels=None)),
        "no pose": (
            [Deproject(), ToFrame(frame="world"), CropWorkspace(frame="world", lower=(0, 0, 0), upper=(1, 1, 1))],
            FULL,
        ),
        "everything masked": ([MaskDepth(near=50.0), Deproject(), IN_CAMERA], FULL),
        "everything masked before": ([MaskDepth(near=50.0), RemoveFlyingPixels(), Deproject(), IN_CAMERA], FULL),
    }


def said_by(run: Callable[[], Any]) -> list[str]:
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - its text is what is compared
        run()
    return [type(caught.value).__name__, str(caught.value), *getattr(caught.value, "__notes__", [])]


@pytest.mark.usefixtures("bodies")
@pytest.mark.parametrize("case", refusals())
def test_the_step_that_refuses_says_so_itself(case, runs):
    steps, capture = refusals()[case]
    chain = Compose(steps)
    assert said_by(lambda: chain(capture)) == said_by(lambda: step_by_step(chain, capture))
    assert runs == [None]


def test_what_is_not_the_usual_beginning_runs_step_by_step(runs):
    pose = tuple(tuple(row) for row in torch.eye(4).tolist())
    oriented = CropWorkspace(frame="camera", lower=(-1, -1, -1), upper=(1, 1, 1), frame_from_box=pose)
    for steps in ([Deproject(), oriented], [Deproject(), ToFrame(frame="base")], [Deproject(), RandomJitter()]):
        Compose(steps)(FULL, generator=torch.Generator().manual_seed(0))
    Compose([IN_CAMERA])(Deproject()(FULL))
    assert not runs


def test_a_subclass_or_a_hook_is_not_passed_over(runs):
    class Half(MaskDepth, abstract=True):
        def transform(self, data, params):
            return data.masked(far=0.8)

    own = Compose([Half(), Deproject(), IN_CAMERA])
    assert_same(own(FULL), step_by_step(own, FULL))
    watched, seen = Compose([MaskDepth(), Deproject(), IN_CAMERA]), []
    watched.steps[1].register_forward_hook(lambda module, inputs, output: seen.append(output.num_points))
    watched(FULL)
    assert seen == [int(FULL.mask[FULL.depth > 0].sum())]


def test_a_cloud_enters_after_the_beginning_as_before():
    chain = Compose([Deproject(), IN_CAMERA])
    assert_same(chain(Deproject()(FULL)), chain(FULL))
