from __future__ import annotations

import pytest
import torch

from pcdata.errors import ConfigError, DTypeError, TooFewPointsError
from pcdata.structures import PointCloud
from pcdata.synthetic import tabletop
from pcdata.transforms import (
    ClusterObjects,
    Compose,
    Deproject,
    LeftOutWarning,
    MergeViews,
    RemovePlane,
    SplitObjects,
    ToFrame,
)
from tests.factories import cloud_in_base


def blobs(*counts: int, frame_id: str = "base") -> PointCloud:
    """Dense blobs 1 m apart along x, one after another, in shuffled rows; labels tell which is which."""
    generator = torch.Generator().manual_seed(len(counts))
    parts = [
        torch.rand(n, 3, generator=generator) * 0.05 + torch.tensor([float(i), 0, 0]) for i, n in enumerate(counts)
    ]
    labels = torch.cat([torch.full((n,), i) for i, n in enumerate(counts)])
    order = torch.randperm(sum(counts), generator=generator)
    return PointCloud(points=torch.cat(parts)[order], labels=labels[order], frame_id=frame_id)


STEP = {"eps": 0.05, "min_points": 5, "min_size": 20, "max_size": 100}


too_large = pytest.mark.filterwarnings("ignore::pcdata.transforms.LeftOutWarning")


@pytest.mark.parametrize("keep", ["objects", "all"])
def test_what_is_no_object_is_counted_and_too_large_is_said(keep):
    batch = PointCloud.cat([blobs(60, 10, 40, 150, 300), blobs(30, 15, 1)])
    with pytest.warns(
        LeftOutWarning, match=r"cloud 0.*a cluster of 300 points, more than max_size=100, .* raise max_size"
    ):
        found = ClusterObjects(**STEP, keep=keep)(batch)
    wanted = [{"noise": 0, "too_small": 10, "too_large": 450}, {"noise": 1, "too_small": 15, "too_large": 0}]
    assert [entry["no_objects"] for entry in found.meta] == wanted
    assert [steps[-1]["params"] for steps in found.history] == wanted
    for entry, single in zip(found.meta, batch.unbatch()):
        objects = sum(one["points"] for one in entry["objects"])
        assert objects + sum(entry["no_objects"].values()) == single.num_points


def test_the_advice_for_a_large_heap_keeps_it():
    heap = ClusterObjects(**{**STEP, "max_size": 400})(blobs(60, 300))
    assert sorted(one["points"] for one in heap.meta[0]["objects"]) == [60, 300]


@too_large
def test_every_blob_of_plausible_size_becomes_one_object():
    cloud = blobs(60, 10, 40, 150)  # the second is too small, the last too large
    found = ClusterObjects(**STEP)(cloud)
    truth = cloud.labels[torch.isin(cloud.labels, torch.tensor([0, 2]))]
    assert found.num_points == 100
    # Objects are numbered by their first point.
    numbers = {int(truth[0]): 0, 2 - int(truth[0]): 1}
    assert found.labels.tolist() == [numbers[label] for label in truth.tolist()]
    sizes = {0: 60, 2: 40}
    by_number = sorted(numbers, key=numbers.__getitem__)
    assert found.meta[0]["objects"] == [{"label": numbers[label], "points": sizes[label]} for label in by_number]


@too_large
def test_the_whole_scene_can_be_kept():
    cloud = blobs(60, 10, 40, 150)
    found = ClusterObjects(**STEP, keep="all")(cloud)
    assert torch.equal(found.points, cloud.points)
    assert torch.equal(found.labels >= 0, torch.isin(cloud.labels, torch.tensor([0, 2])))


@too_large
def test_numbers_start_at_zero_in_every_cloud():
    batch = PointCloud.cat([blobs(10, 30, 40), blobs(30), blobs(150, 50, 60, 70)])
    found = ClusterObjects(**STEP)(batch)
    assert [set(single.labels.tolist()) for single in found.unbatch()] == [{0, 1}, {0}, {0, 1, 2}]
    assert [sum(entry["points"] for entry in meta["objects"]) for meta in found.meta] == found.counts.tolist()


def test_no_object_is_a_typed_error_only_when_objects_are_kept():
    with pytest.raises(
        TooFewPointsError, match="ClusterObjects: cloud 0 has no object: of 10 points 0 are noise, 10 in"
    ):
        ClusterObjects(**STEP)(blobs(10))
    assert ClusterObjects(**STEP, keep="all")(blobs(10)).labels.tolist() == [-1] * 10


def test_the_objects_of_a_rendered_scene_are_counted():
    scene = tabletop(4, num_objects=3, num_views=2, size=(120, 160), floor=False)
    table = RemovePlane(distance=0.004, up=(0, 0, 1), frame="base", max_tilt=0.2, keep="above")
    to_points = Compose([Deproject(), ToFrame(frame="base"), MergeViews(), table])(scene.frame)
    found = ClusterObjects(eps=0.015, min_points=5, min_size=30, keep="all")(to_points)
    assert len(found.meta[0]["objects"]) == 3
    for label in range(3):
        true_labels = to_points.labels[found.labels == label]
        assert len(set(true_labels.tolist())) == 1


def test_split_makes_a_cloud_of_every_object():
    cloud = cloud_in_base((40, 80))
    parts = SplitObjects()(cloud)
    assert parts.counts.tolist() == [10, 10, 20, 20]
    assert [entry["object"] for entry in parts.meta] == [0, 1, 0, 1]
    assert [entry["sample_id"] for entry in parts.meta] == ["sample-0", "sample-0", "sample-1", "sample-1"]
    for part, entry in zip(parts.unbatch(), parts.meta):
        assert set(part.labels.tolist()) == {entry["object"]}
        assert torch.equal(part.points, cloud.points[part.extra["row"]])
        assert part.extra["row"].tolist() == sorted(part.extra["row"].tolist())
    torch.testing.assert_close(
        parts.in_source_frame().points, cloud.in_source_frame().points[parts.extra["row"]], atol=1e-6, rtol=0
    )


def test_split_counts_no_points_before_even_when_the_numbers_agree():
    # Two clouds become two: one of the first, one of the second; the history says the same either way.
    parts = SplitObjects()(PointCloud.cat([blobs(10), blobs(20)]))
    assert [steps[-1] for steps in parts.history] == [
        {
            "step": "SplitObjects",
            "version": 1,
            "fields": {"max_drop": None, "drop_alarm": "error"},
            "frame": "base",
            "unit": "m",
            "params": {"label": 0, "rank": 0},
            "points": count,
        }
        for count in (10, 20)
    ]


def test_a_cloud_with_nothing_to_split_is_an_error_alone_and_in_a_batch():
    unlabeled = blobs(30).with_fields(labels=torch.full((30,), -1))
    for cloud in (unlabeled, PointCloud.cat([blobs(10), unlabeled])):
        with pytest.raises(TooFewPointsError, match=r"cloud \d has no labeled point among its 30"):
            SplitObjects()(cloud)
    with pytest.raises(DTypeError, match="has no labels; put ClusterObjects before it"):
        SplitObjects()(blobs(10).with_fields(labels=None))


def test_sizes_must_be_in_order():
    with pytest.raises(ConfigError, match="min_size 200 exceeds max_size 100"):
        ClusterObjects(min_size=200, max_size=100)
    with pytest.raises(ConfigError, match="min_size 60000 exceeds max_size 50000"):
        ClusterObjects(min_size=60_000)
    ClusterObjects(min_size=60_000, max_area=1.0)
