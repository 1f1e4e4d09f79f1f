from __future__ import annotations

import math

import pytest
import torch

from pcdata.errors import DTypeError, NoPlaneError, ShapeError, TooFewPointsError
from pcdata.functional import smallest_rectangle
from pcdata.geometry.rigid import rotation_about_axis
from pcdata.rng import seeded
from pcdata.structures import PointCloud
from pcdata.synthetic import tabletop
from pcdata.transforms import (
    ClusterObjects,
    Compose,
    Deproject,
    MergeViews,
    RandomRotation,
    RemovePlane,
    ToFrame,
    VoxelDownsample,
    describe_objects,
    label_image,
)
from tests.tables import TABLE, box, rectangle

UP = torch.tensor([0.0, 0.0, 1.0])


def turned_block(degrees: float) -> torch.Tensor:
    """A block of 20 x 8 x 10 cm that stands at (0.1, -0.2), turned about z."""
    turn = rotation_about_axis(UP.double(), torch.tensor(math.radians(degrees), dtype=torch.float64))
    block = box((0.0, 0.0, 0.0), (0.2, 0.08, 0.1), count=6000)
    return (block.double() @ turn.T + torch.tensor([0.1, -0.2, 0.0], dtype=torch.float64)).float()


@pytest.mark.parametrize("degrees", [0, 25, -70])
def test_the_box_of_a_block_is_the_block(degrees):
    block, table = turned_block(degrees), rectangle(**TABLE)
    other = box((-0.3, 0.3, 0.0), (0.05, 0.05, 0.3))
    cloud = PointCloud(
        points=torch.cat([table, block, other]),
        labels=torch.cat([torch.full((len(part),), label) for label, part in ((-1, table), (4, block), (7, other))]),
        frame_id="base",
        viewpoint=torch.tensor([[0.0, 0.0, 2.0]]),
    )
    cloud = RemovePlane(which="supporting", cut="measured")(cloud)
    moved = RandomRotation(axis=None)(cloud, generator=seeded(0))
    back = moved.source_from_cloud[0]
    for found, pose in ((describe_objects(cloud), torch.eye(4, dtype=torch.float64)), (describe_objects(moved), back)):
        first, second = found
        assert (first.label, second.label) == (4, 7)
        assert first.num_points == int((cloud.labels == 4).sum())
        assert first.height == pytest.approx(0.1, abs=0.003)
        assert first.size.tolist() == pytest.approx([0.2, 0.08, 0.1], abs=0.004)
        placed = pose @ first.box
        torch.testing.assert_close(placed[:3, 3], torch.tensor([0.1, -0.2, 0.05]).double(), atol=0.003, rtol=0)
        assert abs(float(placed[2, 2])) > 0.999
        along = math.degrees(math.atan2(float(placed[1, 0]), float(placed[0, 0])))
        assert min(abs(along - degrees) % 180, 180 - abs(along - degrees) % 180) < 2
        assert torch.linalg.det(first.box[:3, :3]) == pytest.approx(1.0)
        outline = (pose[:3, :3] @ first.outline.T).T + pose[:3, 3]
        assert float(outline[:, 2].abs().max()) < 0.003
        edge = outline.roll(-1, 0) - outline
        area = 0.5 * float((outline[:, 0] * edge[:, 1] - outline[:, 1] * edge[:, 0]).sum())
        assert area == pytest.approx(0.2 * 0.08, rel=0.08)
        assert first.volume == pytest.approx(0.2 * 0.08 * 0.1, rel=0.08)
        assert first.tight_size.tolist() == pytest.approx([0.2, 0.1, 0.08], abs=0.004)
        tight = pose @ first.tight_box
        assert abs(float(tight[2, 1])) > 0.999  # of 20, 10 and 8 cm the middle one stands up
        torch.testing.assert_close(tight[:3, 3], torch.tensor([0.1, -0.2, 0.05]).double(), atol=0.003, rtol=0)
        corners = (pose[:3, :3] @ first.hull.T).T + pose[:3, 3]
        assert corners[:, 2].tolist() == pytest.approx(corners[:, 2].clamp(-0.003, 0.103).tolist())


def test_a_block_that_leans_has_a_tight_box_of_its_own_size():
    leaning = box((0.0, 0.0, 0.0), (0.2, 0.08, 0.1), count=6000).double()
    turn = rotation_about_axis(torch.tensor([1.0, 1.0, 0.0]).double() / 2**0.5, torch.tensor(0.6).double())
    points = (leaning @ turn.T).float()
    cloud = PointCloud(points=points, labels=torch.zeros(len(points)).long(), frame_id="base")
    (found,) = describe_objects(cloud, up=UP)
    assert found.tight_size.tolist() == pytest.approx([0.2, 0.1, 0.08], abs=0.004)
    assert float(found.size.prod()) > 1.5 * float(found.tight_size.prod())
    assert found.volume == pytest.approx(0.2 * 0.08 * 0.1, rel=0.08)


def test_labels_may_be_any_numbers_and_objects_single_points():
    block = turned_block(10)
    labels = torch.full((len(block),), 2**40)
    labels[:3] = torch.tensor([-1, 5, -7])
    cloud = PointCloud(points=block, labels=labels, frame_id="base")
    single, whole = describe_objects(cloud, up=UP)
    assert (single.label, whole.label) == (5, 2**40)
    assert (single.num_points, single.volume, single.area) == (1, 0.0, 0.0)
    assert single.tight_size.tolist() == [0.0, 0.0, 0.0]
    assert whole.area == pytest.approx(0.2 * 0.08 + 2 * 0.1 * (0.2 + 0.08), rel=0.15)  # no bottom
    assert describe_objects(cloud.with_fields(labels=torch.full((len(block),), -1)), up=UP) == []


@pytest.mark.parametrize("seed", range(4))
def test_no_turned_rectangle_is_smaller(seed):
    points = torch.randn(40, 2, generator=seeded(seed)) * torch.tensor([1.0, 0.4])
    center, direction, size = smallest_rectangle(points)
    across = torch.stack([-direction[1], direction[0]])
    inside = (points.double() - center) @ torch.stack([direction, across], 1)
    assert bool((inside.abs() <= size / 2 + 1e-9).all())
    angles = torch.arange(0, math.pi / 2, 1e-3, dtype=torch.float64)
    axes = torch.stack([torch.stack([angles.cos(), angles.sin()]), torch.stack([-angles.sin(), angles.cos()])])
    spans = [(points.double() @ axis) for axis in axes]
    areas = (spans[0].amax(0) - spans[0].amin(0)) * (spans[1].amax(0) - spans[1].amin(0))
    assert float(size.prod()) <= float(areas.min()) + 1e-9
    assert size[0] >= size[1]


def test_points_on_a_line_and_one_point_have_flat_rectangles():
    line = torch.tensor([[0.0, 0.0], [1.0, 1.0], [3.0, 3.0]])
    center, direction, size = smallest_rectangle(line)
    assert center.tolist() == pytest.approx([1.5, 1.5])
    assert direction.tolist() == pytest.approx([0.5**0.5] * 2)
    assert size.tolist() == pytest.approx([18**0.5, 0.0], abs=1e-12)
    assert smallest_rectangle(line[:1])[2].tolist() == [0.0, 0.0]
    with pytest.raises(TooFewPointsError):
        smallest_rectangle(line[:0])


def test_up_is_asked_for_where_no_table_was_found():
    block = turned_block(10)
    cloud = PointCloud(points=block, labels=torch.zeros(len(block)).long(), frame_id="base")
    with pytest.raises(NoPlaneError, match="give up="):
        describe_objects(cloud)
    (found,) = describe_objects(cloud, up=UP)
    assert found.size.tolist() == pytest.approx([0.2, 0.08, 0.1], abs=0.004)
    with pytest.raises(DTypeError, match="no labels"):
        describe_objects(cloud.with_fields(labels=None), up=UP)


def test_labels_go_back_to_the_pixels_they_came_from():
    frame = tabletop(2, num_objects=2, num_views=2, size=(60, 80), floor=False).frame
    clouds = Compose([Deproject(), RemovePlane(distance=0.005), ClusterObjects(min_points=5, min_size=10)])(frame)
    for b in range(2):
        image = label_image(clouds, b)
        assert image.shape == (60, 80)
        assert int((image >= 0).sum()) == int(clouds.counts[b])
        assert bool((frame.labels[b][image >= 0] > 0).float().mean() > 0.9)
    thinned = VoxelDownsample(voxel_size=0.01)(clouds)
    with pytest.raises(ShapeError, match=r"give size=\(height, width\)"):
        label_image(thinned)
    merged = Compose([ToFrame(frame="base"), MergeViews()])(Deproject()(frame))
    second = label_image(merged, size=(60, 80), view=1)
    assert torch.equal(second[frame.depth[1] > 0], frame.labels[1][frame.depth[1] > 0])
    with pytest.raises(ShapeError, match="or the view of a merged cloud"):
        label_image(merged, size=(60, 80))
