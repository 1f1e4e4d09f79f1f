"""A triangle mesh whose vertices are a point cloud."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from pcdata.contracts.tensors import check_tensors
from pcdata.errors import ShapeError
from pcdata.structures.point_cloud import PointCloud
from pcdata.structures.structure import Structure


@dataclass(frozen=True, eq=False, kw_only=True)
class SurfaceMesh(Structure):
    """Triangles between the points of one cloud; seen from outside, their corners run counter-clockwise.

    Args:
        vertices: a single cloud.
        triangles: (T, 3) int64 rows of the vertices.
    """

    vertices: PointCloud
    triangles: Tensor

    def __post_init__(self) -> None:
        check_tensors("SurfaceMesh", {"triangles": self.triangles}, {"triangles": "T 3 : int64"})
        if self.vertices.num_clouds != 1:
            raise ShapeError(f"SurfaceMesh: the vertices must be a single cloud, got {self.vertices.num_clouds}")
        if len(self.triangles):
            lowest, highest = self.triangles.aminmax()
            if int(lowest) < 0 or int(highest) >= self.vertices.num_points:
                raise ShapeError(
                    f"SurfaceMesh: triangles must hold rows of the {self.vertices.num_points} vertices, got rows "
                    f"{int(lowest)} to {int(highest)}"
                )

    def __repr__(self) -> str:
        return f"SurfaceMesh({len(self.triangles)} triangles of {self.vertices!r})"
