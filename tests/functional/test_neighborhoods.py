"""Covariances and features of neighborhoods: surfaces with known shapes, NumPy, and finite differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from pcdata import functional as F
from pcdata.errors import ConfigError
from pcdata.rng import seeded


def test_covariances_are_numpys_over_the_neighbors():
    points, queries = (torch.rand(count, 3, generator=seeded(count)) for count in (400, 30))
    index, _, count = F.ball_query(points, radius=0.2, max_neighbors=9, queries=queries)
    mean, covariance, found = F.neighborhood_covariance(points, radius=0.2, max_neighbors=9, queries=queries)
    assert torch.equal(found, count)
    for q in range(30):
        near = points[index[q, : count[q]]].double().numpy()
        if len(near):
            np.testing.assert_allclose(covariance[q].numpy(), np.cov(near.T, bias=True).reshape(3, 3), atol=1e-12)
            np.testing.assert_allclose(mean[q].numpy(), near.mean(0), atol=1e-6)
        else:
            assert not bool(covariance[q].any() | mean[q].any())


def test_far_from_the_origin_no_digit_is_lost():
    points = torch.rand(200, 3, generator=seeded(0)) * 0.01
    far = (points + 1000.0) - 1000.0  # what float32 leaves of them
    one, other = (F.neighborhood_covariance(p, max_neighbors=8)[1] for p in (far, far + 1000.0))
    torch.testing.assert_close(one, other)


def test_the_smallest_axis_is_the_normal():
    points = torch.rand(300, 3, generator=seeded(1))
    points[:, 2] = 0.1 * points[:, 0].square() - 0.2 * points[:, 1]
    normals = F.estimate_normals(points, radius=0.2, max_neighbors=20)
    _, covariance, _ = F.neighborhood_covariance(points, radius=0.2, max_neighbors=20)
    axis = torch.linalg.eigh(covariance)[1][:, :, 0].float()
    assert float((axis * normals).sum(1).abs().min()) > 1 - 1e-6


def test_planes_lines_and_balls_have_the_features_that_they_must():
    uniform = torch.rand(20_000, 3, generator=seeded(2), dtype=torch.float64) - 0.5
    ball = uniform[uniform.norm(dim=1) < 0.5].float()
    plane, line = ball * torch.tensor([1.0, 1.0, 0.0]), ball * torch.tensor([1.0, 0.0, 0.0])
    center = torch.zeros(1, 3)
    found = {}
    for name, cloud in {"ball": ball, "plane": plane, "line": line}.items():
        _, covariance, _ = F.neighborhood_covariance(cloud, max_neighbors=len(cloud), queries=center)
        found[name] = {key: float(value) for key, value in F.shape_features(covariance).items()}
    assert found["line"]["linearity"] == pytest.approx(1, abs=1e-9)
    assert found["plane"]["planarity"] == pytest.approx(1, abs=0.03)
    assert found["ball"]["sphericity"] == pytest.approx(1, abs=0.05)
    assert found["ball"]["surface_variation"] == pytest.approx(1 / 3, abs=0.01)
    assert found["plane"]["surface_variation"] == pytest.approx(0, abs=1e-9)
    assert found["ball"]["eigenvalue_sum"] == pytest.approx(3 * 0.25 / 5, rel=0.03)
    assert found["ball"]["omnivariance"] == pytest.approx(0.25 / 5, rel=0.03)
    assert found["ball"]["eigenentropy"] == pytest.approx(math.log(3), abs=0.01)
    assert found["plane"]["eigenentropy"] == pytest.approx(math.log(2), abs=0.01)
    nothing = F.shape_features(torch.zeros(1, 3, 3))
    assert all(float(value) == 0 for value in nothing.values())
    with pytest.raises(ConfigError, match="unknown feature 'planar'; there are linearity"):
        F.shape_features(torch.zeros(1, 3, 3), "planar")


def test_gradients_reach_the_points_through_the_features():
    points = torch.rand(40, 3, generator=seeded(3))
    index, _ = F.knn(points, k=6)

    def curved(p):
        _, covariance, _ = F.neighborhood_covariance(p, max_neighbors=6)
        return F.shape_features(covariance, "surface_variation", "eigenentropy")

    leaf = points.clone().requires_grad_()
    sum(value.sum() for value in curved(leaf).values()).backward()
    wide = points.double().requires_grad_()
    near = wide[index]
    offset = near - near.mean(1, keepdim=True)
    values = torch.linalg.eigvalsh(offset.mT @ offset / 6)
    share = values / values.sum(1, keepdim=True)
    (share[:, 0] - (share * share.log()).sum(1)).sum().backward()
    torch.testing.assert_close(leaf.grad.double(), wide.grad, rtol=1e-4, atol=1e-4)
