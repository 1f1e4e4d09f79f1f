"""Clouds of one shape, moved by a known motion: every method finds it, and says where it does not."""

from __future__ import annotations

import math

import pytest
import torch

from pcdata.alignment import align_clouds, registration
from pcdata.errors import ConfigError, TooFewPointsError
from pcdata.geometry import rigid
from tests.alignment.test_icp import apart, corner, moved, small_motion

METHODS = ("point_to_plane", "point_to_point", "gicp")


def room(count: int, seed: int) -> torch.Tensor:
    """A corner with a box and a ball that no motion maps onto itself."""
    generator = torch.Generator().manual_seed(seed)
    box = torch.rand(count // 4, 3, generator=generator) * torch.tensor([0.12, 0.06, 0.0]) + torch.tensor(
        [0.1, 0.2, 0.08]
    )
    ball = torch.nn.functional.normalize(torch.randn(count // 4, 3, generator=generator), dim=1) * 0.05
    return torch.cat([corner(count // 2, seed), box, ball + torch.tensor([0.3, 0.1, 0.1])])


@pytest.mark.parametrize("method", METHODS)
def test_a_small_motion_is_found_trusted_and_as_sure_as_the_covariance_says(method):
    if method != "point_to_plane":
        pytest.importorskip("small_gicp")
    target = corner(3000, 0, noise=0.0005)
    truth = small_motion(15, 4, seed=2)
    source = moved(corner(2500, 1, noise=0.0005), rigid.invert_rigid(truth))
    found = align_clouds(source, target, method=method)
    shift, angle = apart(found.target_from_source, truth)
    worst = {"point_to_plane": 0.3, "gicp": 0.3, "point_to_point": 3.0}[method]  # pairs of points slide on surfaces
    assert shift < worst
    assert angle < worst
    assert found.is_trusted, found.reason
    assert found.reason == ""
    assert found.overlap > 0.8
    assert found.basin >= 0.05
    assert found.covariance.shape == (6, 6)
    assert 0 < float(found.covariance.diagonal().max()) < 1e-4


@pytest.mark.parametrize("method", METHODS)
def test_a_plane_leaves_three_directions_open_and_clouds_that_do_not_meet_are_not_trusted(method):
    if method != "point_to_plane":
        pytest.importorskip("small_gicp")
    generator = torch.Generator().manual_seed(3)
    plane = torch.rand(2500, 3, generator=generator) * torch.tensor([0.4, 0.4, 0.0])
    plane += 0.0005 * torch.randn(2500, 3, generator=generator)
    found = align_clouds(plane[::2].clone(), plane[1::2].clone(), method=method)
    assert len(found.found.unobservable) == 3
    cloud = torch.rand(1500, 3, generator=generator) * 0.4
    other = torch.rand(1500, 3, generator=generator) * 0.4 + torch.tensor([0.1, 0.0, 0.0])
    chance = align_clouds(cloud, other, method=method)
    assert not chance.is_trusted
    assert chance.reason


def test_point_to_point_ends_where_small_gicp_does():
    library = pytest.importorskip("small_gicp")
    target, source = corner(2000, 0), moved(corner(2000, 0)[::2], small_motion(5, 1, seed=3))
    ours = align_clouds(source, target, method="point_to_point", max_distance=0.05)
    theirs = library.align(
        target.double().numpy(),
        source.double().numpy(),
        registration_type="ICP",
        downsampling_resolution=1e-6,
        max_correspondence_distance=0.05,
        max_iterations=100,
    )
    shift, angle = apart(ours.target_from_source, torch.from_numpy(theirs.T_target_source.copy()))
    assert shift < 0.1
    assert angle < 0.1


@pytest.mark.slow
@pytest.mark.open3d
def test_any_motion_is_found_by_a_global_search():
    pytest.importorskip("open3d")
    target = room(3000, 0)
    truth = torch.eye(4, dtype=torch.float64)
    truth[:3, :3] = rigid.rotation_from_quaternion(torch.tensor([[0.3, 0.8, -0.4, 0.33]], dtype=torch.float64))[0]
    truth[:3, 3] = torch.tensor([0.8, -0.5, 1.1])
    source = moved(room(3000, 1), rigid.invert_rigid(truth))
    found = align_clouds(source, target, search="global")
    shift, angle = apart(found.target_from_source, truth)
    assert (shift < 1.0, angle < 0.5) == (True, True), (shift, angle, found.reason)
    assert found.is_trusted, found.reason
    assert found.basin == math.inf


def test_what_cannot_be_aligned_is_refused():
    cloud = corner(200, 0)
    with pytest.raises(ConfigError, match=r"method must be one of .* got 'ndt'"):
        align_clouds(cloud, cloud, method="ndt")
    with pytest.raises(ConfigError, match="a global search has no start"):
        align_clouds(cloud, cloud, search="global", initial=torch.eye(4))
    with pytest.raises(TooFewPointsError, match="source has 5 points"):
        align_clouds(cloud[:5], cloud)


def test_global_searches_that_end_elsewhere_as_well_or_meet_little_are_not_trusted(monkeypatch):
    turned = torch.eye(4, dtype=torch.float64)
    turned[:2, :2] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
    starts = [torch.eye(4, dtype=torch.float64), turned]
    monkeypatch.setattr(registration, "_global_poses", lambda source, target: (starts, 0.02))
    ball = torch.nn.functional.normalize(torch.randn(1500, 3, generator=torch.Generator().manual_seed(0)), dim=1) * 0.1
    found = align_clouds(ball[::2].clone(), ball[1::2].clone(), search="global")
    assert not found.is_trusted
    assert "the shape fits in several ways" in found.reason
    monkeypatch.setattr(registration, "_global_poses", lambda source, target: (starts[:1], 0.02))
    source, target = corner(2000, 1), corner(2000, 0)
    found = align_clouds(source, target[target[:, 0] > 0.25], search="global")
    assert not found.is_trusted
    assert "of the source has a partner" in found.reason
    assert align_clouds(source, target, search="global").is_trusted
