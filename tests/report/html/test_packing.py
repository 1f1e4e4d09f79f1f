"""A page's cloud is the cloud, within the bound that it states."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pcdata import PointCloud
from pcdata.report.html.packing import pack_cloud
from tests.factories import cloud_in_base
from tests.report.html.decoding import decoded


def fields_of(packed) -> dict[str, str]:
    return {field["name"]: field["kind"] for field in packed.said["fields"]}


@pytest.mark.parametrize("seed", range(3))
def test_points_and_fields_come_back_within_their_bounds(seed):
    generator = torch.Generator().manual_seed(seed)
    count = 1000
    cloud = PointCloud(
        points=torch.randn(count, 3, generator=generator) * torch.tensor([3.0, 0.2, 0.0]) + 100,
        colors=torch.rand(count, 3, generator=generator),
        normals=torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1),
        labels=torch.randint(-1, 7, (count,), generator=generator) * 1000,
        extra={
            "confidence": torch.rand(count, generator=generator),
            "many": torch.randperm(count, generator=generator) * 99,
        },
        kinds={"confidence": "invariant", "many": "invariant"},
        frame_id="base",
    )
    packed = pack_cloud(cloud, most_points=count)
    found = decoded(packed)
    away = np.abs(found["points"] - cloud.points.double().numpy())
    assert away.max() <= packed.said["bound"] * (1 + 1e-6)
    assert packed.said["bound"] <= 0.5 * 30 / 65535  # six standard deviations of 3 m on either side are less
    assert np.abs(found["colors"] / 255 - cloud.colors.numpy()).max() <= 0.5 / 255 + 1e-6
    assert np.abs((found["normals"] - 127.5) / 127.5 - cloud.normals.numpy()).max() <= 0.5 / 127.5 + 1e-6
    assert np.array_equal(found["labels"][:, 0], cloud.labels.numpy())
    assert np.array_equal(found["many"][:, 0], cloud.extra["many"].numpy())
    assert np.abs(found["confidence"][:, 0] - cloud.extra["confidence"].numpy()).max() <= 0.5 / 65535 + 1e-6


def test_the_pixel_of_a_point_is_kept_and_every_kth_point_of_many():
    cloud = cloud_in_base((2000, 3000))
    packed = pack_cloud(cloud, most_points=1000)
    assert packed.said["total"] == cloud.num_points
    assert 0 < packed.said["count"] <= 1000
    stride = -(-cloud.num_points // 1000)
    away = decoded(packed)["points"] - cloud.points[::stride].double().numpy()
    assert np.abs(away).max() <= packed.said["bound"] * (1 + 1e-6)


def test_a_batch_says_which_cloud_a_point_is_of():
    one = PointCloud(points=torch.rand(5, 3), frame_id="base")
    packed = pack_cloud(PointCloud.cat([one, one, one]), most_points=100)
    assert fields_of(packed) == {"camera": "category"}
    assert decoded(packed)["camera"][:, 0].tolist() == [0] * 5 + [1] * 5 + [2] * 5


@pytest.mark.parametrize("count", [0, 1])
def test_clouds_of_no_extent(count):
    packed = pack_cloud(PointCloud(points=torch.full((count, 3), 7.0), frame_id="base"), most_points=10)
    assert decoded(packed)["points"].tolist() == [[7.0, 7.0, 7.0]] * count
    assert packed.said["bound"] == 0


def test_numbers_that_are_none_come_back_as_none():
    confidence = torch.tensor([0.5, float("nan"), float("inf"), 1.0])
    cloud = PointCloud(points=torch.rand(4, 3), extra={"c": confidence}, kinds={"c": "invariant"}, frame_id="base")
    found = decoded(pack_cloud(cloud, most_points=10))["c"][:, 0]
    assert np.isnan(found[[1, 2]]).all()
    assert found[[0, 3]].tolist() == pytest.approx([0.5, 1.0], abs=1e-4)
