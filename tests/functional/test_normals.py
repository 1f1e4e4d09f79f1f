"""Normals against known surfaces, NumPy's eigensolver and Open3D."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pcdata.errors import ConfigError, DTypeError, ShapeError
from pcdata.functional.normals import estimate_normals, facing_normals, orient_normals, smallest_eigenvector
from pcdata.geometry.rigid import angle_between


def test_normals_of_a_tilted_plane_are_its_normal():
    generator = np.random.default_rng(0)
    normal = np.array([0.48, -0.6, 0.64])
    basis = np.linalg.svd(normal[None])[2][1:]
    points = generator.uniform(-0.05, 0.05, size=(2000, 2)) @ basis + [1.0, 2.0, 3.0]
    found = estimate_normals(torch.from_numpy(points.astype(np.float32)))
    assert float(angle_between(found, torch.from_numpy(normal)).max()) < 1e-3


def test_normals_of_a_sphere_point_along_its_radius():
    points = torch.nn.functional.normalize(torch.randn(6_000, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    outward = orient_normals(points, estimate_normals(points, radius=0.3), torch.zeros(3))
    assert float(angle_between(outward, -points).max()) < 0.12


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        ([[1.0, 2, 3]], [0.0, 0, 1]),  # one point
        ([[0.0, 0, 0], [0.01, 0, 0]], [0.0, 0, 1]),  # two
        ([[1.0, 1, 1]] * 800, [0.0, 0, 1]),  # all at one spot
    ],
)
def test_too_few_or_equal_points_give_z(points: list[list[float]], expected: list[float]):
    assert estimate_normals(torch.tensor(points)).unique(dim=0).tolist() == [expected]


@pytest.mark.parametrize("direction", [[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [1.0, 1, 0], [1.0, -2, 3]])
def test_points_on_a_line_give_a_unit_normal_across_it(direction: list[float]):
    line = torch.nn.functional.normalize(torch.tensor(direction), dim=0)
    points = torch.linspace(-0.01, 0.01, 9)[:, None] * line
    normals = estimate_normals(points)
    torch.testing.assert_close(normals.norm(dim=1), torch.ones(9))
    assert float((normals @ line).abs().max()) < 1e-4


def test_the_last_component_that_is_not_zero_is_positive():
    generator = torch.Generator().manual_seed(1)
    normals = estimate_normals(torch.rand(500, 3, generator=generator) * 0.05)
    assert bool((normals[:, 2] >= 0).all())
    wall = torch.rand(300, 3, generator=generator) * torch.tensor([0.0, 0.02, 0.02])
    assert torch.equal(estimate_normals(wall), torch.tensor([1.0, 0, 0]).expand(300, 3))


def test_a_cloud_far_from_the_origin_keeps_its_normals():
    sheet = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([0.0625, 0.0625, 0.0])
    sheet = (sheet * 2**14).round() / 2**14  # exact in float32 after the shift as well
    assert torch.equal(estimate_normals(sheet + 512.0), estimate_normals(sheet))


def test_a_batch_equals_its_clouds_alone():
    clouds = [torch.rand(n, 3) * 0.05 for n in (100, 0, 1, 2, 50)]
    ptr = torch.tensor([0, 100, 100, 101, 103, 153])
    together = estimate_normals(torch.cat(clouds), ptr)
    assert torch.equal(together, torch.cat([estimate_normals(cloud) for cloud in clouds]))


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**20),
    exponents=st.tuples(*[st.integers(-9, 0)] * 3),
    kind=st.sampled_from(["general", "diagonal", "double", "zero"]),
)
def test_the_closed_form_gives_an_eigenvector_of_the_smallest_eigenvalue(
    seed: int, exponents: tuple[int, int, int], kind: str
):
    generator = np.random.default_rng(seed)
    values = np.array([10.0**e for e in exponents]) * generator.uniform(0.5, 1.0, size=3)
    rotation = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    if kind == "diagonal":
        rotation = np.eye(3)
    if kind == "double":
        values[1] = values[0]
    if kind == "zero":
        values[:] = 0.0
    matrix = rotation @ np.diag(values) @ rotation.T
    entries = [torch.tensor([matrix[i, j]]) for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))]
    vector = smallest_eigenvector(*entries)[0].numpy()
    assert abs(np.linalg.norm(vector) - 1) < 1e-12
    # The Rayleigh quotient is the smallest eigenvalue, up to float64 rounding of the largest.
    assert vector @ matrix @ vector <= values.min() + 1e-12 * max(values.max(), 1e-300)


def test_orient_normals_faces_the_viewpoint_and_keeps_edge_on_normals():
    points = torch.tensor([[0.0, 0, 1], [0, 0, 1], [0, 0, 1]])
    normals = torch.tensor([[0.0, 0, 1], [0, 0, -1], [1, 0, 0]])
    expected = torch.tensor([[0.0, 0, -1], [0, 0, -1], [1, 0, 0]])
    assert torch.equal(orient_normals(points, normals, torch.zeros(3)), expected)
    assert torch.equal(orient_normals(points, normals, torch.zeros(1, 3)), expected)
    per_point = torch.tensor([[0.0, 0, 0], [0, 0, 5], [-9, 0, 1]])
    assert torch.equal(orient_normals(points, normals, per_point), torch.tensor([[0.0, 0, -1], [0, 0, 1], [-1, 0, 0]]))


@pytest.mark.parametrize("count", [0, 1, 5, 40_000])
def test_kernels_turn_what_the_reference_turns(count: int):
    points, normals = torch.randn((2, count, 3), generator=torch.Generator().manual_seed(count))
    points[::3] = normals[::3] * 0.0  # seen edge-on from the origin
    for viewpoint in (torch.zeros(1, 3), points.flip(0) + 1, torch.ones(3).double()):
        turned = facing_normals(points, normals, viewpoint)
        assert torch.equal(turned, facing_normals(points, normals, viewpoint, backend="torch"))
        assert turned.dtype is torch.float32
    asked = normals.clone().requires_grad_()
    orient_normals(points, asked, torch.zeros(3)).sum().backward()
    assert asked.grad is not None


def test_a_compiler_traces_the_plain_body():
    points, normals = torch.randn((2, 20, 3), generator=torch.Generator().manual_seed(3))
    compiled = torch.compile(lambda *given: orient_normals(*given, torch.zeros(3)), backend="eager")
    assert torch.equal(compiled(points, normals), orient_normals(points, normals, torch.zeros(3)))


@pytest.mark.parametrize("backend", ["auto", "torch"])
def test_without_a_radius_the_nearest_count_however_far(backend: str):
    corners = torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 3)  # of a unit cube, each with its three neighbors
    found = estimate_normals(corners, radius=None, max_neighbors=4, backend=backend)
    outward = orient_normals(corners, found, corners + (corners - 0.5))
    torch.testing.assert_close(outward, (corners * 2 - 1) / 3**0.5)
    assert estimate_normals(corners, max_neighbors=4, backend=backend).unique(dim=0).tolist() == [[0.0, 0.0, 1.0]]
    sheet = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1e9, 1e9, 0.0])
    up = torch.tensor([0.0, 0.0, 1.0]).expand(200, 3)
    torch.testing.assert_close(estimate_normals(sheet, radius=None, backend=backend), up)


def test_bad_arguments_raise():
    points = torch.rand(4, 3)
    for radius in (0.0, -1.0, float("inf"), float("nan"), "1"):
        with pytest.raises((ConfigError, DTypeError), match="radius"):
            estimate_normals(points, radius=radius)
    with pytest.raises(ShapeError, match="viewpoint"):
        orient_normals(points, points, torch.zeros(2, 3))
    with pytest.raises(ShapeError, match="normals"):
        orient_normals(points, points[:2], torch.zeros(3))
    with pytest.raises(DTypeError, match="viewpoint"):
        orient_normals(points, points, torch.zeros(3, dtype=torch.int64))


@pytest.mark.open3d
def test_normals_agree_with_open3d_on_a_real_frame(frame_points: torch.Tensor):
    open3d = pytest.importorskip("open3d")
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(frame_points.double().numpy()))
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamHybrid(0.02, 30))
    angle = angle_between(estimate_normals(frame_points), torch.from_numpy(np.asarray(cloud.normals)))
    degrees = torch.rad2deg(torch.minimum(angle, torch.pi - angle))
    # The rest are ties at the 30th neighbor: depth is in whole millimetres.
    assert float((degrees < 0.5).double().mean()) >= 0.99


@pytest.mark.open3d
def test_normals_of_the_nearest_agree_with_open3d():
    open3d = pytest.importorskip("open3d")
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(2))
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.double().numpy()))
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(12))
    angle = angle_between(
        estimate_normals(points, radius=None, max_neighbors=12), torch.from_numpy(np.asarray(cloud.normals))
    )
    assert float(torch.minimum(angle, torch.pi - angle).max()) < 1e-4
