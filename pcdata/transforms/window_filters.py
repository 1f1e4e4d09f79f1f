"""Filters of depth images within windows of pixels: BilateralFilterDepth, MedianFilterDepth."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

from annotated_types import Interval

from pcdata.functional.depth.window_filters import MAX_MEDIAN_REACH, MAX_REACH, bilateral_filter, median_filter
from pcdata.structures import DepthFrame
from pcdata.transforms.base import Params, Transform
from pcdata.transforms.field_types import FromSensor, Metres, Positive


class BilateralFilterDepth(Transform):
    """Average readings with those around them that are near in the image and in depth.

    It never blends across an edge; holes stay holes.

    Args:
        reach: pixels to each side.
        sigma_pixels: how fast readings count less with their distance in the image.
        sigma_depth: how fast they count less with their difference in depth; a few times the noise.
        max_jump: as a part of the depth: what differs more is another surface.
    """

    takes = DepthFrame
    gives = DepthFrame

    reach: Annotated[int, Interval(ge=1, le=MAX_REACH)] = 2
    sigma_pixels: Positive = 1.5
    sigma_depth: Metres = 0.01
    # As a part of the depth: neighbors that differ more lie on two surfaces.
    max_jump: Annotated[Positive, FromSensor(lambda sensor, depth: sensor.edge_threshold(depth) / depth)] = 0.02

    def transform(self, data: DepthFrame, params: Params) -> DepthFrame:
        """Filter all views in one call."""
        depth = bilateral_filter(
            data.depth,
            reach=self.reach,
            sigma_pixels=self.sigma_pixels,
            sigma_depth=self.sigma_depth,
            max_jump=self.max_jump,
        )
        return replace(data, depth=depth)


class MedianFilterDepth(Transform):
    """Replace every reading by the median reading around it, which is one that was measured; holes stay holes.

    Lone readings off their surroundings go. With ``max_jump`` they stay, as do thin things and corners: only readings
    on the pixel's own surface are looked at.

    Args:
        reach: pixels to each side.
        max_jump: as a part of the depth: what differs more is another surface; None = all readings of the window.
    """

    takes = DepthFrame
    gives = DepthFrame

    reach: Annotated[int, Interval(ge=1, le=MAX_MEDIAN_REACH)] = 1
    max_jump: Positive | None = None

    def transform(self, data: DepthFrame, params: Params) -> DepthFrame:
        """Filter all views in one call."""
        return replace(data, depth=median_filter(data.depth, reach=self.reach, max_jump=self.max_jump))
