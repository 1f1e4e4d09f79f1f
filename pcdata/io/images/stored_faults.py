"""What is wrong with the numbers in a depth file, before a reader cleans or refuses it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pcdata.io.images.reading import read_raw_depth


@dataclass(frozen=True)
class RawFaults:
    """Counts of stored values that are no depth."""

    num_pixels: int
    nan: int = 0
    infinite: int = 0
    negative: int = 0


def count_raw_faults(path: str | os.PathLike[str]) -> RawFaults | None:
    """Count NaN, infinite and negative values of a depth image as stored; None = whole numbers, which have none.

    Raises:
        CaptureError: the file is missing, damaged, or not a depth image.
    """
    if Path(path).suffix.lower() == ".png":
        return None  # the readers accept 16-bit whole numbers only
    raw = read_raw_depth(f"count_raw_faults: {path}", Path(path))
    if raw.dtype.kind != "f":
        return None
    nan, infinite = int(np.isnan(raw).sum()), int(np.isinf(raw).sum())
    with np.errstate(invalid="ignore"):
        negative = int(((raw < 0) & np.isfinite(raw)).sum())
    return RawFaults(raw.size, nan, infinite, negative)
