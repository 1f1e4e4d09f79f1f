from __future__ import annotations

import dataclasses

import pytest
import torch

from pcdata.errors import FrameError
from pcdata.geometry import rigid
from pcdata.structures import PointCloud
from pcdata.transforms import EstimateNormals


def sphere(count: int = 600, radius: float = 0.1) -> PointCloud:
    """A ball around the origin with the camera at its center: normals must point inwards."""
    outward = torch.nn.functional.normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    return PointCloud(points=outward * radius, frame_id="base", viewpoint=torch.zeros(1, 3))


def test_normals_of_a_sphere_point_to_the_camera_at_its_center():
    cloud = EstimateNormals(radius=0.03)(sphere())
    angle = rigid.angle_between(cloud.normals, -cloud.points)
    assert float(angle.median()) < 0.05
    assert float(angle.max()) < 0.5


def test_normals_of_a_sphere_point_outwards_to_cameras_around_it():
    cloud = sphere()
    seen_from = cloud.with_extra("viewpoint", cloud.points * 5, "position")
    normals = EstimateNormals(radius=0.03)(dataclasses.replace(seen_from, viewpoint=None)).normals
    assert bool(((normals * cloud.points).sum(1) > 0).all())


def test_normals_are_replaced_and_unit_length():
    cloud = sphere().with_fields(normals=torch.ones(600, 3))
    result = EstimateNormals(radius=0.03)(cloud)
    torch.testing.assert_close(result.normals.norm(dim=1), torch.ones(600))


def test_a_cloud_without_viewpoint_needs_to_say_that_the_sign_is_open():
    cloud = dataclasses.replace(sphere(), viewpoint=None)
    with pytest.raises(FrameError, match=r"no viewpoint to face.*orient: none"):
        EstimateNormals()(cloud)
    normals = EstimateNormals(radius=0.03, orient="none")(cloud).normals
    assert bool((normals[:, 2] >= 0).all())
