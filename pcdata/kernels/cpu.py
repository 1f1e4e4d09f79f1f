"""The compiled CPU backend: importing it registers every kernel of the core beside its reference."""

from __future__ import annotations

from pcdata.kernels import cpu_fusion, cpu_images, cpu_neighbors, cpu_regions, cpu_registration, cpu_rows, cpu_sampling
from pcdata.kernels.native import unavailable

__all__ = [
    "cpu_fusion",
    "cpu_images",
    "cpu_neighbors",
    "cpu_regions",
    "cpu_registration",
    "cpu_rows",
    "cpu_sampling",
    "unavailable",
]
