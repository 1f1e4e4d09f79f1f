"""Limits by area: the same objects at every resolution and distance; nothing is lost unsaid."""

from __future__ import annotations

import math

import pytest
import torch

from pcdata.errors import ConfigError, UnitError
from pcdata.functional.areas import seen_areas
from pcdata.rng import seeded
from pcdata.structures import PointCloud
from pcdata.transforms import (
    ClusterObjects,
    DecimateDepth,
    Deproject,
    LeftOutWarning,
    MergeViews,
    NormalizeUnitSphere,
    RandomSample,
    RemovePlane,
    ToFrame,
    describe_objects,
)
from tests.rooms import room_frame, seen_room, standing

TABLE = ((-0.5, -0.4, -0.002), (0.5, 0.4, 0.0))
SMALL, MIDDLE, LARGE = (0.05, 0.05, 0.05), (0.1, 0.08, 0.12), (0.25, 0.1, 0.2)
THINGS = [standing(-0.35, 0.0, SMALL), standing(0.0, 0.0, MIDDLE), standing(0.33, 0.1, LARGE)]
# The camera sees top and front of all, and the inner sides of the first and the last.
FACES = [(length * width, length * height, width * height) for length, width, height in (SMALL, MIDDLE, LARGE)]
SEEN = [sum(FACES[0]), sum(FACES[1][:2]), sum(FACES[2])]
LIMITS = {"min_area": 0.01, "max_area": 0.05}


def room(scale: float = 1.0, *, noise: float = 0.0, distance: float = 1.0, things=THINGS) -> PointCloud:
    """The things without the table, seen at a multiple of the usual resolution."""
    cloud = seen_room([TABLE, *things], noise=noise, distance=distance, scale=scale)
    thing = cloud.labels > 0
    return cloud.select(thing, torch.tensor([0, int(thing.sum())])).with_fields(labels=cloud.labels[thing] - 1)


@pytest.mark.parametrize("noise", [0.0, 0.0026])
@pytest.mark.parametrize(("scale", "distance"), [(0.5, 1.0), (1.0, 1.0), (2.0, 1.0), (2.0, 1.8)])
def test_areas_on_an_image_are_those_of_the_faces_that_are_seen(scale, distance, noise):
    cloud = room(scale, noise=noise / distance**2, distance=distance)
    areas = seen_areas(cloud.points, cloud.labels, 3, cloud.image_grid())
    if distance == 1:  # from afar sides are seen at a slant that counts as none
        assert areas.tolist() == pytest.approx(SEEN, rel=0.15 if scale == 0.5 else 0.1)
    assert float(areas[1]) == pytest.approx(SEEN[1], rel=0.08)


@pytest.mark.parametrize("noise", [0.0, 0.0026])
@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0])
def test_areas_by_spacing_are_too(scale, noise):
    cloud = room(scale, noise=noise)
    areas = seen_areas(cloud.points, cloud.labels, 3, None)
    assert areas[1:].tolist() == pytest.approx(SEEN[1:], rel=0.2 if scale == 0.5 else 0.1)
    assert float(areas[0]) == pytest.approx(SEEN[0], rel=0.3)  # 40 to 600 points on three faces
    # Equal points are one, and the order is of no matter.
    order = torch.randperm(2 * cloud.num_points, generator=seeded(0))
    twice = cloud.points.repeat(2, 1)[order], cloud.labels.repeat(2)[order]
    torch.testing.assert_close(seen_areas(*twice, 3, None), areas, rtol=0.02, atol=0)


def test_areas_of_other_shapes_and_of_none():
    ball = 0.05 * torch.nn.functional.normalize(torch.randn(3000, 3, generator=seeded(0)), dim=1)
    sheet = torch.rand(500, 3, generator=seeded(1)) * torch.tensor([0.3, 0.2, 0.0])
    points = torch.cat([ball, sheet, torch.zeros(1, 3), torch.ones(4, 3)])
    group = torch.cat([torch.full((n,), k) for k, n in enumerate((3000, 500, 1, 4))])
    areas = seen_areas(points, group, 5, None).tolist()
    assert areas[:2] == pytest.approx([4 * math.pi * 0.05**2, 0.06], rel=0.1)
    assert areas[2:] == [0.0, 0.0, 0.0]  # a point, a point four times, nothing


@pytest.mark.parametrize("by", ["density", "image"])
def test_the_same_objects_are_kept_at_every_resolution(by):
    """A scene at half the resolution has a quarter of the points, and the same objects within limits by area."""
    for noise in (0.0, 0.0026):
        kept, sizes = [], []
        for scale in (0.5, 1.0, 2.0):
            cloud = room(scale, noise=noise)
            with pytest.warns(LeftOutWarning, match=r"a cluster of 0\.[01]\d* m\^2, more than max_area=0\.05"):
                found = ClusterObjects(eps=0.06, min_points=3, by=by, keep="all", **LIMITS)(cloud)
            kept.append([set(found.labels[cloud.labels == thing].tolist()) for thing in range(3)])
            sizes += [one["points"] for one in found.meta[0]["objects"]]
            assert [one["area"] for one in found.meta[0]["objects"]] == pytest.approx([SEEN[1]], rel=0.15)
            assert found.meta[0]["no_objects"]["too_small"] == int((cloud.labels == 0).sum())
            assert found.meta[0]["no_objects"]["too_large"] == int((cloud.labels == 2).sum())
        assert kept == [[{-1}, {0}, {-1}]] * 3
        assert max(sizes) > 10 * min(sizes)


def test_thinned_and_merged_clouds_keep_the_same_objects():
    whole = room(2.0)
    thinned = RandomSample(num_points=whole.num_points // 3)(whole, generator=seeded(0))
    assert thinned.image_grid() is None
    views = torch.cat([whole.points, whole.points + 2e-4])  # seen twice, the images not known
    for cloud in (thinned, PointCloud(points=views, labels=whole.labels.repeat(2), frame_id="camera")):
        with pytest.warns(LeftOutWarning, match="more than max_area"):
            found = ClusterObjects(eps=0.05, min_points=3, keep="all", **LIMITS)(cloud)
        assert [set(found.labels[cloud.labels == thing].tolist()) for thing in range(3)] == [{-1}, {0}, {-1}]


def test_a_batch_of_clouds_is_judged_cloud_by_cloud():
    clouds = [room(1.0), room(1.0, things=THINGS[1:2]), room(1.0, things=THINGS[:2])]
    step = ClusterObjects(eps=0.05, min_points=3, by="image", keep="all", min_area=0.01)
    alone = [step(cloud) for cloud in clouds]
    batch = step(PointCloud.cat(clouds))
    assert torch.equal(batch.labels, torch.cat([found.labels for found in alone]))
    assert [entry["objects"] for entry in batch.meta] == [found.meta[0]["objects"] for found in alone]
    replayed = step.replay(PointCloud.cat(clouds), batch.history)
    assert torch.equal(replayed.labels, batch.labels)
    assert [entry["objects"] for entry in replayed.meta] == [entry["objects"] for entry in batch.meta]


def test_a_heap_over_the_limit_is_parted_before_it_is_judged():
    heap = [standing(-0.06, 0.0, (0.12, 0.12, 0.06)), standing(0.06, 0.04, (0.12, 0.12, 0.14))]
    cloud = room(1.5, things=heap)
    fields = {"eps": 0.03, "min_points": 8, "min_area": 0.002, "max_area": 0.04, "keep": "all"}
    with pytest.warns(LeftOutWarning, match="split_touching: true if it is several that touch"):
        whole = ClusterObjects(**fields)(cloud)
    assert whole.meta[0]["objects"] == []
    assert whole.meta[0]["no_objects"]["too_large"] == cloud.num_points
    parted = ClusterObjects(**fields, split_touching=True)(cloud)
    assert len(parted.meta[0]["objects"]) == 2
    for thing in range(2):
        found = parted.labels[cloud.labels == thing]
        assert float((found == found.mode().values).float().mean()) > 0.95


def test_limits_of_one_kind_take_those_of_the_other_away():
    cloud = room(0.5)
    counts = [int((cloud.labels == thing).sum()) for thing in range(3)]
    assert min(counts) < 100
    step = {"eps": 0.06, "min_points": 3}
    assert len(ClusterObjects(**step)(cloud).meta[0]["objects"]) == sum(count >= 100 for count in counts)
    assert len(ClusterObjects(**step, min_area=1e-4)(cloud).meta[0]["objects"]) == 3
    assert len(ClusterObjects(**step, min_area=1e-4, min_size=100)(cloud).meta[0]["objects"]) < 3
    with pytest.raises(ConfigError, match=r"min_area 0\.2 exceeds max_area 0\.1"):
        ClusterObjects(min_area=0.2, max_area=0.1)
    with pytest.raises(UnitError, match="put it before normalizing"):
        ClusterObjects(min_area=0.1)(NormalizeUnitSphere()(cloud))


# -- by image ---------------------------------------------------------------------------------------------------------


def test_connected_parts_of_the_image_are_the_objects_of_a_scene_in_any_frame():
    cloud = room(1.0)
    by_density, by_image = (
        ClusterObjects(eps=0.05, min_points=1, min_size=20, by=by, keep="all")(cloud) for by in ("density", "image")
    )
    assert torch.equal(by_image.labels, by_density.labels)
    assert set(by_image.labels.tolist()) == {0, 1, 2}
    turned = ToFrame(frame="table", matrix=((0, 0, 1, 0.3), (-1, 0, 0, 0), (0, -1, 0, 1), (0, 0, 0, 1)), start="camera")
    moved = ClusterObjects(eps=0.05, min_size=20, by="image", keep="all", min_area=1e-4)(turned(cloud))
    assert torch.equal(moved.labels, by_density.labels)


def test_what_something_in_front_parts_is_two_by_image_alone():
    post = standing(0.0, -0.15, (0.03, 0.03, 0.3))
    board = standing(0.0, 0.0, (0.4, 0.02, 0.15))
    cloud = room(1.0, things=[post, board])
    fields = {"eps": 0.06, "min_points": 1, "min_size": 20, "keep": "all"}
    assert len(ClusterObjects(**fields)(cloud).meta[0]["objects"]) == 2
    by_image = ClusterObjects(**fields, by="image")(cloud)
    assert len(by_image.meta[0]["objects"]) == 3
    joined = ClusterObjects(**fields, by="image", split_touching=True)(cloud)
    assert len(joined.meta[0]["objects"]) == 2
    assert any(join["why"] == "occluded" for join in joined.meta[0]["touching"]["joins"])


def test_by_image_is_refused_where_the_image_is_gone():
    cloud = room(1.0)
    for gone in (RandomSample(num_points=500)(cloud, generator=seeded(0)), MergeViews()(cloud)):
        if gone.image_grid() is None:
            with pytest.raises(ConfigError, match=r"by='image' links neighboring pixels, .* or say by: density"):
                ClusterObjects(by="image")(gone)


def test_a_decimated_capture_keeps_the_objects_of_the_whole_one():
    frame = room_frame([TABLE, *THINGS], scale=2.0)
    table = RemovePlane(which="supporting", cut="measured")
    step = ClusterObjects(eps=0.05, by="image", min_area=0.002, max_area=0.2)
    whole, half = (step(table(Deproject()(one))) for one in (frame, DecimateDepth(factor=2)(frame)))
    assert half.num_points < 0.3 * whole.num_points
    assert [one["area"] for one in half.meta[0]["objects"]] == pytest.approx(
        [one["area"] for one in whole.meta[0]["objects"]], rel=0.12
    )
    assert len(whole.meta[0]["objects"]) == 3
    facts = describe_objects(whole)
    assert [one.area for one in facts] == pytest.approx([one["area"] for one in whole.meta[0]["objects"]], rel=0.02)
