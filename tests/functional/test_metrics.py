"""Distances between clouds against brute force, SciPy and their laws."""

from __future__ import annotations

import pytest
import torch
from scipy.spatial.distance import directed_hausdorff
from torch import Tensor

from pcdata import functional as F
from pcdata.errors import TooFewPointsError
from pcdata.functional.metrics import chamfer_distance
from pcdata.rng import seeded


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


def pairs():
    a, b = (torch.rand(count, 3, generator=seeded(count)) for count in (70, 55))
    return a, torch.tensor([0, 40, 70]), b, torch.tensor([0, 15, 55])


def test_sides_norms_and_normals_are_those_of_all_pairs_in_float64():
    a, ptr_a, b, ptr_b = pairs()
    normals = [torch.nn.functional.normalize(torch.randn(len(p), 3, generator=seeded(len(p))), dim=1) for p in (a, b)]
    for norm, power in (("l2", 2), ("l1", 1)):
        for squared in (True, False):
            found = {
                sides: F.chamfer_distance(
                    a,
                    ptr_a,
                    b,
                    ptr_b,
                    norm=norm,
                    squared=squared,
                    sides=sides,
                    normals_a=normals[0],
                    normals_b=normals[1],
                )
                for sides in ("a_to_b", "b_to_a", "both")
            }
            for cloud, (one, other) in enumerate(((slice(0, 40), slice(0, 15)), (slice(40, 70), slice(15, 55)))):
                offset = a[one, None].double() - b[None, other].double()
                nearest = offset.norm(p=power, dim=2)
                for sides, axis in (("a_to_b", 1), ("b_to_a", 0)):
                    row = nearest.argmin(axis)
                    pick = (torch.arange(len(row)), row) if axis == 1 else (row, torch.arange(len(row)))
                    apart = offset.norm(p=power, dim=2)[pick]
                    wanted = (apart.square() if squared else apart).mean()
                    cosine = (normals[0][one][pick[0]] * normals[1][other][pick[1]]).sum(1).double()
                    torch.testing.assert_close(found[sides][cloud, 0].double(), wanted, rtol=1e-5, atol=0)
                    torch.testing.assert_close(
                        found[sides][cloud, 1].double(), (1 - cosine.abs()).mean(), rtol=1e-5, atol=0
                    )
            torch.testing.assert_close(found["both"], found["a_to_b"] + found["b_to_a"])


def test_normals_that_point_the_other_way_are_told_where_asked():
    points = torch.rand(30, 3, generator=seeded(1))
    up = torch.tensor([0.0, 0.0, 1.0]).expand(30, 3)
    flipped = torch.where((torch.arange(30) < 10)[:, None], -up, up)
    given = {"normals_a": up, "normals_b": flipped, "sides": "a_to_b"}
    assert chamfer_distance(points, None, points, None, **given).tolist() == [[0.0, 0.0]]
    signed = chamfer_distance(points, None, points, None, **given, abs_cosine=False)
    torch.testing.assert_close(signed, torch.tensor([[0.0, 2 / 3]]))


@pytest.mark.parametrize("columns", [3, 2, 6])
def test_hausdorff_is_scipys_each_way(columns):
    a, ptr_a, b, ptr_b = pairs()
    a, b = (torch.cat([points, points.flip(1) * 0.7], dim=1)[:, :columns].contiguous() for points in (a, b))
    found = F.hausdorff_distance(a, ptr_a, b, ptr_b)
    for cloud, (one, other) in enumerate(((slice(0, 40), slice(0, 15)), (slice(40, 70), slice(15, 55)))):
        wanted = [
            directed_hausdorff(a[one].numpy(), b[other].numpy())[0],
            directed_hausdorff(b[other].numpy(), a[one].numpy())[0],
        ]
        assert found[cloud].tolist() == pytest.approx(wanted, rel=1e-5)


def test_f_scores_know_any_number_of_columns():
    a, b = torch.tensor([[0.0, 0], [1, 0]]), torch.tensor([[0.0, 0.05], [1, 5], [2, 5], [3, 5]])
    assert F.f_score(a, None, b, None, threshold=0.1)[0].tolist() == pytest.approx([1 / 3, 0.5, 0.25])


def test_f_scores_count_what_is_near():
    a = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
    b = torch.tensor([[0.05, 0, 0], [1, 0.05, 0], [9, 0, 0]])
    score, precision, recall = F.f_score(a, None, b, None, threshold=0.1)[0].tolist()
    assert precision == pytest.approx(2 / 4)
    assert recall == pytest.approx(2 / 3)
    assert score == pytest.approx(2 * 0.5 * (2 / 3) / (0.5 + 2 / 3))
    assert F.f_score(a, None, b + 100, None, threshold=0.1).tolist() == [[0.0, 0.0, 0.0]]
