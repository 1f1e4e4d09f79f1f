from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pcdata.errors import ConfigError, DTypeError, OutOfRangeError, ShapeError, TooFewPointsError
from pcdata.functional.rows import ptr_from_counts
from pcdata.functional.sampling import farthest_point_groups, farthest_point_sample, random_sample_index


def brute_force(points: np.ndarray, count: int, start: int = 0) -> list[int]:
    """The contract written down once more, in NumPy."""
    picks = [start]
    nearest = np.full(len(points), np.inf, dtype=np.float32)
    while len(picks) < count:
        difference = points - points[picks[-1]]
        total, *squares = (difference * difference).T
        for square in squares:
            total = total + square
        nearest = np.minimum(nearest, total)
        nearest[picks[-1]] = -1
        picks.append(int(np.argmax(nearest)))
    return picks[:count]


def cloud(count: int, seed: int = 0, levels: int | None = None) -> torch.Tensor:
    """Random points; with ``levels``, on a coarse lattice full of ties and duplicates."""
    generator = torch.Generator().manual_seed(seed)
    if levels is not None:
        return torch.randint(levels, (count, 3), generator=generator).float()
    return torch.randn((count, 3), generator=generator)


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 60), st.integers(0, 99), st.sampled_from([None, 1, 2, 4]), st.sampled_from([1.0, 1e-6, 1e6]))
def test_picks_equal_brute_force_with_ties_and_duplicates(count, seed, levels, scale):
    points = cloud(count, seed, levels) * scale
    index, ptr = farthest_point_sample(points, num_samples=count)
    assert index.tolist() == brute_force(points.numpy(), count)
    assert sorted(index.tolist()) == list(range(count))
    assert ptr.tolist() == [0, count]


def test_picks_equal_brute_force_over_several_tiles():
    points = cloud(5000, levels=12)
    index, _ = farthest_point_sample(points, num_samples=2000)
    assert index.tolist() == brute_force(points.numpy(), 2000)


def test_duplicates_are_taken_last_and_in_row_order():
    points = torch.tensor([[0.0, 0, 0], [0, 0, 0], [1, 0, 0], [1, 0, 0], [5, 0, 0]])
    assert farthest_point_sample(points, num_samples=5)[0].tolist() == [0, 4, 2, 1, 3]


def test_squared_distances_that_overflow_still_give_distinct_points():
    points = cloud(20) * 1e30
    assert len(farthest_point_sample(points, num_samples=20)[0].unique()) == 20


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(0, 20), min_size=1, max_size=5), st.integers(0, 99))
def test_a_batch_is_each_cloud_alone(counts, seed):
    ptr = ptr_from_counts(counts)
    points = cloud(sum(counts), seed, levels=5)
    wanted = [count // 2 for count in counts]
    index, out_ptr = farthest_point_sample(points, ptr, num_samples=torch.tensor(wanted))
    alone = [
        start + farthest_point_sample(points[start:stop], num_samples=k)[0]
        for start, stop, k in zip(ptr.tolist(), ptr[1:].tolist(), wanted)
    ]
    assert torch.equal(index, torch.cat(alone))
    assert out_ptr.diff().tolist() == wanted


def test_fewer_samples_are_the_start_of_more():
    points = cloud(200)
    more = farthest_point_sample(points, num_samples=50)[0]
    assert torch.equal(farthest_point_sample(points, num_samples=20)[0], more[:20])


def test_asking_for_more_points_than_there_are_names_the_cloud():
    with pytest.raises(TooFewPointsError, match="5 points were asked of cloud 1, which has 3"):
        farthest_point_sample(cloud(13), torch.tensor([0, 10, 13]), num_samples=5)


def test_wrong_counts_are_refused():
    with pytest.raises(ShapeError, match="2 counts were given for 1 clouds"):
        farthest_point_sample(cloud(5), num_samples=[1, 2])
    with pytest.raises(DTypeError, match=r"must be an int.*2\.5"):
        farthest_point_sample(cloud(5), num_samples=2.5)
    with pytest.raises(ConfigError, match="negative"):
        farthest_point_sample(cloud(5), num_samples=-1)


def test_inputs_that_require_gradients_are_sampled():
    assert len(farthest_point_sample(cloud(9).requires_grad_(), num_samples=3)[0]) == 3


def test_a_real_frame_is_sampled_as_by_brute_force(frame_points: torch.Tensor):
    index, _ = farthest_point_sample(frame_points, num_samples=1024)
    assert index.tolist() == brute_force(frame_points.numpy(), 1024)


def test_random_rows_are_distinct_and_inside_their_cloud():
    ptr = torch.tensor([0, 10, 10, 40])
    index, out_ptr = random_sample_index(ptr, [10, 0, 12], torch.tensor([1, 2, 3]))
    assert out_ptr.tolist() == [0, 10, 10, 22]
    assert sorted(index[:10].tolist()) == list(range(10))
    assert len(index[10:].unique()) == 12
    assert bool(((index[10:] >= 10) & (index[10:] < 40)).all())


@pytest.mark.parametrize("replace", [False, True])
def test_random_rows_depend_on_the_clouds_own_seed_alone(replace):
    ptr = torch.tensor([0, 50, 90])
    index, _ = random_sample_index(ptr, 20, torch.tensor([7, 8]), replace=replace)
    alone, _ = random_sample_index(torch.tensor([0, 40]), 20, torch.tensor([8]), replace=replace)
    assert torch.equal(index[20:], 50 + alone)
    other, _ = random_sample_index(torch.tensor([0, 40]), 20, torch.tensor([9]), replace=replace)
    assert not torch.equal(alone, other)


def test_more_random_rows_extend_fewer():
    ptr, seed = torch.tensor([0, 100]), torch.tensor([4])
    more, _ = random_sample_index(ptr, 60, seed)
    assert torch.equal(random_sample_index(ptr, 10, seed)[0], more[:10])


def test_random_rows_are_uniform():
    picked = torch.cat([random_sample_index(torch.tensor([0, 10]), 3, torch.tensor([s]))[0] for s in range(2000)])
    counts = torch.bincount(picked, minlength=10)
    assert int((counts - 600).abs().max()) < 100  # about five standard deviations


def test_replacement_repeats_rows_but_needs_one():
    index, _ = random_sample_index(torch.tensor([0, 3]), 50, torch.tensor([0]), replace=True)
    assert index.unique().tolist() == [0, 1, 2]
    with pytest.raises(TooFewPointsError, match="cloud 0"):
        random_sample_index(torch.tensor([0, 0]), 1, torch.tensor([0]), replace=True)
    with pytest.raises(TooFewPointsError, match="4 points were asked of cloud 0, which has 3"):
        random_sample_index(torch.tensor([0, 3]), 4, torch.tensor([0]))


def test_seeds_must_be_one_per_cloud():
    with pytest.raises(ShapeError, match="1 seeds were given for 2 clouds"):
        random_sample_index(torch.tensor([0, 3, 6]), 1, torch.tensor([0]))


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 40), st.integers(0, 99), st.sampled_from([None, 2, 4]), st.sampled_from([1, 3, 6]))
def test_any_start_and_any_number_of_columns_equal_brute_force(count, seed, levels, columns):
    points = cloud(count * columns, seed, levels).reshape(-1)[: count * columns].reshape(count, columns)
    start = seed % count
    index, _ = farthest_point_sample(points, num_samples=count, start=torch.tensor([start]))
    assert index.tolist() == brute_force(points.numpy(), count, start)


def test_many_clouds_of_any_size_are_sampled_side_by_side():
    counts = [0, 1, 5, 1500, 90, 2100, 64, 63, 0]
    ptr = ptr_from_counts(counts)
    points = cloud(sum(counts), 3, levels=9)
    wanted = [min(count, 40) for count in counts]
    index, _ = farthest_point_sample(points, ptr, num_samples=wanted, backend="torch")
    expected = [
        first + row
        for first, count, k in zip(ptr.tolist(), counts, wanted)
        if k
        for row in brute_force(points[first : first + count].numpy(), k)
    ]
    assert index.tolist() == expected


def test_a_ratio_gives_the_counts_that_torch_cluster_gives():
    ptr = ptr_from_counts([10, 30, 1, 0, 7])
    _, out_ptr = farthest_point_sample(cloud(48), ptr, ratio=0.1)
    assert out_ptr.diff().tolist() == [1, 3, 1, 0, 1]  # ceil(0.1 * n) in float32
    with pytest.raises(ConfigError, match="give either num_samples"):
        farthest_point_sample(cloud(5), num_samples=2, ratio=0.5)
    with pytest.raises(ConfigError, match="give either num_samples"):
        farthest_point_groups(cloud(5))


def test_seeds_draw_a_start_of_each_cloud_that_does_not_depend_on_the_batch():
    ptr = ptr_from_counts([50, 20])
    points = cloud(70)
    index, _ = farthest_point_sample(points, ptr, num_samples=4, seeds=torch.tensor([5, 6]))
    alone, _ = farthest_point_sample(points[50:], num_samples=4, seeds=torch.tensor([6]))
    assert torch.equal(index[4:] - 50, alone)
    firsts = [int(farthest_point_sample(points, num_samples=1, seeds=torch.tensor([s]))[0]) for s in range(400)]
    assert min(firsts) < 5
    assert max(firsts) > 64
    assert len(set(firsts)) > 60
    with pytest.raises(ConfigError, match="give either start, a row of each cloud, or seeds"):
        farthest_point_sample(points, num_samples=1, seeds=torch.tensor([1]), start=torch.tensor([1]))
    with pytest.raises(OutOfRangeError, match="start 20 is no row of cloud 1, which has 20"):
        farthest_point_sample(points, ptr, num_samples=1, start=torch.tensor([49, 20]))


def test_labels_get_equal_shares_as_far_as_they_have_points():
    labels = torch.tensor([0] * 50 + [7] * 3 + [-1] * 20 + [4] * 4 + [4] * 30)
    points, ptr = cloud(107), torch.tensor([0, 77, 107])
    index, out_ptr = farthest_point_sample(points, ptr, labels=labels, num_samples=[20, 9])
    assert out_ptr.tolist() == [0, 20, 29]
    first = index[:20]
    assert len(first.unique()) == 20
    shares = {label: int((labels[first] == label).sum()) for label in (-1, 0, 4, 7)}
    assert shares == {-1: 7, 0: 6, 4: 4, 7: 3}
    assert labels[first[:8]].tolist() == [-1, 0, 4, 7] * 2  # in turns
    alone, _ = farthest_point_sample(points[:50], num_samples=6)
    assert torch.equal(first[labels[first] == 0], alone)
    assert torch.equal(index[20:] - 77, farthest_point_sample(points[77:], num_samples=9)[0])


def test_every_point_is_grouped_with_its_nearest_sample():
    counts = [60, 0, 33]
    ptr = ptr_from_counts(counts)
    points = cloud(93, 2, levels=4)
    asked = {"num_samples": [9, 0, 5], "start": torch.tensor([7, 0, 2])}
    index, out_ptr, group, distance = farthest_point_groups(points, ptr, **asked)
    assert torch.equal(index, farthest_point_sample(points, ptr, **asked)[0])
    for b, (start, stop) in enumerate(zip(ptr.tolist(), ptr[1:].tolist())):
        samples = points[index[out_ptr[b] : out_ptr[b + 1]]]
        if len(samples):
            apart = torch.cdist(points[start:stop].double(), samples.double())
            assert torch.equal(group[start:stop] - out_ptr[b], apart.argmin(1))  # the first of equals
            torch.testing.assert_close(distance[start:stop].double(), apart.amin(1))
