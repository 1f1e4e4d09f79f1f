"""DescribeShape: how flat, thin or curved the surface around each point is."""

from __future__ import annotations

from typing import Literal

from pcdata.errors import ConfigError
from pcdata.functional.neighborhoods import neighborhood_covariance, shape_features
from pcdata.structures import PointCloud
from pcdata.structures.kinds import Kind
from pcdata.transforms.base import Params, Transform
from pcdata.transforms.field_types import Count, Metres

ShapeFeature = Literal[
    "linearity",
    "planarity",
    "sphericity",
    "anisotropy",
    "surface_variation",
    "omnivariance",
    "eigenentropy",
    "eigenvalue_sum",
]


class DescribeShape(Transform):
    """Add features of each point's neighborhood as fields of their own, (N,) float32; see F.shape_features.

    Args:
        features: names of the fields; surface_variation is what PCL calls curvature.
        radius: of the neighborhood; None = the nearest points, however far.
        max_neighbors: the nearest within the radius, the point itself among them.
    """

    runs_statistics = True

    features: tuple[ShapeFeature, ...] = ("surface_variation",)
    radius: Metres | None = 0.02
    max_neighbors: Count = 30

    def check_fields(self) -> None:
        """Require a feature, and each once."""
        if not self.features or len(set(self.features)) < len(self.features):
            raise ConfigError(f"DescribeShape: features must name some, each once, got {self.features}")

    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Measure the points of each cloud alone, and write the features."""
        _, covariance, _ = neighborhood_covariance(
            data.points.detach(),
            data.ptr,
            radius=self.radius,
            max_neighbors=self.max_neighbors,
            grid=data.image_grid(),
        )
        found = shape_features(covariance, *self.features)
        for name in self.features:
            data = data.with_extra(name, found[name].float(), Kind.INVARIANT)
        return data
