"""The compiled CPU backend: importing it registers every kernel of the core beside its reference."""

from __future__ import annotations

from pcdata.kernels.cpu import depth_filters as cpu_depth_filters
from pcdata.kernels.cpu import depth_to_color as cpu_registration
from pcdata.kernels.cpu import fusion as cpu_fusion
from pcdata.kernels.cpu import grasps as cpu_grasps
from pcdata.kernels.cpu import image_windows as cpu_image_windows
from pcdata.kernels.cpu import images as cpu_images
from pcdata.kernels.cpu import lenses as cpu_lenses
from pcdata.kernels.cpu import motions as cpu_motions
from pcdata.kernels.cpu import neighborhoods as cpu_neighborhoods
from pcdata.kernels.cpu import neighbors as cpu_neighbors
from pcdata.kernels.cpu import noise as cpu_noise
from pcdata.kernels.cpu import outliers as cpu_outliers
from pcdata.kernels.cpu import planes as cpu_planes
from pcdata.kernels.cpu import rendering as cpu_rendering
from pcdata.kernels.cpu import rows as cpu_rows
from pcdata.kernels.cpu import sampling as cpu_sampling
from pcdata.kernels.cpu import selection as cpu_selection
from pcdata.kernels.cpu import stored_rows as cpu_stored_rows
from pcdata.kernels.cpu import surfaces as cpu_surfaces
from pcdata.kernels.cpu import touching as cpu_touching
from pcdata.kernels.cpu.native import unavailable

__all__ = [
    "cpu_depth_filters",
    "cpu_fusion",
    "cpu_grasps",
    "cpu_image_windows",
    "cpu_images",
    "cpu_lenses",
    "cpu_motions",
    "cpu_neighborhoods",
    "cpu_neighbors",
    "cpu_noise",
    "cpu_outliers",
    "cpu_planes",
    "cpu_registration",
    "cpu_rendering",
    "cpu_rows",
    "cpu_sampling",
    "cpu_selection",
    "cpu_stored_rows",
    "cpu_surfaces",
    "cpu_touching",
    "unavailable",
]
