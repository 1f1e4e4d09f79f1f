"""Spheres, cylinders, lines and circles that are known are found, and are the least squares of their own inliers."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from torch import Tensor

from pcdata.errors import ConfigError, DTypeError, NoShapeError, ShapeError, TooFewPointsError
from pcdata.functional import ransac
from pcdata.functional.row_draws import draw_rows
from pcdata.functional.rows import ptr_from_counts
from pcdata.functional.shapes import ransac_circle, ransac_cylinder, ransac_line, ransac_sphere
from pcdata.rng import seeded

CENTER = torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64)
WIDE = torch.float64


def rotation(seed: int) -> Tensor:
    matrix = torch.linalg.qr(torch.randn(3, 3, generator=seeded(seed), dtype=WIDE))[0]
    return matrix * torch.linalg.det(matrix)


def clutter(count: int, seed: int) -> Tensor:
    return torch.rand(count, 3, generator=seeded(seed + 90), dtype=WIDE) - 0.5


def surface(kind: str, count: int, seed: int, *, noise: float = 0.001) -> Tensor:
    """Points of a shape of radius 0.1 (a line of 0.4) about CENTER, whose axis is the third column of a rotation."""
    draw = seeded(seed)
    turn, along = torch.rand(2, count, generator=draw, dtype=WIDE)
    turn, along = 2 * math.pi * turn, 0.4 * (along - 0.5)
    ring = 0.1 * torch.stack([turn.cos(), turn.sin()], 1)
    if kind == "sphere":
        points = 0.1 * torch.nn.functional.normalize(torch.randn(count, 3, generator=draw, dtype=WIDE), dim=1)
    elif kind == "cylinder":
        points = torch.cat([ring, along[:, None]], 1)
    elif kind == "circle":
        points = torch.cat([ring, 0 * along[:, None]], 1)
    else:
        points = torch.cat([0 * ring, along[:, None]], 1)
    points = points @ rotation(seed).T + CENTER
    return points + noise * torch.randn(count, 3, generator=draw, dtype=WIDE)


def scene(kind: str, seed: int = 0, *, noise: float = 0.001) -> Tensor:
    return torch.cat([surface(kind, 300, seed, noise=noise), clutter(300, seed)]).float()


FIND = {"sphere": ransac_sphere, "cylinder": ransac_cylinder, "line": ransac_line, "circle": ransac_circle}
KINDS = pytest.mark.parametrize("kind", FIND)


def numbers(kind: str, found) -> np.ndarray:
    """A point, a direction and a radius of the first cloud, as far as the shape has them."""
    return torch.cat([value[0].reshape(-1) for value in found[:-1]]).numpy()


def apart(kind: str, shape: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Residuals in NumPy: by projections, where the library takes cross products."""
    offset = points - shape[:3]
    if kind == "sphere":
        return np.linalg.norm(offset, axis=1) - shape[3]
    axis = shape[3:6] / np.linalg.norm(shape[3:6])
    along = offset @ axis
    away = np.sqrt(np.maximum((offset**2).sum(1) - along**2, 0))
    if kind == "line":
        return away
    return away - shape[6] if kind == "cylinder" else np.hypot(away - shape[6], along)


@KINDS
@pytest.mark.parametrize("seed", range(6))
def test_a_known_shape_is_found_among_clutter(kind, seed):
    found = FIND[kind](scene(kind, seed).requires_grad_(), distance=0.005, seed=seed)
    assert bool(found.inlier_mask[:300].float().mean() > 0.995)
    assert not any(value.requires_grad for value in found)
    assert float(apart(kind, numbers(kind, found), CENTER[None].numpy())[0]) == pytest.approx(
        {"sphere": -0.1, "cylinder": -0.1, "line": 0.0, "circle": 0.1}[kind], abs=0.002
    )
    if kind != "sphere":
        axis = rotation(seed)[:, 2]
        assert abs(float(found[1][0] @ axis)) == pytest.approx(1, abs=1e-3)
        assert float(found[1][0].abs().max()) == float(found[1][0].max())
    if kind != "line":
        assert float(found.radius) == pytest.approx(0.1, abs=0.001)


@KINDS
def test_it_is_the_least_squares_of_its_own_inliers(kind):
    points = scene(kind, 3)
    found = FIND[kind](points, distance=0.005)
    inliers = points[found.inlier_mask].double().numpy()
    ours = numbers(kind, found)
    fitted = least_squares(lambda shape: apart(kind, shape, inliers), ours, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert (apart(kind, ours, inliers) ** 2).sum() <= (fitted.fun**2).sum() * (1 + 1e-9)


def test_two_points_are_a_line_and_a_flat_ring_is_a_circle():
    line = ransac_line(torch.tensor([[0.0, 0, 1], [0, 4, 1]]))
    assert line.center.tolist() == [[0, 2, 1]]
    assert line.direction.tolist() == [[0, 1, 0]]
    assert line.length.tolist() == [4]
    turn = torch.linspace(0, 6, 40)
    ring = torch.stack([2 + turn.cos(), 3 + turn.sin(), 0 * turn], 1)
    circle = ransac_circle(ring, distance=1e-4)
    torch.testing.assert_close(circle.center, torch.tensor([[2.0, 3, 0]], dtype=WIDE), atol=1e-6, rtol=0)
    assert float(circle.normal[0, 2]) == pytest.approx(1)


@KINDS
def test_the_mask_is_the_documented_test_and_the_ends_are_those_of_the_inliers(kind):
    points = scene(kind, 1)
    found = FIND[kind](points, distance=0.005)
    wide = points.double().numpy()
    distance = np.abs(apart(kind, numbers(kind, found), wide))
    clear = np.abs(distance - 0.005) > 1e-9
    assert ((distance < 0.005) == found.inlier_mask.numpy())[clear].all()
    if kind in ("line", "cylinder"):
        along = (wide[found.inlier_mask.numpy()] - found.center[0].numpy()) @ found[1][0].numpy()
        np.testing.assert_allclose([along.min(), along.max()], [-float(found.length) / 2, float(found.length) / 2])


@KINDS
def test_many_clouds_are_found_as_each_alone_on_any_number_of_threads(kind):
    counts = [12 + n for n in range(70)]
    clouds = [torch.cat([surface(kind, count, n), clutter(count // 2, n)]).float() for n, count in enumerate(counts)]
    ptr = ptr_from_counts([len(cloud) for cloud in clouds])
    seeds = list(range(70))
    given = {"distance": 0.005, "num_hypotheses": 40}
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        batch = FIND[kind](torch.cat(clouds), ptr, seed=seeds, **given)
        torch.set_num_threads(2)
        again = FIND[kind](torch.cat(clouds), ptr, seed=torch.tensor(seeds), **given)
    finally:
        torch.set_num_threads(threads)
    for one, other in zip(batch, again, strict=True):
        assert torch.equal(one, other)
    for n in (0, 31, 69):
        alone = FIND[kind](clouds[n], seed=n, **given)
        for one, other in zip(batch[:-1], alone[:-1], strict=True):
            assert torch.equal(one[n], other[0])
        assert torch.equal(batch.inlier_mask[int(ptr[n]) : int(ptr[n + 1])], alone.inlier_mask)


@KINDS
def test_far_off_and_in_another_unit_it_is_the_same_shape(kind):
    points = scene(kind, 2, noise=0.0)
    here = FIND[kind](points, distance=0.005)
    there = FIND[kind](points * 1024, distance=0.005 * 1024)
    assert torch.equal(here.inlier_mask, there.inlier_mask)
    for one, other in zip(here[:-1], there[:-1]):
        direction = one is here[1] and kind != "sphere"
        torch.testing.assert_close(one if direction else one * 1024, other, rtol=1e-9, atol=1e-9)
    moved = FIND[kind](points + 1000, distance=0.005)
    assert bool((moved.inlier_mask == here.inlier_mask).float().mean() > 0.99)  # float32 leaves 0.06 mm
    if kind != "line":
        assert float(moved.radius) == pytest.approx(0.1, abs=1e-4)


@pytest.mark.parametrize("kind", ["sphere", "cylinder"])
def test_normals_find_what_is_a_small_part_in_few_tries(kind):
    points = torch.cat([surface(kind, 150, 5, noise=0.0), clutter(1350, 5)])
    away = points[:150] - CENTER
    if kind == "cylinder":
        axis = rotation(5)[:, 2]
        away = away - (away @ axis)[:, None] * axis
    normals = torch.nn.functional.normalize(torch.cat([-3 * away, clutter(1350, 6)]), dim=1) * 0.5
    found = FIND[kind](points.float(), normals=normals.float(), distance=0.003, num_hypotheses=500)
    assert bool(found.inlier_mask[:150].all())
    assert float(found.radius) == pytest.approx(0.1, abs=1e-4)


@pytest.mark.parametrize("kind", ["sphere", "cylinder", "circle"])
def test_the_radius_keeps_to_its_limits(kind):
    points = torch.cat([scene(kind), 0.3 * (scene(kind) - CENTER.float()) + 0.25])
    assert float(FIND[kind](points, distance=0.003, radius=(0.05, 0.2)).radius) == pytest.approx(0.1, abs=0.002)
    assert float(FIND[kind](points, distance=0.003, radius=(0.02, 0.05)).radius) == pytest.approx(0.03, abs=0.002)
    with pytest.raises(NoShapeError, match=f"ransac_{kind}: cloud 0: none of the 1000 hypotheses is one within"):
        FIND[kind](points, radius=(1e6, 1e7))


@pytest.mark.parametrize("kind", ["line", "cylinder", "circle"])
def test_the_axis_keeps_to_its_tilt_and_points_up(kind):
    upright = surface(kind, 120, 0) - CENTER
    upright = (upright @ rotation(0)).float() + torch.tensor([0.9, 0.0, 0.0])  # about the z axis, off the others
    points = torch.cat([scene(kind, 4), upright])
    found = FIND[kind](points, distance=0.005, up=(0, 0, -2), max_tilt=0.2)
    assert float(found[1][0, 2]) == pytest.approx(-1, abs=1e-3)
    assert bool(found.inlier_mask[-120:].float().mean() > 0.98)
    with pytest.raises(ConfigError, match="but up was not given"):
        FIND[kind](points, max_tilt=0.2)


def test_large_clouds_are_compared_on_a_part_and_their_best_on_all(monkeypatch):
    points = torch.cat([surface("sphere", 3000, 0), clutter(9000, 0)]).float()[torch.randperm(12000)]
    part = ransac_sphere(points, distance=0.004)
    monkeypatch.setattr(ransac, "SCORED", 1 << 30)
    whole = ransac_sphere(points, distance=0.004)
    assert float((part.center - whole.center).norm()) < 1e-4
    assert int(part.inlier_mask.sum()) >= 2990


@pytest.mark.parametrize("size", [2, 3])
def test_draws_are_distinct_and_uniform(size):
    rows = draw_rows(4, size, 24_000, seeded(1))
    assert bool((rows.sort(dim=1).values.diff(dim=1) > 0).all())
    _, counts = rows.unique(dim=0, return_counts=True)
    assert len(counts) == math.perm(4, size)  # every ordered draw of 4 points
    assert int((counts - 24_000 // len(counts)).abs().max()) < 5 * math.sqrt(24_000 / len(counts))


def test_points_that_determine_nothing_are_told():
    same = torch.full((20, 3), 0.3)
    for kind, find in FIND.items():
        with pytest.raises(NoShapeError, match=f"ransac_{kind}: cloud 1: no .* of its points that were drawn"):
            find(torch.cat([scene(kind)[:60], same]), ptr_from_counts([60, 20]))
        with pytest.raises(TooFewPointsError):
            find(same[:1])
    flat = torch.cat([torch.rand(50, 2, generator=seeded(0)), torch.zeros(50, 1)], 1)
    with pytest.raises(NoShapeError, match="no 4 of its points"):
        ransac_sphere(flat)
    spread, normals = torch.rand(200, 3, generator=seeded(0)), torch.randn(200, 3, generator=seeded(1))
    with pytest.raises(NoShapeError, match=r"no sphere has 2 points nearer than distance=1e-12; .* unit"):
        ransac_sphere(spread, normals=normals, distance=1e-12)


@pytest.mark.parametrize(
    ("given", "error", "words"),
    [
        ({"radius": 0.1}, DTypeError, "least and the largest"),
        ({"radius": (0.1, "2")}, DTypeError, "least and the largest"),
        ({"radius": (0.2, 0.1)}, ConfigError, "low <= high"),
        ({"radius": (-1, 0.1)}, ConfigError, "low <= high"),
        ({"radius": (math.nan, 0.1)}, ConfigError, "low <= high"),
        ({"up": (0, 0)}, ShapeError, "up must be"),
        ({"up": (0, 0, 0)}, ConfigError, "up must be"),
        ({"seed": [1, 2]}, ShapeError, "2 seeds"),
        ({"up": (0, 0, 1), "max_tilt": 4}, ConfigError, "between 0 and pi"),
    ],
)
def test_wrong_limits_are_refused(given, error, words):
    with pytest.raises(error, match=f"ransac_cylinder: .*{words}"):
        ransac_cylinder(scene("cylinder"), **given)
