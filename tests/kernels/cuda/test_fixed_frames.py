"""A chain captured for the frames of a stream: the same launches do every frame, and the clouds are the chain's own."""

from __future__ import annotations

import pickle
from dataclasses import replace

import pytest
import torch

from pcdata import transforms as T
from pcdata.functional.rows import ptr_after_mask
from pcdata.live import Fault, LivePipeline
from pcdata.structures import DepthFrame
from pcdata.structures.structure import derived
from pcdata.synthetic import tabletop
from tests import pretend_device
from tests.factories import assert_same
from tests.kernels.cuda import harness
from tests.pretend_device import watching

pytestmark = pytest.mark.skipif(
    harness.unavailable() is not None or not pretend_device.AVAILABLE,
    reason=harness.unavailable() or "this PyTorch has no devices written in Python",
)

CROP = T.CropWorkspace(frame="camera", lower=(-0.4, -0.4, 0.2), upper=(0.4, 0.4, 1.5))
STEPS = (
    T.MaskDepth(near=0.2, far=3.0),
    T.RemoveFlyingPixels(),
    T.Deproject(),
    CROP,
    T.RemoveStatisticalOutliers(),
    T.RemoveRadiusOutliers(radius=0.06),
    T.RemovePlane(num_hypotheses=100),
    T.FarthestPointSample(num_points=16),
    T.EstimateNormals(radius=0.1),
)


def frame(seed: int, num_views: int = 1, size: tuple[int, int] = (36, 48)):
    first, made = (tabletop(one, noise="stereo", size=size, num_views=num_views).frame for one in (0, seed))
    return replace(made, labels=None, camera=first.camera)


@pytest.fixture
def device(monkeypatch):
    return harness.as_on_a_gpu(monkeypatch)


@pytest.mark.parametrize("num_views", [1, 4])
def test_every_frame_is_the_same_work_and_gives_the_cloud_of_the_chain(device, num_views):
    chain = T.Compose(STEPS)
    live = LivePipeline(chain, like=frame(0, num_views).to(device))
    assert live.captured == tuple(type(step).__name__ for step in STEPS)
    for seed in (1, 2):
        given = frame(seed, num_views)
        expected = chain(given)
        there = given.to(device)
        with watching() as watched:
            found = live(there)
        assert found.fault is None, found.reason
        assert watched.waits.total() == 1, watched.waits
        assert_same(expected, found.cloud.to("cpu"), tolerance=2e-6)
        assert torch.equal(found.cloud.source_index.cpu(), expected.source_index)
        assert len(expected.meta[0]["planes"]) == 1
    assert live.stats().clouds == 2


def test_a_step_without_fixed_shapes_ends_what_is_captured(device):
    chain = T.Compose(
        [
            T.MaskDepth(near=0.2, far=3.0),
            T.Deproject(),
            T.RemoveRadiusOutliers(radius=0.06),
            T.VoxelDownsample(voxel_size=0.05),
        ]
    )
    live = LivePipeline(chain, like=frame(0).to(device))
    assert live.captured == ("MaskDepth", "Deproject", "RemoveRadiusOutliers")
    found = live(frame(1).to(device))
    assert_same(chain(frame(1)), found.cloud.to("cpu"), tolerance=2e-6)
    assert "captured: MaskDepth, Deproject, RemoveRadiusOutliers" in str(live.stats())
    assert list(live.stats().latency) == ["whole", "MaskDepth + Deproject + RemoveRadiusOutliers", "VoxelDownsample"]


class KeepsEvenRows(T.RemoveRadiusOutliers, abstract=True):
    """Somebody's step, made of one that could be captured."""

    def pick(self, cloud, streams):
        keep = torch.arange(cloud.num_points, device=cloud.device) % 2 == 0
        return keep, ptr_after_mask(keep, cloud.ptr)


@pytest.mark.parametrize(
    "step",
    [
        KeepsEvenRows(),
        T.RemoveRadiusOutliers(radius=0.06, max_drop=0.99),
        T.CropWorkspace(frame="camera", lower=(-1, -1, 0.1), upper=(1, 1, 2), invert=True),
        T.FarthestPointSample(num_points=9, start=3),
        T.FarthestPointSample(num_points=9, color_weight=0.3),
    ],
    ids=lambda step: repr(step)[:40],
)
def test_whatever_a_step_is_asked_its_answer_is_that_of_the_chain(device, step):
    chain = T.Compose([T.Deproject(), step])
    live = LivePipeline(chain, like=frame(0).to(device))
    found = live(frame(1).to(device))
    assert_same(chain(frame(1)), found.cloud.to("cpu"), tolerance=2e-6)


def test_hooks_see_what_goes_through_a_step(device):
    chain, seen = T.Compose([T.Deproject(), T.RemoveRadiusOutliers(radius=0.06)]), []
    chain.steps[1].register_forward_hook(lambda step, given, made: seen.append(made.num_points))
    live = LivePipeline(chain, like=frame(0).to(device))
    live(frame(1).to(device))
    assert live.captured == ("Deproject",)
    assert len(seen) == 2


def patch() -> torch.Tensor:
    """Six pixels amid the image."""
    pixels = torch.zeros(36, 48)
    pixels[17:20, 23:25] = 1
    return pixels


def bad(depth: torch.Tensor, value: float) -> torch.Tensor:
    depth = depth.clone()
    depth[0, 5, 7] = value
    return depth


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda depth: bad(depth, torch.nan), Fault.BAD_VALUES),
        (lambda depth: bad(depth, torch.inf), Fault.BAD_VALUES),
        (lambda depth: bad(depth, -1.0), Fault.BAD_VALUES),
        (torch.zeros_like, Fault.EMPTY),
        (lambda depth: torch.full_like(depth, 5.0), Fault.FAILED_STEP),
        (lambda depth: depth * patch(), Fault.FAILED_STEP),
        (lambda depth: bad(depth, 3e38), None),
    ],
    ids=["NaN", "infinite", "negative", "nothing", "nothing in the box", "too few to sample", "far out"],
)
def test_what_is_wrong_with_a_frame_is_told_as_without_a_gpu(device, change, fault):
    chain = T.Compose([T.Deproject(), CROP, T.RemoveRadiusOutliers(radius=0.06), T.FarthestPointSample(num_points=9)])
    pipelines = LivePipeline(chain, like=frame(0)), LivePipeline(chain, like=frame(0).to(device))
    for changed in (lambda depth: depth, change, lambda depth: depth):
        here = frame(0)
        there = here.to(device)
        here = derived(here, depth=changed(here.depth))
        there = derived(there, depth=pretend_device.pretend(here.depth))
        expected, found = (live(one) for live, one in zip(pipelines, (here, there)))
        assert (found.fault, found.reason) == (expected.fault, expected.reason.replace("cpu", "pretend:0"))
        if expected.cloud is not None:
            assert_same(expected.cloud, found.cloud.to("cpu"), tolerance=2e-6)
    assert pipelines[0].stats().faults == pipelines[1].stats().faults
    assert pipelines[1].stats().faults.get(fault, 0) == (fault is not None)


def test_a_frozen_camera_is_noticed_and_forgotten(device):
    chain = T.Compose([T.Deproject(), CROP])
    live = LivePipeline(chain, like=frame(0).to(device))
    faults = []
    for seed in (1, 1, 2, 2):
        faults.append(live(frame(seed).to(device)).fault)
    live.reset()
    faults.append(live(frame(2).to(device)).fault)
    assert faults == [None, Fault.FROZEN, None, Fault.FROZEN, None]
    moving = LivePipeline(chain, like=frame(0).to(device), same_pixels=False)
    assert [moving(frame(1).to(device)).fault for _ in range(2)] == [None, None]


def test_a_cloud_is_its_caller_s_whatever_comes_after(device):
    live = LivePipeline(T.Compose(STEPS[:5]), like=frame(0).to(device))
    first = live(frame(1).to(device)).cloud
    kept = first.to("cpu")
    live(frame(2).to(device))
    assert_same(kept, first.to("cpu"))
    assert first.history == T.Compose(STEPS[:5])(frame(1)).history


def test_what_is_told_of_a_plane_is_found_out_when_it_is_read(device):
    chain = T.Compose([T.Deproject(), CROP, T.RemovePlane(num_hypotheses=50, probability=0.99), T.RemovePlane(seed=2)])
    live = LivePipeline(chain, like=frame(0).to(device), warm_planes=True)
    assert live.captured == ("Deproject", "CropWorkspace", "RemovePlane", "RemovePlane")
    there = frame(1).to(device)
    with watching() as watched:
        found = live(there).cloud
    assert watched.waits.total() == 1
    live(frame(2).to(device))
    expected = chain(frame(1))
    assert len(found.meta[0]["planes"]) == 2
    assert_same(expected, pickle.loads(pickle.dumps(found.to("cpu"))), tolerance=2e-6)
    assert [step["step"] for step in found.history[0]] == [step["step"] for step in expected.history[0]]
    assert [step.get("num_inliers") for step in found.history[0]] == [
        step.get("num_inliers") for step in expected.history[0]
    ]


@pytest.mark.parametrize(
    "options",
    [{"which": "supporting"}, {"up": (0.0, -1.0, 0.0), "frame": "camera"}, {"keep": "above"}],
    ids=str,
)
def test_planes_that_need_the_host_run_as_ever(device, options):
    live = LivePipeline(
        T.Compose([T.Deproject(), CROP, T.RemovePlane(tilt_alarm=None, **options)]), like=frame(0).to(device)
    )
    assert live.captured == ("Deproject", "CropWorkspace")


def test_arrays_go_to_the_device_of_the_first_frame(device):
    first = frame(0)
    like = DepthFrame.from_numpy(
        (1000 * first.depth).round().numpy().astype("uint16"), first.camera.intrinsics.numpy(), metres_per_unit=0.001
    )
    chain = T.Compose([T.Deproject(), CROP, T.FarthestPointSample(num_points=64)])
    here, there = LivePipeline(chain, like=like), LivePipeline(chain, like=like.to(device))
    stored = (1000 * frame(1).depth).round().numpy().astype("uint16")
    for pixels in (stored, stored[:, ::-1].copy(), stored):
        with watching() as watched:
            found = there(pixels)
        assert_same(here(pixels).cloud, found.cloud.to("cpu"))
        assert watched.waits.total() == 1, watched.waits
