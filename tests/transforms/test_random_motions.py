"""Random motions: what their matrices are, over many draws."""

from __future__ import annotations

import math

import pytest
import torch

from pcdata.errors import ConfigError, PoseError
from pcdata.geometry import rigid
from pcdata.rng import Streams, seeded
from pcdata.structures import PointCloud
from pcdata.transforms import RandomFlip, RandomRotation, RandomScale, RandomShear, RandomTranslation
from tests.factories import cloud_in_base

MANY = 400


def matrices(transform, cloud: PointCloud | None = None) -> torch.Tensor:
    """(MANY, 4, 4) draws, one per cloud of a batch of one-point clouds."""
    if cloud is None:
        points = torch.randn(MANY, 3, generator=seeded(9))
        cloud = PointCloud(points=points, ptr=torch.arange(MANY + 1), frame_id="base")
    return transform.make_params(cloud, Streams.of(seeded(0), cloud.num_clouds))["matrix"]


@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (1.0, -2.0, 0.5), None])
@pytest.mark.parametrize("about", ["origin", "centroid"])
def test_rotations_are_rotations(axis, about):
    drawn = matrices(RandomRotation(axis=axis, about=about))
    rigid.check_rigid("test", drawn, tolerance=1e-12)
    torch.testing.assert_close(torch.linalg.det(drawn[:, :3, :3]), torch.ones(MANY).double())


def test_angles_fill_the_range_about_the_axis():
    drawn = matrices(RandomRotation(axis=(0, 0, 3), degrees=40))
    angle = torch.atan2(drawn[:, 1, 0], drawn[:, 0, 0])
    limit = math.radians(40)
    assert float(angle.abs().max()) <= limit
    assert float(angle.max()) > 0.95 * limit
    assert float(angle.min()) < -0.95 * limit
    assert abs(float(angle.mean())) < 4 * limit / math.sqrt(3 * MANY)
    torch.testing.assert_close(drawn[:, 2, :3], torch.tensor([0.0, 0, 1]).double().expand(MANY, 3))


def test_rotations_without_an_axis_are_uniform():
    drawn = matrices(RandomRotation(axis=None))
    # Of a uniform rotation every entry has mean 0 and variance 1/3, and cos(angle) has mean -1/2.
    linear = drawn[:, :3, :3]
    assert float(linear.mean(0).abs().max()) < 4 / math.sqrt(3 * MANY)
    assert float((linear.square().mean(0) - 1 / 3).abs().max()) < 0.08
    cosine = (linear.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2
    assert abs(float(cosine.mean()) + 0.5) < 4 * 0.5 / math.sqrt(MANY)


def test_about_the_centroid_the_mean_stays():
    cloud = cloud_in_base((120, 90))
    for step in (
        RandomRotation(axis=None, about="centroid"),
        RandomScale(low=0.5, high=2.0, about="centroid", per_axis=True),
        RandomFlip(probability=(1, 1, 0), about="centroid"),
        RandomShear(about="centroid"),
    ):
        moved = step(cloud, generator=seeded(1))
        for before, after in zip(cloud.unbatch(), moved.unbatch()):
            torch.testing.assert_close(after.points.mean(0), before.points.mean(0), atol=1e-6, rtol=0)
            assert not torch.equal(before.points, after.points)


def test_distances_survive_a_rotation():
    cloud = cloud_in_base((60,))
    moved = RandomRotation(axis=None)(cloud, generator=seeded(1))
    torch.testing.assert_close(torch.pdist(moved.points), torch.pdist(cloud.points), atol=1e-6, rtol=0)


def test_an_axis_must_point_somewhere_and_a_range_needs_an_axis():
    with pytest.raises(ConfigError, match="axis must not be zero"):
        RandomRotation(axis=(0, 0, 0))
    with pytest.raises(ConfigError, match="degrees must stay 180; or give an axis"):
        RandomRotation(axis=None, degrees=10)
    with pytest.raises(ConfigError, match=r"RandomRotation\.degrees: .*less than or equal to 180"):
        RandomRotation(degrees=200)


def test_offsets_fill_their_range_axis_by_axis():
    drawn = matrices(RandomTranslation(max_offset=(0.1, 0.0, 0.3)))
    assert torch.equal(drawn[:, :3, :3], torch.eye(3).double().expand(MANY, 3, 3))
    offset = drawn[:, :3, 3]
    assert not bool(offset[:, 1].any())
    for axis, limit in ((0, 0.1), (2, 0.3)):
        assert float(offset[:, axis].abs().max()) <= limit
        assert float(offset[:, axis].max()) > 0.95 * limit
        assert float(offset[:, axis].min()) < -0.95 * limit
    assert abs(float(torch.corrcoef(offset[:, [0, 2]].T)[0, 1])) < 0.2
    assert float(matrices(RandomTranslation(max_offset=0.05))[:, :3, 3].abs().max()) <= 0.05
    for wrong in (-0.1, (0.1, -0.1, 0.1)):
        with pytest.raises(ConfigError, match="is no range"):
            RandomTranslation(max_offset=wrong)


def test_scales_lie_in_range_one_for_all_axes_or_one_each():
    for per_axis in (False, True):
        drawn = matrices(RandomScale(low=0.5, high=2.0, per_axis=per_axis))
        factor = drawn.diagonal(dim1=1, dim2=2)[:, :3]
        assert torch.equal(torch.diag_embed(factor), drawn[:, :3, :3])
        assert float(factor.min()) >= 0.5
        assert float(factor.max()) < 2.0
        assert float(factor.min()) < 0.6
        assert float(factor.max()) > 1.9
        assert bool((factor[:, 0] == factor[:, 1]).all()) != per_axis
    with pytest.raises(ConfigError, match=r"low 1\.2 exceeds high 1\.1"):
        RandomScale(low=1.2)


def test_scaling_keeps_metres_so_objects_really_grow():
    cloud = cloud_in_base((60,))
    moved = RandomScale(low=2.0, high=2.0)(cloud, generator=seeded(0))
    assert moved.unit == "m"
    torch.testing.assert_close(moved.points, cloud.points * 2)


def test_shears_fill_their_ranges_entry_by_entry():
    linear = matrices(RandomShear(low=-0.2, high=0.4))[:, :3, :3]
    assert bool((torch.diagonal(linear, dim1=1, dim2=2) == 1).all())
    off = linear[:, ~torch.eye(3, dtype=torch.bool)]
    assert float(off.min()) >= -0.2
    assert float(off.max()) < 0.4
    assert float(off.amin(0).max()) < -0.15
    assert float(off.amax(0).min()) > 0.35
    assert float((torch.corrcoef(off.T) - torch.eye(6)).abs().max()) < 0.25
    low = ((0.0, 0.0, -0.5), (0.0, 0.0, 0.1), (0.0, 0.0, 0.0))
    high = ((0.0, 0.0, 0.9), (0.0, 0.0, 0.1), (0.0, 0.0, 0.0))
    linear = matrices(RandomShear(low=low, high=high))[:, :3, :3]
    expected = torch.eye(3, dtype=torch.float64).repeat(MANY, 1, 1)
    expected[:, 0, 2], expected[:, 1, 2] = linear[:, 0, 2], 0.1
    assert torch.equal(linear, expected)
    assert float(linear[:, 0, 2].min()) < -0.45
    assert float(linear[:, 0, 2].max()) > 0.85


def test_a_sheared_plane_keeps_its_points_and_its_normal():
    generator = seeded(4)
    normal = torch.nn.functional.normalize(torch.randn(3, generator=generator), dim=0)
    across = torch.linalg.svd(normal[None])[2][1:]
    points = torch.randn(50, 2, generator=generator) @ across
    cloud = PointCloud(points=points, normals=normal.repeat(50, 1), frame_id="base")
    moved = RandomShear(low=-0.4, high=0.4)(cloud, generator=seeded(1))
    assert not torch.allclose(moved.points, points, atol=0.05)
    assert float((moved.points @ moved.normals[0]).abs().max()) < 1e-5
    assert float((moved.normals.norm(dim=1) - 1).abs().max()) < 1e-6


def test_shears_that_flatten_or_mirror_and_what_is_no_shear_are_refused():
    for low, high in ((-0.5, 0.1), (0.0, 0.5), (((0, 1.0, 0), (0, 0, 0), (0, 0, 0)),) * 2):
        with pytest.raises(ConfigError, match="must add up to less than 1"):
            RandomShear(low=low, high=high)
    with pytest.raises(ConfigError, match=r"low 0\.2 exceeds high 0\.1"):
        RandomShear(low=0.2)
    with pytest.raises(ConfigError, match="diagonal"):
        RandomShear(high=((0.1, 0.1, 0.1),) * 3)
    linear = matrices(RandomShear(low=-0.49, high=0.49))[:, :3, :3]
    assert float(torch.linalg.det(linear).min()) > 0


def test_each_axis_flips_with_its_own_probability():
    drawn = matrices(RandomFlip(probability=(0.25, 0.0, 1.0)))
    signs = drawn.diagonal(dim1=1, dim2=2)[:, :3]
    assert abs(float((signs[:, 0] < 0).double().mean()) - 0.25) < 4 * math.sqrt(0.25 * 0.75 / MANY)
    assert bool((signs[:, 1] == 1).all())
    assert bool((signs[:, 2] == -1).all())


def test_mirrored_normals_still_point_out_of_the_mirrored_surface():
    outward = torch.nn.functional.normalize(torch.randn(50, 3, generator=seeded(0)), dim=1)
    ball = PointCloud(points=outward * 0.1, normals=outward, frame_id="base")
    moved = RandomFlip(probability=(1, 0, 0))(ball, generator=seeded(0))
    torch.testing.assert_close(moved.points, ball.points * torch.tensor([-1.0, 1, 1]))
    torch.testing.assert_close(moved.normals, moved.points / 0.1)


def test_a_flip_is_a_mirror_which_poses_cannot_follow():
    drawn = matrices(RandomFlip(probability=(1, 0, 0)))
    torch.testing.assert_close(torch.linalg.det(drawn), -torch.ones(MANY).double())
    with pytest.raises(PoseError, match="mirrors"):
        rigid.map_poses(drawn[0], torch.eye(4).double())


def test_every_cloud_of_a_batch_draws_for_itself():
    for step in (RandomRotation(), RandomTranslation(), RandomScale()):
        drawn = matrices(step)
        assert len({tuple(matrix.flatten().tolist()) for matrix in drawn}) == MANY
