"""Operations on tensors: points (N, 3) and row pointers ``ptr`` (B+1,) in, tensors out, on any device.

Gradients flow through what is computed from coordinates and depth: deprojection, projection, motions, voxel means,
decimated, resized, undistorted, filtered and filled depth, undistorted images, disparity, distances between clouds,
distances and covariances of neighbors, interpolated features, the motion between paired points. None flow through
decisions (indices, masks, labels, planes and other shapes, sizes, which points are neighbors), nor through estimated
normals, ``register_depth``, rendering, ``spatial_filter`` and TSDF volumes.
"""

from pcdata.functional.boundaries import boundary_mask
from pcdata.functional.boxes import smallest_box
from pcdata.functional.closest_points import ClosestPoints, iterate_closest_points
from pcdata.functional.clusters import core_point_mask, dbscan
from pcdata.functional.depth.average import DepthAverage, average_depth
from pcdata.functional.depth.deproject import deproject_depth, pixel_rays, project_points, range_to_depth
from pcdata.functional.depth.depth_to_color import RegisteredDepth, register_depth
from pcdata.functional.depth.disparity import depth_to_disparity, disparity_to_depth, spatial_filter
from pcdata.functional.depth.flying_pixels import flying_pixel_mask
from pcdata.functional.depth.holes import fill_holes, fill_rows
from pcdata.functional.depth.resampling import decimate_depth, resize_depth
from pcdata.functional.depth.temporal import TemporalState, temporal_filter
from pcdata.functional.depth.undistortion import undistort_depth, undistort_image
from pcdata.functional.depth.window_filters import bilateral_filter, median_filter
from pcdata.functional.grasp_conventions import (
    GRASP_CONVENTIONS,
    GraspConvention,
    GraspGroup,
    convert_grasps,
    read_grasp_group,
)
from pcdata.functional.grasps import GraspChecks, ParallelJaw, check_grasps
from pcdata.functional.hard_voxels import HardVoxels, hard_voxels
from pcdata.functional.hulls import ConvexHull, convex_hull_3d
from pcdata.functional.image_clusters import image_clusters
from pcdata.functional.image_grid import ImageGrid
from pcdata.functional.interpolation import interpolate_features
from pcdata.functional.metrics import chamfer_distance, f_score, hausdorff_distance
from pcdata.functional.neighbor_index import NeighborIndex
from pcdata.functional.neighborhoods import SHAPE_FEATURES, neighborhood_covariance, shape_features
from pcdata.functional.neighbors import ball_query, knn, radius_neighbors
from pcdata.functional.normals import estimate_normals, orient_normals
from pcdata.functional.outliers import radius_outlier_mask, statistical_outlier_mask
from pcdata.functional.paired_points import PairedMotion, fit_paired_points
from pcdata.functional.plane_segments import segment_planes, supporting_plane
from pcdata.functional.planes import ransac_plane
from pcdata.functional.ranges import deproject_ranges, render_ranges
from pcdata.functional.rectangles import smallest_rectangle
from pcdata.functional.rendering import (
    RenderedPoints,
    RenderedTriangles,
    depth_normals,
    render_points,
    render_triangles,
)
from pcdata.functional.rows import cloud_of_rows, ptr_from_counts
from pcdata.functional.sampling import farthest_point_groups, farthest_point_sample, random_sample_index
from pcdata.functional.selection import box_mask, convex_hull, duplicate_mask, polygon_mask
from pcdata.functional.shapes import (
    FoundCircle,
    FoundCylinder,
    FoundLine,
    FoundSphere,
    ransac_circle,
    ransac_cylinder,
    ransac_line,
    ransac_sphere,
)
from pcdata.functional.table_surface import TableSurface, table_surface
from pcdata.functional.visibility import frustum_mask, hidden_point_mask
from pcdata.functional.voxel_averages import (
    voxel_majority,
    voxel_maximum,
    voxel_mean,
    voxel_mean_direction,
    voxel_minimum,
)
from pcdata.functional.voxels import find_voxel_size, voxel_cells, voxel_downsample, voxel_nearest
from pcdata.geometry.lens import distort_normalized, undistort_normalized

__all__ = [
    "GRASP_CONVENTIONS",
    "SHAPE_FEATURES",
    "ClosestPoints",
    "ConvexHull",
    "DepthAverage",
    "FoundCircle",
    "FoundCylinder",
    "FoundLine",
    "FoundSphere",
    "GraspChecks",
    "GraspConvention",
    "GraspGroup",
    "HardVoxels",
    "ImageGrid",
    "NeighborIndex",
    "PairedMotion",
    "ParallelJaw",
    "RegisteredDepth",
    "RenderedPoints",
    "RenderedTriangles",
    "TableSurface",
    "TemporalState",
    "average_depth",
    "ball_query",
    "bilateral_filter",
    "boundary_mask",
    "box_mask",
    "chamfer_distance",
    "check_grasps",
    "cloud_of_rows",
    "convert_grasps",
    "convex_hull",
    "convex_hull_3d",
    "core_point_mask",
    "dbscan",
    "decimate_depth",
    "deproject_depth",
    "deproject_ranges",
    "depth_normals",
    "depth_to_disparity",
    "disparity_to_depth",
    "distort_normalized",
    "duplicate_mask",
    "estimate_normals",
    "f_score",
    "farthest_point_groups",
    "farthest_point_sample",
    "fill_holes",
    "fill_rows",
    "find_voxel_size",
    "fit_paired_points",
    "flying_pixel_mask",
    "frustum_mask",
    "hard_voxels",
    "hausdorff_distance",
    "hidden_point_mask",
    "image_clusters",
    "interpolate_features",
    "iterate_closest_points",
    "knn",
    "median_filter",
    "neighborhood_covariance",
    "orient_normals",
    "pixel_rays",
    "polygon_mask",
    "project_points",
    "ptr_from_counts",
    "radius_neighbors",
    "radius_outlier_mask",
    "random_sample_index",
    "range_to_depth",
    "ransac_circle",
    "ransac_cylinder",
    "ransac_line",
    "ransac_plane",
    "ransac_sphere",
    "read_grasp_group",
    "register_depth",
    "render_points",
    "render_ranges",
    "render_triangles",
    "resize_depth",
    "segment_planes",
    "shape_features",
    "smallest_box",
    "smallest_rectangle",
    "spatial_filter",
    "statistical_outlier_mask",
    "supporting_plane",
    "table_surface",
    "temporal_filter",
    "undistort_depth",
    "undistort_image",
    "undistort_normalized",
    "voxel_cells",
    "voxel_downsample",
    "voxel_majority",
    "voxel_maximum",
    "voxel_mean",
    "voxel_mean_direction",
    "voxel_minimum",
    "voxel_nearest",
]
