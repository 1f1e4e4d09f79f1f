"""Operations on tensors: points (N, 3) and row pointers ``ptr`` (B+1,) in, tensors out, on any device.

Gradients flow through what is computed from coordinates and depth: deprojection, projection, motions, voxel means,
decimated, resized and filled depth, disparity, Chamfer distance. None flow through decisions (indices, masks, labels,
planes, sizes, the neighbours and distances of a search), nor through estimated normals, ``register_depth``,
``spatial_filter`` and TSDF volumes. The distance of neighbours with a gradient is that of the rows that a search named.
"""

from pcdata.functional.clusters import dbscan
from pcdata.functional.depth import deproject_depth, pixel_rays, project_points, range_to_depth
from pcdata.functional.depth_average import DepthAverage, average_depth
from pcdata.functional.depth_holes import fill_holes, fill_rows
from pcdata.functional.depth_registration import RegisteredDepth, register_depth
from pcdata.functional.depth_resampling import decimate_depth, resize_depth
from pcdata.functional.depth_temporal import TemporalState, temporal_filter
from pcdata.functional.disparity import depth_to_disparity, disparity_to_depth, spatial_filter
from pcdata.functional.edge_offset import EdgeOffset, EdgeVotes, edge_votes, offset_from_votes
from pcdata.functional.extremes import pile_at_extreme
from pcdata.functional.flying_pixels import flying_pixel_mask
from pcdata.functional.grid import ImageGrid
from pcdata.functional.icp import Alignment, icp_point_to_plane
from pcdata.functional.lens import distort_normalized, undistort_normalized
from pcdata.functional.metrics import chamfer_distance
from pcdata.functional.missing_region import largest_missing_block, largest_missing_region
from pcdata.functional.neighbors import ball_query, knn
from pcdata.functional.normals import estimate_normals, orient_normals
from pcdata.functional.occlusion_edges import occlusion_edges
from pcdata.functional.outliers import radius_outlier_mask, statistical_outlier_mask
from pcdata.functional.plane_residuals import PlaneResiduals, point_to_plane_residuals
from pcdata.functional.planes import ransac_plane
from pcdata.functional.sampling import farthest_point_sample, random_sample_index
from pcdata.functional.view_agreement import view_agreement
from pcdata.functional.voxels import (
    find_voxel_size,
    voxel_downsample,
    voxel_majority,
    voxel_mean,
    voxel_mean_direction,
    voxel_minimum,
)

__all__ = [
    "Alignment",
    "DepthAverage",
    "EdgeOffset",
    "EdgeVotes",
    "ImageGrid",
    "PlaneResiduals",
    "RegisteredDepth",
    "TemporalState",
    "average_depth",
    "ball_query",
    "chamfer_distance",
    "dbscan",
    "decimate_depth",
    "deproject_depth",
    "depth_to_disparity",
    "disparity_to_depth",
    "distort_normalized",
    "edge_votes",
    "estimate_normals",
    "farthest_point_sample",
    "fill_holes",
    "fill_rows",
    "find_voxel_size",
    "flying_pixel_mask",
    "icp_point_to_plane",
    "knn",
    "largest_missing_block",
    "largest_missing_region",
    "occlusion_edges",
    "offset_from_votes",
    "orient_normals",
    "pile_at_extreme",
    "pixel_rays",
    "point_to_plane_residuals",
    "project_points",
    "radius_outlier_mask",
    "random_sample_index",
    "range_to_depth",
    "ransac_plane",
    "register_depth",
    "resize_depth",
    "spatial_filter",
    "statistical_outlier_mask",
    "temporal_filter",
    "undistort_normalized",
    "view_agreement",
    "voxel_downsample",
    "voxel_majority",
    "voxel_mean",
    "voxel_mean_direction",
    "voxel_minimum",
]
