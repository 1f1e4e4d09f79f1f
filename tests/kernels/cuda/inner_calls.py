"""Calls of inner functions that kernels of the GPU serve: name -> what runs it on a backend, with small made data."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from pcdata.functional.depth.boxed import deproject_into_box
from pcdata.functional.depth.confidence import filled_confidence
from pcdata.functional.depth.deproject import deproject_depth, deproject_images, mask_depth
from pcdata.functional.depth.disparity import reciprocals, smoothed_images
from pcdata.functional.depth.flying_pixels import without_flying_pixels
from pcdata.functional.depth.holes import fill_rows, filled_images
from pcdata.functional.depth.temporal import temporal_step
from pcdata.functional.fixed_rows import move_kept
from pcdata.functional.image_grid import ImageGrid
from pcdata.functional.largest_planes import largest_planes
from pcdata.functional.noise import move_points
from pcdata.functional.rows import inside_box, transform_directions
from pcdata.rng import seeded

Call = Callable[[str], Any]


def depth_images(shape: tuple[int, int, int] = (2, 21, 30), seed: int = 0, holes: float = 0.3) -> Tensor:
    """Two slopes with a step between them, noise, and holes."""
    drawn = torch.rand((2, *shape), generator=seeded(seed))
    across = torch.linspace(0.5, 1.0, max(shape[2], 1))[: shape[2]]
    slope = torch.where(across > 0.75, across + 0.4, across)
    return torch.where(drawn[0] < holes, 0.0, slope + 0.01 * drawn[1])


def cameras(shape: tuple[int, int, int] = (2, 21, 30)) -> Tensor:
    views, height, width = shape
    one = [[[60.0 + v, 0.0, width / 2 - 0.3], [0.0, 58.5, height / 2 + 0.2 * v], [0.0, 0.0, 1.0]] for v in range(views)]
    return torch.tensor(one, dtype=torch.float64)


def on_image() -> dict[str, Any]:
    """A cloud that still lies on its images."""
    points, ptr, pixel = deproject_depth(depth_images(), cameras())
    return {"points": points, "ptr": ptr, "grid": ImageGrid(pixel, (21, 30), cameras())}


def _box(backend: str) -> Any:
    region = {"lower": (-0.2, -0.1, 0.5), "upper": (0.4, 0.3, 1.9), "near": 0.5, "far": 2.0, "mask": None}
    matrix = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    return deproject_into_box(depth_images(), cameras(), None, None, {}, matrix=matrix, **region, backend=backend)


def _over_time(backend: str) -> Any:
    history = torch.randint(0, 256, (2, 21, 30), generator=seeded(3), dtype=torch.uint8)
    return temporal_step(depth_images(), None, depth_images(seed=1), history, 0.4, 0.05, 3, backend=backend)


def _filled_confidence(backend: str) -> Any:
    before = depth_images()
    return filled_confidence(before, torch.where(before > 0, before, 0.5), None, None, backend=backend)


def _move_kept(backend: str) -> Any:
    points, ptr, keep = torch.rand((50, 3), generator=seeded(1)), torch.tensor([0, 20, 40]), torch.arange(50) % 3 == 0
    return move_kept(points, torch.arange(50), ptr, keep, backend=backend)


def _augmented(backend: str) -> Any:
    points, ptr = torch.randn((70, 3), generator=seeded(1)), torch.tensor([0, 0, 70])
    matrix, seeds = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1), torch.tensor([5, 6])
    moved = move_points(points, ptr, [matrix, (seeds, 0.01, None)], backend=backend)
    turned = transform_directions(points, ptr, matrix, backend=backend)
    return moved, turned, inside_box(moved, (-1, -1, -1), (1, 1, 1), backend=backend)


def _largest_planes(backend: str) -> Any:
    points = torch.rand((300, 3), generator=seeded(2))
    points[:200, 2] = 0.3 * points[:200, 0]
    options = {"distance": 0.01, "num_hypotheses": 40, "seed": 5, "probability": None}
    return largest_planes(points, torch.tensor([0, 300]), **options, backend=backend)


CALLS: dict[str, Call] = {
    "mask_depth": lambda backend: mask_depth(depth_images(), 0.6, 1.2, None, backend=backend),
    "deproject_images": lambda backend: deproject_images(depth_images(), cameras(), None, None, {}, backend=backend),
    "deproject_into_box": _box,
    "largest_planes": _largest_planes,
    "move_kept": _move_kept,
    "move_points": _augmented,
    "reciprocals": lambda backend: reciprocals(depth_images(), torch.tensor([20.0, 30.0]), backend=backend),
    "smoothed_images": lambda backend: smoothed_images(depth_images(), None, 0.5, 0.1, 1, backend=backend),
    "temporal_step": _over_time,
    "without_flying_pixels": lambda backend: without_flying_pixels(depth_images(), None, 0.02, 3, backend=backend),
    "filled_images": lambda backend: filled_images(depth_images(), "left", 3, 1, backend=backend),
    "fill_rows": lambda backend: fill_rows(depth_images(), 2, backend=backend),
    "filled_confidence": _filled_confidence,
}
