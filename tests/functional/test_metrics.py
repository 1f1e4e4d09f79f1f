"""Chamfer distance against brute force and its laws."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from pcdata.errors import TooFewPointsError
from pcdata.functional.metrics import chamfer_distance


def brute_force(a: Tensor, b: Tensor, *, squared: bool) -> Tensor:
    distance = torch.cdist(a.double(), b.double(), compute_mode="donot_use_mm_for_euclid_dist")
    distance = distance**2 if squared else distance
    return distance.amin(1).mean() + distance.amin(0).mean()


@pytest.mark.parametrize("squared", [True, False])
def test_chamfer_equals_brute_force_per_cloud(squared: bool):
    a = [torch.rand(n, 3) for n in (50, 1, 300)]
    b = [torch.rand(n, 3) for n in (40, 7, 2)]
    result = chamfer_distance(
        torch.cat(a), torch.tensor([0, 50, 51, 351]), torch.cat(b), torch.tensor([0, 40, 47, 49]), squared=squared
    )
    expected = torch.stack([brute_force(x, y, squared=squared) for x, y in zip(a, b, strict=True)])
    torch.testing.assert_close(result, expected.float())


def test_chamfer_of_a_shifted_pair_is_known():
    a = torch.tensor([[0.0, 0, 0], [10, 0, 0]])
    b = a + torch.tensor([0.0, 0, 2.0])
    assert chamfer_distance(a, None, b, None).tolist() == [8.0]
    assert chamfer_distance(a, None, b, None, squared=False).tolist() == [4.0]


def test_chamfer_is_symmetric_and_zero_for_a_reordered_cloud():
    a, b = torch.rand(500, 3), torch.rand(200, 3) * 3
    assert torch.equal(chamfer_distance(a, None, b, None), chamfer_distance(b, None, a, None))
    assert chamfer_distance(a, None, a.flip(0), None).tolist() == [0.0]


def test_far_apart_clouds_are_exact_too():
    a, b = torch.rand(2000, 3), torch.rand(2000, 3) + 50.0
    torch.testing.assert_close(chamfer_distance(a, None, b, None)[0], brute_force(a, b, squared=True).float())


@pytest.mark.parametrize("squared", [True, False])
def test_gradients_equal_those_of_brute_force(squared: bool):
    a = torch.rand(40, 3, requires_grad=True)
    b = torch.rand(30, 3, requires_grad=True)
    grads = torch.autograd.grad(chamfer_distance(a, None, b, None, squared=squared).sum(), [a, b])
    expected = torch.autograd.grad(brute_force(a, b, squared=squared), [a, b])
    for grad, known in zip(grads, expected, strict=True):
        torch.testing.assert_close(grad, known)


def test_gradient_of_equal_clouds_is_finite():
    a = torch.rand(20, 3, requires_grad=True)
    chamfer_distance(a, None, a.detach().clone(), None, squared=False).sum().backward()
    assert a.grad is not None
    assert not a.grad.any()


def test_an_empty_cloud_is_named():
    ptr = torch.tensor([0, 3, 3])
    with pytest.raises(TooFewPointsError, match="cloud 1 of points_b is empty"):
        chamfer_distance(torch.rand(4, 3), torch.tensor([0, 2, 4]), torch.rand(3, 3), ptr)
