from __future__ import annotations

import math

import pytest
import torch

from pcdata.errors import ConfigError, FrameError, NoPlaneError
from pcdata.geometry import rigid
from pcdata.rng import seeded
from pcdata.structures import PointCloud
from pcdata.synthetic import tabletop
from pcdata.transforms import (
    Center,
    Compose,
    Deproject,
    MergeViews,
    NormalizeUnitSphere,
    RandomRotation,
    RandomScale,
    RemovePlane,
    ToFrame,
    planes_in_cloud,
)
from tests.factories import cloud_in_base

TABLE = RemovePlane(distance=0.004, up=(0.0, 0.0, 1.0), frame="base", max_tilt=0.2)


def test_the_table_goes_and_the_objects_stay():
    cloud = cloud_in_base()
    left = RemovePlane(distance=0.005)(cloud)
    assert torch.equal(left.extra["row"], torch.nonzero(cloud.labels >= 0).squeeze(1))
    for entry, single in zip(left.meta, cloud.unbatch()):
        (plane,) = entry["planes"]
        assert plane["num_inliers"] == int((single.labels < 0).sum())


def test_the_plane_found_is_the_plane_that_is_there():
    cloud = TABLE(cloud_in_base())
    for b in range(3):
        normal_offset = planes_in_cloud(cloud, b)
        torch.testing.assert_close(normal_offset, torch.tensor([[0.0, 0, 1, 0]]).double(), atol=1e-5, rtol=0)
        assert cloud.meta[b]["planes"][0]["tilt"] < 1e-4


def test_the_stored_plane_is_in_the_source_frame():
    cloud = TABLE(cloud_in_base((100,)))
    (plane,) = cloud.meta[0]["planes"]
    assert plane["frame"] == "camera"
    camera_from_base = rigid.invert_rigid(cloud.frames["base"][0])
    expected = camera_from_base[:3, :3] @ torch.tensor([0.0, 0, 1]).double()
    torch.testing.assert_close(torch.tensor(plane["normal"]).double(), expected, atol=1e-5, rtol=0)


def test_the_plane_follows_whatever_is_done_to_the_cloud_later():
    original = cloud_in_base((120, 90))
    moves = [RandomRotation(axis=None, about="centroid"), RandomScale(per_axis=True), Center(), NormalizeUnitSphere()]
    moved = Compose([TABLE, *moves])(original, generator=seeded(2))
    # The table itself, taken the same way by the inverse of the way back.
    table = original.select(original.labels < 0, torch.tensor([0, 60, 106]))
    table_moved = table.in_source_frame().transformed(torch.linalg.inv(moved.source_from_cloud))
    for b, part in enumerate(table_moved.unbatch()):
        plane = planes_in_cloud(moved, b)[0]
        assert abs(float(plane[:3].norm()) - 1) < 1e-12
        distance = part.points.double() @ plane[:3] + plane[3]
        assert float(distance.abs().max()) < 1e-4
        # The objects are still on the side that the normal points to.
        assert bool((moved.unbatch()[b].points.double() @ plane[:3] + plane[3] > 0).all())


def test_above_drops_what_hangs_below_the_table():
    cloud = cloud_in_base((100,))
    below = cloud.with_fields(points=torch.where(cloud.labels[:, None] == 1, -cloud.points, cloud.points))
    both = RemovePlane(distance=0.005, up=(0, 0, 1), frame="base")(below)
    above = RemovePlane(distance=0.005, up=(0, 0, 1), frame="base", keep="above")(below)
    assert set(both.labels.tolist()) == {0, 1}
    assert set(above.labels.tolist()) == {0}
    upside_down = RemovePlane(distance=0.005, up=(0, 0, -1), frame="base", keep="above")(below)
    assert set(upside_down.labels.tolist()) == {1}


def wall_and_shelf() -> PointCloud:
    """A large wall x = 0.5 and a smaller shelf z = 0."""
    generator = torch.Generator().manual_seed(0)
    wall = torch.rand(300, 3, generator=generator) * torch.tensor([0.0, 1.0, 1.0]) + torch.tensor([0.5, 0.0, 0.1])
    shelf = torch.rand(150, 3, generator=generator) * torch.tensor([0.4, 1.0, 0.0])
    labels = torch.cat([torch.zeros(300), torch.ones(150)]).long()
    return PointCloud(points=torch.cat([wall, shelf]), labels=labels, frame_id="base")


def test_a_tilt_limit_finds_the_shelf_and_not_the_larger_wall():
    cloud = wall_and_shelf()
    assert set(RemovePlane()(cloud).labels.tolist()) == {1}
    level = RemovePlane(up=(0, 0, 1), frame="base", max_tilt=math.radians(10))
    assert set(level(cloud).labels.tolist()) == {0}
    assert level(cloud).meta[0]["planes"][0]["tilt"] < 1e-3


def test_planes_add_up():
    surfaces = wall_and_shelf()
    blob = torch.rand(20, 3, generator=torch.Generator().manual_seed(1)) * 0.1 + torch.tensor([0.1, 0.2, 0.3])
    cloud = PointCloud(points=torch.cat([surfaces.points, blob]), frame_id="base")
    assert planes_in_cloud(cloud).shape == (0, 4)
    left = Compose([RemovePlane(), RemovePlane()])(cloud)
    assert torch.equal(left.points, blob)
    expected = torch.tensor([[-1.0, 0, 0, 0.5], [0, 0, 1.0, 0]]).double()  # the wall's normal faces the origin
    torch.testing.assert_close(planes_in_cloud(left).abs(), expected.abs(), atol=1e-6, rtol=0)


def test_no_level_plane_is_a_typed_error():
    wall = wall_and_shelf().select(torch.arange(300), torch.tensor([0, 300]))
    with pytest.raises(NoPlaneError, match="within max_tilt of up"):
        RemovePlane(up=(0, 0, 1), frame="base", max_tilt=0.1)(wall)


def test_fields_that_need_each_other_are_asked_for():
    with pytest.raises(ConfigError, match="up and the frame it is in together"):
        RemovePlane(up=(0, 0, 1))
    with pytest.raises(ConfigError, match="max_tilt is measured from up"):
        RemovePlane(max_tilt=0.1)
    with pytest.raises(FrameError, match="given in frame 'world' but the cloud is in 'base'"):
        RemovePlane(up=(0, 0, 1), frame="world")(cloud_in_base())


def test_the_rendered_table_is_found_from_several_views():
    scene = tabletop(2, num_objects=2, num_views=2, size=(60, 80), floor=False)
    cloud = Compose([Deproject(), ToFrame(frame="base"), MergeViews(), TABLE])(scene.frame)
    (plane,) = planes_in_cloud(cloud)
    torch.testing.assert_close(plane, scene.truth.table_plane, atol=1e-4, rtol=0)
    assert float((cloud.labels > 0).float().mean()) > 0.5  # what is left is mostly objects


def table_through_the_origin(seed: int, *, offset: float = 0.0) -> PointCloud:
    """A noisy table in the frame on its top, and an object on it."""
    generator = seeded(seed)
    table = torch.rand(3000, 3, generator=generator) - 0.5
    table[:, 2] = offset + 0.001 * torch.randn(3000, generator=generator)
    block = torch.rand(400, 3, generator=generator) * 0.1 + torch.tensor([0.0, 0.0, 0.02 + offset])
    return PointCloud(points=torch.cat([table, block]), frame_id="base", viewpoint=torch.tensor([[0.2, 0.1, 0.9]]))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("offset", [0.0, 0.006, -0.006])
def test_the_upper_side_of_a_plane_through_the_origin_is_asked_for(seed, offset):
    cloud = table_through_the_origin(seed, offset=offset)
    with pytest.raises(
        ConfigError, match=r"is open: the plane passes the origin of 'base' .* up=\(x, y, z\), frame='base'"
    ):
        RemovePlane(keep="above")(cloud)
    above = RemovePlane(keep="above", up=(0, 0, 1), frame="base")(cloud)
    assert int((above.points[:, 2] > offset + 0.015).sum()) == 400
    assert above.meta[0]["planes"][0]["faces"] == "up"


def test_the_normal_of_a_plane_through_the_origin_does_not_hang_on_noise():
    left = [RemovePlane()(table_through_the_origin(seed)) for seed in range(8)]
    assert {cloud.meta[0]["planes"][0]["faces"] for cloud in left} == {"neither side"}
    assert all(float(planes_in_cloud(cloud)[0, 2]) > 0.99 for cloud in left)


def test_a_plane_off_the_origin_faces_it_and_has_an_upper_side():
    for offset in (-0.5, 0.5):
        cloud = table_through_the_origin(0, offset=offset)
        above = RemovePlane(keep="above")
        if offset < 0:
            assert int((above(cloud).points[:, 2] > offset + 0.015).sum()) == 400
            assert above(cloud).meta[0]["planes"][0]["faces"] == "origin"
        assert float(planes_in_cloud(RemovePlane()(cloud))[0, 3]) > 0


@pytest.mark.parametrize("lean", [-0.05, 0.0, 0.05])
def test_a_wall_has_no_upper_side(lean):
    generator = seeded(0)
    wall = torch.rand(2000, 3, generator=generator)
    wall[:, 0] = 0.7 + lean * wall[:, 2]
    cloud = PointCloud(points=torch.cat([wall, torch.rand(200, 3, generator=generator) * 0.3]), frame_id="base")
    with pytest.raises(ConfigError, match=r"contains up to within .* degrees, so neither side is above"):
        RemovePlane(keep="above", up=(0, 0, 1), frame="base")(cloud)
    assert RemovePlane(up=(0, 0, 1), frame="base")(cloud).num_points > 0
