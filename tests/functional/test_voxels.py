from __future__ import annotations

import itertools
from collections import Counter

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pcdata.errors import ConfigError, DTypeError, ShapeError, TooFewPointsError, UnitError
from pcdata.functional.rows import ptr_from_counts
from pcdata.functional.voxel_averages import voxel_majority, voxel_mean, voxel_mean_direction
from pcdata.functional.voxels import find_voxel_size, voxel_downsample, voxel_nearest
from pcdata.rng import seeded


def cloud(count: int, seed: int = 0) -> torch.Tensor:
    return torch.rand((count, 3), generator=torch.Generator().manual_seed(seed))


def brute_force(points: np.ndarray, voxel_size: float) -> tuple[np.ndarray, list[int]]:
    """Open3D's grid in plain Python: means in the order the voxels first appear, and each point's voxel."""
    wide = points.astype(np.float64)
    origin = wide.min(axis=0) - voxel_size / 2
    numbers: dict[tuple[float, ...], int] = {}
    inverse = [numbers.setdefault(tuple(np.floor((p - origin) / voxel_size)), len(numbers)) for p in wide]
    means = [wide[np.array(inverse) == number].mean(axis=0) for number in range(len(numbers))]
    return np.array(means), inverse


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 80), st.integers(0, 99), st.floats(0.05, 2.0), st.sampled_from([1e-3, 1.0, 1e3, 1e6]))
def test_voxels_and_means_equal_brute_force(count, seed, voxel_size, scale):
    points = cloud(count, seed) * scale
    means, ptr, inverse = voxel_downsample(points, voxel_size=voxel_size * scale)
    expected, expected_inverse = brute_force(points.numpy(), voxel_size * scale)
    np.testing.assert_allclose(means.numpy(), expected, rtol=2e-7, atol=1e-9 * scale)
    assert inverse.tolist() == expected_inverse
    assert ptr.tolist() == [0, len(expected)]


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(0, 30), min_size=1, max_size=5), st.integers(0, 99))
def test_a_batch_is_each_cloud_alone(counts, seed):
    ptr = ptr_from_counts(counts)
    points = cloud(sum(counts), seed)
    sizes = [0.2 + 0.1 * one for one in range(len(counts))]
    means, out_ptr, inverse = voxel_downsample(points, ptr, voxel_size=torch.tensor(sizes, dtype=torch.float64))
    alone = [voxel_downsample(part, voxel_size=size) for part, size in zip(points.split(counts), sizes)]
    assert torch.equal(means, torch.cat([one[0] for one in alone]))
    assert out_ptr.diff().tolist() == [len(one[0]) for one in alone]
    shifted = [one[2] + int(start) for one, start in zip(alone, out_ptr)]
    assert torch.equal(inverse, torch.cat(shifted))


def test_the_order_of_points_does_not_change_a_bit_of_the_means():
    points = cloud(20_000)
    shuffled = points[torch.randperm(len(points), generator=torch.Generator().manual_seed(1))]
    means = [voxel_downsample(p, voxel_size=0.1)[0] for p in (points, shuffled)]
    assert torch.equal(*(m.unique(dim=0) for m in means))


def test_voxels_come_in_the_order_of_their_lowest_row():
    _, _, inverse = voxel_downsample(cloud(500).requires_grad_(), voxel_size=0.2)
    first_rows = [inverse.tolist().index(voxel) for voxel in range(int(inverse.max()) + 1)]
    assert first_rows == sorted(first_rows)


def test_duplicates_become_one_point_at_their_place():
    point = torch.tensor([[0.1234567, -7.654321, 1e-3]])
    means, _, inverse = voxel_downsample(point.repeat(1000, 1), voxel_size=0.01)
    torch.testing.assert_close(means, point, rtol=1e-7, atol=0)
    assert inverse.tolist() == [0] * 1000


def test_an_empty_cloud_stays_empty():
    means, ptr, inverse = voxel_downsample(torch.zeros(0, 3), voxel_size=0.1)
    assert means.shape == (0, 3)
    assert ptr.tolist() == [0, 0]
    assert inverse.shape == (0,)


def test_keys_too_wide_for_64_bits_still_tell_voxels_apart():
    # 2e9 voxels along each axis: 2^93 cells, far more than any packed 64-bit key holds.
    corners = torch.tensor([[x, y, z] for x in (-1e6, 1e6) for y in (-1e6, 1e6) for z in (-1e6, 1e6)])
    points = torch.cat([corners, corners])
    means, _, inverse = voxel_downsample(points, voxel_size=1e-3)
    torch.testing.assert_close(means, corners, rtol=1e-7, atol=0)
    assert inverse.tolist() == [*range(8), *range(8)]


def test_voxels_whose_packed_keys_would_wrap_to_the_same_number_stay_apart():
    # 2^32 voxels along each axis: one step in x is 2^64 in a packed key, which is 0.
    step = 1 / (2**32 - 1)
    points = torch.tensor([[0.0, 0, 0], [step, 0, 0], [1, 1, 1]])
    assert voxel_downsample(points, voxel_size=step)[2].tolist() == [0, 1, 2]


def test_an_extent_that_float64_cannot_count_is_an_error():
    with pytest.raises(UnitError, match=r"cloud 1 spans 2e\+16 voxels of 1e-10.*unit of the points"):
        voxel_downsample(torch.tensor([[0.0] * 3, [0.0] * 3, [2e6] * 3]), torch.tensor([0, 1, 3]), voxel_size=1e-10)


@pytest.mark.parametrize(
    ("size", "error"),
    [(0.0, ConfigError), (-1.0, ConfigError), (float("nan"), ConfigError), ([0.1, 0.2], ShapeError)],
)
def test_wrong_voxel_sizes_are_refused(size, error):
    with pytest.raises(error, match="voxel_downsample: voxel_size"):
        voxel_downsample(cloud(5), voxel_size=size)


@pytest.mark.open3d
@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_a_real_frame_thins_as_open3d_does(frame_points: torch.Tensor, unit: float):
    open3d = pytest.importorskip("open3d")
    spatial = pytest.importorskip("scipy.spatial")
    points = frame_points * unit
    theirs = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.double().numpy()))
    expected = np.asarray(theirs.voxel_down_sample(0.003 * unit).points)
    means, _, _ = voxel_downsample(points, voxel_size=0.003 * unit)
    assert len(means) == len(expected)
    apart, nearest = spatial.cKDTree(expected).query(means.double().numpy())
    assert apart.max() < 1e-6 * unit
    assert len(set(nearest)) == len(expected)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 4), st.integers(-2, 3)), max_size=40))
def test_votes_go_to_the_most_frequent_then_lowest_label(pairs):
    inverse = torch.tensor([voxel for voxel, _ in pairs], dtype=torch.int64)
    labels = torch.tensor([label for _, label in pairs], dtype=torch.int64)
    expected = []
    for voxel in range(5):
        votes = Counter(label for v, label in pairs if v == voxel)
        expected.append(min(votes, key=lambda label: (-votes[label], label)) if votes else -1)
    assert voxel_majority(labels, inverse, 5).tolist() == expected


def test_labels_far_apart_are_not_averaged_or_overflowed():
    labels = torch.tensor([2**62, -(2**62), 2**62])
    assert voxel_majority(labels, torch.zeros(3, dtype=torch.int64), 1).tolist() == [2**62]


def test_colors_average_and_keep_their_dtype():
    colors = torch.tensor([[0.0, 1.0], [1.0, 0.0], [0.5, 0.5]])
    means = voxel_mean(colors, torch.tensor([0, 0, 2]), 3)
    assert means.tolist() == [[0.5, 0.5], [0.0, 0.0], [0.5, 0.5]]
    assert means.dtype == torch.float32


def test_integers_have_no_mean_and_floats_no_vote():
    group = torch.zeros(2, dtype=torch.int64)
    with pytest.raises(DTypeError, match="voxel_majority"):
        voxel_mean(torch.zeros(2, 1).long(), group, 1)
    with pytest.raises(DTypeError, match="int64"):
        voxel_majority(torch.zeros(2), group, 1)


def test_mean_directions_have_unit_length_or_none():
    directions = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1]])
    means = voxel_mean_direction(directions, torch.tensor([0, 0, 1, 1]), 2)
    half = 0.5**0.5
    torch.testing.assert_close(means, torch.tensor([[half, half, 0], [0, 0, 0]]))


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 200), st.integers(0, 99), st.sampled_from([1e-3, 1.0, 1e6]))
def test_the_size_found_leaves_enough_points_and_a_little_more_leaves_fewer(num_points, seed, scale):
    points = cloud(200, seed) * scale
    size = find_voxel_size(points, num_points=num_points)
    count = len(voxel_downsample(points, voxel_size=size)[0])
    assert count >= num_points
    if count > num_points:
        assert len(voxel_downsample(points, voxel_size=size * (1 + 1e-6))[0]) < num_points


def test_a_size_is_found_for_each_cloud_alone():
    ptr = torch.tensor([0, 300, 1000])
    points = cloud(1000) * torch.tensor([1.0, 1.0, 0.1])
    sizes = find_voxel_size(points, ptr, num_points=50)
    assert sizes.dtype == torch.float64
    assert torch.equal(sizes[1:], find_voxel_size(points[300:], num_points=50))
    counts = voxel_downsample(points, ptr, voxel_size=sizes)[1].diff()
    assert bool((counts >= 50).all())
    assert int(counts.max()) <= 52


def test_duplicates_do_not_count_as_points_to_find():
    points = cloud(5).repeat(10, 1)
    assert len(voxel_downsample(points, voxel_size=find_voxel_size(points, num_points=5))[0]) == 5
    with pytest.raises(TooFewPointsError, match="6 points were asked of cloud 0, which has 5 distinct ones"):
        find_voxel_size(points, num_points=6)
    with pytest.raises(TooFewPointsError, match="cloud 1, which has 0 distinct"):
        find_voxel_size(points, torch.tensor([0, 50, 50]), num_points=1)
    with pytest.raises(ConfigError, match="num_points"):
        find_voxel_size(points, num_points=0)


def test_one_point_fits_any_voxel():
    assert float(find_voxel_size(torch.ones(1, 3), num_points=1)) > 0


def by_hand(points, size, origin):
    """Voxel -> rows, in the order of their lowest row."""
    voxels: dict[tuple[int, ...], list[int]] = {}
    for row, cell in enumerate(np.floor((points.double().numpy() - origin) / size).astype(int).tolist()):
        voxels.setdefault(tuple(cell), []).append(row)
    return voxels


def test_a_stated_grid_with_edges_per_axis_holds_the_points_that_it_says():
    points, size, origin = (
        torch.rand(300, 3, generator=seeded(1)),
        np.array([0.2, 0.3, 0.5]),
        np.array([0.05, -0.1, 7.0]),
    )
    voxels = by_hand(points, size, origin)
    means, ptr, inverse = voxel_downsample(points, voxel_size=size[None], origin=origin)
    assert int(ptr[-1]) == len(voxels)
    for number, rows in enumerate(voxels.values()):
        assert inverse[rows].tolist() == [number] * len(rows)
        torch.testing.assert_close(means[number], points[rows].mean(0), atol=1e-6, rtol=0)
    full = {cell: rows for cell, rows in voxels.items() if len(rows) >= 5}
    few, _, where = voxel_downsample(points, voxel_size=size[None], origin=origin, min_points=5)
    assert torch.equal(few, means[[number for number, rows in enumerate(voxels.values()) if len(rows) >= 5]])
    assert sorted((where >= 0).nonzero().squeeze(1).tolist()) == sorted(itertools.chain(*full.values()))


def test_clouds_that_share_a_grid_share_its_voxels():
    points = torch.rand(100, 3, generator=seeded(2)) - 0.5
    both, ptr = torch.cat([points, points[::3] + 1e-9]), torch.tensor([0, 100, 134])
    means, means_ptr, _ = voxel_downsample(both, ptr, voxel_size=0.25, origin=(0.0, 0.0, 0.0))
    cells = [set(map(tuple, torch.floor(means[a:b] / 0.25).int().tolist())) for a, b in itertools.pairwise(means_ptr)]
    assert cells[1] <= cells[0]


def test_the_point_nearest_to_the_center_of_each_voxel_is_found():
    points, size = torch.rand(300, 3, generator=seeded(3)), torch.tensor([[0.2, 0.3, 0.5]], dtype=torch.float64)
    ptr, origin = torch.tensor([0, 300]), torch.tensor([[0.1, 0.0, -0.3]], dtype=torch.float64)
    means, _, inverse = voxel_downsample(points, voxel_size=size, origin=origin)
    found = voxel_nearest(points, ptr, inverse, len(means), voxel_size=size, origin=origin)
    for number, (cell, rows) in enumerate(by_hand(points, size.numpy(), origin.numpy()).items()):
        center = origin[0] + (torch.tensor(cell) + 0.5) * size[0]
        assert int(found[number]) == rows[int((points[rows].double() - center).square().sum(1).argmin())]


def test_the_gradient_of_means_leaves_out_the_points_of_voxels_left_out():
    points = torch.rand(60, 3, generator=seeded(4)).requires_grad_()
    means, _, inverse = voxel_downsample(points, voxel_size=0.4, min_points=3)
    means.sum().backward()
    size = torch.bincount(inverse[inverse >= 0])
    wanted = torch.where(inverse < 0, 0.0, 1.0 / size[inverse.clamp(min=0)])
    torch.testing.assert_close(points.grad, wanted[:, None].expand(-1, 3))
