"""Images of an export read back, as the loaders make points of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CaptureError
from pcdata.files.opening import check_inside
from pcdata.io.images.reading import read_color, read_raw_depth

MANY = 20_000  # points of a depth image that a verdict is reached on: every rule left is one of means and extents

Fields = dict[str, NDArray[Any]]


def stored_depth(folder: Path, path: Path, units_per_metre: float = 1.0) -> NDArray[Any]:  # (H, W) metres
    """Read the depth image of an export, whatever it holds.

    Raises:
        CaptureError: it is missing, damaged, or a link leads out of the export.
    """
    check_inside("check", path, [folder])
    raw = read_raw_depth(f"check: {path}", path)
    return raw if units_per_metre == 1.0 else raw / units_per_metre


def stored_colors(folder: Path, path: Path) -> NDArray[np.uint8]:  # (H, W, 3) RGB
    """Read the color image of an export.

    Raises:
        CaptureError: it is missing, damaged, or a link leads out of the export.
    """
    check_inside("check", path, [folder])
    pixels: NDArray[np.uint8] = read_color(path).numpy()
    return pixels


def image_fields(
    where: Path,
    depth: NDArray[Any],  # (H, W) metres
    intrinsics: NDArray[Any],  # (3, 3)
    colors: NDArray[np.uint8] | None = None,  # (H, W, 3)
    inside: NDArray[np.bool_] | None = None,  # (H, W)
) -> Fields:
    """Return an image, and its points in the camera's frame with their colors, as the loaders make them.

    Raises:
        CaptureError: the parts do not fit together.
    """
    matrix = np.asarray(intrinsics, dtype=np.float64)
    sizes = {part.shape[:2] for part in (depth, colors, inside) if part is not None}
    if matrix.shape != (3, 3) or not matrix[0, 0] or not matrix[1, 1] or depth.ndim != 2 or len(sizes) > 1:
        raise CaptureError(f"{where}: images of {sorted(sizes)} and intrinsics {matrix.shape} do not fit together")
    with np.errstate(invalid="ignore"):
        kept = depth > 0 if inside is None else (depth > 0) & inside
    row, column = (index[:: -(-len(index) // MANY) or 1] for index in np.nonzero(kept))
    z = depth[row, column].astype(np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        x, y = (column - matrix[0, 2]) * z / matrix[0, 0], (row - matrix[1, 2]) * z / matrix[1, 1]
    fields: Fields = {"depth": depth, "points": np.stack([x, y, z], axis=1).astype(np.float32)}
    if colors is not None:
        fields |= {"image": colors, "colors": colors[row, column]}
    return fields
