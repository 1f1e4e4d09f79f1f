"""Truncated signed distance fields: many depth images averaged into one surface."""

from pcdata.functional.tsdf.blocks import VoxelBlocks, bytes_per_block, voxel_planes
from pcdata.functional.tsdf.grid import VoxelGrid
from pcdata.functional.tsdf.integrate import find_blocks, integrate_view, locate_views, touched_blocks
from pcdata.functional.tsdf.marching import find_triangles
from pcdata.functional.tsdf.room import VoxelRoom
from pcdata.functional.tsdf.surface import Crossings, find_crossings
from pcdata.functional.tsdf.views import (
    Carving,
    FusionView,
    Weighting,
    check_labels,
    pack_colors,
    pack_labels,
    weight_image,
)

__all__ = [
    "Carving",
    "Crossings",
    "FusionView",
    "VoxelBlocks",
    "VoxelGrid",
    "VoxelRoom",
    "Weighting",
    "bytes_per_block",
    "check_labels",
    "find_blocks",
    "find_crossings",
    "find_triangles",
    "integrate_view",
    "locate_views",
    "pack_colors",
    "pack_labels",
    "touched_blocks",
    "voxel_planes",
    "weight_image",
]
