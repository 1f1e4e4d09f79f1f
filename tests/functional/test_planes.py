from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pcdata.errors import ConfigError, DTypeError, NonFiniteError, NoPlaneError, ShapeError, TooFewPointsError
from pcdata.functional import plane_steps
from pcdata.functional import planes as planes_module
from pcdata.functional.planes import ransac_plane
from pcdata.functional.row_draws import draw_rows
from pcdata.geometry.plane_fit import fit_plane, plane_distance, planes_through
from pcdata.rng import seeded


def slab(count: int, normal: list[float], offset: float, *, noise: float = 0.002, seed: int = 0) -> torch.Tensor:
    """Points within ``noise`` of the plane n.p + offset = 0, over a square metre."""
    generator = torch.Generator().manual_seed(seed)
    unit = torch.nn.functional.normalize(torch.tensor(normal, dtype=torch.float64), dim=0)
    along = torch.linalg.svd(unit[None]).Vh[1:]
    points = (torch.rand((count, 2), generator=generator, dtype=torch.float64) - 0.5) @ along - offset * unit
    noise_along = noise * (2 * torch.rand((count, 1), generator=generator, dtype=torch.float64) - 1)
    return (points + noise_along * unit).float()


def clutter(count: int, seed: int = 0) -> torch.Tensor:
    return torch.rand((count, 3), generator=torch.Generator().manual_seed(seed)) - 0.5


def scene(seed: int = 0) -> torch.Tensor:
    """A table below the origin (z up) with clutter."""
    return torch.cat([clutter(300, seed), slab(700, [0.1, 0.0, 1.0], 0.3, seed=seed)])


def least_squares_inliers(points: np.ndarray, inliers: np.ndarray, distance: float) -> np.ndarray:
    """Refit by singular values (not eigenvalues) and select again, in NumPy."""
    chosen = points[inliers].astype(np.float64)
    center = chosen.mean(axis=0)
    normal = np.linalg.svd(chosen - center, full_matrices=False)[2][-1]
    x, y, z = points.T
    nx, ny, nz, d = np.append(normal, -normal @ center).astype(np.float32)
    return np.abs(((nx * x + ny * y) + nz * z) + d) < np.float32(distance)


def angle_to(plane: torch.Tensor, direction: list[float]) -> float:
    unit = torch.nn.functional.normalize(torch.tensor(direction, dtype=torch.float64), dim=0)
    return math.acos(min(1.0, float(plane[:3] @ unit)))


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 999), st.floats(0.05, 2.0))
def test_a_known_plane_is_found(seed, offset):
    normal = torch.randn(3, generator=torch.Generator().manual_seed(seed)).tolist()
    points = torch.cat([slab(500, normal, offset, seed=seed), clutter(100, seed)])
    planes, inliers = ransac_plane(points.requires_grad_(), num_hypotheses=100)
    assert not planes.requires_grad
    assert planes.dtype == torch.float64
    assert float(planes[0, :3].norm()) == pytest.approx(1.0)
    assert bool(inliers[:500].all())
    assert angle_to(planes[0], normal) < 0.01
    assert float(planes[0, 3]) == pytest.approx(offset, abs=0.002)


def test_the_mask_is_the_documented_float32_test_on_the_returned_plane():
    points = scene()
    planes, inliers = ransac_plane(points)
    x, y, z = points.numpy().T
    nx, ny, nz, d = planes[0].float().numpy()
    assert torch.equal(inliers, torch.from_numpy(np.abs(((nx * x + ny * y) + nz * z) + d) < np.float32(0.01)))


def test_the_distance_is_strict():
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0.3, 0.7, 0.25], [0.7, 0.3, -0.25]])
    assert ransac_plane(points, distance=0.25)[1].tolist() == [True] * 4 + [False] * 2


def test_the_plane_is_the_least_squares_plane_of_its_own_inliers():
    points = scene()
    planes, inliers = ransac_plane(points)
    fitted = fit_plane(points[inliers])
    assert min(float((planes[0] - fitted).abs().max()), float((planes[0] + fitted).abs().max())) < 1e-12
    expected = least_squares_inliers(points.numpy(), inliers.numpy(), 0.01)
    assert torch.equal(inliers, torch.from_numpy(expected))


def test_every_hypothesis_is_scored_on_every_point(monkeypatch):
    monkeypatch.setattr(plane_steps, "_PLANES", 3)
    monkeypatch.setattr(plane_steps, "_POINTS", 7)
    points = scene()
    hypotheses = planes_through(points[draw_rows(len(points), 3, 50, seeded(0))])
    counts = plane_steps._count_near(points, hypotheses, 0.01)
    expected = (plane_distance(points, hypotheses).abs() < 0.01).sum(dim=1)
    assert torch.equal(counts, expected)


def test_scoring_is_strict_too():
    points = torch.tensor([[0.0, 0, 0.25], [0, 0, -0.25], [0, 0, 0.125]])
    level = torch.tensor([[0.0, 0, 1, 0]], dtype=torch.float64)
    assert plane_steps._count_near(points, level, 0.25).tolist() == [1]


def test_among_equal_hypotheses_the_earliest_wins():
    points = slab(50, [0.0, 0.0, 1.0], 0.5, noise=0.0)
    hypotheses = torch.tensor([[0.0, 0, 1, 0.4], [0.0, 0, 1, 0.501], [0.0, 0, 1, 0.499]], dtype=torch.float64)
    allowed = torch.ones(1, 3, dtype=torch.bool)
    ptr, none = torch.tensor([0, 50]), torch.zeros(1, dtype=torch.int64)
    near = plane_steps.record_planes(points, ptr, hypotheses[None], allowed, 0.01, none, backend="torch")
    assert near.tolist() == [[0, 50, 0]]
    best = planes_module._best_planes(hypotheses[None], allowed, allowed, near, 0.01, 0)
    assert torch.equal(best, hypotheses[1:2])


@pytest.mark.parametrize("probability", [None, 0.99])
def test_a_guess_is_scored_like_any_other(probability):
    points = scene()
    planes, inliers = ransac_plane(points, probability=probability)
    wrong = torch.tensor([[0.0, 0, 2.0, -90.0]], dtype=torch.float64)
    for guess in (wrong, wrong * torch.nan, wrong * 0):
        again = ransac_plane(points, probability=probability, guess=guess)
        assert torch.equal(again[0], planes)
        assert torch.equal(again[1], inliers)
    few = ransac_plane(points, num_hypotheses=1, seed=5, guess=3 * planes)
    assert int(few[1].sum()) >= int(inliers.sum())
    with pytest.raises(ShapeError, match="guess"):
        ransac_plane(points, guess=planes[0])
    up = torch.linalg.cross(planes[0, :3], torch.tensor([0.3, 0.5, 0.7], dtype=torch.float64))
    tilted, _ = ransac_plane(points, guess=planes, up=up, max_tilt=0.5)
    assert angle_to(tilted[0], up.tolist()) <= 0.5 + 1e-9


def large_scene() -> torch.Tensor:
    """More points than are scored under a probability, row by row of an image 848 wide."""
    v, u = torch.meshgrid(torch.arange(100) / 100, torch.arange(848) / 848, indexing="ij")
    table = torch.stack([u, v, 1 + 0.1 * u + 0.002 * torch.sin(300 * u * v)], dim=-1)
    table[:, 600:, 2] -= torch.rand(100, 248, generator=seeded(5))
    return table.reshape(-1, 3)


@pytest.mark.parametrize("backend", ["auto", "torch"])
def test_a_search_on_some_points_finds_the_plane_of_all(backend):
    points = large_scene()
    expected, inliers = ransac_plane(points)
    planes, mask = ransac_plane(points, probability=0.9999, backend=backend)
    assert torch.equal(mask, inliers)
    torch.testing.assert_close(planes, expected, rtol=0, atol=1e-9)
    small = scene()
    both, masks = ransac_plane(torch.cat([points, small]), torch.tensor([0, 84_800, 85_800]), probability=0.9999)
    assert torch.equal(masks[:84_800], mask)
    assert torch.equal(both[1:], ransac_plane(small, probability=0.9999)[0])


def test_points_that_are_scored_are_spread_over_rows_and_columns():
    counts = torch.tensor([848 * 480, 5, 64 * 16_384])
    ptr = torch.cat([torch.zeros(1, dtype=torch.int64), counts.cumsum(0)])
    rows = torch.arange(int(ptr[-1]), dtype=torch.float64)[:, None].expand(-1, 3)
    chosen, chosen_ptr = plane_steps.spread_points(rows, ptr, 14)
    assert chosen_ptr.tolist() == [0, 16_384, 16_389, 32_773]
    assert bool((chosen[1:, 0] > chosen[:-1, 0]).all())
    for own, width in ((chosen[:16_384, 0], 848), (chosen[16_389:, 0] - float(ptr[2]), 64)):
        columns = torch.bincount(own.long() % width, minlength=width)
        assert int(columns.min()) > 0.5 * 16_384 / width
        assert int(columns.max()) < 2 * 16_384 / width


def test_a_plane_of_fewer_points_than_the_scored_ones_show_is_found_still():
    points = torch.rand((60_000, 3), generator=seeded(3))
    some, _ = plane_steps.spread_points(points, torch.tensor([0, 60_000]), 14)
    hypotheses = planes_through(points[draw_rows(60_000, 3, 20, seeded(0))])
    assert int((plane_distance(some, hypotheses).abs() < 1e-7).sum(1).max()) < 3
    _, inliers = ransac_plane(points, distance=1e-7, probability=0.9, num_hypotheses=20)
    assert int(inliers.sum()) >= 3


def test_hypotheses_beyond_the_tilt_are_never_scored(monkeypatch):
    scored = []
    monkeypatch.setattr(plane_steps, "_count_near", lambda points, planes, distance: _kept(scored, points, planes))
    up, limit = torch.tensor([0.0, 0, 1]), 0.3
    ransac_plane(scene(), num_hypotheses=200, up=up, max_tilt=limit, backend="torch")
    assert 0 < len(scored[0]) < 200
    assert bool((scored[0][:, 2].abs() >= math.cos(limit)).all())


def _kept(scored, points, planes):
    scored.append(planes)
    return (plane_distance(points, planes).abs() < 0.01).sum(dim=1)


def test_the_same_seed_repeats_and_a_batch_is_each_cloud_alone():
    clouds = [scene(0), scene(1)[:400], scene(2)]
    ptr = torch.tensor([0, 1000, 1400, 2400])
    planes, inliers = ransac_plane(torch.cat(clouds), ptr, num_hypotheses=50, seed=3)
    alone = [ransac_plane(one, num_hypotheses=50, seed=3) for one in clouds]
    assert torch.equal(planes, torch.cat([plane for plane, _ in alone]))
    assert torch.equal(inliers, torch.cat([mask for _, mask in alone]))


def test_clouds_can_have_their_own_seeds_and_ups():
    cloud = scene()
    both = torch.cat([cloud, cloud])
    up = torch.tensor([[0.0, 0, 1], [0, 0, -1]])
    planes, _ = ransac_plane(both, torch.tensor([0, 1000, 2000]), seed=[3, 4], up=up)
    assert torch.equal(planes[0], ransac_plane(cloud, seed=3, up=(0, 0, 1))[0][0])
    assert torch.equal(planes[1], ransac_plane(cloud, seed=4, up=(0, 0, -1))[0][0])


@pytest.mark.parametrize("offset", [0.3, -0.3])
def test_without_up_the_normal_faces_the_origin(offset):
    planes, _ = ransac_plane(slab(200, [0.2, 0.1, 1.0], offset))
    assert float(planes[0, 3]) > 0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_with_up_the_normal_points_along_it(sign):
    planes, _ = ransac_plane(slab(200, [0.2, 0.1, 1.0], 0.3), up=(0, 0, 7 * sign))
    assert float(planes[0, 2]) * sign > 0


def test_a_wall_larger_than_the_table_loses_under_a_tilt_limit():
    points = torch.cat([slab(800, [1.0, 0.0, 0.0], 0.4, seed=1), slab(300, [0.0, 0.05, 1.0], 0.3, seed=2)])
    wall, _ = ransac_plane(points)
    assert angle_to(wall[0], [1, 0, 0]) < 0.02
    table, inliers = ransac_plane(points, up=(0, 0, 1), max_tilt=0.2)
    assert angle_to(table[0], [0, 0.05, 1]) < 0.02
    assert bool(inliers[800:].all())


def test_refinement_never_leaves_the_tilt_limit():
    points = slab(500, [0.3, 0.0, 1.0], 0.3, noise=0.03)
    limit = math.atan(0.3) - 0.02  # just short of the true plane
    planes, inliers = ransac_plane(points, distance=0.02, up=(0, 0, 1), max_tilt=limit)
    assert angle_to(planes[0], [0, 0, 1]) <= limit
    assert int(inliers.sum()) > 100


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3, 1e6])
def test_the_result_scales_with_the_unit(scale):
    points = scene()
    planes, inliers = ransac_plane(points)
    scaled, scaled_inliers = ransac_plane(points * scale, distance=0.01 * scale)
    assert float((inliers ^ scaled_inliers).sum()) <= 2  # rounding at the edge of the slab
    torch.testing.assert_close(scaled[0] / torch.tensor([1, 1, 1, scale]), planes[0], atol=1e-4, rtol=0)


def test_duplicates_do_not_break_the_search():
    planes, inliers = ransac_plane(scene().repeat(3, 1))
    assert bool(inliers[300:1000].all())
    assert float(planes[0, :3].norm()) == pytest.approx(1.0)


def test_three_points_make_a_plane():
    planes, inliers = ransac_plane(torch.tensor([[0.0, 0, 1], [1, 0, 1], [0, 1, 1]]))
    torch.testing.assert_close(planes, torch.tensor([[0.0, 0, -1, 1]], dtype=torch.float64))
    assert inliers.tolist() == [True] * 3


@pytest.mark.parametrize(
    "points",
    [torch.ones(10, 3), torch.linspace(-1, 1, 50)[:, None] * torch.tensor([[0.3, -0.7, 0.9]]) + 0.123],
    ids=["one point repeated", "a line"],
)
def test_points_on_a_line_have_no_plane(points):
    with pytest.raises(NoPlaneError, match="cloud 0: all 1000 triples drawn lie on a line"):
        ransac_plane(points)


def test_no_plane_within_the_tilt_limit_is_an_error():
    with pytest.raises(NoPlaneError, match="within max_tilt of up; is up in the frame"):
        ransac_plane(slab(200, [1.0, 0.0, 0.0], 0.3, noise=0.0), up=(0, 0, 1), max_tilt=0.1)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_points_name_their_cloud(count):
    points = torch.cat([scene(), clutter(count)])
    with pytest.raises(TooFewPointsError, match=f"cloud 1 of points {f'has {count}' if count else 'is empty'}"):
        ransac_plane(points, torch.tensor([0, 1000, 1000 + count]))


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"max_tilt": 0.1}, ConfigError, "max_tilt is an angle from up"),
        ({"max_tilt": 10.0, "up": (0, 0, 1)}, ConfigError, "radians"),
        ({"distance": 0.0}, ConfigError, "distance"),
        ({"num_hypotheses": 0}, ConfigError, "num_hypotheses"),
        ({"up": (0, 0, 0)}, ConfigError, "not zero"),
        ({"up": (0, 1)}, ShapeError, "up must be"),
        ({"seed": 1.5}, DTypeError, "seed must be an int"),
        ({"seed": [1, 2]}, ShapeError, "2 seeds were given for 1 clouds"),
    ],
)
def test_wrong_parameters_are_refused(arguments, error, message):
    with pytest.raises(error, match=message):
        ransac_plane(scene(), **arguments)


def test_non_finite_points_are_refused():
    with pytest.raises(NonFiniteError):
        ransac_plane(torch.full((5, 3), torch.nan))


def test_the_table_of_a_real_frame_is_its_own_least_squares_plane(frame_points: torch.Tensor):
    planes, inliers = ransac_plane(frame_points)
    expected = least_squares_inliers(frame_points.numpy(), inliers.numpy(), 0.01)
    assert torch.equal(inliers, torch.from_numpy(expected))
    assert int(inliers.sum()) > 50_000
    assert float(planes[0, 3]) > 0  # the camera looks down on the table


@pytest.mark.open3d
def test_the_table_of_a_real_frame_is_the_one_open3d_finds(frame_points: torch.Tensor):
    open3d = pytest.importorskip("open3d")
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(frame_points.double().numpy()))
    open3d.utility.random.seed(0)
    theirs, their_inliers = cloud.segment_plane(0.01, 3, 1000, 1.0)
    planes, inliers = ransac_plane(frame_points)
    cosine = abs(float(planes[0, :3] @ torch.tensor(theirs[:3])))
    assert math.acos(min(1.0, cosine)) < math.radians(0.5)
    assert int(inliers.sum()) > 0.98 * len(their_inliers)
