"""docs/operations.md: what each operation on clouds gives, and what neighboring libraries call it; made from here.

``python -m tests.functional.test_peers > docs/operations.md`` writes the page anew.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import pcdata.functional
from pcdata.contracts.dispatch import OPERATIONS, why_unavailable

ROOT = Path(__file__).parents[2]
# Operation -> the test that holds it to an oracle, and what others call it.
PEERS = {
    "ball_query": ("functional/test_neighbors.py", "PyTorch3D `ops.ball_query`; Open3D `hybrid_search`"),
    "box_mask": ("functional/test_selection.py", "Open3D `crop`; PCL `CropBox`"),
    "chamfer_distance": ("functional/test_metrics.py", "PyTorch3D `loss.chamfer_distance`"),
    "core_point_mask": ("functional/test_clusters.py", "scikit-learn `DBSCAN.core_sample_indices_`"),
    "dbscan": ("functional/test_clusters.py", "Open3D `cluster_dbscan`; scikit-learn `DBSCAN`"),
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
    "hausdorff_distance": ("functional/test_metrics.py", "SciPy `directed_hausdorff`"),
    "knn": ("functional/test_neighbors.py", "torch-cluster `knn`; PyTorch3D `knn_points`; Open3D `knn_search`"),
    "neighborhood_covariance": (
        "functional/test_neighborhoods.py",
        "Open3D `estimate_covariances`; PyTorch3D `estimate_pointcloud_local_coord_frames`",
    ),
    "polygon_mask": (
        "functional/test_selection.py",
        "Open3D `SelectionPolygonVolume`; PCL `ExtractPolygonalPrismData`",
    ),
    "radius_neighbors": ("functional/test_neighbors.py", "torch-cluster `radius`; Open3D `fixed_radius_search`"),
    "radius_outlier_mask": ("functional/test_outliers.py", "Open3D `remove_radius_outlier`"),
    "ransac_plane": ("functional/test_planes.py", "Open3D `segment_plane`"),
    "statistical_outlier_mask": ("functional/test_outliers.py", "Open3D `remove_statistical_outlier`"),
    "voxel_downsample": ("functional/test_voxels.py", "Open3D `voxel_down_sample`; PyG `GridSampling`"),
}


def page() -> str:
    why_unavailable("cpu")  # loads the kernels
    lines = [
        "# Operations on clouds, and what others call them",
        "",
        "Made by `tests/functional/test_peers.py` from the registered operations; all are called as "
        "`pcdata.functional.NAME` and take ragged batches (`polygon_mask`: each point by itself). Compiled "
        "bodies know three coordinates and Open3D's voxel grid; all else runs in torch.",
        "",
        "| operation | gradients | compiled | held to an oracle in | others call it |",
        "|---|---|---|---|---|",
    ]
    for name, (test, peers) in sorted(PEERS.items()):
        operation = OPERATIONS[name]
        gradient = "yes" if operation.gradient else "no"
        compiled = "yes" if operation.serves("cpu") else "no"
        lines.append(f"| `{name}` | {gradient} | {compiled} | `tests/{test}` | {peers} |")
    return "\n".join(lines) + "\n"


@pytest.mark.skipif(why_unavailable("cpu") is not None, reason="the page tells what the compiled core serves")
def test_the_page_is_made_from_the_operations():
    assert (ROOT / "docs" / "operations.md").read_text(encoding="utf-8") == page()


def test_every_operation_of_the_page_exists_and_its_oracle_calls_it():
    for name, (test, _) in PEERS.items():
        assert name in pcdata.functional.__all__
        assert re.search(rf"\b{name}\(", (ROOT / "tests" / test).read_text(encoding="utf-8")), name


if __name__ == "__main__":
    print(page(), end="")
