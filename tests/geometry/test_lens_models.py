"""Lenses of every model against OpenCV, RealSense's formulas and the law that projecting undoes deprojecting."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from pcdata.errors import CaptureError
from pcdata.functional import pixel_rays, project_points
from pcdata.geometry.lens import distort_normalized, fold_radius, undistort_normalized
from pcdata.geometry.lens_models import LENS_MODELS, lens_facts, lens_row, model_named, same_width
from pcdata.structures import Camera

D455 = [-0.0565362684428692, 0.068201869726181, 0.0003659751964733, 0.000692575704306364, -0.0218431670218706]
T265 = [-0.0051, 0.0391, -0.0368, 0.0062]
LENSES = {
    "opencv": [0.45, -2.6, 0.0006, -0.0002, 1.5, 0.33, -2.4, 1.4, 0.001, -0.0004, 0.0008, 0.0003, 0.02, -0.03],
    "inverse_brown_conrady": D455,
    "fisheye": T265,
    "f_theta": [0.92],
    "f_theta_polynomial": [0.004, -0.06, 0.02, -0.011],
    "inverse_f_theta_polynomial": [-0.003, 0.05, 0.01, 0.008],
}
each_model = pytest.mark.parametrize("model", LENSES)


def lens(model: str, values: list[float] | None = None) -> torch.Tensor:
    return torch.tensor([lens_row("test", model, values or LENSES[model])], dtype=torch.float64)


def grid(half: float, count: int = 21) -> torch.Tensor:
    line = torch.linspace(-half, half, count, dtype=torch.float64)
    return torch.stack(torch.meshgrid(line, 0.7 * line, indexing="xy"), -1)[None]


def test_every_model_has_a_lens_here():
    assert set(LENSES) == set(LENS_MODELS)


def test_the_fisheye_agrees_with_opencv_both_ways():
    cv2 = pytest.importorskip("cv2")
    rays = grid(2.0)
    flat = rays.reshape(-1, 1, 2).numpy()
    expected = cv2.fisheye.distortPoints(flat, np.eye(3), np.array(T265))
    bent = distort_normalized(rays, lens("fisheye"))
    np.testing.assert_allclose(bent.reshape(-1, 2).numpy(), expected[:, 0], atol=1e-12)
    back = cv2.fisheye.undistortPoints(expected, np.eye(3), np.array(T265))
    found = undistort_normalized(torch.from_numpy(expected[:, 0])[None], lens("fisheye"))[0]
    np.testing.assert_allclose(found.numpy(), back[:, 0], atol=1e-6)


def test_realsense_models_agree_with_the_formulas_of_its_sdk():
    x, y = grid(0.6).reshape(-1, 2).numpy().T
    r2 = x * x + y * y
    k1, k2, p1, p2, k3 = D455
    f = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    a, b = x * f, y * f
    wanted = np.stack([a + 2 * p1 * a * b + p2 * (r2 + 2 * a * a), b + 2 * p2 * a * b + p1 * (r2 + 2 * b * b)], 1)
    found = distort_normalized(grid(0.6), lens("inverse_brown_conrady")).reshape(-1, 2)
    np.testing.assert_allclose(found.numpy(), wanted, atol=1e-14)
    r = np.sqrt(r2)
    scale = np.where(r > 0, np.arctan(2 * r * math.tan(0.92 / 2)) / 0.92 / np.where(r > 0, r, 1), 1.0)
    found = distort_normalized(grid(0.6), lens("f_theta")).reshape(-1, 2)[r > 0]
    np.testing.assert_allclose(found.numpy(), np.stack([x * scale, y * scale], 1)[r > 0], atol=1e-14)


F_THETA = {  # of an image of 1936 x 1220: from angles to pixels, and from pixels to angles
    False: [0.0, 930.4, 3.2, -41.7, 12.9, -8.3],
    True: [0.0, 1.0748e-3, 2.1e-9, 4.2e-11, -3.1e-14, 2.5e-17],
}


@pytest.mark.parametrize("inverse", [False, True])
@pytest.mark.parametrize(("c", "d"), [(1.0, 0.0), (0.0, 0.0), (0.9987, 0.0021)])
def test_pixels_of_nvidia_s_f_theta_are_those_of_a_search(inverse, c, d):
    camera = Camera.f_theta(
        polynomial=F_THETA[inverse], cx=970.3, cy=604.9, size=(1220, 1936), inverse=inverse, c=c, d=d
    )
    theta = torch.linspace(0.0, 1.1, 23, dtype=torch.float64)
    turn = torch.linspace(0.0, 6.0, 23, dtype=torch.float64)
    around = torch.stack([turn.cos(), turn.sin()], 1)
    points = torch.cat([theta.sin()[:, None] * around, theta.cos()[:, None]], 1) * 2.3
    if inverse:  # halving, of which no derivative is needed
        low, high = np.zeros(23), np.full(23, 2000.0)
        for _ in range(100):
            middle = (low + high) / 2
            below = np.polynomial.polynomial.polyval(middle, F_THETA[True]) < theta.numpy()
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        distance = torch.from_numpy((low + high) / 2)
    else:
        distance = torch.from_numpy(np.polynomial.polynomial.polyval(theta.numpy(), F_THETA[False]))
    linear = torch.tensor([[c or 1.0, d], [0.0, 1.0]], dtype=torch.float64)
    expected = (distance[:, None] * around) @ linear.T + torch.tensor([970.3, 604.9], dtype=torch.float64)
    found, _ = project_points(points, intrinsics=camera.intrinsics, distortion=camera.distortion)
    torch.testing.assert_close(found, expected, atol=1e-8, rtol=0)
    # And the rays of those pixels are the points' again.
    normalized = torch.linalg.solve(
        camera.intrinsics[0], torch.cat([expected, torch.ones(23, 1, dtype=torch.float64)], 1).T
    ).T[None, :, :2]
    rays = undistort_normalized(normalized, camera.distortion)[0]
    torch.testing.assert_close(rays, points[:, :2] / points[:, 2:], atol=1e-11, rtol=1e-11)


@pytest.mark.parametrize("model", ["f_theta_polynomial", "inverse_f_theta_polynomial"])
def test_a_polynomial_of_angles_ends_where_it_turns_back(model):
    row = lens(model, [0.0, -0.4, 0.0, 0.0])  # x - 0.4 x^3 grows up to 1 / sqrt(1.2)
    top = 1 / math.sqrt(1.2)
    reached = top - 0.4 * top**3
    theta, radius = (reached, top) if "inverse" in model else (top, reached)
    assert float(fold_radius(row)[0]) == pytest.approx(math.tan(theta), rel=1e-9)
    near = torch.tensor([[[0.999 * radius, 0.0], [1.001 * radius, 0.0], [0.0, 0.5 * radius]]], dtype=torch.float64)
    assert undistort_normalized(near, row).isnan().any(-1).tolist() == [[False, True, False]]
    points = torch.tensor([[math.tan(0.999 * theta), 0.0, 1.0], [math.tan(1.001 * theta), 0.0, 1.0]])
    pixels, _ = project_points(points, intrinsics=torch.eye(3, dtype=torch.float64)[None], distortion=row)
    assert pixels.isnan().any(-1).tolist() == [False, True]


@pytest.mark.parametrize("model", ["fisheye", "f_theta_polynomial", "inverse_f_theta_polynomial"])
def test_with_no_coefficients_the_radius_is_the_angle(model):
    row = lens(model, [0.0] * 4)
    bent = distort_normalized(grid(1.5), row)[0]
    rays = grid(1.5)[0]
    torch.testing.assert_close(bent.norm(dim=-1), rays.norm(dim=-1).atan(), atol=1e-14, rtol=0)


def test_what_is_no_f_theta_polynomial_is_refused():
    given = {"cx": 31.5, "cy": 23.5, "size": (48, 64)}
    for polynomial in ([], [0.0], [0.1, 50.0], [0.0, -50.0], [0.0, float("nan")], [0.0] + [1.0] * 6):
        with pytest.raises(CaptureError, match=r"Camera\.f_theta: polynomial must be 2 to 6 coefficients"):
            Camera.f_theta(polynomial=polynomial, **given)
    with pytest.raises(CaptureError, match="e must be 0"):
        Camera.f_theta(polynomial=[0.0, 50.0], e=0.1, **given)
    assert Camera.f_theta(polynomial=[0.0, 50.0], **given).lenses == [("f_theta_polynomial", [0.0] * 4)]


def test_the_lens_of_a_d455_is_opencv_s_to_a_twentieth_of_a_pixel():
    focal = 640.0  # of its color image, 1280x720
    rays = grid(1.0)
    apart = distort_normalized(rays, lens("inverse_brown_conrady")) - distort_normalized(rays, lens("opencv", D455))
    assert 0.001 < focal * float(apart.norm(dim=-1).max()) < 0.05


@each_model
def test_projecting_undoes_deprojecting_over_the_whole_image(model):
    k = torch.tensor([[[60.0, 0.3, 47.0], [0.0, 61.0, 35.5], [0.0, 0.0, 1.0]]], dtype=torch.float64)
    rays = pixel_rays(k, (72, 96), lens(model))[0].reshape(-1, 2)
    seen = ~rays.isnan().any(-1)
    assert float(seen.double().mean()) > 0.7
    points = torch.cat([rays, torch.ones_like(rays[:, :1])], 1)[seen] * 1.7
    pixels, _ = project_points(points, intrinsics=k, distortion=lens(model))
    v, u = torch.meshgrid(torch.arange(72.0), torch.arange(96.0), indexing="ij")
    wanted = torch.stack([u, v], -1).reshape(-1, 2)[seen].double()
    torch.testing.assert_close(pixels, wanted, atol=1e-9, rtol=0)


def test_what_the_lens_does_not_see_is_invalid_and_never_folded_back():
    folding = lens("fisheye", [-0.3, 0.0, 0.0, 0.0])  # grows up to 1.054 rad
    fold = float(fold_radius(folding)[0])
    assert fold == pytest.approx(math.tan(math.sqrt(1 / 0.9)))
    k = torch.eye(3, dtype=torch.float64)[None]
    points = torch.tensor([[0.99 * fold, 0.0, 1.0], [1.01 * fold, 0.0, 1.0], [0.3, 0.0, -1.0]], dtype=torch.float64)
    pixels, _ = project_points(points, intrinsics=k, distortion=folding)
    assert pixels.isnan().any(-1).tolist() == [False, True, True]
    largest = float(distort_normalized(torch.tensor([[[fold, 0.0]]]), folding)[0, 0, 0])
    around = torch.tensor([[[largest - 1e-6, 0.0], [largest + 1e-6, 0.0]]], dtype=torch.float64)
    assert undistort_normalized(around, folding).isnan().any(-1).tolist() == [[False, True]]
    beyond = torch.tensor([[[1.0, 1.5]]], dtype=torch.float64)  # more than a quarter turn off axis
    assert bool(undistort_normalized(beyond, lens("f_theta")).isnan().all())


@each_model
def test_gradients_are_those_of_both_functions(model):
    rays = torch.tensor([[[0.31, -0.22], [0.05, 0.4]]], dtype=torch.float64, requires_grad=True)
    row = lens(model)
    places = range(len(LENSES[model])) if row.shape[1] < 16 else range(1, 1 + len(LENSES[model]))
    free = row[0, list(places)].clone().requires_grad_()

    def with_lens(function):
        def called(xy, values):
            full = row.clone().index_put(
                (torch.zeros(len(values), dtype=torch.long), torch.tensor(list(places))), values
            )
            return function(xy, full)

        return called

    assert torch.autograd.gradcheck(with_lens(distort_normalized), (rays, free), atol=1e-6)
    assert torch.autograd.gradcheck(with_lens(undistort_normalized), (rays, free), atol=1e-5)


def test_the_axis_has_a_gradient():
    for model in LENSES:
        center = torch.zeros(1, 1, 2, dtype=torch.float64, requires_grad=True)
        for function in (distort_normalized, undistort_normalized):
            (slope,) = torch.autograd.grad(function(center, lens(model)).sum(), center)
            assert bool(slope.isfinite().all())


def test_views_of_one_rig_have_lenses_of_different_models():
    rows = [torch.tensor([D455], dtype=torch.float64), lens("fisheye"), None, lens("f_theta")]
    together = same_width(rows, [1, 1, 2, 1])
    assert together.shape == (5, 16)
    rays = grid(0.4)
    bent = distort_normalized(rays.expand(5, *rays.shape[1:]), together)
    for view, row in enumerate([rows[0], rows[1], None, None, rows[3]]):
        assert torch.equal(bent[view : view + 1], rays if row is None else distort_normalized(rays, row))


def test_names_of_others_are_known_and_wrong_lenses_are_refused():
    assert model_named("Inverse Brown Conrady") == model_named("MODIFIED_BROWN_CONRADY") == "inverse_brown_conrady"
    assert model_named("equidistant") == model_named("Kannala Brandt4") == "fisheye"
    assert model_named("panini") is None
    for model, values in LENSES.items():
        assert lens_facts(lens_row("test", model, values)) == (model, values)
    with pytest.raises(CaptureError, match=r"'fishy' is not known; did you mean.*fisheye"):
        lens_row("test", "fishy", [0.0] * 4)
    with pytest.raises(CaptureError, match="fisheye has 4 coefficients, got 5"):
        lens_row("test", "fisheye", [0.1] * 5)
