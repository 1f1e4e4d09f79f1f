"""Filters of depth images: SpatialFilterDepth, FillHoles, RemoveFlyingPixels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Interval, Le

from pcdata.contracts.known import FINITE, NOT_NEGATIVE, is_known, note
from pcdata.functional.depth.disparity import disparity_scale, reciprocals, smoothed_images
from pcdata.functional.depth.flying_pixels import without_flying_pixels
from pcdata.functional.depth.holes import fill_rows, filled_images
from pcdata.structures import DepthFrame
from pcdata.structures.filled_depth import with_filled_depth
from pcdata.structures.structure import checked_copy, derived
from pcdata.transforms.base import Params, Transform
from pcdata.transforms.families import MaskTransform
from pcdata.transforms.field_types import Count, FromSensor, Metres, Positive


class SpatialFilterDepth(Transform):
    """Smooth surfaces and keep edges, in disparity, with the parameters of librealsense's spatial filter.

    The focal length is fx of the frame's camera. Pixels filled by ``hole_fill_radius`` are COMPLETED.

    Args:
        alpha: weight of the pixel itself; 1 = no smoothing.
        delta: 1/32 pixel of disparity: the smallest step that is an edge.
        iterations: how often the filter runs along rows and columns.
        hole_fill_radius: pixels filled from both ends of every gap in a row.
        baseline: between the two imagers; it scales what delta means.
    """

    takes = DepthFrame
    gives = DepthFrame

    alpha: Annotated[float, Gt(0), Le(1)] = 0.5
    delta: Positive = 20.0
    iterations: Count = 2
    hole_fill_radius: Annotated[int, Ge(0)] = 0
    baseline: Metres = 0.05

    def transform(self, data: DepthFrame, params: Params) -> DepthFrame:
        """Filter all views in one call."""
        scale = disparity_scale(data.camera.intrinsics[:, 0, 0].to(data.device), self.baseline)
        if not self.hole_fill_radius:
            depth = smoothed_images(data.depth.detach(), scale, self.alpha, self.delta, self.iterations)
            return checked_copy(data, depth=depth)
        disparity = smoothed_images(
            reciprocals(data.depth.detach(), scale), None, self.alpha, self.delta, self.iterations
        )
        depth = reciprocals(fill_rows(disparity, self.hole_fill_radius), scale)
        return with_filled_depth(data, depth)


class FillHoles(Transform):
    """Give pixels without a reading the depth of a reading beside them, by one of librealsense's three rules.

    Filled pixels are marked in the confidence: COMPLETED up to ``max_distance`` pixels from the reading they copy,
    HALLUCINATED beyond.

    Args:
        rule: which neighbor fills a hole.
        max_size: only where no square of this many pixels + 1 without a reading fits; None = all.
        max_distance: pixels to the nearest reading, up to which holes are filled.
    """

    takes = DepthFrame
    gives = DepthFrame

    rule: Literal["left", "farthest", "nearest"] = "farthest"
    max_size: Count | None = None
    max_distance: Count = 8

    def transform(self, data: DepthFrame, params: Params) -> DepthFrame:
        """Fill all views in one call."""
        depth, far = filled_images(data.depth, self.rule, self.max_size, self.max_distance)
        return with_filled_depth(data, depth, far)


class RemoveFlyingPixels(MaskTransform):
    """Set readings to "no reading" that hang between two surfaces at a depth edge.

    Cheap enough for every frame, and best done before any filter that averages or fills: those would spread them.

    Args:
        tolerance: how far a reading may be off the plane through its neighbors, as a part of its depth.
        min_neighbors: of the eight, on the reading's own surface.
    """

    # As a part of the depth: neighbors that differ more lie on two surfaces.
    tolerance: Annotated[Positive, FromSensor(lambda sensor, depth: sensor.edge_threshold(depth) / depth)] = 0.02
    min_neighbors: Annotated[int, Interval(ge=1, le=8)] = 3

    def transform(self, data: DepthFrame, params: Params) -> DepthFrame:
        """Blank the flying pixels of all views."""
        depth, confidence = without_flying_pixels(data.depth, data.confidence, self.tolerance, self.min_neighbors)
        for fact in (FINITE, NOT_NEGATIVE):
            if is_known(fact, data.depth):
                note(fact, depth)
        return derived(data, depth=depth, confidence=confidence)

    def fixed_work(self, like: DepthFrame) -> Callable[[DepthFrame], DepthFrame] | None:
        """Blank on the device; a limit to what goes needs the host."""
        return None if self.max_drop is not None else lambda frame: self.transform(frame, {})
