"""Operations on a device that is not the processor, without a GPU: see ``pretend_device``."""

from __future__ import annotations

import pytest
import torch

from pcdata.contracts.dispatch import OPERATIONS
from tests import pretend_device
from tests.functional.test_op_contract import COUNTS, EXAMPLES, Example, call, clouds_of, each_example, packed
from tests.pretend_device import Watched, host, pretend, watching

pytestmark = pytest.mark.skipif(not pretend_device.AVAILABLE, reason="this PyTorch has no devices written in Python")

# How often the host may wait for the device in one call on three clouds, and how often it does so today or less.
MOST_WAITS = {
    "ball_query": 32,
    "bilateral_filter": 1,
    "boundary_mask": 8,
    "box_mask": 1,
    "chamfer_distance": 43,
    "core_point_mask": 17,
    "dbscan": 235,
    "decimate_depth": 1,
    "deproject_depth": 97,
    "deproject_ranges": 2,
    "depth_normals": 95,
    "duplicate_mask": 6,
    "estimate_normals": 7,
    "f_score": 13,
    "farthest_point_groups": 3,
    "farthest_point_sample": 11,
    "fill_holes": 16,
    "find_voxel_size": 70,
    "fit_paired_points": 4,
    "flying_pixel_mask": 1,
    "frustum_mask": 6,
    "hard_voxels": 10,
    "hausdorff_distance": 13,
    "hidden_point_mask": 10,
    "image_clusters": 61,
    "interpolate_features": 7,
    "iterate_closest_points": 45,
    "knn": 44,
    "median_filter": 1,
    "neighborhood_covariance": 8,
    "pack_colors": 0,
    "polygon_mask": 1,
    "project_points": 6,
    "radius_neighbors": 18,
    "radius_outlier_mask": 12,
    "ransac_circle": 21,
    "ransac_cylinder": 37,
    "ransac_line": 19,
    "ransac_plane": 34,
    "ransac_sphere": 27,
    "register_depth": 137,
    "render_points": 7,
    "render_ranges": 2,
    "render_triangles": 102,
    "resize_depth": 1,
    "segment_planes": 177,
    "spatial_filter": 1,
    "statistical_outlier_mask": 7,
    "supporting_plane": 550,
    "table_surface": 269,
    "undistort_depth": 11,
    "undistort_image": 11,
    "voxel_downsample": 6,
}

# Each loops over clouds, or over cameras; the others launch as much for many clouds as for few.
LOOPS = {
    "deproject_depth": "every camera has its own lens",
    "depth_normals": "every camera has its own lens",
    "frustum_mask": "every camera has its own lens",
    "project_points": "every camera has its own lens",
    "register_depth": "every camera has its own lens",
    "render_points": "every camera has its own lens",
    "render_triangles": "every camera has its own lens",
    "undistort_depth": "every camera has its own lens",
    "undistort_image": "every camera has its own lens",
    "ransac_circle": "blocks of hypotheses are those of one cloud",
    "ransac_cylinder": "blocks of hypotheses are those of one cloud",
    "ransac_line": "blocks of hypotheses are those of one cloud",
    "ransac_plane": "blocks of hypotheses are those of one cloud",
    "ransac_sphere": "blocks of hypotheses are those of one cloud",
    "segment_planes": "a cloud has as many planes as it has",
    "supporting_plane": "a cloud has as many planes as it has",
    "table_surface": "every table has its own height map",
    "find_voxel_size": "the search ends when the last cloud's does",
    "iterate_closest_points": "the rounds end when the last cloud's do",
    "farthest_point_sample": "groups of rows are those of one cloud",
    "farthest_point_groups": "groups of rows are those of one cloud",
    "knn": "in six dimensions distances are those of one cloud",
}


def named(example: Example) -> str:
    return f"{example.name}-{example.cloud.__name__}"


def watched_call(example: Example, counts: tuple[int, ...]) -> tuple[tuple[torch.Tensor, ...], Watched]:
    arguments = {key: pretend(value) for key, value in packed(example, clouds_of(example, counts)).items()}
    with watching() as watched:
        found = call(example, arguments)
    return found, watched


@each_example
def test_the_answer_is_that_of_the_reference_and_stays_on_the_device(example):
    expected = call(example, packed(example, clouds_of(example)), backend="torch")
    found, watched = watched_call(example, COUNTS)
    for one, other in zip(found, expected, strict=True):
        assert one.device.type == pretend_device.NAME
        assert torch.equal(host(one), other)
    waits = sum(watched.waits.values())
    assert waits <= MOST_WAITS[example.name], watched.waits


@pytest.mark.parametrize("example", [example for example in EXAMPLES if example.name not in LOOPS], ids=named)
def test_many_clouds_take_no_more_launches_than_few(example):
    few, many = (watched_call(example, (30, 21, 40) * times)[1] for times in (1, 5))
    assert many.launches <= 1.5 * few.launches + 60, many.launches - few.launches
    assert many.waits.total() <= 1.5 * few.waits.total() + 20, many.waits - few.waits


def test_what_loops_is_known_and_nothing_else():
    assert set(LOOPS) < set(OPERATIONS)


def test_the_device_refuses_what_a_gpu_refuses():
    there, here = pretend(torch.ones(3)), torch.ones(3)
    with pytest.raises(RuntimeError, match="same device"):
        there + here
    with pytest.raises(RuntimeError, match="same device"):
        torch.where(here > 0, there, there)
    with pytest.raises(TypeError, match="numpy"):
        there.numpy()
    with pytest.raises(RuntimeError, match="address"):
        there.data_ptr()
    with pytest.raises(RuntimeError, match="indices"):
        here[pretend(torch.tensor([0, 1]))]
    assert torch.equal(host(there + torch.tensor(1.0)), torch.full((3,), 2.0))  # a number of the host may be mixed in


def test_the_device_counts_what_a_gpu_waits_for():
    there = pretend(torch.tensor([0.0, 1.0, 2.0]))
    with watching() as watched:
        there.sum() + 1
        there.to(torch.float64)
    assert not watched.waits
    assert not watched.uploads
    assert watched.launches == 3
    for waits in (
        lambda: there.sum().item(),
        lambda: bool((there > 0).any()),
        lambda: there.tolist(),
        lambda: there.cpu(),
        lambda: there[there > 0],
        lambda: there.nonzero(),
        lambda: torch.empty(3).copy_(there),
    ):
        with watching() as watched:
            waits()
        assert watched.waits.total() == 1, watched.waits
    with watching() as watched:
        torch.ones(3).to(there.device)
        there[torch.tensor([0, 1])]
    assert watched.uploads.total() == watched.waits.total() == 2
    with watching() as watched:
        torch.ones(3).to(there.device, non_blocking=True)
    assert watched.uploads.total() == 1
    assert not watched.waits
