"""The compiled sampling kernels give the reference's results bit for bit: any cloud, thread count, instruction set."""

from __future__ import annotations

import signal
import threading
import time
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pcdata.contracts.dispatch import why_unavailable
from pcdata.functional.depth.deproject import deproject_depth
from pcdata.functional.rows import ptr_from_counts
from pcdata.functional.sampling import farthest_point_sample
from pcdata.functional.voxels import find_voxel_size, voxel_downsample
from pcdata.rng import seeded
from tests.kernels.cpu.clouds import CLOUDS, assert_equal_to_reference, extent_of, organized, random

REASON = why_unavailable("cpu")
pytestmark = pytest.mark.skipif(REASON is not None, reason=str(REASON))

few = settings(max_examples=30, deadline=None)


@pytest.mark.parametrize("name", CLOUDS)
def test_farthest_points_equal_the_reference(name, machine):
    points, counts = CLOUDS[name]
    wanted = [count if count <= 900 else 60 for count in counts]
    assert_equal_to_reference(farthest_point_sample, points, ptr_from_counts(counts), num_samples=wanted, case=(name,))


@few
@given(
    st.lists(st.integers(0, 90), min_size=1, max_size=4),
    st.integers(0, 999),
    st.sampled_from([1, 2, 5, 50, 10**6]),
    st.sampled_from([1e-30, 1e-3, 1.0, 1e6]),
)
def test_farthest_points_of_small_clouds_equal_the_reference(counts, seed, levels, scale):
    generator = torch.Generator().manual_seed(seed)
    points = torch.randint(levels, (sum(counts), 3), generator=generator).float() * scale
    assert_equal_to_reference(farthest_point_sample, points, ptr_from_counts(counts), num_samples=counts)


def test_farthest_points_of_none_or_too_few():
    points, ptr = random(10, 3), ptr_from_counts([4, 6])
    for wanted in (0, [0, 3], [5, 1], -1, [1]):
        assert_equal_to_reference(farthest_point_sample, points, ptr, num_samples=wanted)


def test_many_farthest_points_of_a_large_cloud_equal_the_reference():
    points = organized(120, 160)
    assert_equal_to_reference(farthest_point_sample, points, num_samples=2000)


@pytest.mark.parametrize("order", ["image", "holes", "strays", "repeated", "shuffled"])
def test_pixels_side_by_side_are_sampled_as_any_points_are(order, machine):
    """Pieces of rows of an image are sorted as one, but for those over an edge; the last is no whole piece."""
    points, generator = organized(100, 155)[:-3], seeded(3)
    points[5000:9000] += 0.4  # an edge
    if order == "holes":
        points = points[torch.rand(len(points), generator=generator) < 0.8]
    elif order == "strays":
        points[::701] *= 1e4
    elif order == "repeated":
        points[2000:14_000] = points[2000]
    elif order == "shuffled":
        points = points[torch.randperm(len(points), generator=generator)]
    assert_equal_to_reference(farthest_point_sample, points, num_samples=150, case=(order, "pixels"))


def test_a_dense_spot_far_from_the_rest_is_sampled_exactly():
    # Every level of the spatial sort sees two clusters: the recursion is as deep as float32 allows.
    points = torch.cat([random(400, 3, seed=k) * 2.0**-k for k in range(0, 100, 4)])
    assert_equal_to_reference(farthest_point_sample, points, num_samples=200)


def test_ctrl_c_stops_farthest_point_sampling_within_a_second():
    if threading.current_thread() is not threading.main_thread():
        pytest.skip("signals reach the main thread only")

    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    points = random(400_000, 3)
    before = signal.signal(signal.SIGPROF, interrupt)
    try:
        started = time.process_time()  # like the timer, it does not run while other processes have the cores
        signal.setitimer(signal.ITIMER_PROF, 0.2)
        with pytest.raises(KeyboardInterrupt):
            farthest_point_sample(points, num_samples=400_000, backend="cpu")
        assert time.process_time() - started < 1.2
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


@pytest.mark.parametrize("cells_per_extent", [0.5, 7.0, 300.0, 1e7, 1e17])
@pytest.mark.parametrize("name", CLOUDS)
def test_voxels_equal_the_reference(name, cells_per_extent, machine):
    points, counts = CLOUDS[name]
    size = (extent_of(points) or 1.0) / cells_per_extent
    case = (name, cells_per_extent)
    assert_equal_to_reference(voxel_downsample, points, ptr_from_counts(counts), voxel_size=size, case=case)


@few
@given(
    st.lists(st.integers(0, 60), min_size=1, max_size=4),
    st.integers(0, 999),
    st.sampled_from([1e-3, 0.3, 1.0, 1e9]),
    st.sampled_from([1e-6, 1e-3, 1.0, 1e6]),
)
def test_voxels_of_small_clouds_with_a_size_each_equal_the_reference(counts, seed, relative, scale):
    points = random(sum(counts), 3, seed=seed) * scale
    sizes = [scale * relative * (1 + cloud) for cloud in range(len(counts))]
    assert_equal_to_reference(voxel_downsample, points, ptr_from_counts(counts), voxel_size=sizes)


def test_points_on_voxel_borders_fall_where_the_reference_puts_them():
    axis = torch.arange(40.0) * 0.1
    points = torch.cartesian_prod(axis, axis, axis)
    for size in (0.1, 0.2, 0.05, 1 / 3):
        assert_equal_to_reference(voxel_downsample, points, voxel_size=size)


@pytest.mark.parametrize("name", CLOUDS)
def test_the_voxel_size_found_equals_the_reference(name):
    points, counts = CLOUDS[name]
    if max(counts) > 10_000:
        points, counts = points[:10_000], [10_000]
    for num_points in (1, 3, 200):
        assert_equal_to_reference(find_voxel_size, points, ptr_from_counts(counts), num_points=num_points)
    assert_equal_to_reference(find_voxel_size, points, ptr_from_counts(counts), num_points=0)


def test_a_real_frame_gives_the_references_results(frame, machine):
    points, _, _ = deproject_depth(*frame)
    assert_equal_to_reference(farthest_point_sample, points, num_samples=64, case=("real",))
    assert_equal_to_reference(farthest_point_sample, points[::40], num_samples=2000, case=("real, thin",))
    assert_equal_to_reference(voxel_downsample, points, voxel_size=0.003, case=("real",))
