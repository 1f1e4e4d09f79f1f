"""Iterated closest points: known motions, a loop over SciPy's tree in float64, and batches."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from pcdata.errors import ConfigError, DTypeError, PoseError, TooFewPointsError
from pcdata.functional.closest_points import iterate_closest_points
from pcdata.functional.rows import ptr_from_counts
from pcdata.rng import seeded


def motion(degrees: float, shift: float, scale: float = 1.0) -> torch.Tensor:
    matrix = torch.eye(4, dtype=torch.float64)
    turn = Rotation.from_rotvec(np.radians(degrees) * np.ones(3) / 3**0.5)
    matrix[:3, :3] = scale * torch.from_numpy(turn.as_matrix())
    matrix[:3, 3] = shift
    return matrix


def pair(seed: int, matrix: torch.Tensor, count: int = 400) -> tuple[torch.Tensor, torch.Tensor]:
    points = torch.rand(count, 3, generator=seeded(seed), dtype=torch.float64)
    targets = points @ matrix[:3, :3].T + matrix[:3, 3]
    return points.float(), targets[torch.randperm(count, generator=seeded(9))].float()


@pytest.mark.parametrize("scale", [1.0, 1.03])
def test_small_motions_are_found_exactly(scale):
    matrix = motion(2.0, 0.01, scale)
    points, targets = pair(0, matrix)
    found = iterate_closest_points(points, targets, with_scale=scale != 1.0)
    torch.testing.assert_close(found.matrix[0], matrix, atol=1e-6, rtol=0)
    assert float(found.scale) == pytest.approx(scale, abs=1e-6)
    assert float(found.rmse) < 1e-6
    assert found.overlap.tolist() == [1.0]


def by_loop(points: np.ndarray, targets: np.ndarray, rounds: int, radius: float) -> tuple[np.ndarray, float]:
    tree, rotation, shift = cKDTree(targets), np.eye(3), np.zeros(3)
    for _ in range(rounds):
        distance, index = tree.query(points @ rotation.T + shift)
        a, b = points[distance < radius], targets[index[distance < radius]]
        left, _, right = np.linalg.svd((b - b.mean(0)).T @ (a - a.mean(0)))
        rotation = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
        shift = b.mean(0) - rotation @ a.mean(0)
    return np.concatenate([rotation, shift[:, None]], 1), float(
        np.sqrt((((a @ rotation.T + shift) - b) ** 2).sum(1).mean())
    )


@pytest.mark.parametrize("radius", [10.0, 0.08])
def test_rounds_are_those_of_the_loop(radius):
    points, targets = pair(3, motion(6.0, 0.03))
    targets = targets[:300]
    for rounds in (1, 2, 7):
        found = iterate_closest_points(points, targets, max_rounds=rounds, tolerance=1e-15, max_distance=radius)
        matrix, rmse = by_loop(points.double().numpy(), targets.double().numpy(), rounds, radius)
        np.testing.assert_allclose(found.matrix[0, :3].numpy(), matrix, atol=1e-6)
        assert float(found.rmse) == pytest.approx(rmse, rel=1e-4)


def test_a_batch_is_each_pair_alone_and_starts_where_it_is_told():
    pairs = [pair(n, motion(1.0 + n, 0.01 * n), 60 + 40 * n) for n in range(4)]
    ptr = ptr_from_counts([len(points) for points, _ in pairs])
    points, targets = (torch.cat(side) for side in zip(*pairs))
    batch = iterate_closest_points(points, targets, ptr, ptr)
    assert bool(batch.converged.all())
    for n, (own, goal) in enumerate(pairs):
        alone = iterate_closest_points(own, goal)
        assert torch.equal(alone.matrix[0], batch.matrix[n])
        assert torch.equal(alone.rmse[0], batch.rmse[n])
    far = motion(120.0, 0.5)
    own, goal = pair(0, far)
    start = far.clone()
    start[:3, 3] += 0.01
    found = iterate_closest_points(own, goal, initial=start[None])
    torch.testing.assert_close(found.matrix[0], far, atol=1e-6, rtol=0)


def test_what_cannot_be_found_is_told():
    points, targets = pair(0, motion(1.0, 0.0))
    assert not bool(iterate_closest_points(points, targets[:50], max_rounds=1).converged)
    with pytest.raises(PoseError, match=r"iterate_closest_points: no rotation is determined for cloud 0.*max_distance"):
        iterate_closest_points(points, targets + 100, max_distance=0.1)
    with pytest.raises(TooFewPointsError, match="iterate_closest_points"):
        iterate_closest_points(points, targets[:0])
    with pytest.raises(ConfigError, match="iterate_closest_points: max_distance"):
        iterate_closest_points(points, targets, max_distance=-1.0)
    with pytest.raises(DTypeError, match="iterate_closest_points: with_scale"):
        iterate_closest_points(points, targets, with_scale=1)
