"""The operations that existed first, on one 1280x720 frame: Open3D, fpsample, torch-cluster and SciPy beside them.

Parameters are equal, and Open3D's RANSAC may not stop early (probability 1.0). "Open3D" is its legacy interface,
"Open3D tensor" the newer one, where it has the operation.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from timing import Case, installed, same

import pcdata
from pcdata import functional as F

PEERS = ("open3d", "fpsample", "torch_cluster", "scipy")


def cases(cloud: pcdata.PointCloud) -> Iterator[Case]:
    """Every operation beside every installed peer that has it."""
    points, grid = cloud.points.contiguous(), cloud.image_grid()
    shuffled = points[torch.randperm(len(points), generator=torch.Generator().manual_seed(0))].contiguous()
    above = points[~F.ransac_plane(points)[1]].contiguous()
    if installed("open3d"):
        yield from open3d_cases(points, shuffled, above, grid)
        yield from open3d_tensor_cases(points, above, grid)
    yield from sampling_cases(points, above)
    if installed("scipy"):
        from scipy.spatial import cKDTree

        yield Case(
            "kNN, 20", len(points), lambda: F.knn(points, k=20), "SciPy cKDTree",
            lambda: cKDTree(points.numpy()).query(points.numpy(), k=20, workers=-1),
            lambda a, b: f"distances within {np.abs(a[1].numpy() - b[0]).max():.0e} m",
        )  # fmt: skip


def open3d_cases(points: torch.Tensor, shuffled: torch.Tensor, above: torch.Tensor, grid: Any) -> Iterator[Case]:
    import open3d as o3d

    def legacy(tensor: torch.Tensor) -> Any:
        return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(tensor.double().numpy()))

    count, cloud, mixed, standing = len(points), legacy(points), legacy(shuffled), legacy(above)

    def masks(ours: torch.Tensor, theirs: Any) -> str:
        kept = np.zeros(count, dtype=bool)
        kept[np.asarray(theirs[1])] = True
        return same(kept, ~ours.numpy())

    def plane(ours: Any, theirs: Any) -> str:
        normal = np.array(theirs[0][:3]) / np.linalg.norm(theirs[0][:3])
        angle = np.degrees(np.arccos(np.clip(abs(normal @ ours[0][0, :3].double().numpy()), 0, 1)))
        return f"normals {angle:.3f} degrees apart"

    def voxels(ours: Any, theirs: Any) -> str:
        a, b = ours[0].double().numpy(), np.asarray(theirs.points)
        if len(a) != len(b):
            return f"{len(a)} and {len(b)} voxels"
        return f"equal within {max(legacy(ours[0]).compute_point_cloud_distance(theirs)):.0e} m"

    def normals(ours: torch.Tensor, theirs: Any) -> str:
        cosine = np.abs((ours.double().numpy() * np.asarray(theirs)).sum(1)).clip(0, 1)
        return f"{100 * (np.degrees(np.arccos(cosine)) < 0.5).mean():.2f} % within 0.5 degrees"

    def their_normals(one: Any) -> Any:
        one.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=0.02, max_nn=30))
        return one.normals

    variants = [
        ("organized", points, cloud, grid),
        ("unorganized", points, cloud, None),
        ("shuffled", shuffled, mixed, None),
    ]
    for variant, p, c, g in variants:
        yield Case(
            f"statistical outliers 20, 2.0, {variant}", count, lambda p=p, g=g: F.statistical_outlier_mask(p, grid=g),
            "Open3D", lambda c=c: c.remove_statistical_outlier(20, 2.0), masks,
        )  # fmt: skip
        yield Case(
            f"radius outliers 5, 1 cm, {variant}", count, lambda p=p, g=g: F.radius_outlier_mask(p, grid=g),
            "Open3D", lambda c=c: c.remove_radius_outlier(5, 0.01), masks,
        )  # fmt: skip
        yield Case(
            f"normals 2 cm, 30, {variant}", count, lambda p=p, g=g: F.estimate_normals(p, grid=g),
            "Open3D", lambda c=c: their_normals(c), normals,
        )  # fmt: skip
    yield Case(
        "plane 1 cm, 1000 hypotheses", count, lambda: F.ransac_plane(points), "Open3D",
        lambda: cloud.segment_plane(0.01, 3, 1000, probability=1.0), plane,
    )  # fmt: skip
    yield Case(
        "DBSCAN 2 cm, 50", len(above), lambda: F.dbscan(above), "Open3D", lambda: standing.cluster_dbscan(0.02, 50),
        lambda a, b: same(a.numpy(), np.asarray(b)),
    )  # fmt: skip
    yield Case(
        "voxels 3 mm", count, lambda: F.voxel_downsample(points, voxel_size=0.003), "Open3D",
        lambda: cloud.voxel_down_sample(0.003), voxels,
    )  # fmt: skip


def open3d_tensor_cases(points: torch.Tensor, above: torch.Tensor, grid: Any) -> Iterator[Case]:
    import open3d as o3d

    def tensor(values: torch.Tensor) -> Any:
        return o3d.t.geometry.PointCloud(o3d.core.Tensor(values.numpy()))

    count, cloud, standing = len(points), tensor(points), tensor(above)

    def masks(ours: torch.Tensor, theirs: Any) -> str:
        return same(theirs[1].numpy(), ~ours.numpy())

    def normals(ours: torch.Tensor, theirs: Any) -> str:
        cosine = np.abs((ours.numpy() * theirs.numpy()).sum(1)).clip(0, 1)
        return f"{100 * (np.degrees(np.arccos(cosine)) < 0.5).mean():.2f} % within 0.5 degrees"

    def their_normals() -> Any:
        cloud.estimate_normals(max_nn=30, radius=0.02)
        return cloud.point.normals

    yield Case(
        "statistical outliers 20, 2.0, organized", count, lambda: F.statistical_outlier_mask(points, grid=grid),
        "Open3D tensor", lambda: cloud.remove_statistical_outliers(20, 2.0), masks,
    )  # fmt: skip
    yield Case(
        "radius outliers 5, 1 cm, organized", count, lambda: F.radius_outlier_mask(points, grid=grid),
        "Open3D tensor", lambda: cloud.remove_radius_outliers(5, 0.01), masks,
    )  # fmt: skip
    yield Case(
        "normals 2 cm, 30, organized", count, lambda: F.estimate_normals(points, grid=grid),
        "Open3D tensor", their_normals, normals,
    )  # fmt: skip
    yield Case(
        "voxels 3 mm", count, lambda: F.voxel_downsample(points, voxel_size=0.003),
        "Open3D tensor", lambda: cloud.voxel_down_sample(0.003),
        lambda a, b: f"{len(a[0])} and {len(b.point.positions)} voxels (its grid starts elsewhere)",
    )  # fmt: skip
    yield Case(
        "DBSCAN 2 cm, 50", len(above), lambda: F.dbscan(above), "Open3D tensor",
        lambda: standing.cluster_dbscan(0.02, 50), lambda a, b: same(a.numpy(), b.numpy()),
    )  # fmt: skip


def sampling_cases(points: torch.Tensor, above: torch.Tensor) -> Iterator[Case]:
    for tensor, counts in ((points, (1024, 20000)), (above, (1024, 4096))):
        for count in counts:
            yield from farthest_point_cases(tensor, count)


def farthest_point_cases(points: torch.Tensor, count: int) -> Iterator[Case]:
    def ours() -> torch.Tensor:
        return F.farthest_point_sample(points, num_samples=count)[0]

    def compare(a: torch.Tensor, b: Any) -> str:
        return same_picks(points, count, a.numpy(), np.asarray(b, dtype=np.int64))

    name = f"farthest points, {count}"
    if installed("fpsample"):
        import fpsample

        def by_fpsample() -> Any:
            return fpsample.bucket_fps_kdline_sampling(points.numpy(), count, h=9, start_idx=0)

        yield Case(name, len(points), ours, "fpsample", by_fpsample, compare)
    if installed("torch_cluster") and count < 20000:  # minutes there
        import torch_cluster

        def by_torch_cluster() -> Any:
            return torch_cluster.fps(points, ratio=(count - 0.5) / len(points), random_start=False)

        yield Case(name, len(points), ours, "torch-cluster", by_torch_cluster, compare)


def same_picks(points: torch.Tensor, count: int, ours: np.ndarray, theirs: np.ndarray) -> str:
    """Compare from their first point on, and up to the first tie: fpsample does not always start where it is told."""
    note = ""
    if theirs[0] != 0:
        order = np.arange(len(points))
        order[[0, theirs[0]]] = order[[theirs[0], 0]]
        ours = order[F.farthest_point_sample(points[torch.from_numpy(order)], num_samples=count)[0].numpy()]
        note = f" (both from point {theirs[0]})"
    different = np.flatnonzero(ours != theirs)
    if len(different) == 0:
        return "identical" + note
    first = int(different[0])
    picked, rivals = points.numpy()[ours[:first]], points.numpy()[[ours[first], theirs[first]]]
    gap = [np.square(picked - rival).sum(1, dtype=np.float32).min() for rival in rivals]
    return f"identical up to a tie at pick {first}{note}" if gap[0] == gap[1] else f"differ from pick {first} on{note}"
