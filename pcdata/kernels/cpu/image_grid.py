"""The depth image of an organized cloud as the compiled core takes it."""

from __future__ import annotations

from torch import Tensor

from pcdata.functional.image_grid import ImageGrid


def grid_arguments(grid: ImageGrid | None) -> tuple[Tensor | None, int, Tensor | None]:
    """Return what the core wants of a grid: pixels, width, motions into the cameras' frames."""
    if grid is None:
        return None, 0, None
    motion = grid.camera_from_points
    return (
        grid.pixel_index.contiguous(),
        grid.size[1],
        None if motion is None else motion.detach().double().contiguous(),
    )
