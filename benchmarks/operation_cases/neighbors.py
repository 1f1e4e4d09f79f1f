"""Searches for neighbors and the distances between clouds: options beside SciPy, scikit-learn and Open3D."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from timing import Case, installed, same

import pcdata
from pcdata import functional as F

K = 16
RADIUS = 0.01  # metres


def cases(cloud: pcdata.PointCloud) -> Iterator[Case]:
    """All of this file."""
    points = cloud.points[::8].contiguous()
    yield from wide_cases(points)
    yield from index_cases(points)
    yield from radius_cases(points)
    yield from shape_cases(points)
    yield from metric_cases(points)


def wide_cases(points: torch.Tensor) -> Iterator[Case]:
    """The k nearest among more columns than three: points with colors, with normals too, and learned features."""
    some = points[::5].contiguous()
    count = len(some)
    generator = torch.Generator().manual_seed(0)
    bends = [some * scale + shift for scale, shift in ((7.0, 0.3), (19.0, 0.7), (31.0, 0.1))]
    colors, normals = bends[0].sin() * 0.1, bends[1].cos() * 0.1
    learned = torch.cat([some, *(bend.sin() for bend in bends)], 1)
    mixing = torch.randn(12, 32, generator=generator)
    tables = {
        3: some,
        6: torch.cat([some, colors], 1),
        9: torch.cat([some, colors, normals], 1),
        32: (learned @ mixing).tanh() + 0.05 * torch.randn(count, 32, generator=generator),
    }
    for width, table in tables.items():
        table = table.contiguous()
        array = table.numpy()
        if installed("scipy"):
            from scipy.spatial import cKDTree

            yield Case(
                f"kNN {K}, {width} columns", count, lambda table=table: F.knn(table, k=K), "SciPy cKDTree",
                lambda array=array: cKDTree(array).query(array, k=K, workers=-1)[0],
                lambda a, b: f"distances within {np.abs(a[1].numpy() - b).max():.0e}",
            )  # fmt: skip
        if installed("sklearn"):
            from sklearn.neighbors import NearestNeighbors

            yield Case(
                f"kNN {K}, {width} columns", count, lambda table=table: F.knn(table, k=K), "scikit-learn, brute force",
                lambda array=array: NearestNeighbors(n_neighbors=K, algorithm="brute").fit(array).kneighbors(array)[0],
                lambda a, b: f"distances within {np.abs(a[1].numpy() - b).max():.0e}",
            )  # fmt: skip
        if installed("open3d") and width > 3:
            import open3d as o3d

            def indexed(table: torch.Tensor = table) -> Any:
                search = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor(table.numpy()))
                search.knn_index()
                return search.knn_search(o3d.core.Tensor(table.numpy()), K)[1].sqrt().numpy()

            yield Case(
                f"kNN {K}, {width} columns", count, lambda table=table: F.knn(table, k=K), "Open3D tensor", indexed,
                lambda a, b: f"distances within {np.abs(a[1].numpy() - b).max():.0e}",
            )  # fmt: skip


def index_cases(points: torch.Tensor) -> Iterator[Case]:
    """Few queries at a time into points that were sorted once, as a planner or a tracker asks."""
    queries = (points[::97] + 0.003).contiguous()
    index = F.NeighborIndex(points)
    if installed("scipy"):
        from scipy.spatial import cKDTree

        tree, asked = cKDTree(points.numpy()), queries.numpy()
        yield Case(
            "kNN 16, few queries, sorted before", len(queries), lambda: index.knn(queries=queries, k=K),
            "SciPy cKDTree, built before", lambda: tree.query(asked, k=K, workers=-1),
            lambda a, b: f"distances within {np.abs(a[1].numpy() - b[0]).max():.0e}",
        )  # fmt: skip
    if installed("open3d"):
        import open3d as o3d

        array = points.double().numpy()
        tree_of_cloud = o3d.geometry.KDTreeFlann(o3d.geometry.PointCloud(o3d.utility.Vector3dVector(array)))

        def one_by_one() -> np.ndarray:
            return np.array([tree_of_cloud.search_knn_vector_3d(query, K)[2] for query in queries.double().numpy()])

        yield Case(
            "kNN 16, few queries, sorted before", len(queries), lambda: index.knn(queries=queries, k=K),
            "Open3D KDTreeFlann, one by one", one_by_one,
            lambda a, b: f"distances within {np.abs(a[1].numpy() - np.sqrt(b)).max():.0e}",
        )  # fmt: skip
        search = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor(points.numpy()))
        search.fixed_radius_index(RADIUS)
        yield Case(
            "all within 1 cm, few queries, sorted before", len(queries),
            lambda: index.radius_neighbors(queries=queries, radius=RADIUS), "Open3D tensor",
            lambda: search.fixed_radius_search(o3d.core.Tensor(queries.numpy()), RADIUS),
            lambda a, b: f"{len(a[0])} and {len(b[0].numpy())} neighbors",
        )  # fmt: skip


def radius_cases(points: torch.Tensor) -> Iterator[Case]:
    count, array = len(points), points.numpy()
    each = (points[:, 2] * RADIUS).clamp(min=0.002)
    if installed("scipy"):
        from scipy.spatial import cKDTree

        yield Case(
            "all neighbors, a radius per query", count, lambda: F.radius_neighbors(points, radius=each),
            "SciPy cKDTree, counts alone",
            lambda: cKDTree(array).query_ball_point(array, each.numpy(), workers=-1, return_length=True),
            lambda a, b: same(a[2].diff().numpy(), b),
        )  # fmt: skip
        yield Case(
            "32 nearest, a radius per query", count, lambda: F.ball_query(points, radius=each, max_neighbors=32),
            "SciPy cKDTree, one radius",
            lambda: cKDTree(array).query(array, k=32, distance_upper_bound=float(each.max()), workers=-1),
            lambda a, b: f"{int(a[2].sum())} neighbors of {int(np.isfinite(b[0]).sum())}",
        )  # fmt: skip
    if installed("open3d"):
        import open3d as o3d

        tensor = o3d.core.Tensor(array)

        def fixed() -> Any:
            search = o3d.core.nns.NearestNeighborSearch(tensor)
            search.fixed_radius_index(RADIUS)
            return search.fixed_radius_search(tensor, RADIUS)

        yield Case(
            "all neighbors within 1 cm", count, lambda: F.radius_neighbors(points, radius=RADIUS), "Open3D tensor",
            fixed, lambda a, b: f"{len(a[0])} and {len(b[0].numpy())} neighbors",
        )  # fmt: skip


def shape_cases(points: torch.Tensor) -> Iterator[Case]:
    count, array = len(points), points.double().numpy()

    def features() -> dict[str, torch.Tensor]:
        return F.shape_features(F.neighborhood_covariance(points, max_neighbors=30)[1])

    if installed("open3d"):
        import open3d as o3d

        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(array))

        def covariances() -> Any:
            cloud.estimate_covariances(o3d.geometry.KDTreeSearchParamKNN(30))
            return np.asarray(cloud.covariances)

        yield Case(
            "covariance of 30 neighbors", count, lambda: F.neighborhood_covariance(points, max_neighbors=30), "Open3D",
            covariances, lambda a, b: f"within {np.abs(a[1].numpy() - b).max():.0e} m2",
        )  # fmt: skip
    if installed("scipy"):
        from scipy.spatial import cKDTree

        def curvature() -> np.ndarray:
            around = array[cKDTree(array).query(array, k=30, workers=-1)[1]]
            offset = around - around.mean(1, keepdims=True)
            values = np.linalg.eigvalsh(offset.transpose(0, 2, 1) @ offset)
            return values[:, 0] / values.sum(1)

        yield Case(
            "curvature and 7 features, 30 neighbors", count, features, "SciPy and NumPy, curvature alone", curvature,
            lambda a, b: f"within {np.abs(a['surface_variation'].numpy() - b).max():.0e}",
        )  # fmt: skip


def metric_cases(points: torch.Tensor) -> Iterator[Case]:
    half = len(points) // 2
    a, b = points[:half].contiguous(), (points[half:] + 0.001).contiguous()
    count = len(points)
    normals_a, normals_b = F.estimate_normals(a), F.estimate_normals(b)
    x, y = a.double().numpy(), b.double().numpy()
    if installed("scipy"):
        from scipy.spatial import cKDTree

        def to_nearest(one: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return cKDTree(other).query(one, workers=-1)

        def within(ours: Any, theirs: Any) -> str:
            value = float(np.asarray(ours).reshape(-1)[0])
            return f"{abs(value - float(theirs)) / max(float(theirs), 1e-30):.0e} of it apart"

        yield Case(
            "Chamfer, both sides", count, lambda: F.chamfer_distance(a, None, b, None), "SciPy cKDTree",
            lambda: np.square(to_nearest(x, y)[0]).mean() + np.square(to_nearest(y, x)[0]).mean(), within,
        )  # fmt: skip
        yield Case(
            "Chamfer, one side", count, lambda: F.chamfer_distance(a, None, b, None, sides="a_to_b"), "SciPy cKDTree",
            lambda: np.square(to_nearest(x, y)[0]).mean(), within,
        )  # fmt: skip
        yield Case(
            "Chamfer, L1", count,
            lambda: F.chamfer_distance(a, None, b, None, norm="l1", squared=False, sides="a_to_b"),
            "SciPy cKDTree", lambda: cKDTree(y).query(x, p=1, workers=-1)[0].mean(), within,
        )  # fmt: skip

        def with_normals() -> Any:
            distance, index = to_nearest(x, y)
            turned = 1 - np.abs((normals_a.numpy() * normals_b.numpy()[index]).sum(1))
            return np.square(distance).mean() + 0 * turned.mean()

        yield Case(
            "Chamfer with normals", count,
            lambda: F.chamfer_distance(a, None, b, None, normals_a=normals_a, normals_b=normals_b, sides="a_to_b"),
            "SciPy cKDTree", with_normals, within,
        )  # fmt: skip

        def ours_with_gradient() -> torch.Tensor:
            leaf = a.clone().requires_grad_()
            F.chamfer_distance(leaf, None, b, None).sum().backward()
            return leaf.grad

        def theirs_with_gradient() -> torch.Tensor:
            leaf = a.clone().requires_grad_()
            forth, back = to_nearest(x, y)[1], to_nearest(y, x)[1]
            loss = (leaf - b[forth]).square().sum(1).mean() + (leaf[back] - b).square().sum(1).mean()
            loss.backward()
            return leaf.grad

        yield Case(
            "Chamfer and its gradient", count, ours_with_gradient, "SciPy cKDTree and torch", theirs_with_gradient,
            lambda ours, theirs: f"gradients within {float((ours - theirs).abs().max()):.0e}",
        )  # fmt: skip

        def hausdorff() -> Any:
            return to_nearest(x, y)[0].max()

        yield Case(
            "Hausdorff distance", count, lambda: F.hausdorff_distance(a, None, b, None), "SciPy cKDTree, one way",
            hausdorff, within,
        )  # fmt: skip
        yield Case(
            "F-score at 1 mm", count, lambda: F.f_score(a, None, b, None, threshold=0.001)[:, 1], "SciPy cKDTree",
            lambda: (to_nearest(x, y)[0] < 0.001).mean() + 0 * (to_nearest(y, x)[0] < 0.001).mean(), within,
        )  # fmt: skip
    if installed("open3d"):
        import open3d as o3d

        one, other = (o3d.geometry.PointCloud(o3d.utility.Vector3dVector(array)) for array in (x, y))
        yield Case(
            "Hausdorff distance", count, lambda: F.hausdorff_distance(a, None, b, None), "Open3D, one way",
            lambda: max(one.compute_point_cloud_distance(other)),
            lambda ours, theirs: f"{abs(float(ours[0, 0]) - theirs):.0e} m apart",
        )  # fmt: skip
