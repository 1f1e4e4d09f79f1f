"""The GPU backend: importing it registers every kernel of ``core/pc/gpu`` beside its reference."""

from __future__ import annotations

from pcdata.kernels.cuda import clusters as cuda_clusters
from pcdata.kernels.cuda import compaction as cuda_compaction
from pcdata.kernels.cuda import deprojection as cuda_deprojection
from pcdata.kernels.cuda import depth_filters as cuda_depth_filters
from pcdata.kernels.cuda import fusion as cuda_fusion
from pcdata.kernels.cuda import holes as cuda_holes
from pcdata.kernels.cuda import largest_planes as cuda_largest_planes
from pcdata.kernels.cuda import motions as cuda_motions
from pcdata.kernels.cuda import neighbors as cuda_neighbors
from pcdata.kernels.cuda import outliers as cuda_outliers
from pcdata.kernels.cuda import planes as cuda_planes
from pcdata.kernels.cuda import registration as cuda_registration
from pcdata.kernels.cuda import resampling as cuda_resampling
from pcdata.kernels.cuda import sampling as cuda_sampling
from pcdata.kernels.cuda import surfaces as cuda_surfaces
from pcdata.kernels.cuda import voxels as cuda_voxels
from pcdata.kernels.cuda.gpu import unavailable

__all__ = [
    "cuda_clusters",
    "cuda_compaction",
    "cuda_deprojection",
    "cuda_depth_filters",
    "cuda_fusion",
    "cuda_holes",
    "cuda_largest_planes",
    "cuda_motions",
    "cuda_neighbors",
    "cuda_outliers",
    "cuda_planes",
    "cuda_registration",
    "cuda_resampling",
    "cuda_sampling",
    "cuda_surfaces",
    "cuda_voxels",
    "unavailable",
]
