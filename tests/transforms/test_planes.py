from __future__ import annotations

import gc
import json
import math
import pickle
import weakref

import pytest
import torch

from pcdata.errors import ConfigError, FrameError, NoPlaneError, TooFewPointsError
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
    TiltedPlaneWarning,
    ToFrame,
    plane_hulls_in_cloud,
    planes_in_cloud,
)
from tests.factories import cloud_in_base
from tests.tables import TABLE as TABLE_SIZE
from tests.tables import WALL, box, rectangle

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


def test_what_is_told_of_a_plane_is_found_out_late_and_is_that_of_its_time():
    cloud = cloud_in_base((100,))
    at_once, late, copied = (TABLE(cloud) for _ in range(3))
    told = at_once.meta[0]["planes"]
    points = weakref.ref(cloud.points.untyped_storage())
    cloud.source_from_cloud.mul_(2)
    cloud.points.zero_()
    del cloud
    gc.collect()
    assert points() is None  # what is told later holds no points
    assert late.meta[0]["planes"] == told
    assert pickle.loads(pickle.dumps(copied)).meta[0]["planes"] == told


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
    with pytest.warns(TiltedPlaneWarning, match=r"tilted by (87|90)\.\d degrees from up; likely it is a wall"):
        assert RemovePlane(up=(0, 0, 1), frame="base")(cloud).num_points > 0


# -- the table of a scene ----------------------------------------------------------------------------------------------

SUPPORTING = RemovePlane(which="supporting", cut="measured", probability=0.9999)


def in_base(*parts: torch.Tensor) -> PointCloud:
    """Parts by label, seen from above and aside."""
    labels = torch.cat([torch.full((len(part),), number) for number, part in enumerate(parts)])
    return PointCloud(
        points=torch.cat(parts), labels=labels, frame_id="base", viewpoint=torch.tensor([[-1.0, 0.0, 1.0]])
    )


BLOCKS = [box((x, y, 0.0), (0.08, 0.06, 0.12), seed=9) for x, y in ((0.1, 0.1), (-0.2, 0.2), (0.25, -0.2))]


def kept_share(cloud: PointCloud, left: PointCloud, *labels: int) -> list[float]:
    return [float((left.labels == label).sum() / (cloud.labels == label).sum()) for label in labels]


def test_the_table_goes_and_wall_and_things_stay_though_the_wall_is_larger():
    cloud = in_base(rectangle(**WALL, seed=1), rectangle(**TABLE_SIZE), *BLOCKS)
    left = SUPPORTING(cloud)
    wall, table, *things = kept_share(cloud, left, 0, 1, 2, 3, 4)
    assert wall > 0.98
    assert table < 0.01
    assert min(things) > 0.95
    over = RemovePlane(which="supporting", cut="measured", keep="over")(cloud)
    assert kept_share(cloud, over, 0) == [0.0]  # what is not over the table goes too
    assert min(kept_share(cloud, over, 2, 3, 4)) > 0.95


def test_of_two_tables_the_one_with_things_on_it_goes():
    low = rectangle((-0.4, -0.4, 0.0), (0.8, 0.0, 0.0), (0.0, 0.8, 0.0), count=4000)
    high = rectangle((0.5, -0.4, 0.2), (0.8, 0.0, 0.0), (0.0, 0.8, 0.0), count=4000)
    cloud = in_base(low, high, *BLOCKS)
    assert kept_share(cloud, SUPPORTING(cloud), 0, 1) == pytest.approx([0.0, 1.0], abs=0.01)


def test_an_empty_table_leaves_a_cloud_of_nothing_which_is_told():
    with pytest.raises(TooFewPointsError, match="nothing is left of cloud 0"):
        SUPPORTING(in_base(rectangle(**TABLE_SIZE)))


def test_a_cloud_without_a_table_is_told():
    blob = torch.rand(3000, 3, generator=seeded(0)) * 2
    with pytest.raises(NoPlaneError, match=r"no plane holds 0\.03 of its"):
        RemovePlane(which="supporting", distance=0.002)(in_base(blob))


@pytest.mark.parametrize(
    ("frame", "steps", "cause"),
    [
        ("base", [], r"the pose of the camera in 'base' is off by as much .* or the table does lean"),
        ("camera", [], "the camera looks down at another angle"),
        ("base", [RandomRotation(axis=(1, 0, 0), degrees=0.001)], "RandomRotation before it turned the cloud"),
    ],
)
def test_a_tilted_table_is_told_with_its_angle_and_the_likely_cause(frame, steps, cause):
    tilted = rectangle((-0.5, -0.5, 0.0), (1.0, 0.0, math.tan(math.radians(12))), (0.0, 1.0, 0.0))
    cloud = PointCloud(points=torch.cat([tilted, box((0, 0, 0.0), (0.1, 0.1, 0.2))]), frame_id=frame)
    cloud = Compose(steps)(cloud, generator=seeded(0)) if steps else cloud
    step = RemovePlane(which="supporting", up=(0, 0, 1), frame=frame)
    with pytest.warns(TiltedPlaneWarning, match=rf"tilted by 1[12]\.\d degrees from up; likely {cause}"):
        left = step(cloud)
    assert left.meta[0]["planes"][0]["tilt"] == pytest.approx(math.radians(12), abs=0.01)
    quiet = RemovePlane(which="supporting", up=(0, 0, 1), frame=frame, tilt_alarm=None)
    assert quiet(cloud).meta[0]["planes"][0]["tilt"] == left.meta[0]["planes"][0]["tilt"]


def test_what_is_known_of_the_plane_is_stored():
    cloud = in_base(rectangle(**TABLE_SIZE, noise=0.002), *BLOCKS)
    left = RemovePlane(which="supporting", cut="measured", up=(0, 0, 1), frame="base")(cloud)
    (plane,) = left.meta[0]["planes"]
    assert plane["inlier_share"] == plane["num_inliers"] / cloud.num_points
    assert plane["rms"] == pytest.approx(0.002, rel=0.1)
    assert plane["noise"] == pytest.approx(0.002, rel=0.15)
    assert plane["tilt"] < 0.01
    (hull,) = plane_hulls_in_cloud(left)
    assert 3 <= len(hull) <= 24
    edge = hull.roll(-1, 0) - hull
    area = 0.5 * float((hull[:, 0] * edge[:, 1] - hull[:, 1] * edge[:, 0]).sum())  # counterclockwise from above
    assert area == pytest.approx(1.0, rel=0.02)
    largest = RemovePlane()(cloud).meta[0]["planes"][0]
    assert "noise" not in largest
    assert largest["hull"]


def test_a_noise_that_is_not_known_is_not_in_the_history():
    seen = in_base(rectangle(**TABLE_SIZE, noise=0.002), *BLOCKS)
    cloud = PointCloud(points=seen.points, frame_id="base")  # from nowhere
    step = RemovePlane(cut="measured")
    left = step(cloud)
    ((entry,),) = left.history
    assert "disparity_noise" not in entry["params"]
    assert json.loads(json.dumps(entry, allow_nan=False)) == entry
    assert torch.equal(step.replay(cloud, [entry]).points, left.points)
