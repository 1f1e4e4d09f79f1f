"""Interpolated features against a plain sum, and where points coincide."""

from __future__ import annotations

import pytest
import torch

from pcdata.errors import DTypeError, TooFewPointsError
from pcdata.functional import interpolate_features
from pcdata.rng import seeded


def test_features_are_averaged_by_the_inverse_squares_of_distances():
    points = torch.tensor([[-1.0, 0, 0], [0, 0, 0], [1, 0, 0], [-2, 0, 0], [0, 0, 0], [2, 0, 0]])
    features = torch.tensor([[1.0], [10.0], [100.0], [-1.0], [-10.0], [-100.0]])
    queries = torch.tensor([[-1.0, -1, 0], [1, 1, 0], [-2, -2, 0], [2, 2, 0]])
    ptr, queries_ptr = torch.tensor([0, 3, 6]), torch.tensor([0, 2, 4])
    found = interpolate_features(points, features, ptr, queries=queries, queries_ptr=queries_ptr, k=2)
    # Of (-1, -1): 1 away from the first, sqrt(2) from the second: (1 * 1 + 10 / 2) / (1 + 1 / 2).
    torch.testing.assert_close(found, torch.tensor([[4.0], [70.0], [-4.0], [-70.0]]))


def test_random_clouds_agree_with_a_plain_sum_in_float64():
    generator = seeded(0)
    points, queries = (torch.rand(count, 3, generator=generator) for count in (80, 30))
    features = torch.randn(80, 6, generator=generator)
    squared = (queries[:, None].double() - points.double()).square().sum(2)
    nearest, index = squared.topk(4, largest=False)
    weight = (1 / nearest) / (1 / nearest).sum(1, keepdim=True)
    expected = (weight[..., None] * features.double()[index]).sum(1).float()
    torch.testing.assert_close(interpolate_features(points, features, queries=queries, k=4), expected)


@pytest.mark.parametrize("scale", [1e-18, 1.0, 1e15])
def test_a_query_on_a_point_has_its_features_and_no_distance_is_too_small(scale):
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 0, 0], [3, 0, 0]]) * scale
    features = torch.tensor([[0.0], [4.0], [8.0], [100.0]])
    queries = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]) * scale
    found = interpolate_features(points, features, queries=queries, k=3)
    torch.testing.assert_close(found[:2], torch.tensor([[0.0], [6.0]]))
    torch.testing.assert_close(found[2:], torch.tensor([[(4.0 + 8.0 + 100.0) / 3]]))


def test_fewer_points_than_k_give_what_there_is_and_gradients_reach_features_alone():
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0]], requires_grad=True)
    features = torch.tensor([[1.0, 2.0], [3.0, 4.0]], dtype=torch.float64, requires_grad=True)
    found = interpolate_features(points, features, queries=torch.tensor([[0.5, 0, 0]]), k=9)
    torch.testing.assert_close(found.detach(), torch.tensor([[2.0, 3.0]], dtype=torch.float64))
    found.sum().backward()
    assert features.grad is not None
    torch.testing.assert_close(features.grad, torch.full((2, 2), 0.5, dtype=torch.float64))
    assert points.grad is None


def test_labels_and_clouds_without_points_are_refused():
    with pytest.raises(DTypeError, match="interpolate_features: features"):
        interpolate_features(torch.zeros(2, 3), torch.zeros(2, 1, dtype=torch.int64), queries=torch.zeros(1, 3))
    with pytest.raises(TooFewPointsError, match="interpolate_features"):
        interpolate_features(torch.zeros(0, 3), torch.zeros(0, 1), queries=torch.zeros(1, 3))
