"""Outlier removal: RemoveStatisticalOutliers, RemoveRadiusOutliers."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Annotated, Any

from torch import Tensor

from pcdata.contracts.dispatch import roomy_body
from pcdata.functional.fixed_rows import FixedRows
from pcdata.functional.outliers import rows_in_company, usual_rows
from pcdata.rng import Streams
from pcdata.sensors import SensorProfile
from pcdata.structures import PointCloud
from pcdata.transforms.base import Params
from pcdata.transforms.families import GEOMETRY, RemoveTransform, params_of
from pcdata.transforms.field_types import Count, FromSensor, Metres, Positive


class RemoveStatisticalOutliers(RemoveTransform):
    """Drop points whose mean distance to their nearest neighbors is unusual for their cloud (Open3D's rule).

    Args:
        num_neighbors: nearest neighbors, the point itself among them.
        std_ratio: standard deviations above the cloud's mean that are still usual.
    """

    runs_statistics = True

    num_neighbors: Count = 20
    std_ratio: Positive = 2.0

    def looks_at(self) -> Collection[str]:
        """The points and the image."""
        return GEOMETRY

    def pick(self, cloud: PointCloud, streams: Streams) -> Params:
        """Keep the usual rows."""
        return params_of(usual_rows(cloud.points, cloud.ptr, self.num_neighbors, self.std_ratio, cloud.image_grid()))

    def fixed_keep(self, like: FixedRows) -> Callable[[FixedRows], Tensor] | None:
        """Mark the usual rows."""
        return _kept(
            "statistical_outlier_mask", like, num_neighbors=self.num_neighbors, std_ratio=self.std_ratio, grid=None
        )


class RemoveRadiusOutliers(RemoveTransform):
    """Drop points with no more than ``min_neighbors`` points, themselves included, within a radius (Open3D's rule)."""

    runs_statistics = True

    min_neighbors: Count = 5
    radius: Annotated[Metres, FromSensor(SensorProfile.outlier_radius)] = 0.01

    def looks_at(self) -> Collection[str]:
        """The points and the image."""
        return GEOMETRY

    def pick(self, cloud: PointCloud, streams: Streams) -> Params:
        """Keep the rows with company."""
        return params_of(rows_in_company(cloud.points, cloud.ptr, self.min_neighbors, self.radius, cloud.image_grid()))

    def decides_within(self, share: float) -> bool:
        """Where it does not have to pass over more rows than it looks at."""
        return share >= 0.5

    def params_within(self, data: PointCloud, within: Tensor, ptr: Tensor) -> Params:
        """Keep the rows with company among some."""
        fields = self.min_neighbors, self.radius, data.image_grid()
        return params_of(rows_in_company(data.points, data.ptr, *fields, within))

    def fixed_keep(self, like: FixedRows) -> Callable[[FixedRows], Tensor] | None:
        """Mark the rows with company."""
        return _kept("radius_outlier_mask", like, min_neighbors=self.min_neighbors, radius=self.radius, grid=None)


def _kept(name: str, like: FixedRows, **fields: Any) -> Callable[[FixedRows], Tensor] | None:
    """Return what marks the rows that an operation does not."""
    body = roomy_body(name, like.points.device)
    return None if body is None else lambda rows: ~body(points=rows.points, ptr=rows.ptr, **fields)
