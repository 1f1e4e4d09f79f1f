"""SurfaceMesh: what it refuses."""

from __future__ import annotations

import pytest
import torch

from pcdata.errors import ShapeError
from pcdata.structures import PointCloud, SurfaceMesh


def cloud(*ptr: int) -> PointCloud:
    return PointCloud(points=torch.zeros(ptr[-1], 3), frame_id="base", ptr=torch.tensor(ptr))


@pytest.mark.parametrize("rows", [[0, 1, 3], [-1, 0, 1]])
def test_a_triangle_of_points_that_are_not_there_is_refused(rows):
    with pytest.raises(ShapeError, match=rf"rows of the 3 vertices, got rows {min(rows)} to {max(rows)}"):
        SurfaceMesh(vertices=cloud(0, 3), triangles=torch.tensor([rows]))


def test_vertices_of_several_clouds_are_refused():
    with pytest.raises(ShapeError, match="must be a single cloud, got 2"):
        SurfaceMesh(vertices=cloud(0, 2, 3), triangles=torch.empty((0, 3), dtype=torch.int64))


def test_a_mesh_may_be_empty():
    assert "0 triangles" in repr(SurfaceMesh(vertices=cloud(0, 0), triangles=torch.empty((0, 3), dtype=torch.int64)))
