"""ClusterObjects(split_touching=True): objects that touch come apart, whole ones stay whole."""

from __future__ import annotations

import math

import pytest
import torch

from pcdata.errors import ConfigError
from pcdata.structures import Camera, DepthFrame, PointCloud
from pcdata.transforms import ClusterObjects, Compose, Deproject, RemovePlane, VoxelDownsample
from pcdata.validation import score_segmentation

SIZE, FOCAL = (150, 200), 210.0
TABLE = math.radians(40)  # the camera looks down on the table by as much, from 0.8 m


def scene(*boxes, noise: float = 0.0) -> tuple[PointCloud, torch.Tensor]:
    """Show boxes (x, y, width, depth, height), in metres on the table, in a camera; return the cloud and its truth."""
    rows, columns = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in SIZE), indexing="ij")
    ray = torch.stack([(columns - 99.5) / FOCAL, (rows - 74.5) / FOCAL, torch.ones_like(rows)], -1).reshape(-1, 3)
    # Table axes in the camera: x right, y away, z up; the table's origin is 0.8 m before the camera.
    axes = torch.tensor([[1, 0, 0], [0, -math.sin(TABLE), math.cos(TABLE)], [0, -math.cos(TABLE), -math.sin(TABLE)]])
    way, start = ray @ axes.double().T, -axes.double() @ torch.tensor([0.0, 0.0, 0.8]).double()
    depth, label = -start[2] / way[:, 2], torch.full((len(ray),), -1)
    for number, (x, y, width, length, height) in enumerate(boxes):
        lower = torch.tensor([x - width / 2, y - length / 2, 0.0]).double()
        upper = torch.tensor([x + width / 2, y + length / 2, height]).double()
        slabs = torch.stack([(lower - start) / way, (upper - start) / way])
        near, far = slabs.amin(0).amax(1), slabs.amax(0).amin(1)
        hit = (near < far) & (near < depth) & (near > 0)
        depth, label = torch.where(hit, near, depth), torch.where(hit, number, label)
    generator = torch.Generator().manual_seed(0)
    depth = 1 / (1 / depth + noise * torch.randn(len(depth), generator=generator, dtype=torch.float64))
    camera = Camera.pinhole(fx=FOCAL, fy=FOCAL, cx=99.5, cy=74.5, size=SIZE)
    frame = DepthFrame.from_numpy(depth.reshape(SIZE).float().numpy(), camera, labels=label.reshape(SIZE).numpy())
    cloud = Compose([Deproject(), RemovePlane(distance=0.006)])(frame)
    return cloud, cloud.labels


STEP_FIELDS = {"split_touching": True, "eps": 0.03, "min_points": 10, "min_size": 60}
STEP = ClusterObjects(**STEP_FIELDS)


def parted(cloud: PointCloud, truth: torch.Tensor) -> tuple[PointCloud, float]:
    """Return the labeled cloud, and the overlap F of its labels."""
    found = ClusterObjects(**{**STEP_FIELDS, "keep": "all"})(cloud)
    return found, score_segmentation(found.labels, truth).overlap_f


LOW_AND_HIGH = ((-0.06, 0, 0.12, 0.12, 0.06), (0.06, 0.04, 0.12, 0.12, 0.14))
ONE_BEFORE_ANOTHER = ((0, 0.06, 0.2, 0.1, 0.12), (0.02, -0.04, 0.1, 0.1, 0.05))
ON_TOP = ((0, 0, 0.22, 0.2, 0.08), (0.02, 0.02, 0.1, 0.1, 0.16))


@pytest.mark.parametrize("noise", [0.0, 0.0015])
@pytest.mark.parametrize("boxes", [LOW_AND_HIGH, ONE_BEFORE_ANOTHER, ON_TOP])
def test_boxes_that_touch_come_apart_and_stay_whole(boxes, noise):
    cloud, truth = scene(*boxes, noise=noise)
    assert int(ClusterObjects(**{**STEP_FIELDS, "split_touching": False})(cloud).labels.max()) == 0
    found, f = parted(cloud, truth)
    assert f > 0.95
    (cut,) = found.meta[0]["touching"]["cuts"]
    assert cut["objects"] == [0, 1]
    assert 0.35 < cut["strength"] <= 1
    assert cut["pixels"] > 10


def test_lines_of_missing_pixels_part_nothing():
    whole, truth = scene(*LOW_AND_HIGH, noise=0.0015)
    pixel = whole.source_index
    there = (pixel // SIZE[1] % 4 > 0) & (pixel % SIZE[1] % 5 > 0)  # as depth registered to a larger image has them
    cloud = whole.select(there, torch.tensor([0, int(there.sum())]))
    found, f = parted(cloud, truth[there])
    assert f > 0.95
    assert len(found.meta[0]["touching"]["cuts"]) == 1


def test_what_shows_no_evidence_stays_one():
    # Two boxes with flush faces look like one long box.
    cloud, _ = scene((-0.06, 0, 0.12, 0.1, 0.1), (0.06, 0, 0.12, 0.1, 0.1), noise=0.001)
    found, _ = parted(cloud, torch.zeros_like(cloud.labels))
    assert found.labels.max() == 0
    assert found.meta[0]["touching"]["cuts"] == []


def test_parts_that_an_object_in_front_keeps_apart_are_one():
    cloud, truth = scene((0, 0.06, 0.4, 0.1, 0.06), (0, -0.05, 0.08, 0.06, 0.24), noise=0.0005)
    found, f = parted(cloud, truth)
    assert f > 0.95
    behind = int(found.labels[truth == 0].mode().values)
    assert {"object": behind, "why": "occluded"} in found.meta[0]["touching"]["joins"]


def test_two_boxes_with_the_table_between_them_stay_two():
    cloud, truth = scene((-0.15, 0, 0.12, 0.1, 0.08), (0.15, 0, 0.12, 0.1, 0.08), noise=0.0005)
    found, f = parted(cloud, truth)
    assert f > 0.95
    assert len(found.meta[0]["objects"]) == 2


def test_labels_follow_the_lowest_row_of_each_object():
    cloud, truth = scene(*LOW_AND_HIGH, (0.3, 0, 0.08, 0.08, 0.1))
    found, _ = parted(cloud, truth)
    labels = found.labels[found.labels >= 0]
    first = [int((labels == one).nonzero()[0]) for one in labels.unique()]
    assert first == sorted(first)
    assert [one["label"] for one in found.meta[0]["objects"]] == [0, 1, 2]


def test_a_heap_larger_than_the_limit_is_parted_before_it_is_judged():
    cloud, _ = scene(*LOW_AND_HIGH)
    sizes = [int(n) for n in torch.bincount(cloud.labels[cloud.labels >= 0])]
    found = ClusterObjects(**{**STEP_FIELDS, "max_size": max(sizes) + 100})(cloud)
    assert len(found.meta[0]["objects"]) == 2
    assert found.meta[0]["no_objects"]["too_large"] == 0


def test_clouds_of_a_batch_are_parted_each_by_itself():
    clouds = [scene(*boxes)[0] for boxes in (LOW_AND_HIGH, ON_TOP)]
    alone = [STEP(cloud) for cloud in clouds]
    batch = STEP(PointCloud.cat(clouds))
    assert torch.equal(batch.labels, torch.cat([one.labels for one in alone]))
    assert [meta["touching"] for meta in batch.meta] == [one.meta[0]["touching"] for one in alone]
    own = [history[-1]["params"] for history in batch.history]  # two cuts of two clouds
    assert own == [one.history[0][-1]["params"] for one in alone]


def test_a_cloud_that_left_its_image_is_refused():
    cloud, _ = scene(*LOW_AND_HIGH)
    with pytest.raises(ConfigError, match="needs the depth images that the points lie on"):
        STEP(VoxelDownsample(voxel_size=0.004)(cloud))


def test_one_smooth_thing_without_contacts_and_a_cloud_without_things_have_no_cuts():
    cloud, _ = scene((0, 0, 0.2, 0.2, 0.1))
    top = cloud.select(cloud.points[:, 1] < 0, torch.tensor([0, int((cloud.points[:, 1] < 0).sum())]))
    found = STEP(top)
    assert [one["label"] for one in found.meta[0]["objects"]] == [0]
    assert found.meta[0]["touching"]["cuts"] == []
    nothing = ClusterObjects(**{**STEP_FIELDS, "min_size": 100_000, "max_size": 200_000, "keep": "all"})(cloud)
    assert (nothing.labels == -1).all()
    assert nothing.meta[0]["touching"]["cuts"] == nothing.meta[0]["objects"] == []
