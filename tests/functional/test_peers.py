"""docs/operations.md: what each operation gives, and what neighboring libraries call it; made from here.

``python -m tests.functional.test_peers > docs/operations.md`` writes the page anew.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import pcdata.functional
from pcdata.contracts.dispatch import OPERATIONS, why_unavailable
from pcdata.contracts.tensors import parse_spec

ROOT = Path(__file__).parents[2]
# Operation -> the test that holds it to an oracle, and what others call it.
PEERS = {
    "ball_query": ("functional/test_neighbors.py", "PyTorch3D `ops.ball_query`; Open3D `hybrid_search`"),
    "bilateral_filter": (
        "functional/depth/test_window_filters.py",
        "kornia `bilateral_blur`; OpenCV `bilateralFilter`; PCL `FastBilateralFilter`",
    ),
    "boundary_mask": (
        "functional/test_boundaries.py",
        "PCL `BoundaryEstimation`; Open3D tensor `compute_boundary_points`",
    ),
    "box_mask": ("functional/test_selection.py", "Open3D `crop`; PCL `CropBox`"),
    "chamfer_distance": ("functional/test_metrics.py", "PyTorch3D `loss.chamfer_distance`"),
    "core_point_mask": ("functional/test_clusters.py", "scikit-learn `DBSCAN.core_sample_indices_`"),
    "dbscan": ("functional/test_clusters.py", "Open3D `cluster_dbscan`; scikit-learn `DBSCAN`"),
    "decimate_depth": ("functional/depth/test_resampling.py", "librealsense `decimation_filter`"),
    "deproject_depth": (
        "functional/depth/test_deproject.py",
        "Open3D `create_from_depth_image`; kornia `depth_to_3d`; OpenCV `rgbd.depthTo3d`; "
        "librealsense `rs2_deproject_pixel_to_point`",
    ),
    "deproject_ranges": ("functional/test_rendering.py", "PCL `RangeImageSpherical`"),
    "depth_normals": (
        "functional/test_rendering.py",
        "kornia `depth_to_normals`; OpenCV `RgbdNormals`; PCL `IntegralImageNormalEstimation`",
    ),
    "duplicate_mask": ("functional/test_selection.py", "Open3D `remove_duplicated_points`"),
    "estimate_normals": (
        "functional/test_normals.py",
        "Open3D `estimate_normals`; PyTorch3D `estimate_pointcloud_normals`",
    ),
    "f_score": ("functional/test_metrics.py", "Open3D `compute_metrics` (F-score)"),
    "farthest_point_groups": ("functional/test_sampling.py", "torch-cluster `fps` then `nearest`"),
    "farthest_point_sample": (
        "functional/test_sampling.py",
        "torch-cluster `fps`; PyTorch3D `sample_farthest_points`; Open3D `farthest_point_down_sample`",
    ),
    "fill_holes": ("functional/depth/test_holes.py", "librealsense `hole_filling_filter`"),
    "find_voxel_size": ("functional/test_voxels.py", ""),
    "fit_paired_points": (
        "functional/test_paired_points.py",
        "PyTorch3D `corresponding_points_alignment`; SciPy `Rotation.align_vectors`; "
        "PCL `TransformationEstimationSVD`; OpenCV `estimateAffine3D`",
    ),
    "flying_pixel_mask": ("functional/depth/test_flying_pixels.py", "PCL `ShadowPoints`"),
    "frustum_mask": ("functional/test_visibility.py", "PCL `FrustumCulling`"),
    "hard_voxels": (
        "functional/test_hard_voxels.py",
        "MMDetection3D `VoxelizationByGridShape`; mmcv `Voxelization`; spconv `PointToVoxel`",
    ),
    "hausdorff_distance": ("functional/test_metrics.py", "SciPy `directed_hausdorff`"),
    "hidden_point_mask": ("functional/test_visibility.py", "Open3D `hidden_point_removal`"),
    "image_clusters": ("functional/test_image_clusters.py", "PCL `OrganizedEuclideanClusterExtraction`"),
    "interpolate_features": (
        "functional/test_interpolation.py",
        "PyG `knn_interpolate`; Open3D-ML `three_interpolate`",
    ),
    "iterate_closest_points": ("functional/test_closest_points.py", "PyTorch3D `iterative_closest_point`"),
    "knn": ("functional/test_neighbors.py", "torch-cluster `knn`; PyTorch3D `knn_points`; Open3D `knn_search`"),
    "median_filter": ("functional/depth/test_window_filters.py", "OpenCV `medianBlur`; PCL `MedianFilter`"),
    "neighborhood_covariance": (
        "functional/test_neighborhoods.py",
        "Open3D `estimate_covariances`; PyTorch3D `estimate_pointcloud_local_coord_frames`",
    ),
    "polygon_mask": (
        "functional/test_selection.py",
        "Open3D `SelectionPolygonVolume`; PCL `ExtractPolygonalPrismData`",
    ),
    "project_points": (
        "functional/depth/test_deproject.py",
        "OpenCV `projectPoints`; kornia `project_points`; librealsense `rs2_project_point_to_pixel`",
    ),
    "radius_neighbors": ("functional/test_neighbors.py", "torch-cluster `radius`; Open3D `fixed_radius_search`"),
    "radius_outlier_mask": ("functional/test_outliers.py", "Open3D `remove_radius_outlier`"),
    "ransac_circle": ("functional/test_shapes.py", "PCL `SACMODEL_CIRCLE3D`, `SACMODEL_CIRCLE2D`"),
    "ransac_cylinder": ("functional/test_shapes.py", "PCL `SACMODEL_CYLINDER`"),
    "ransac_line": ("functional/test_shapes.py", "PCL `SACMODEL_LINE`, `SACMODEL_STICK`"),
    "ransac_plane": ("functional/test_planes.py", "Open3D `segment_plane`; PCL `SACMODEL_PLANE`"),
    "ransac_sphere": ("functional/test_shapes.py", "PCL `SACMODEL_SPHERE`, `SACMODEL_NORMAL_SPHERE`"),
    "register_depth": (
        "functional/depth/test_depth_to_color.py",
        "librealsense `align`; OpenCV `rgbd.registerDepth`",
    ),
    "render_points": (
        "functional/test_rendering.py",
        "PyTorch3D `PointsRasterizer`; Open3D `project_to_depth_image`",
    ),
    "render_ranges": ("functional/test_rendering.py", "PCL `RangeImageSpherical`"),
    "render_triangles": ("functional/test_rendering.py", "PyTorch3D `MeshRasterizer`; Open3D `RaycastingScene`"),
    "resize_depth": ("functional/depth/test_resampling.py", "OpenCV `resize`"),
    "segment_planes": ("functional/test_plane_segments.py", "Open3D `segment_plane`, repeated"),
    "spatial_filter": ("functional/depth/test_disparity.py", "librealsense `spatial_filter`"),
    "statistical_outlier_mask": ("functional/test_outliers.py", "Open3D `remove_statistical_outlier`"),
    "supporting_plane": ("functional/test_plane_segments.py", ""),
    "table_surface": ("functional/test_table_surface.py", ""),
    "undistort_depth": ("functional/depth/test_undistortion.py", "OpenCV `remap`, nearest"),
    "undistort_image": (
        "functional/depth/test_undistortion.py",
        "OpenCV `undistort`, `fisheye.undistortImage`; kornia `undistort_image`",
    ),
    "voxel_downsample": ("functional/test_voxels.py", "Open3D `voxel_down_sample`; PyG `GridSampling`"),
}


def batches(name: str) -> str:
    """How an operation takes many at once, by its contract."""
    contract = OPERATIONS[name].contract
    assert contract is not None
    specs = [parse_spec(text) for text in contract.tensors.values()]
    if any(spec.is_ptr for spec in specs):
        return "ragged"
    return "images of one size" if any(spec.dims[0] == "V" for spec in specs) else "rows"


def page() -> str:
    why_unavailable("cpu")  # loads the kernels
    lines = [
        "# Operations, and what others call them",
        "",
        "Made by `tests/functional/test_peers.py` from the registered operations; all are called as "
        '`pcdata.functional.NAME`. Many at once: "ragged" takes clouds of any sizes, one after another, cut by `ptr`, '
        'without a loop over them; "rows" knows no clouds. Compiled bodies run on the CPU and give what the references '
        "give; all else runs in torch, on any device. [Calls of other libraries beside ours](coming_from.md).",
        "",
        "| operation | gradients | many at once | compiled | held to an oracle in | others call it |",
        "|---|---|---|---|---|---|",
    ]
    for name, (test, peers) in sorted(PEERS.items()):
        operation = OPERATIONS[name]
        gradient = "yes" if operation.gradient else "no"
        compiled = "yes" if operation.serves("cpu") else "no"
        lines.append(f"| `{name}` | {gradient} | {batches(name)} | {compiled} | `tests/{test}` | {peers} |")
    lines += [
        "",
        "Points that are searched often are sorted once by `NeighborIndex` (SciPy `cKDTree`, scikit-learn "
        "`NearestNeighbors`, Open3D `NearestNeighborSearch`): its `knn`, `ball_query` and `radius_neighbors` give what "
        "the operations of these names give, bit for bit (`tests/functional/test_neighbor_index.py`).",
        "",
        "Alignment of clouds without partners is `pcdata.alignment.align_clouds` "
        "([alignment.md](alignment.md)), fusion "
        "`pcdata.TSDFVolume` ([fusion.md](fusion.md)), rendering of structures `pcdata.render` "
        "([rendering.md](rendering.md)), lenses [lenses.md](lenses.md).",
    ]
    return "\n".join(lines) + "\n"


@pytest.mark.skipif(why_unavailable("cpu") is not None, reason="the page tells what the compiled core serves")
def test_the_page_is_made_from_the_operations():
    assert (ROOT / "docs" / "operations.md").read_text(encoding="utf-8") == page()


def test_every_public_operation_is_on_the_page():
    assert PEERS.keys() == OPERATIONS.keys() & set(pcdata.functional.__all__)


def test_every_operation_of_the_page_exists_and_its_oracle_calls_it():
    for name, (test, _) in PEERS.items():
        assert name in pcdata.functional.__all__
        assert re.search(rf"\b{name}\(", (ROOT / "tests" / test).read_text(encoding="utf-8")), name


if __name__ == "__main__":
    print(page(), end="")
