"""ClusterObjects(split_touching=True) on merged clouds; bowls, mugs and borders."""

from __future__ import annotations

import pytest
import torch

from pcdata.errors import ConfigError
from pcdata.functional.touching.limits import KINECT_NOISE
from pcdata.structures import Camera, DepthFrame, PointCloud
from pcdata.synthetic import Box, Cylinder, Shape, Turned, bowl_profile, look_at, mug_profile, tabletop
from pcdata.synthetic.scene import make_table
from pcdata.synthetic.tabletop import rendered
from pcdata.transforms import (
    ClusterObjects,
    Compose,
    Deproject,
    MergeViews,
    RandomJitter,
    RemovePlane,
    ToFrame,
    VoxelDownsample,
)
from pcdata.validation import score_segmentation

UP = {"up": (0, 0, 1), "frame": "base"}
FIELDS = {"split_touching": True, "eps": 0.03, "min_points": 8, "min_size": 60, "max_size": 1_000_000, "keep": "all"}
SMALL = Camera.pinhole(fx=230, fy=230, cx=119.5, cy=89.5, size=(180, 240))


def standing(shape: Shape, x: float, y: float, rise: float) -> Shape:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([x, y, rise], dtype=torch.float64)
    return type(shape)(**{**vars(shape), "base_from_object": pose})


def box(label: int, x: float, y: float, size: tuple[float, float, float]) -> Shape:
    return standing(Box(base_from_object=torch.eye(4), size=size, label=label), x, y, size[2] / 2)


def can(label: int, x: float, y: float, radius: float, height: float) -> Shape:
    shape = Cylinder(base_from_object=torch.eye(4), radius=radius, height=height, label=label)
    return standing(shape, x, y, height / 2)


def seen(*objects: Shape, eye=(0.0, -0.55, 0.6), target=(0.0, 0.0, 0.03), noise: float = 0.0) -> PointCloud:
    """Return what one camera sees of objects on a table, the table removed; labels are the truth."""
    pose = look_at(eye, target)[None]
    truth, _ = rendered(SMALL, pose, make_table(), None, objects, lit=False)
    jitter = torch.randn(truth.depth.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    there = truth.depth > 0
    depth = torch.where(there, 1 / (1 / truth.depth.clamp(min=0.1) + noise * jitter), 0.0).float()
    frame = DepthFrame(depth=depth, camera=SMALL, labels=truth.labels, world_from_camera=pose, frame_id="base")
    table = RemovePlane(cut="measured", keep="over", max_tilt=0.3, **UP)
    return Compose([Deproject(), ToFrame(frame="base"), table])(frame)


def scored(cloud: PointCloud, **fields: object) -> tuple[PointCloud, float]:
    truth = torch.where(cloud.labels > 0, cloud.labels, -1)
    found = ClusterObjects(**{**FIELDS, **fields})(cloud)
    return found, score_segmentation(found.labels, truth).overlap_f


@pytest.mark.parametrize("noise", [0.0, KINECT_NOISE / 2])
def test_a_bowl_and_a_mug_are_one_object_each_though_they_are_concave(noise):
    bowl = Turned(base_from_object=torch.eye(4), profile=bowl_profile(0.09, 0.05, 0.005), label=1)
    mug = Turned(base_from_object=torch.eye(4), profile=mug_profile(0.05, 0.09, 0.005), label=2)
    cloud = seen(standing(bowl, -0.14, 0, 0.025), standing(mug, 0.12, 0, 0.045), noise=noise)
    found, f = scored(cloud)
    assert f > 0.95
    assert len(found.meta[0]["objects"]) == 2


def test_objects_at_the_border_of_the_image_come_apart_too():
    low, high = box(1, -0.08, 0, (0.12, 0.12, 0.05)), box(2, 0.04, 0.03, (0.12, 0.12, 0.14))
    cloud = seen(low, high, target=(0.33, 0.0, 0.03), noise=KINECT_NOISE / 3)
    pixel = cloud.source_index % SMALL.size[1]
    assert all(int(pixel[cloud.labels == label].min()) < 2 for label in (1,))  # cut off
    found, f = scored(cloud)
    assert f > 0.95
    assert len(found.meta[0]["objects"]) == 2


def test_an_object_that_another_hides_in_part_is_one():
    cloud = seen(box(1, 0, 0.08, (0.36, 0.08, 0.07)), can(2, 0, -0.03, 0.03, 0.16), noise=KINECT_NOISE / 3)
    found, f = scored(cloud)
    assert f > 0.95
    assert len(found.meta[0]["objects"]) == 2


def test_five_times_the_noise_of_a_kinect_does_not_collapse():
    boxes = (
        box(1, -0.09, 0, (0.16, 0.16, 0.07)),
        box(2, 0.08, 0.02, (0.18, 0.18, 0.2)),
        box(3, -0.3, 0, (0.14, 0.14, 0.12)),
    )
    _, f = scored(seen(*boxes, noise=5 * KINECT_NOISE), min_points=4)
    assert f > 0.85


def heap(num_views: int = 4, size: tuple[int, int] = (360, 480)) -> PointCloud:
    frame = tabletop(0, 8, num_views, size=size, touching=True, floor=False).frame
    steps = [
        Deproject(),
        ToFrame(frame="base"),
        MergeViews(),
        RemovePlane(cut="measured", keep="over", max_tilt=0.2, **UP),
    ]
    return Compose(steps)(frame)


@pytest.fixture(scope="module")
def merged() -> PointCloud:
    return heap()


def test_objects_of_a_merged_heap_come_apart(merged):
    truth = torch.where(merged.labels > 0, merged.labels, -1)
    plain = ClusterObjects(**{**FIELDS, "split_touching": False})(merged)
    assert len(plain.meta[0]["objects"]) < 4
    found, _ = scored(merged)
    scores = score_segmentation(found.labels, truth)
    assert scores.mean_iou > 0.9
    assert scores.found == 1.0
    cuts = found.meta[0]["touching"]["cuts"]
    assert len(cuts) >= 7
    assert all(0 < cut["strength"] <= 1 and cut["pixels"] > 0 for cut in cuts)
    first = [int((found.labels == one).nonzero()[0]) for one in range(len(found.meta[0]["objects"]))]
    assert first == sorted(first)


def test_motions_of_a_merged_cloud_and_lost_rows_change_nothing(merged):
    found, f = scored(merged)
    turned = merged.transformed(look_at((0.3, -0.2, 0.4))[None])
    moved = ClusterObjects(**FIELDS)(turned)
    agree = score_segmentation(moved.labels, found.labels)
    assert agree.overlap_f > 0.95  # cells lie elsewhere
    half = merged.points[:, 0] < 0.05
    kept = merged.select(half, torch.tensor([0, int(half.sum())]))
    _, f = scored(kept)
    assert f > 0.9


@pytest.mark.parametrize("step", [VoxelDownsample(voxel_size=0.004), RandomJitter(sigma=0.02, clip=0.06)])
def test_points_that_left_their_pixels_are_refused(merged, step):
    gone = step(merged, generator=torch.Generator().manual_seed(0)) if step.is_random else step(merged)
    with pytest.raises(ConfigError, match="needs the depth images that the points lie on"):
        ClusterObjects(**FIELDS)(gone)


def test_merged_clouds_of_a_batch_are_parted_each_by_itself(merged):
    other = heap(2)
    batch = ClusterObjects(**FIELDS)(PointCloud.cat([merged, other]))
    alone = [ClusterObjects(**FIELDS)(cloud) for cloud in (merged, other)]
    assert torch.equal(batch.labels, torch.cat([one.labels for one in alone]))
    assert [meta["touching"] for meta in batch.meta] == [one.meta[0]["touching"] for one in alone]
