"""From depth images to the points inside a box: what several steps do, one after another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from torch import Tensor

from pcdata.contracts.dispatch import inner
from pcdata.functional.depth.deproject import Deprojected, deproject_images, mask_depth
from pcdata.functional.depth.flying_pixels import without_flying_pixels
from pcdata.functional.rows import counts_from_ptr, inside_box, pick_rows, ptr_after_mask, transform_points


@inner
def deproject_into_box(
    depth: Tensor,
    intrinsics: Tensor,
    distortion: Tensor | None,
    colors: Tensor | None,
    images: Mapping[str, Tensor],
    *,
    matrix: Tensor | None,  # (V, 4, 4) float64, moves the points of each view; None = they stay
    lower: Sequence[float],
    upper: Sequence[float],
    near: float | None,
    far: float | None,
    mask: Tensor | None,
    flying: tuple[float, int] | None = None,  # tolerance, min_neighbors
) -> tuple[Deprojected, Tensor] | None:
    """Run the steps from :func:`mask_depth` to a box as one; None if a point is not finite.

    Between the two: :func:`without_flying_pixels`, unless ``flying`` is None, :func:`deproject_images` and a motion.

    Returns:
        What is inside the box, moved, and how many points each view had before the box, (V,) int64.
    """
    masked = mask_depth(depth, near, far, mask)
    if flying is not None:
        masked = without_flying_pixels(masked, None, *flying)[0]
    whole = deproject_images(masked, intrinsics, distortion, colors, images)
    points = whole.points if matrix is None else transform_points(whole.points, whole.ptr, matrix)
    inside = inside_box(points, lower, upper)
    if inside is None:
        return None
    fields = {"points": points, "source_index": whole.source_index}
    kept = pick_rows(fields if whole.colors is None else fields | {"colors": whole.colors}, inside)
    ptr = ptr_after_mask(inside, whole.ptr)
    inner_part = Deprojected(
        kept["points"], ptr, kept["source_index"], kept.get("colors"), pick_rows(whole.rows, inside)
    )
    return inner_part, counts_from_ptr(whole.ptr)
