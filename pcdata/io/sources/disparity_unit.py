"""The unit of stored depth, measured: a stereo camera's disparity says how far the same pixels are in metres.

z = focal * baseline / disparity, so a disparity image in pixels beside a depth image leaves no choice of unit. Source:
Hartley & Zisserman, Multiple View Geometry, 2nd ed., section 11.12.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.io.images.reading import image_size, read_labels, read_raw_depth

_USUAL = (0.001, 0.0001, 0.0002, 0.00025, 0.000125, 0.00001, 0.01)  # metres; no two are nearer than a quarter
_TOLERANCE = 0.03  # of the focal length and the baseline, which a factory calibration knows better
_AGREEING = 0.9  # part of the pixels: edges of objects lie elsewhere in images that were filtered after matching
_MIN_PIXELS = 100


def unit_by_disparity(
    where: str,
    depth: Path,
    disparity: Path,
    focal: float,  # pixels, of images of this size
    baseline: float,  # metres
) -> float | None:
    """Return the one usual unit in which stored depth is what the disparity says; None = it names none.

    Disparity counts where it is in pixels: of 8 bits or floating point. Numbers of 16 bits are parts of a pixel, 1/16
    or 1/32 by the camera, and no file says which.

    Raises:
        CaptureError: an image cannot be read.
    """
    raw = read_raw_depth(where, depth)
    shifts = _in_pixels(where, disparity)
    if raw.dtype.kind == "f" or shifts is None or shifts.shape != raw.shape:
        return None
    known = (raw > 0) & np.isfinite(shifts) & (shifts >= 1)
    if int(known.sum()) < _MIN_PIXELS:
        return None
    stored, pixels = raw[known].astype(np.float64), shifts[known].astype(np.float64)
    measured = focal * baseline / (stored * pixels)  # of each pixel, metres per unit
    whole = shifts.dtype.kind != "f"
    slack = _TOLERANCE + (1.0 / pixels if whole else 0.0)  # whole pixels of disparity are cut off or rounded
    for unit in _USUAL:
        agrees = np.abs(measured / unit - 1.0) <= slack
        if abs(float(np.median(measured)) / unit - 1.0) <= _TOLERANCE and agrees.mean() >= _AGREEING:
            return unit
    return None


def _in_pixels(where: str, file: Path) -> NDArray[Any] | None:
    if file.suffix.lower() == ".png":
        image_size(where, file)
        values = read_labels(file).numpy()
        return values if values.max(initial=0) <= 255 else None
    values = read_raw_depth(where, file)
    return values if values.dtype.kind == "f" else None
