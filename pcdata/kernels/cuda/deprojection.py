"""From depth images to points: pixels are chosen, then written where they belong.

The host waits once, for how many points there are; what a reference refuses is left to it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

import pcdata.functional.depth.boxed  # noqa: F401 - the function must be registered before its kernel
from pcdata.contracts.dispatch import INNER, OPERATIONS, kernel
from pcdata.contracts.known import FINITE, note
from pcdata.contracts.on_host import read_together, uploaded
from pcdata.functional.depth.deproject import Deprojected, check_intrinsics
from pcdata.functional.rows import ptr_from_counts
from pcdata.kernels.cameras import depth_limits, images_fit, rays_of_cameras, region_fits
from pcdata.kernels.cuda.depth_filters import without_flying_pixels
from pcdata.kernels.cuda.launching import Launcher, launcher_of

_WORD = 32  # pixels
_OF_THREAD = 8  # pixels that a thread of the first pass looks at


@kernel("mask_depth", "cuda")
def mask_depth(depth: Tensor, near: float | None, far: float | None, mask: Tensor | None) -> Tensor:
    """Decide and write in one pass."""
    if not region_fits(depth, None, mask) or depth.dtype is not torch.float32:
        left: Tensor = INNER["mask_depth"].reference(depth, near, far, mask)
        return left
    masked = torch.empty_like(depth, memory_format=torch.contiguous_format)
    given = depth.contiguous(), depth.numel(), *depth_limits(near, far), _contiguous(mask), masked
    launcher_of(depth).launch("pc_keep_depths", depth.numel(), *given)
    return masked


@kernel("deproject_depth", "cuda")
def deproject_depth(depth: Tensor, intrinsics: Tensor, *, distortion: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Write the points and their pixels."""
    chosen = _Chosen.of(depth, intrinsics, distortion)
    if chosen is None:
        return OPERATIONS["deproject_depth"].reference(depth, intrinsics, distortion=distortion)
    made = chosen.written(over_all_views=False)
    return made.points, made.ptr, made.source_index


@kernel("deproject_images", "cuda")
def deproject_images(
    depth: Tensor,
    intrinsics: Tensor,
    distortion: Tensor | None,
    colors: Tensor | None,
    images: Mapping[str, Tensor],
) -> Deprojected:
    """Write the points and all that goes along with them."""
    chosen = None
    if images_fit(depth, intrinsics, distortion, colors, images):
        chosen = _Chosen.of(depth, intrinsics, distortion)
    if chosen is None:
        return INNER["deproject_images"].reference(depth, intrinsics, distortion, colors, images)
    return chosen.written(colors=colors, images=images)


@kernel("deproject_into_box", "cuda")
def deproject_into_box(
    depth: Tensor,
    intrinsics: Tensor,
    distortion: Tensor | None,
    colors: Tensor | None,
    images: Mapping[str, Tensor],
    *,
    matrix: Tensor | None,
    lower: Sequence[float],
    upper: Sequence[float],
    near: float | None,
    far: float | None,
    mask: Tensor | None,
    flying: tuple[float, int] | None = None,
) -> tuple[Deprojected, Tensor] | None:
    """Write only what is inside the box."""
    chosen = None
    if flying is not None:
        depth = without_flying_pixels(mask_depth(depth, near, far, mask), None, *flying)[0]
        near = far = mask = None
    if images_fit(depth, intrinsics, distortion, colors, images) and region_fits(depth, matrix, mask):
        box = (*map(float, lower), *map(float, upper))
        moved = None if matrix is None else matrix.double().contiguous()
        chosen = _Chosen.of(depth, intrinsics, distortion, depth_limits(near, far), mask, moved, box)
    if chosen is None or not chosen.is_finite:
        region = {"matrix": matrix, "lower": lower, "upper": upper, "near": near, "far": far, "mask": mask}
        return INNER["deproject_into_box"].reference(depth, intrinsics, distortion, colors, images, **region)
    readings = uploaded(torch.tensor(chosen.readings, dtype=torch.int64, device="cpu"), depth.device)
    return chosen.written(colors=colors, images=images), readings


@dataclass(frozen=True)
class _Chosen:
    """Which pixels become points."""

    launcher: Launcher
    images: tuple[Tensor | int | None, ...]  # as the kernels take them
    shape: torch.Size
    kept: Tensor  # (words,) int32: a bit for each of 32 pixels
    ends: Tensor  # (words,) int64: how many pixels are kept up to the end of each word
    counts: list[int]  # of each view
    readings: list[int]  # of each view, before the box
    is_finite: bool

    @classmethod
    def of(
        cls,
        depth: Tensor,
        intrinsics: Tensor,
        distortion: Tensor | None,
        limits: tuple[float, float] = (0.0, torch.inf),
        mask: Tensor | None = None,
        matrix: Tensor | None = None,
        box: tuple[float, ...] | None = None,
    ) -> _Chosen | None:
        """Decide about every pixel; None where there is none, or something wrong that the reference says best."""
        check_intrinsics("deproject_depth", intrinsics)
        if depth.numel() == 0 or depth.dtype is not torch.float32:
            return None
        views, height, width = depth.shape
        rays = rays_of_cameras(intrinsics, (height, width), distortion)
        images = depth.contiguous(), views, height, width, *rays, matrix
        words = -(-depth.numel() // _WORD)
        kept = torch.empty(words, dtype=torch.int32, device=depth.device)
        counts = torch.empty(words, dtype=torch.int64, device=depth.device)
        told = torch.zeros(2 * views + 2, dtype=torch.int64, device=depth.device)
        region = *limits, _contiguous(mask), int(box is not None), *(box or (0.0,) * 6)
        threads = -(-words // _OF_THREAD) * _WORD
        launcher = launcher_of(depth)
        launcher.launch("pc_choose_readings", threads, *images, *region, kept, counts, told)
        ends = counts.cumsum(0)
        (numbers,) = read_together([told])
        if numbers[-2]:
            return None
        of_views = numbers[:views], numbers[views : 2 * views]
        return cls(launcher, images, depth.shape, kept, ends, *of_views, is_finite=not numbers[-1])

    def written(
        self, *, over_all_views: bool = True, colors: Tensor | None = None, images: Mapping[str, Tensor] | None = None
    ) -> Deprojected:
        """Write the points and what goes along with them."""
        count, device = sum(self.counts), self.kept.device
        points = torch.empty((count, 3), dtype=torch.float32, device=device)
        pixel_index = torch.empty(count, dtype=torch.int64, device=device)
        rgb = None if colors is None else torch.empty((count, 3), dtype=torch.float32, device=device)
        results = self.kept, self.ends, int(over_all_views), _contiguous(colors), points, pixel_index, rgb
        self.launcher.launch("pc_write_points", self.shape.numel() if count else 0, *self.images, *results)
        if self.is_finite:
            note(FINITE, points)
        rows = {name: image.flatten(0, 2)[pixel_index] for name, image in (images or {}).items()}
        return Deprojected(points, ptr_from_counts(self.counts, device), pixel_index, rgb, rows)


def _contiguous(tensor: Tensor | None) -> Tensor | None:
    return None if tensor is None else tensor.contiguous()
