"""The filters as transforms: what they do to a noisy capture, and how they mark what they made up."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from pcdata.errors import ConfigError
from pcdata.functional import depth_to_disparity, spatial_filter
from pcdata.structures import Confidence, DepthFrame
from pcdata.synthetic import SensorNoise, tabletop
from pcdata.transforms import Compose, FillHoles, RemoveFlyingPixels, SpatialFilterDepth
from tests.factories import depth_edges, frame_with_counts


@pytest.fixture(scope="module")
def noisy():
    return tabletop(1, num_objects=4, noise=SensorNoise(flying_pixels=0.0), size=(240, 320), floor=False)


def bare(depth: torch.Tensor) -> DepthFrame:
    frame = frame_with_counts((10,) * len(depth))
    camera = dataclasses.replace(frame.camera, size=tuple(depth.shape[1:]), is_window=True)
    return DepthFrame(depth=depth, camera=camera)


def test_the_spatial_filter_halves_the_noise_of_surfaces_and_keeps_edges_within_a_pixel(noisy):
    truth = noisy.truth.depth.float()
    across, edge = depth_edges(truth.double(), 0.05)
    inside = (torch.nn.functional.max_pool2d(edge.float(), 7, 1, 3) == 0) & (noisy.frame.depth > 0)
    filtered = SpatialFilterDepth()(noisy.frame).depth
    before, after = ((depth - truth)[inside].square().mean().sqrt() for depth in (noisy.frame.depth, filtered))
    assert float(after) < 0.5 * float(before)

    at_edge = edge & (filtered > 0)
    nearer_own_side = (filtered - truth).abs() < (filtered - across).abs()
    assert float(nearer_own_side[at_edge].float().mean()) > 0.99


def test_the_spatial_filter_works_on_the_disparity_of_each_view(noisy):
    frame = noisy.frame
    step = SpatialFilterDepth(alpha=0.3, delta=7.0, iterations=1, baseline=0.1)
    disparity = depth_to_disparity(frame.depth, frame.camera.intrinsics[:, 0, 0], 0.1)
    expected = spatial_filter(disparity, alpha=0.3, delta=7.0, iterations=1)
    found = depth_to_disparity(step(frame).depth, frame.camera.intrinsics[:, 0, 0], 0.1)
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=0)


def test_pixels_filled_by_the_spatial_filter_are_marked():
    depth = torch.full((1, 6, 12), 0.5)
    depth[0, 2, 4:7] = 0
    depth[0, 3, :] = 0
    frame = SpatialFilterDepth(hole_fill_radius=2)(bare(depth))
    filled = (frame.depth > 0) & (depth == 0)
    assert filled[0, 2, 4:7].tolist() == [True, True, True]
    assert not bool(filled[0, 3].any())
    assert bool((frame.confidence[filled] == Confidence.COMPLETED).all())
    assert bool((frame.confidence[depth > 0] == Confidence.RELIABLE).all())
    assert bool((frame.confidence[frame.depth == 0] == Confidence.NO_READING).all())
    assert SpatialFilterDepth()(bare(depth)).confidence is None, "nothing filled, nothing to mark"


@pytest.mark.parametrize("rule", ["left", "farthest", "nearest"])
def test_filled_holes_are_completed_near_a_reading_and_hallucinated_far_from_one(rule):
    depth = torch.full((1, 40, 40), 0.5)
    depth[0, 5:35, 5:35] = 0
    frame = FillHoles(rule=rule, max_distance=4)(bare(depth))
    confidence = frame.confidence[0]
    assert bool((frame.depth == 0.5).all())
    assert confidence[20].tolist()[:5] == [Confidence.RELIABLE] * 5
    assert confidence[20].tolist()[5:9] == [Confidence.COMPLETED] * 4
    assert confidence[20].tolist()[9:20] == [Confidence.HALLUCINATED] * 11


def test_filling_keeps_the_confidence_that_readings_have():
    frame = frame_with_counts((120, 90))
    filled = FillHoles()(frame)
    readings = frame.depth > 0
    assert torch.equal(filled.confidence[readings], frame.confidence[readings])
    assert torch.equal(filled.depth[readings], frame.depth[readings])


def test_removed_flying_pixels_have_no_reading_and_no_confidence():
    depth = torch.where(torch.arange(20) < 10, 0.5, 1.0).expand(1, 12, 20).clone()
    depth[0, 6, 10] = 0.75
    frame = dataclasses.replace(bare(depth), confidence=torch.full(depth.shape, 3, dtype=torch.uint8))
    cleaned = RemoveFlyingPixels()(frame)
    assert (cleaned.depth != depth).nonzero().tolist() == [[0, 6, 10]]
    assert cleaned.depth[0, 6, 10] == 0
    assert (cleaned.confidence == Confidence.NO_READING).nonzero().tolist() == [[0, 6, 10]]
    assert RemoveFlyingPixels()(bare(depth)).confidence is None


def test_the_chain_that_librealsense_recommends_ends_nearer_to_the_truth():
    noise = SensorNoise()
    scene = tabletop(4, num_objects=5, noise=noise, size=(240, 320), floor=False)
    chain = Compose([RemoveFlyingPixels(), SpatialFilterDepth(), FillHoles(max_size=4)])
    frame = chain(scene.frame)
    truth = scene.truth.depth.float()

    def share_wrong(depth: torch.Tensor) -> float:
        there = truth > 0
        return float(((depth - truth).abs() > 0.02 * truth)[there].float().mean())

    assert share_wrong(frame.depth) < 0.35 * share_wrong(scene.frame.depth)
    assert [step["step"] for step in frame.provenance["history"]] == [
        "RemoveFlyingPixels",
        "SpatialFilterDepth",
        "FillHoles",
    ]


def test_parameters_are_checked_when_the_step_is_made():
    for wrong in ({"alpha": 0.0}, {"alpha": 1.01}, {"delta": 0.0}, {"iterations": 0}, {"hole_fill_radius": -1}):
        with pytest.raises(ConfigError, match=rf"SpatialFilterDepth\.{next(iter(wrong))}"):
            SpatialFilterDepth(**wrong)
    with pytest.raises(ConfigError, match=r"FillHoles\.rule"):
        FillHoles(rule="right")
    with pytest.raises(ConfigError, match=r"RemoveFlyingPixels\.min_neighbors"):
        RemoveFlyingPixels(min_neighbors=9)
