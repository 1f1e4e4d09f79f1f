"""EstimateNormals: surface normals that face the camera which saw each point."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal

from pcdata.contracts.dispatch import roomy_body
from pcdata.contracts.known import FINITE, note
from pcdata.errors import FrameError
from pcdata.functional.fixed_rows import FixedRows
from pcdata.functional.normals import estimate_normals, normals_facing, orient_normals
from pcdata.functional.rows import cloud_of_rows
from pcdata.structures import PointCloud
from pcdata.transforms.base import Params, Transform
from pcdata.transforms.field_types import Count, Metres


class EstimateNormals(Transform):
    """Fit a plane to the nearest neighbors, within a radius or however far; replaces any normals the cloud had.

    After merging, every point's normal faces the camera that saw that point.

    Args:
        radius: metres; None = the nearest, however far.
        max_neighbors: the nearest within the radius, the point itself among them.
        orient: "none": the sign is arbitrary but repeatable.
    """

    runs_statistics = True

    radius: Metres | None = 0.02
    max_neighbors: Count = 30
    orient: Literal["viewpoint", "none"] = "viewpoint"

    def fixed_work(self, like: FixedRows) -> Callable[[FixedRows], FixedRows] | None:
        """Estimate for clouds whose sizes are known."""
        body = roomy_body("estimate_normals", like.points.device)
        if body is None or like.counts is None:
            return None
        seen_from = like.viewpoint[cloud_of_rows(like.ptr)]

        def work(rows: FixedRows) -> FixedRows:
            normals = body(
                points=rows.points, ptr=rows.ptr, radius=self.radius, max_neighbors=self.max_neighbors, grid=None
            )
            if self.orient == "viewpoint":
                for values in (rows.points, normals, seen_from):
                    note(FINITE, values)
                normals = orient_normals(rows.points, normals, seen_from)
            return replace(rows, normals=normals)

        return work

    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Estimate from the points of each cloud alone, and write the normals."""
        search: dict[str, Any] = {"radius": self.radius, "max_neighbors": self.max_neighbors, "grid": data.image_grid()}
        if self.orient == "none":
            return data.with_fields(normals=estimate_normals(data.points, data.ptr, **search))
        is_one = data.num_clouds == 1 and "viewpoint" not in data.extra
        viewpoint = data.viewpoint if is_one else data.viewpoint_per_point()
        if viewpoint is None:
            raise FrameError(
                "EstimateNormals: the cloud has no viewpoint to face; set PointCloud.viewpoint to where the sensor "
                "stood, or choose orient: none"
            )
        return data.with_fields(normals=normals_facing(data.points, data.ptr, **search, viewpoint=viewpoint))
