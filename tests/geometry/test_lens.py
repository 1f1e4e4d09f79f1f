from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pcdata.errors import CaptureError, ShapeError
from pcdata.geometry import lens as lens_module
from pcdata.geometry.lens import distort_normalized, fold_radius, undistort_normalized

# One realistic lens per length: a webcam, the same with k3, a rational wide-angle (Azure Kinect), and with thin prism.
WEBCAM = [0.12, -0.25, 0.0011, -0.0007]
LENSES = {
    4: WEBCAM,
    5: [*WEBCAM, 0.09],
    8: [0.45, -2.6, 0.0006, -0.0002, 1.5, 0.33, -2.4, 1.4],
    12: [0.45, -2.6, 0.0006, -0.0002, 1.5, 0.33, -2.4, 1.4, 0.001, -0.0004, 0.0008, 0.0003],
    14: [0.45, -2.6, 0.0006, -0.0002, 1.5, 0.33, -2.4, 1.4, 0.001, -0.0004, 0.0008, 0.0003, 0.03, -0.02],
}


def grid_of_rays(half_width: float, half_height: float) -> torch.Tensor:
    x = torch.linspace(-half_width, half_width, 33, dtype=torch.float64)
    y = torch.linspace(-half_height, half_height, 25, dtype=torch.float64)
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)[None]


def coefficients(count: int) -> torch.Tensor:
    return torch.tensor([LENSES[count]], dtype=torch.float64)


@pytest.mark.parametrize("count", LENSES)
def test_bending_agrees_with_opencv(count):
    cv2 = pytest.importorskip("cv2")
    rays = grid_of_rays(0.7, 0.5)
    points = torch.cat([rays, torch.ones_like(rays[..., :1])], dim=-1).reshape(-1, 3).numpy()
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), np.array(LENSES[count]))
    bent = distort_normalized(rays, coefficients(count))
    np.testing.assert_allclose(bent.reshape(-1, 2).numpy(), expected[:, 0], atol=1e-13)


@pytest.mark.parametrize("count", LENSES)
def test_unbending_agrees_with_opencv(count):
    cv2 = pytest.importorskip("cv2")
    bent = grid_of_rays(0.6, 0.45)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-13)
    flat = bent.reshape(-1, 1, 2).numpy()
    expected = cv2.undistortPointsIter(flat, np.eye(3), np.array(LENSES[count]), None, None, stop)
    straight = undistort_normalized(bent, coefficients(count))
    np.testing.assert_allclose(straight.reshape(-1, 2).numpy(), expected[:, 0], atol=1e-9)


@pytest.mark.parametrize("count", LENSES)
def test_unbending_inverts_the_forward_model(count):
    rays = grid_of_rays(0.7, 0.5)
    there_and_back = undistort_normalized(distort_normalized(rays, coefficients(count)), coefficients(count))
    torch.testing.assert_close(there_and_back, rays, atol=1e-10, rtol=0)


@settings(max_examples=40, deadline=None)
@given(
    st.floats(-0.4, 0.4), st.floats(-0.3, 0.3), st.floats(-0.005, 0.005), st.floats(-0.005, 0.005), st.floats(-0.1, 0.1)
)
def test_every_answer_is_a_solution_on_the_lens_side_of_the_fold(k1, k2, p1, p2, k3):
    lens = torch.tensor([[k1, k2, p1, p2, k3]], dtype=torch.float64)
    bent = grid_of_rays(0.8, 0.6)
    straight = undistort_normalized(bent, lens)
    solved = ~straight.isnan().any(-1)
    torch.testing.assert_close(distort_normalized(straight, lens)[solved], bent[solved], atol=1e-11, rtol=0)
    assert bool((straight[solved].norm(dim=-1) < fold_radius(lens)).all())


def test_no_distortion_changes_no_bit():
    rays = grid_of_rays(0.7, 0.5)
    assert torch.equal(undistort_normalized(rays, torch.zeros(1, 5)), rays)
    assert torch.equal(distort_normalized(rays, torch.zeros(1, 5)), rays)


def test_views_bend_by_their_own_lens():
    rays = grid_of_rays(0.5, 0.4).repeat(2, 1, 1, 1)
    lenses = torch.cat([coefficients(5), -coefficients(5)])
    both = undistort_normalized(rays, lenses)
    for view in range(2):
        assert torch.equal(both[view], undistort_normalized(rays[view : view + 1], lenses[view : view + 1])[0])


def test_the_fold_of_a_barrel_lens_is_where_its_slope_vanishes():
    # r (1 + k1 r^2) has slope 1 + 3 k1 r^2.
    assert float(fold_radius(torch.tensor([[-0.3, 0.0, 0.0, 0.0]]))) == pytest.approx((1 / 0.9) ** 0.5)
    assert fold_radius(torch.tensor([[0.3, 0.0, 0.0, 0.0]])).tolist() == [torch.inf]


def test_beyond_the_reach_of_the_lens_there_is_no_answer():
    lens = torch.tensor([[-0.3, 0.0, 0.0, 0.0]], dtype=torch.float64)
    fold = float(fold_radius(lens))
    reach = fold * (1 - 0.3 * fold * fold)
    bent = torch.tensor([[[0.999 * reach, 0.0], [1.001 * reach, 0.0], [0.0, 3.0]]], dtype=torch.float64)
    assert undistort_normalized(bent, lens).isnan().tolist() == [[[False, False], [True, True], [True, True]]]


def test_a_solution_beyond_the_fold_is_not_taken():
    # k1 r^2 + k2 r^4 = 0 at r^2 = 2.5, so the lens seems to leave that ray alone; but it folds at r^2 = 0.5.
    lens = torch.tensor([[-1.0, 0.4, 0.0, 0.0]], dtype=torch.float64)
    ray = torch.tensor([[[2.5**0.5, 0.0]]], dtype=torch.float64)
    torch.testing.assert_close(distort_normalized(ray, lens), ray)
    assert bool(undistort_normalized(ray, lens).isnan().all())


@pytest.mark.parametrize("count", LENSES)
def test_the_slope_used_by_newton_is_the_derivative(count):
    terms = lens_module._split(coefficients(count), 1)
    x, y = torch.rand((2, 50), dtype=torch.float64) - 0.5
    by_hand = lens_module._jacobian(x, y, terms)
    (xx, xy), (yx, yy) = torch.autograd.functional.jacobian(lambda x, y: lens_module._bend(x, y, terms), (x, y))
    for ours, theirs in zip(by_hand, (xx, xy, yx, yy)):
        torch.testing.assert_close(ours, theirs.diagonal())


@pytest.mark.parametrize(("count", "message"), [(16, "that of its model"), (6, "4, 5, 8, 12 or 14"), (0, "pass None")])
def test_other_numbers_of_coefficients_are_refused(count, message):
    with pytest.raises(CaptureError, match=message):
        distort_normalized(torch.zeros(1, 3, 2), torch.full((1, count), 9.0))


def test_views_must_agree():
    with pytest.raises(ShapeError, match="the same V views"):
        undistort_normalized(torch.zeros(2, 3, 2), torch.zeros(1, 5))


# One lens that never folds, one with its fold inside the image, and the rational ones.
CURVED = {
    "never folds": [0.18, 0.02, 0.0, 0.0],
    "folds inside": [-0.8, 0.0, 0.0, 0.0],
    "8": LENSES[8],
    "12": LENSES[12],
}


@pytest.mark.parametrize("lens", CURVED.values(), ids=CURVED)
def test_the_gradient_of_unbending_is_that_of_the_inverse_function(lens):
    given = torch.tensor([lens, [0.1 * value for value in lens]], dtype=torch.float64, requires_grad=True)
    bent = torch.tensor([[0.0, 0.0], [0.2, -0.1], [-0.31, 0.22]], dtype=torch.float64).repeat(2, 1, 1).requires_grad_()
    assert torch.autograd.gradcheck(undistort_normalized, (bent, given), eps=1e-6, atol=1e-6)


@pytest.mark.parametrize("lens", CURVED.values(), ids=CURVED)
def test_where_there_is_no_inverse_there_is_no_gradient(lens):
    given = torch.tensor([lens], dtype=torch.float64, requires_grad=True)
    bent = grid_of_rays(1.5, 1.2).requires_grad_()
    straight = undistort_normalized(bent, given)
    solved = ~straight.isnan()
    straight[solved].square().sum().backward()
    assert bent.grad is not None
    assert given.grad is not None
    assert bool(torch.isfinite(bent.grad).all())
    assert bool(torch.isfinite(given.grad).all())
    assert bool((bent.grad[~solved] == 0).all())
    assert torch.equal(straight.detach(), undistort_normalized(bent.detach(), given.detach())) or not solved.all()


@pytest.mark.parametrize("apart", [0.0, 3e-7, 2.9e-6, 9e-6])
def test_a_pole_that_a_zero_cancels_is_no_end_of_the_lens(apart):
    zero, pole = 0.35, 0.35 * (1 + apart)
    pair = [0.1 - 1 / zero, -0.1 / zero, 0, 0, 0, -1 / pole, 0, 0]  # (1 - t/zero) (1 + 0.1 t) / (1 - t/pole)
    lens, plain = torch.tensor([pair, [0.1, 0, 0, 0, 0, 0, 0, 0]], dtype=torch.float64).split(1)
    assert float(fold_radius(lens)) == float(fold_radius(plain)) > 1
    bent = grid_of_rays(0.8, 0.6)
    torch.testing.assert_close(undistort_normalized(bent, lens), undistort_normalized(bent, plain), atol=1e-9, rtol=0)


def test_a_pole_beside_a_zero_that_does_not_cancel_it_ends_the_lens():
    pair = [-1 / 0.35, 0, 0, 0, 0, -1 / 0.36, 0, 0]
    assert float(fold_radius(torch.tensor([pair], dtype=torch.float64))) <= 0.36**0.5
