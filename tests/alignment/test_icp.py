import math

import pytest
import torch

from pcdata.alignment import icp_point_to_plane, point_to_plane_residuals
from pcdata.errors import ConfigError, PoseError, ShapeError, TooFewPointsError
from pcdata.functional import estimate_normals
from pcdata.functional.rows import transform_points
from pcdata.geometry import rigid
from pcdata.geometry.small_motions import (
    motion_from_twist,
    plane_system,
    solve_observable,
    twist_from_motion,
)


def corner(count: int, seed: int, *, noise: float = 0.0) -> torch.Tensor:
    """Points on three perpendicular faces of 0.4 m: every motion is observable."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 3, generator=generator) * 0.4
    points[torch.arange(count), torch.arange(count) % 3] = 0.0
    return points + noise * torch.randn(count, 3, generator=generator)


def small_motion(millimetres: float, degrees: float, seed: int) -> torch.Tensor:
    directions = torch.randn(2, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    axis, shift = torch.nn.functional.normalize(directions, dim=1)
    twist = torch.cat([axis * math.radians(degrees), shift * millimetres * 1e-3])
    return motion_from_twist(twist, torch.full((3,), 0.1, dtype=torch.float64))


def moved(points: torch.Tensor, matrix: torch.Tensor) -> torch.Tensor:
    return transform_points(points, torch.tensor([0, len(points)]), matrix[None])


def apart(a: torch.Tensor, b: torch.Tensor) -> tuple[float, float]:
    """Millimetres and degrees between two motions, at the corner's middle."""
    twist = twist_from_motion(rigid.invert_rigid(a) @ b, torch.full((3,), 0.1, dtype=torch.float64))
    return float(twist[3:].norm()) * 1e3, math.degrees(float(twist[:3].norm()))


def test_residuals_are_the_signed_distances_to_a_plane():
    generator = torch.Generator().manual_seed(0)
    plane = torch.rand(2000, 3, generator=generator)
    plane[:, 2] = 0.0
    above = torch.rand(50, 3, generator=generator) * 0.5 + 0.25
    above[:, 2] = torch.linspace(-0.02, 0.02, 50)
    up = torch.tensor([0.0, 0.0, 1.0]).expand(2000, 3)
    found = point_to_plane_residuals(above, plane, up, max_distance=0.1)
    assert found.source_index.tolist() == list(range(50))
    torch.testing.assert_close(found.residual, above[:, 2].double())


def test_points_beyond_the_distance_or_with_other_normals_do_not_overlap():
    target = corner(3000, 0)
    up = torch.tensor([0.0, 0.0, 1.0]).expand(3000, 3)
    source = torch.tensor([[0.2, 0.2, 0.005], [0.2, 0.2, 0.3]])
    assert point_to_plane_residuals(source, target, up, max_distance=0.02).source_index.tolist() == [0]
    sideways = torch.tensor([[1.0, 0.0, 0.0]]).expand(2, 3)
    other = point_to_plane_residuals(source, target, up, max_distance=0.02, source_normals=sideways)
    assert len(other.residual) == 0


@pytest.mark.parametrize("kernel", ["tukey", "huber", "trimmed", "none"])
@pytest.mark.parametrize("seed", range(3))
def test_icp_finds_a_known_motion(kernel, seed):
    truth = small_motion(10.0, 1.0, seed)
    source, target = corner(3000, 1), corner(6000, 2)
    found = icp_point_to_plane(moved(source, rigid.invert_rigid(truth)), target, kernel=kernel)
    shift, angle = apart(found.target_from_source, truth)
    assert found.converged
    assert shift < 0.1
    assert angle < 0.02
    assert found.overlap > 0.95
    assert len(found.unobservable) == 0


def test_tukey_ignores_a_part_that_moved():
    truth = small_motion(5.0, 0.5, 0)
    source = moved(corner(3000, 1), rigid.invert_rigid(truth))
    source[:600] += torch.tensor([0.0, 0.0, 0.008])
    found = icp_point_to_plane(source, corner(6000, 2), kernel="tukey")
    least_squares = icp_point_to_plane(source, corner(6000, 2), kernel="none")
    assert apart(found.target_from_source, truth)[0] < apart(least_squares.target_from_source, truth)[0] / 3


def test_a_plane_slides_along_itself_and_is_not_moved_along_it():
    generator = torch.Generator().manual_seed(0)
    noise = torch.tensor([0.0, 0.0, 0.001])
    target = torch.rand(4000, 3, generator=generator) * torch.tensor([1.0, 1.0, 0.0])
    source = torch.rand(2000, 3, generator=generator) * torch.tensor([1.0, 1.0, 0.0])
    target += noise * torch.randn(4000, 3, generator=generator)
    source += noise * torch.randn(2000, 3, generator=generator) + torch.tensor([0.0, 0.0, 0.006])
    found = icp_point_to_plane(source, target, normal_radius=0.06)
    assert len(found.unobservable) == 3
    # Whatever the basis: no unobservable twist lifts or tilts the plane.
    assert float(found.unobservable[:, [0, 1, 5]].abs().max()) < 0.2
    motion = found.target_from_source
    assert abs(float(motion[2, 3]) + 0.006) < 5e-4
    assert float(motion[:2, 3].norm()) < 1e-3


def test_a_sphere_turns_about_its_center():
    generator = torch.Generator().manual_seed(0)
    center = torch.tensor([0.3, 0.0, 1.0])
    source, target = (
        0.2 * torch.nn.functional.normalize(torch.randn(n, 3, generator=generator), dim=1) for n in (2000, 8000)
    )
    found = icp_point_to_plane(
        source + center + 0.004,
        target + center,
        source_normals=source / 0.2,
        target_normals=target / 0.2,
    )
    assert len(found.unobservable) == 3
    at_center = moved(center[None], motion_from_twist(found.unobservable[0] * 1e-3, found.pivot)) - center
    assert float(at_center.norm()) < 1e-4
    shift = found.target_from_source[:3, :3] @ (center + 0.004).double() + found.target_from_source[:3, 3]
    torch.testing.assert_close(shift, center.double(), atol=3e-4, rtol=0)


def test_covariance_predicts_the_scatter_of_the_result():
    truth = small_motion(3.0, 0.3, 0)
    errors, variances = [], []
    for seed in range(12):
        source, target = corner(2000, seed, noise=1e-3), corner(8000, 100 + seed, noise=1e-3)
        found = icp_point_to_plane(moved(source, rigid.invert_rigid(truth)), target)
        errors.append(twist_from_motion(found.target_from_source @ rigid.invert_rigid(truth), found.pivot))
        variances.append(found.covariance.diagonal())
    ratio = torch.stack(errors).square().mean(0) / torch.stack(variances).mean(0)
    assert 0.2 < float(ratio.mean()) < 5


@pytest.mark.parametrize("seed", range(3))
def test_motion_and_twist_are_inverse(seed):
    twist = torch.randn(6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    pivot = torch.tensor([0.3, -1.0, 2.0], dtype=torch.float64)
    torch.testing.assert_close(twist_from_motion(motion_from_twist(twist, pivot), pivot), twist)
    zero = torch.zeros(6, dtype=torch.float64)
    torch.testing.assert_close(motion_from_twist(zero, pivot), torch.eye(4, dtype=torch.float64))


def test_noise_of_the_normals_alone_does_not_make_a_plane_observable():
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(5000, 3, generator=generator, dtype=torch.float64) * torch.tensor([1.0, 1.0, 0.0])
    tilt = 0.05 * torch.randn(5000, 3, generator=generator, dtype=torch.float64)
    normals = torch.nn.functional.normalize(torch.tensor([0.0, 0.0, 1.0]) + tilt * torch.tensor([1.0, 1.0, 0.0]), dim=1)
    residual, weights = 1e-3 * torch.randn(5000, generator=generator, dtype=torch.float64), torch.ones(5000).double()
    pivot = points.mean(0)
    honest = plane_system(points, normals, residual, weights, pivot=pivot, normal_sigma=0.05)
    naive = plane_system(points, normals, residual, weights, pivot=pivot, normal_sigma=1e-6)
    assert len(solve_observable(honest).unobservable) == 3
    assert len(solve_observable(naive).unobservable) == 0


def test_too_little_overlap_is_an_error():
    with pytest.raises(TooFewPointsError, match=r"only 0 of 300 source points"):
        icp_point_to_plane(corner(300, 0) + 5.0, corner(300, 1))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"max_distances": (0.01, 0.02)}, ConfigError, "coarse to fine"),
        ({"max_distances": ()}, ConfigError, "at least one"),
        ({"kernel": "tuky"}, ConfigError, "tukey"),
        ({"scale": -1.0}, ConfigError, "scale"),
        ({"max_iterations": 0}, ConfigError, "max_iterations"),
        ({"initial": torch.eye(4) * 2}, PoseError, "initial"),
        ({"target_normals": torch.ones(5, 3)}, ShapeError, "target_normals"),
    ],
)
def test_bad_arguments_are_refused(change, error, message):
    with pytest.raises(error, match=message):
        icp_point_to_plane(corner(300, 0), corner(300, 1), **change)


@pytest.mark.open3d
@pytest.mark.parametrize("seed", range(3))
def test_icp_agrees_with_open3d(seed):
    open3d = pytest.importorskip("open3d")
    truth = small_motion(8.0, 0.8, seed)
    source, target = moved(corner(2000, 1, noise=5e-4), rigid.invert_rigid(truth)), corner(5000, 2, noise=5e-4)
    normals = estimate_normals(target, radius=0.03)
    ours = icp_point_to_plane(
        source, target, target_normals=normals, max_distances=(0.05,), kernel="none", max_normal_angle=4.0
    )
    clouds = [open3d.geometry.PointCloud(open3d.utility.Vector3dVector(x.double().numpy())) for x in (source, target)]
    clouds[1].normals = open3d.utility.Vector3dVector(normals.double().numpy())
    registration = open3d.pipelines.registration
    theirs = registration.registration_icp(
        *clouds,
        0.05,
        torch.eye(4).numpy(),
        registration.TransformationEstimationPointToPlane(),
        registration.ICPConvergenceCriteria(relative_fitness=0, relative_rmse=0, max_iteration=60),
    )
    shift, angle = apart(ours.target_from_source, torch.from_numpy(theirs.transformation.copy()))
    assert shift < 0.02
    assert angle < 0.005
