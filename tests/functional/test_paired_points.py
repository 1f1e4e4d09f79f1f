"""The motion between paired points against SciPy, known motions and brute force."""

from __future__ import annotations

import pytest
import torch

from pcdata.errors import ConfigError, DTypeError, PoseError, ShapeError, TooFewPointsError
from pcdata.functional import fit_paired_points
from pcdata.geometry import rigid
from pcdata.rng import seeded


def turn(seed: int) -> torch.Tensor:
    drawn = torch.randn(1, 4, generator=seeded(seed), dtype=torch.float64)
    return rigid.rotation_from_quaternion(drawn)[0]


def cloud(count: int, seed: int) -> torch.Tensor:
    return torch.randn(count, 3, generator=seeded(seed), dtype=torch.float64) * torch.tensor([1.0, 0.6, 0.3])


@pytest.mark.parametrize("scale", [1.0, 2.5])
@pytest.mark.parametrize("flat", [False, True])
def test_a_known_motion_is_found_for_every_cloud_of_a_ragged_batch(scale, flat):
    parts, targets, expected = [], [], []
    for seed, count in enumerate((3, 50, 8)):
        points = cloud(count, seed)
        if flat:
            points[:, 2] = 0
        shift = torch.tensor([0.3, -2.0, 10.0 * seed], dtype=torch.float64)
        parts.append(points)
        targets.append(scale * points @ turn(seed).T + shift)
        matrix = torch.eye(4, dtype=torch.float64)
        matrix[:3, :3], matrix[:3, 3] = scale * turn(seed), shift
        expected.append(matrix)
    found = fit_paired_points(torch.cat(parts), torch.cat(targets), torch.tensor([0, 3, 53, 61]), with_scale=scale != 1)
    torch.testing.assert_close(found.matrix, torch.stack(expected), atol=1e-9, rtol=0)
    torch.testing.assert_close(found.scale, torch.full((3,), scale, dtype=torch.float64))
    assert float(found.rmse.max()) < 1e-6


def test_noisy_weighted_points_agree_with_scipy_and_nothing_near_fits_better():
    transform = pytest.importorskip("scipy.spatial.transform")
    points, weights = cloud(40, 1), torch.rand(40, generator=seeded(2), dtype=torch.float64)
    targets = points @ turn(3).T + 0.2 * torch.randn(40, 3, generator=seeded(4), dtype=torch.float64)
    found = fit_paired_points(points, targets, weights=weights)
    share = (weights / weights.sum())[:, None]
    centered = [one - (share * one).sum(0) for one in (targets, points)]
    theirs, _ = transform.Rotation.align_vectors(*(one.numpy() for one in centered), weights=weights.numpy())
    torch.testing.assert_close(found.matrix[0, :3, :3], torch.from_numpy(theirs.as_matrix()), atol=1e-9, rtol=0)

    def error(matrix: torch.Tensor) -> float:
        moved = points @ matrix[:3, :3].T + matrix[:3, 3]
        return float((share[:, 0] * (moved - targets).square().sum(1)).sum().sqrt())

    best = error(found.matrix[0])
    assert float(found.rmse[0]) == pytest.approx(best, rel=1e-12)
    for seed in range(20):
        near = found.matrix[0].clone()
        near[:3, :3] = near[:3, :3] @ torch.linalg.matrix_exp(
            0.01 * (lambda a: a - a.T)(torch.randn(3, 3, generator=seeded(seed), dtype=torch.float64))
        )
        near[:3, 3] += 0.005 * torch.randn(3, generator=seeded(seed + 50), dtype=torch.float64)
        assert error(near) > best


def test_mirrored_points_get_a_rotation_and_never_a_reflection():
    points = cloud(30, 5)
    mirrored = points * torch.tensor([1.0, 1.0, -1.0])
    found = fit_paired_points(points, mirrored)
    assert float(torch.linalg.det(found.matrix[0, :3, :3])) == pytest.approx(1.0)
    assert float(found.rmse[0]) > 0.1


def test_points_that_determine_no_rotation_are_refused():
    line = torch.linspace(0, 1, 10)[:, None] * torch.tensor([1.0, 2.0, 3.0])
    good = cloud(10, 0).float()
    for points, targets in ((line, good), (good, line), (good, torch.ones(10, 3))):
        with pytest.raises(PoseError, match="no rotation is determined for cloud 1"):
            fit_paired_points(torch.cat([good, points]), torch.cat([good, targets]), torch.tensor([0, 10, 20]))
    with pytest.raises(TooFewPointsError):
        fit_paired_points(good[:2], good[:2])
    with pytest.raises(ConfigError, match="weights must be at least 0"):
        fit_paired_points(good, good, weights=-torch.ones(10))
    with pytest.raises(DTypeError, match="with_scale must be True or False"):
        fit_paired_points(good, good, with_scale=1)


@pytest.mark.parametrize("with_scale", [False, True])
def test_gradients_are_those_of_the_fit(with_scale):
    points, weights = cloud(6, 1), torch.rand(6, generator=seeded(2), dtype=torch.float64) + 0.1
    targets = points @ turn(3).T + 0.2 * torch.randn(6, 3, generator=seeded(4), dtype=torch.float64)
    inputs = [one.requires_grad_() for one in (points, targets, weights)]

    def fitted(a, b, w):
        return tuple(fit_paired_points(a, b, weights=w, with_scale=with_scale))

    assert torch.autograd.gradcheck(fitted, inputs, atol=1e-6)


def test_ten_thousand_small_clouds_are_one_call():
    points = cloud(80_000, 0)
    targets = points @ turn(1).T
    ptr = torch.arange(0, 80_001, 8)
    found = fit_paired_points(points, targets, ptr)
    torch.testing.assert_close(found.matrix[:, :3, :3], turn(1).expand(10_000, 3, 3), atol=1e-7, rtol=0)


@pytest.mark.parametrize("columns", [2, 4, 7])
def test_points_of_any_number_of_columns_are_turned_and_never_mirrored(columns):
    generator = seeded(columns)
    rotation = torch.linalg.qr(torch.randn(columns, columns, generator=generator, dtype=torch.float64))[0]
    rotation[:, 0] *= torch.linalg.det(rotation)
    points = torch.randn(30, columns, generator=generator, dtype=torch.float64)
    found = fit_paired_points(points, 1.5 * points @ rotation.T + 2.0, with_scale=True)
    torch.testing.assert_close(found.matrix[0, :columns, :columns], 1.5 * rotation, atol=1e-9, rtol=0)
    torch.testing.assert_close(found.matrix[0, :, columns], torch.tensor([2.0] * columns + [1.0], dtype=torch.float64))
    mirrored = points.clone()
    mirrored[:, 0] *= -1
    linear = fit_paired_points(points, mirrored).matrix[0, :columns, :columns]
    assert float(torch.linalg.det(linear)) == pytest.approx(1.0)


def test_one_column_and_points_of_a_plane_in_one_place_are_refused():
    with pytest.raises(ShapeError, match="two columns or more"):
        fit_paired_points(torch.rand(4, 1), torch.rand(4, 1))
    with pytest.raises(PoseError, match="do not spread"):
        fit_paired_points(torch.ones(4, 2), torch.rand(4, 2))
