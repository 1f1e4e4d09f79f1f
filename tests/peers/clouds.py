"""Calls of libraries of point clouds: Open3D, PyTorch3D, torch-cluster, PyG, PCL, MMDetection3D."""

from __future__ import annotations

import numpy as np

from tests.peers.calls import Call, Names, Section, both_signs, by, in_order, rows_of, same


def _points(cloud: object) -> object:
    return np.asarray(cloud.points)  # type: ignore[attr-defined]


def _their_normals(_: object, ours: object, seen: Names) -> None:
    by(both_signs, both_signs, 1e-4)(np.asarray(seen["pcd"].normals), ours, seen)


def _their_oriented_normals(_: object, ours: object, seen: Names) -> None:
    same()(np.asarray(seen["pcd"].normals), ours, seen)


OPEN3D = Section(
    "Open3D",
    "`pcd` is an `o3d.geometry.PointCloud` of the points, `nns` a `NearestNeighborSearch` with its index made. "
    "`pcdata.to_open3d` and `pcdata.from_open3d` hand clouds, meshes, cameras and captures over, without a copy where "
    "that can be: [exchange.md](exchange.md).",
    (
        Call(
            "pcd.voxel_down_sample(0.05)",
            "F.voxel_downsample(points, voxel_size=0.05)[0]",
            "the same grid; voxels come in the order of their first rows; `origin` states another grid",
            by(lambda a: in_order(_points(a)), in_order, 1e-4),
        ),
        Call(
            "pcd.uniform_down_sample(3)",
            "cloud.select(torch.arange(0, 200, 3), F.ptr_from_counts([67]))",
            "any rows, in any order, of every field",
            by(_points, lambda b: b.points),
        ),
        Call(
            "pcd.random_down_sample(0.5)",
            "pcdata.RandomPointDropout(low=0.5, high=0.5)(cloud, generator=generator)",
            "the part that is dropped; seeded per sample",
            by(lambda a: len(a.points), lambda b: b.num_points),
        ),
        Call(
            "pcd.farthest_point_down_sample(16)",
            "points[F.farthest_point_sample(points, num_samples=16)[0]]",
            "rows, in the order in which they were picked",
            by(lambda a: in_order(_points(a)), in_order),
        ),
        Call(
            "pcd.remove_statistical_outlier(20, 2.0)[1]",
            "~F.statistical_outlier_mask(points, num_neighbors=20, std_ratio=2.0)",
            "a mask of the outliers against the rows that stay",
            by(np.asarray, rows_of),
        ),
        Call(
            "pcd.remove_radius_outlier(5, 0.05)[1]",
            "~F.radius_outlier_mask(points, min_neighbors=5, radius=0.05)",
            "likewise",
            by(np.asarray, rows_of),
        ),
        Call(
            "pcd.remove_duplicated_points()",
            "points[~F.duplicate_mask(points)]",
            "",
            by(_points, lambda b: b),
        ),
        Call(
            "pcd.remove_non_finite_points()",
            "pcdata.DropNonFinite()(cloud).points",
            "elsewhere such points are an error, and none is dropped silently",
            by(_points, lambda b: b),
        ),
        Call(
            "pcd.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(0.05, 30))",
            "F.estimate_normals(points, radius=0.05, max_neighbors=30)",
            "the last component that is not 0 is positive; the sign there is arbitrary",
            _their_normals,
        ),
        Call(
            "pcd.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(12))",
            "F.estimate_normals(points, radius=None, max_neighbors=12)",
            "likewise; the radius alone (`KDTreeSearchParamRadius`): `max_neighbors=len(points)`",
            _their_normals,
        ),
        Call(
            "pcd.orient_normals_towards_camera_location([0, 0, 0])",
            "F.orient_normals(points, normals, torch.zeros(3))",
            "one viewpoint, or one per point",
            _their_oriented_normals,
        ),
        Call(
            "pcd.orient_normals_to_align_with_direction([0, 0, 1])",
            "F.orient_normals(points, normals, points + torch.tensor([0.0, 0.0, 1.0]))",
            "a viewpoint one step along the direction",
            _their_oriented_normals,
        ),
        Call(
            "pcd.cluster_dbscan(eps=0.03, min_points=4)",
            "F.dbscan(points, eps=0.03, min_points=4)",
            "label for label, border points too",
            same(),
        ),
        Call(
            "pcd.segment_plane(0.01, 3, 1000)",
            "F.ransac_plane(points, distance=0.01, num_hypotheses=1000)",
            "one plane per cloud and a mask; refitted to its inliers, seeded, its side is stated",
            by(lambda a: np.abs(a[0]), lambda b: b[0].abs(), 0.05),
        ),
        Call(
            "pcd.crop(o3d.geometry.AxisAlignedBoundingBox([0, 0, 0], [0.15, 0.15, 0.15]))",
            "points[F.box_mask(points, lower=(0, 0, 0), upper=(0.15, 0.15, 0.15))]",
            "faces included in both, rounded to float32 here; a box for each cloud",
            by(_points, lambda b: b),
        ),
        Call(
            "pcd.crop(o3d.geometry.OrientedBoundingBox([0.1, 0.1, 0.1], pose[:3, :3].numpy(), [0.1, 0.15, 0.1]))",
            "pcdata.CropWorkspace(frame='base', lower=(-0.05, -0.075, -0.05), upper=(0.05, 0.075, 0.05), "
            "frame_from_box=tuple(map(tuple, pose.tolist())))(cloud).points",
            "corners in the box's own axes and its pose, not center and extent",
            by(lambda a: in_order(_points(a)), in_order, 1e-4),
        ),
        Call(
            "pcd.compute_point_cloud_distance(other_pcd)",
            "F.knn(others, queries=points, k=1)[1]",
            "from every query to the nearest point",
            same(),
        ),
        Call(
            "pcd.compute_mahalanobis_distance()",
            "((points - points.mean(0)).double() @ torch.linalg.inv(torch.cov(points.double().T, correction=0)) "
            "* (points - points.mean(0))).sum(1).sqrt()",
            "of neighborhoods: `F.neighborhood_covariance`",
            same(1e-4),
        ),
        Call(
            "pcd.get_minimal_oriented_bounding_box()",
            "F.smallest_box(points)",
            "pose and edges, the longest first; of boxes that stand upright: `F.smallest_rectangle(points[:, :2])`; "
            "both of objects: `pcdata.transforms.describe_objects`",
            by(lambda a: float(np.cbrt(np.prod(a.extent))), lambda b: float(b[1].prod()) ** (1 / 3), 0.002),
        ),
        Call(
            "pcd.compute_convex_hull()[0].get_volume()",
            "F.convex_hull_3d(points).volume",
            "with rows of the corners and of the triangles, and the area",
            by(float, float, 1e-6),
        ),
        Call(
            "pcd.compute_nearest_neighbor_distance()",
            "F.knn(points, k=1, exclude_self=True)[1]",
            "infinity, not 0, for a point alone",
            same(),
        ),
        Call(
            "o3d.geometry.KDTreeFlann(pcd).search_knn_vector_3d(queries[0].double().numpy(), 8)",
            "F.NeighborIndex(points).knn(queries=queries, k=8)",
            "sorted once, searched often; all queries of a call at once, distances and not their squares",
            by(lambda a: np.asarray(a[1]), lambda b: b[0][0]),
        ),
        Call(
            "nns.knn_search(o3d.core.Tensor(queries.numpy()), 8)",
            "F.knn(points, queries=queries, k=8)",
            "distances, not their squares",
            by(lambda a: a[0].numpy(), lambda b: b[0]),
        ),
        Call(
            "nns.fixed_radius_search(o3d.core.Tensor(queries.numpy()), 0.05)",
            "F.radius_neighbors(points, queries=queries, radius=0.05)",
            "distances, not their squares; nearest first",
            by(lambda a: a[2].numpy(), lambda b: b[2]),
        ),
        Call(
            "nns.hybrid_search(o3d.core.Tensor(queries.numpy()), 0.05, 8)",
            "F.ball_query(points, queries=queries, radius=0.05, max_neighbors=8)",
            "padded with row N and infinity, not -1 and 0; distances, not their squares",
            by(lambda a: np.where(a[0].numpy() < 0, 200, a[0].numpy()), lambda b: b[0]),
        ),
        Call(
            "pcd.estimate_covariances(o3d.geometry.KDTreeSearchParamKNN(12))",
            "F.neighborhood_covariance(points, max_neighbors=12)[1]",
            "mean and number of neighbors beside it; gradients",
            lambda a, b, seen: same(1e-4)(np.asarray(seen["pcd"].covariances), b, seen),
        ),
        Call(
            "o3d.geometry.PointCloud.create_from_depth_image(o3d.geometry.Image(depth[0].numpy()), intrinsic, "
            "depth_scale=1.0, depth_trunc=100.0)",
            "F.deproject_depth(depth[:1], K[:1])[0]",
            "all views at once; metres; limits of depth are a step of their own (`MaskDepth`)",
            by(_points, lambda b: b, 1e-5),
        ),
        Call(
            "o3d.geometry.PointCloud.create_from_depth_image(o3d.geometry.Image(depth[0].numpy()), intrinsic, "
            "np.linalg.inv(frame.world_from_camera[0].numpy()), depth_scale=1.0, depth_trunc=100.0)",
            "pcdata.ToFrame(frame='base')(pcdata.Deproject()(frame)).unbatch()[0].points",
            "the extrinsic there is camera from world",
            by(_points, lambda b: b, 1e-5),
        ),
        Call(
            "pcd.transform(pose.numpy())",
            "cloud.transformed(pose.repeat(1, 1, 1)).points",
            "one matrix per cloud; normals, poses and viewpoints follow",
            by(_points, lambda b: b, 1e-5),
        ),
        Call(
            "o3d.pipelines.registration.TransformationEstimationPointToPoint().compute_transformation(pcd, moved_pcd, "
            "pairs)",
            "F.fit_paired_points(points, moved).matrix",
            "partners by row; `weights`, `with_scale`; one cloud or thousands",
            same(1e-4),
        ),
        Call(
            "o3d.pipelines.registration.registration_icp(surface_pcd, shifted_pcd, 0.02, np.eye(4), "
            "o3d.pipelines.registration.TransformationEstimationPointToPlane())",
            "pcdata.alignment.align_clouds(surface, surface + 0.003).found.target_from_source",
            "normals are found; `is_trusted` judges the result, which is not changed in place",
            by(lambda a: a.transformation, lambda b: b, 1e-3),
        ),
        Call(
            "np.stack([voxels.get_voxel(p) for p in points.double().numpy()])",
            "F.voxel_cells(points, 0.05, (points.amin(0) - 0.025).tolist())",
            "the origin is stated; the grid of `voxels` starts half an edge below the lowest corner",
            same(0),
        ),
        Call(
            "sorted(row for row in pcd.hidden_point_removal([0.1, 0.1, 1.0], 50.0)[1] if row < 200)",
            "torch.nonzero(~F.hidden_point_mask(points, viewpoint=(0.1, 0.1, 1.0), radius_factor=50.0 / "
            "float((points.double() - torch.tensor([0.1, 0.1, 1.0])).norm(dim=1).max())))[:, 0]",
            "the radius as a multiple of the distance to the farthest point; hidden points are marked; a viewpoint for "
            "each cloud; as a step: `RemoveHiddenPoints`",
            same(0),
        ),
        Call(
            "other_pcd.select_by_index(list(range(10)), invert=True)",
            "others[10:]",
            "rows and masks of torch; `cloud.select` for all fields",
            by(_points, lambda b: b),
        ),
    ),
    {"o3d": "open3d"},
    """
def _cloud(rows):
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(rows.double().numpy()))
pcd, other_pcd, moved_pcd = _cloud(points), _cloud(others), _cloud(moved)
pcd.normals = o3d.utility.Vector3dVector(normals.double().numpy())
surface_pcd, shifted_pcd = _cloud(surface), _cloud(surface + 0.003)
shifted_pcd.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(20))
pairs = o3d.utility.Vector2iVector(np.stack([np.arange(200)] * 2, 1))
voxels = o3d.geometry.VoxelGrid.create_from_point_cloud(pcd, 0.05)
nns = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor(points.numpy()))
nns.knn_index(), nns.fixed_radius_index(0.05), nns.hybrid_index(0.05)
fx, fy, cx, cy = K[0, 0, 0], K[0, 1, 1], K[0, 0, 2], K[0, 1, 2]
intrinsic = o3d.camera.PinholeCameraIntrinsic(32, 24, float(fx), float(fy), float(cx), float(cy))
""",
)

PYTORCH3D = Section(
    "PyTorch3D",
    "Padded batches (B, P, 3) with lengths become packed ones: `pcdata.PointCloud.padded()` and `from_padded` turn one "
    "into the other. PyTorch3D multiplies row vectors (`X @ R + T`): its `R` is the transpose of ours. Its "
    "cameras look "
    "along +z with x to the left and y up.",
    (
        Call(
            "knn_points(queries, points, K=8)",
            "F.knn(points, ptr, queries=queries, queries_ptr=queries_ptr, k=8)",
            "the cloud that is searched comes first; distances, not their squares; (index, distance)",
        ),
        Call(
            "knn_gather(features, idx)",
            "features[F.knn(points, k=8)[0]]",
            "rows of the packed batch; where a cloud has fewer than k points, row N raises instead of gathering row 0",
        ),
        Call(
            "ball_query(queries, points, K=8, radius=0.05)",
            "F.ball_query(points, ptr, queries=queries, queries_ptr=queries_ptr, radius=0.05, max_neighbors=8)",
            "the nearest 8, not the first 8; padded with row N and infinity, not -1 and 0",
        ),
        Call(
            "sample_farthest_points(points, K=16)",
            "F.farthest_point_sample(points, ptr, num_samples=16)",
            "rows and `ptr`; a cloud that is too small is an error, not padded with -1 "
            "(`FarthestPointSample(if_short=)` "
            "says what to do); `random_start_point=True` is `seeds=`",
        ),
        Call(
            "chamfer_distance(points, others)",
            "F.chamfer_distance(points, None, others, None)",
            "one number per cloud, not the mean of the batch; sums over points are means times counts",
        ),
        Call(
            "chamfer_distance(points, others, single_directional=True, norm=1)",
            "F.chamfer_distance(points, None, others, None, sides='a_to_b', norm='l1', squared=False)",
            "one way",
        ),
        Call(
            "chamfer_distance(points, others, x_normals=normals, y_normals=other_normals)",
            "F.chamfer_distance(points, None, others, None, normals_a=normals, normals_b=other_normals)",
            "both losses as columns (B, 2)",
        ),
        Call(
            "chamfer_distance(points, others, x_normals=normals, y_normals=other_normals, abs_cosine=False)",
            "F.chamfer_distance(points, None, others, None, normals_a=normals, normals_b=other_normals, "
            "abs_cosine=False)",
            "likewise",
        ),
        Call(
            "chamfer_distance(points, others, batch_reduction='sum', point_reduction='sum')",
            "200 * F.chamfer_distance(points, None, others, None, sides='a_to_b') "
            "+ 150 * F.chamfer_distance(points, None, others, None, sides='b_to_a')",
            "means times the numbers of points",
        ),
        Call("knn_points(queries, points, K=8, norm=1)", "F.knn(points, queries=queries, k=8, norm='l1')", ""),
        Call(
            "chamfer_distance(points, others, point_reduction=None)",
            "F.knn(others, queries=points, k=1)[1] ** 2",
            "per point, one way",
        ),
        Call(
            "chamfer_distance(points, others, point_reduction='max')",
            "F.hausdorff_distance(points, None, others, None) ** 2",
            "both ways as columns",
        ),
        Call(
            "corresponding_points_alignment(points, moved, weights, estimate_scale=True)",
            "F.fit_paired_points(points, moved, weights=weights, with_scale=True)",
            "any number of columns; 4x4 for column vectors, scale inside; never a reflection; an undetermined "
            "rotation is an error",
        ),
        Call(
            "iterative_closest_point(points, moved, estimate_scale=True)",
            "F.iterate_closest_points(points, points + 0.003, ptr, ptr, with_scale=True)",
            "a ragged batch in one call; 4x4 for column vectors, scale inside; `max_distance` of partners",
        ),
        Call(
            "iterative_closest_point(points, moved)",
            "pcdata.alignment.align_clouds(surface, surface + 0.003, method='point_to_point')",
            "one pair of clouds; `is_trusted`",
        ),
        Call(
            "estimate_pointcloud_normals(points, neighborhood_size=30)",
            "F.estimate_normals(points, radius=None, max_neighbors=30)",
            "no gradient; the sign by a rule, `F.orient_normals` by a viewpoint",
        ),
        Call(
            "estimate_pointcloud_local_coord_frames(points, neighborhood_size=30)",
            "torch.linalg.eigh(F.neighborhood_covariance(points, max_neighbors=30)[1])",
            "curvatures and frames; gradients; signs are not made to agree",
        ),
        Call(
            "Pointclouds(points=[a, b]).points_packed()",
            "pcdata.PointCloud.cat([cloud, cloud]).points",
            "`ptr` beside it; `unbatch()` gives the list",
        ),
        Call(
            "Pointclouds(points=[a, b]).points_padded()",
            "pcdata.PointCloud.cat([cloud, cloud]).padded().points",
            "`mask` beside it",
        ),
        Call(
            "PointsRasterizer(cameras, PointsRasterizationSettings(radius=0.01))(clouds).zbuf",
            "F.render_points(points + 0.5, intrinsics=K[:1], size=(24, 32), point_size=0.02)",
            "size in metres, not in the screen's units; the point in front alone; 0 where nothing is, not -1",
        ),
        Call(
            "cameras_from_opencv_projection(R, tvec, camera_matrix, image_size)",
            "pcdata.Camera.pinhole(fx=20.0, fy=20.0, cx=15.5, cy=11.5, size=(24, 32))",
            "OpenCV's axes; captures of other conventions: `--kind convention`",
        ),
    ),
)

TORCH_CLUSTER = Section(
    "torch-cluster",
    "",
    (
        Call(
            "fps(points, batch, ratio=0.25, random_start=False)",
            "F.farthest_point_sample(points, F.ptr_from_counts(torch.bincount(batch)), ratio=0.25)[0]",
            "`random_start=True` (their default) is `seeds=`, the same alone or in a batch",
            same(),
        ),
        Call(
            "knn(points, queries, 8, batch, queries_batch)",
            "F.knn(points, ptr, queries=queries, queries_ptr=queries_ptr, k=8)[0]",
            "a table (Q, k) with distances, not pairs (2, E)",
            by(lambda a: in_order(a[1]), lambda b: in_order(b.flatten())),
        ),
        Call(
            "knn_graph(points, k=6, batch=batch, loop=False)",
            "F.knn(points, ptr, k=6, exclude_self=True)[0]",
            "pairs: `torch.stack([index.flatten(), torch.arange(N).repeat_interleave(k)])`",
            by(lambda a: in_order(a[0]), lambda b: in_order(b.flatten())),
        ),
        Call(
            "radius(points, queries, 0.05, batch, queries_batch, max_num_neighbors=1000)",
            "F.radius_neighbors(points, ptr, queries=queries, queries_ptr=queries_ptr, radius=0.05)[0]",
            "compressed rows; all of them, or the nearest `max_neighbors` by `F.ball_query`, never the first ones met",
            by(lambda a: in_order(a[1]), in_order),
        ),
        Call(
            "radius_graph(points, r=0.05, batch=batch, loop=False, max_num_neighbors=1000)",
            "F.radius_neighbors(points, ptr, radius=0.05, exclude_self=True)[0]",
            "likewise",
            by(lambda a: in_order(a[0]), in_order),
        ),
        Call(
            "nearest(points, queries, batch, queries_batch)",
            "F.knn(queries, queries_ptr, queries=points, queries_ptr=ptr, k=1)[0]",
            "batch and one column",
            same(),
        ),
        Call(
            "grid_cluster(points, torch.tensor([0.05, 0.05, 0.05]))",
            "F.voxel_downsample(points, voxel_size=0.05, origin=points.amin(0))[2]",
            "voxels are numbered by their first row, none is empty; two columns: append one of zeros",
            by(lambda a: len(a.unique()), lambda b: len(b.unique())),
        ),
    ),
    {"torch_cluster": "torch_cluster"},
    "from torch_cluster import fps, grid_cluster, knn, knn_graph, nearest, radius, radius_graph",
)

PYG = Section(
    "PyTorch Geometric",
    "A `Data` with `pos` and `batch` is a `pcdata.PointCloud` with `points` and `ptr`; `pcdata.to_pyg` and "
    "`pcdata.from_pyg` turn one into the other: [exchange.md](exchange.md).",
    (
        Call("Center()(data)", "pcdata.Center()(cloud)", "each cloud of a batch by itself"),
        Call(
            "NormalizeScale()(data)", "pcdata.NormalizeUnitSphere()(cloud)", "farthest point at 1, not the largest axis"
        ),
        Call(
            "FixedPoints(64, replace=False)(data)",
            "pcdata.RandomSample(num_points=64)(cloud, generator=generator)",
            "seeded per sample",
        ),
        Call(
            "FixedPoints(300, allow_duplicates=True)(data)",
            "pcdata.RandomSample(num_points=300, if_short='tile')(cloud, generator=generator)",
            "what happens with too few points is stated",
        ),
        Call(
            "GridSampling(0.05)(data)",
            "pcdata.VoxelDownsample(voxel_size=0.05)(cloud)",
            "labels vote, colors and normals are averaged by what they are",
        ),
        Call(
            "voxel_grid(pos, size=0.05, batch=batch)",
            "F.voxel_downsample(points, ptr, voxel_size=0.05, origin=(0, 0, 0))[2]",
            "the number of its voxel for each point, none is empty",
        ),
        Call(
            "RandomJitter(0.01)(data)",
            "pcdata.RandomJitter(sigma=0.01)(cloud, generator=generator)",
            "Gaussian, not uniform; `clip` bounds it",
        ),
        Call(
            "RandomScale((0.8, 1.2))(data)",
            "pcdata.RandomScale(low=0.8, high=1.2)(cloud, generator=generator)",
            "also per axis, about a point",
        ),
        Call(
            "RandomRotate(15, axis=2)(data)",
            "pcdata.RandomRotation(axis=(0, 0, 1), degrees=15)(cloud, generator=generator)",
            "normals, poses and signals turn too",
        ),
        Call(
            "RandomFlip(axis=0)(data)",
            "pcdata.RandomFlip(probability=(0.5, 0, 0))(cloud, generator=generator)",
            "likewise",
        ),
        Call(
            "RandomShear(0.2)(data)",
            "pcdata.RandomShear(low=-0.2, high=0.2)(cloud, generator=generator)",
            "normals stay at right angles; a range for each entry",
        ),
        Call(
            "LinearTransformation(matrix)(data)",
            "cloud.transformed(torch.diag(torch.tensor([2.0, 1.0, 1.0, 1.0], dtype=torch.float64))[None])",
            "4x4, on column vectors as theirs; normals, poses and viewpoints follow",
        ),
        Call(
            "RemoveDuplicatedEdges, RemoveIsolatedNodes on points",
            "pcdata.Compose([pcdata.RemoveDuplicates(), pcdata.RemoveRadiusOutliers(min_neighbors=1, radius=0.05)])"
            "(cloud)",
            "of points, as steps",
        ),
        Call(
            "RandomNodeSplit-like shuffling of rows",
            "pcdata.RandomShuffle()(cloud, generator=generator)",
            "a permutation of each cloud, seeded per sample",
        ),
        Call(
            "ComposeFilters, Data.subgraph(mask)",
            "cloud.select(points[:, 2] > 0.05, F.ptr_from_counts([int((points[:, 2] > 0.05).sum())]))",
            "any rows; by values of a field: `KeepValues`",
        ),
        Call(
            "Distance()(data).edge_attr",
            "F.radius_neighbors(points, ptr, radius=0.05, exclude_self=True)[1]",
            "distances come with the neighbors",
        ),
        Call(
            "Cartesian(norm=False)(data).edge_attr",
            "(lambda index: points[index] - points[:, None])(F.knn(points, ptr, k=6, exclude_self=True)[0])",
            "offsets to the neighbors, (N, k, 3)",
        ),
        Call("KNNGraph(k=6)(data).edge_index", "F.knn(points, ptr, k=6, exclude_self=True)[0]", "a table, not pairs"),
        Call(
            "RadiusGraph(0.05)(data).edge_index",
            "F.radius_neighbors(points, ptr, radius=0.05, exclude_self=True)",
            "compressed rows",
        ),
        Call(
            "knn_interpolate(features, points, queries, k=3)",
            "F.interpolate_features(points, features, queries=queries, k=3)",
            "a query on a point has exactly its features; gradients to features in both",
        ),
        Call(
            "Compose([...])(data)",
            "pcdata.Compose([pcdata.Center(), pcdata.RandomRotation()])(cloud, generator=generator)",
            "neighbors are checked when it is made; also from YAML",
        ),
        Call("Batch.from_data_list([a, b])", "pcdata.PointCloud.cat([cloud, cloud])", "`unbatch()` takes it apart"),
        Call("ToDense(300)(data)", "cloud.padded(300)", "fields and a mask"),
        Call("fps(pos, batch, ratio=0.5)", "F.farthest_point_sample(points, ptr, ratio=0.5)", "as in torch-cluster"),
    ),
    missing=(
        ("`NormalizeRotation`, `NormalizeFeatures`, `AddPositionalEncoding`-like features", "left to the model"),
        ("`SamplePoints`, `FaceToEdge`, `GenerateMeshNormals`", "of meshes"),
        ("`ToUndirected`, `AddSelfLoops`, `GCNNorm`, `RandomLinkSplit` and the like", "of graphs"),
    ),
)

PCL = Section(
    "PCL",
    "Filters become functions that return masks, or steps of a chain. `setNegative(true)` is `~mask` or `invert=True`; "
    "`setKeepOrganized` has no partner: points know the pixel they come from (`source_index`).",
    (
        Call(
            "PassThrough.setFilterFieldName('z'), setFilterLimits(0.05, 0.1)",
            "points[(points[:, 2] >= 0.05) & (points[:, 2] <= 0.1)]",
            "of other fields: `KeepValues(field=, low=, high=)`",
        ),
        Call("CropBox.setMin, setMax", "F.box_mask(points, lower=(0, 0, 0), upper=(0.1, 0.1, 0.1))", "faces included"),
        Call(
            "CropBox.setTransform, setRotation",
            "pcdata.CropWorkspace(frame='base', lower=(0, 0, 0), upper=(0.1, 0.1, 0.1), "
            "frame_from_box=tuple(map(tuple, pose.tolist())))(cloud)",
            "the pose of the box in the frame",
        ),
        Call(
            "FrustumCulling.setCameraPose, setHorizontalFOV, setVerticalFOV",
            "pcdata.CropFrustum(frame='base', frame_from_camera=tuple(map(tuple, torch.eye(4).tolist())), fx=60.0, "
            "fy=60.0, cx=31.5, cy=23.5, size=(48, 64), near=0.01, far=2.0)(cloud)",
            "a camera of OpenCV's axes, with any lens; `F.frustum_mask` for cameras of many clouds",
        ),
        Call(
            "CropHull (2D)",
            "F.polygon_mask(points[:, :2].contiguous(), polygon=[(0, 0), (0.1, 0), (0, 0.1)])",
            "a polygon, also concave",
        ),
        Call("ConvexHull (2D)", "F.convex_hull(points[:, :2])", "rows of the corners, counterclockwise"),
        Call("ConvexHull (3D)", "F.convex_hull_3d(points)", "with triangles, volume and area"),
        Call(
            "ExtractPolygonalPrismData.setHeightLimits(0.0, 0.1)",
            "pcdata.CropPolygon(frame='base', polygon=((0, 0), (0.2, 0), (0, 0.2)), low=0.0, high=0.1)(cloud)",
            "`RemovePlane(keep='over')` stands on the hull of the plane that it finds",
        ),
        Call(
            "VoxelGrid.setLeafSize(0.05, 0.05, 0.05)",
            "F.voxel_downsample(points, voxel_size=0.05, origin=(0, 0, 0))",
            "`voxel_size=[[x, y, z]]` for an edge per axis; `min_points` is setMinimumPointsNumberPerVoxel",
        ),
        Call(
            "UniformSampling.setRadiusSearch(0.05)",
            "pcdata.VoxelSample(voxel_size=0.05, keep='nearest')(cloud)",
            "the point nearest to the center of each voxel",
        ),
        Call(
            "RandomSample.setSample(50)",
            "pcdata.RandomSample(num_points=50)(cloud, generator=generator)",
            "in random order",
        ),
        Call(
            "FarthestPointSampling.setSample(50)",
            "F.farthest_point_sample(points, num_samples=50)",
            "starts at the first row",
        ),
        Call(
            "StatisticalOutlierRemoval.setMeanK(20), setStddevMulThresh(2.0)",
            "F.statistical_outlier_mask(points, num_neighbors=21, std_ratio=2.0)",
            "the point itself counts at distance 0 (Open3D's rule), so means are smaller by k / (k + 1)",
        ),
        Call(
            "RadiusOutlierRemoval.setRadiusSearch(0.05), setMinNeighborsInRadius(5)",
            "F.radius_outlier_mask(points, radius=0.05, min_neighbors=5)",
            "the point itself counts, and more than 5 are needed",
        ),
        Call("removeNaNFromPointCloud", "pcdata.DropNonFinite()(cloud)", ""),
        Call(
            "NormalEstimation.setKSearch(12)",
            "F.estimate_normals(points, radius=None, max_neighbors=12)",
            "curvature: `F.shape_features(covariance, 'surface_variation')`",
        ),
        Call(
            "NormalEstimation.setRadiusSearch(0.05)", "F.estimate_normals(points, radius=0.05, max_neighbors=200)", ""
        ),
        Call("flipNormalTowardsViewpoint", "F.orient_normals(points, normals, torch.zeros(3))", ""),
        Call(
            "IntegralImageNormalEstimation", "F.depth_normals(depth, K)", "curvature beside it; not across depth edges"
        ),
        Call(
            "KdTreeFLANN.nearestKSearch(queries, 8)",
            "F.knn(points, queries=queries, k=8)",
            "distances, not their squares",
        ),
        Call(
            "KdTreeFLANN.radiusSearch(queries, 0.05)",
            "F.radius_neighbors(points, queries=queries, radius=0.05)",
            "likewise",
        ),
        Call(
            "EuclideanClusterExtraction.setClusterTolerance(0.03), setMinClusterSize(10)",
            "pcdata.ClusterObjects(eps=0.03, min_points=1, min_size=10)(cloud)",
            "`min_points` above 1 asks for density (DBSCAN)",
        ),
        Call("SACSegmentation (SACMODEL_PLANE)", "F.ransac_plane(points, distance=0.01)", "refined, seeded"),
        Call(
            "SACSegmentation (SACMODEL_PERPENDICULAR_PLANE)",
            "F.ransac_plane(points, distance=0.01, up=(0, 0, 1), max_tilt=0.2)",
            "radians",
        ),
        Call(
            "SACSegmentation (SACMODEL_SPHERE), setRadiusLimits(0.01, 0.2)",
            "F.ransac_sphere(points, distance=0.01, radius=(0.01, 0.2))",
            "refined by least squares, seeded; `normals=` is SACMODEL_NORMAL_SPHERE without its weight",
        ),
        Call(
            "SACSegmentationFromNormals (SACMODEL_CYLINDER), setAxis, setEpsAngle(0.3)",
            "F.ransac_cylinder(points, distance=0.01, radius=(0.01, 0.2), up=(0, 0, 1), max_tilt=0.3)",
            "normals are found where none are given, and weigh nothing; with the length along the axis",
        ),
        Call("SACSegmentation (SACMODEL_LINE)", "F.ransac_line(points, distance=0.01)", "with its length"),
        Call("SACSegmentation (SACMODEL_CIRCLE3D)", "F.ransac_circle(points, distance=0.01)", ""),
        Call(
            "SACSegmentation (SACMODEL_CIRCLE2D)",
            "F.ransac_circle(points * torch.tensor([1.0, 1.0, 0.0]), distance=0.01)",
            "",
        ),
        Call(
            "FastBilateralFilter.setSigmaS(1.5), setSigmaR(0.01)",
            "pcdata.BilateralFilterDepth(sigma_pixels=1.5, sigma_depth=0.01)(frame)",
            "of depth images, before they become points",
        ),
        Call("MedianFilter.setWindowSize(3)", "pcdata.MedianFilterDepth()(frame)", "likewise"),
        Call(
            "BoundaryEstimation.setKSearch(30), setAngleThreshold(1.57)",
            "F.boundary_mask(points, normals, max_neighbors=30, min_gap=1.57)",
            "a mask",
        ),
        Call("TransformationEstimationSVD", "F.fit_paired_points(points, moved)", ""),
        Call(
            "GeneralizedIterativeClosestPoint.align",
            "pcdata.alignment.align_clouds(surface, surface + 0.003, method='gicp')",
            "through small_gicp",
        ),
        Call(
            "transformPointCloudWithNormals",
            "cloud.transformed(pose.repeat(1, 1, 1))",
            "all that has a direction turns",
        ),
        Call(
            "PointCloud operator+",
            "torch.cat([points, others])",
            "views of one capture: `MergeViews`; two scenes: `mix_scenes`",
        ),
        Call(
            "RangeImageSpherical.createFromPointCloud",
            "F.render_ranges(points, size=(16, 64), elevations=(-1.5, 1.5))",
            "0 = nothing seen",
        ),
    ),
)

MMDETECTION3D = Section(
    "MMDetection3D",
    "Points are columns there (x, y, z, ...) and fields here (`colors`, `labels`, extras of a stated kind).",
    (
        Call(
            "GlobalRotScaleTrans(rot_range=[-0.78, 0.78], scale_ratio_range=[0.95, 1.05])",
            "pcdata.Compose([pcdata.RandomRotation(degrees=44.7), pcdata.RandomScale(low=0.95, "
            "high=1.05)])(cloud, generator=generator)",
            "degrees; boxes and poses are signals, which move too",
        ),
        Call(
            "RandomFlip3D(flip_ratio_bev_horizontal=0.5)",
            "pcdata.RandomFlip(probability=(0, 0.5, 0))(cloud, generator=generator)",
            "horizontal is along y for LiDAR points",
        ),
        Call(
            "PointsRangeFilter([0, 0, 0, 0.1, 0.1, 0.1])",
            "pcdata.CropWorkspace(frame='base', lower=(0, 0, 0), upper=(0.1, 0.1, 0.1))(cloud)",
            "faces included",
        ),
        Call(
            "PointSample(64)",
            "pcdata.RandomSample(num_points=64)(cloud, generator=generator)",
            "fewer points: `if_short`, `with_replacement`",
        ),
        Call(
            "RandomDropPointsColor(drop_ratio=0.2)",
            "pcdata.RandomColorDrop(probability=0.2)(cloud, generator=generator)",
            "",
        ),
        Call(
            "RandomJitterPoints(jitter_std=[0.01, 0.01, 0.01], clip_range=[-0.05, 0.05])",
            "pcdata.RandomJitter(sigma=(0.01, 0.01, 0.01), clip=0.05)(cloud, generator=generator)",
            "the length of the offset is clipped",
        ),
        Call(
            "GlobalAlignment(rotation_axis=2)",
            "cloud.transformed(pose.repeat(1, 1, 1), frame_id='aligned')",
            "as a step: `ToFrame(frame=, matrix=, start=)`; a matrix that is not rigid is refused",
        ),
        Call(
            "VoxelizationByGridShape / mmcv Voxelization([0.05, 0.05, 0.1], [0, 0, 0, 0.2, 0.2, 0.2], 5, 200)",
            "F.hard_voxels(points, voxel_size=[[0.05, 0.05, 0.1]], lower=(0, 0, 0), upper=(0.2, 0.2, 0.2), "
            "max_points=5, max_voxels=200)",
            "rows of the points; cells are x, y, z: `.cell.flip(1)` is theirs; of all fields by the same rows",
        ),
        Call(
            "VoxelBasedPointSampler",
            "pcdata.RandomVoxelSample(voxel_size=0.05)(cloud, generator=generator)",
            "one point per voxel",
        ),
        Call(
            "PointSegClassMapping with seg_label_mapping={10: 1, 252: 1}",
            "pcdata.MapLabels(mapping=((10, 1), (252, 1)), others=0)(cloud)",
            "labels that the table leaves out stay, or become `others`",
        ),
        Call(
            "Voxelization(voxel_size=[0.05] * 3, max_num_points=-1)",
            "F.voxel_cells(points, 0.05)",
            "cells as (x, y, z), of any sign; `F.voxel_downsample` for the points of each",
        ),
        Call(
            "PolarMix, LaserMix",
            "pcdata.mix_scenes(cloud, cloud)",
            "whole scenes, labels kept apart; partners drawn in a dataset: `MixedCloudDataset`",
        ),
        Call(
            "PointShuffle",
            "pcdata.RandomShuffle()(cloud, generator=generator)",
            "",
        ),
        Call(
            "RandomChoice(transforms=[...], prob=[0.3, 0.7])",
            "pcdata.RandomOneOf(steps=[pcdata.RandomFlip(), pcdata.RandomShear()], weights=(0.3, 0.7))"
            "(cloud, generator=generator)",
            "per cloud; weights need not add up to 1",
        ),
        Call(
            "RandomApply(transforms=[...], prob=0.5)",
            "pcdata.RandomApply(step=pcdata.RandomJitter(), probability=0.5)(cloud, generator=generator)",
            "per cloud",
        ),
        Call(
            "GlobalRotScaleTrans(translation_std=[0.1, 0.1, 0.1])",
            "pcdata.RandomTranslation(max_offset=(0.1, 0.1, 0.1))(cloud, generator=generator)",
            "uniform, not Gaussian",
        ),
        Call(
            "IndoorPatchPointSample(num_points=64, block_size=0.1)",
            "pcdata.Compose([pcdata.RandomColumn(size=0.1, min_points=10), pcdata.RandomSample(num_points=64, "
            "if_short='repeat')])(cloud, generator=generator)",
            "the column, then the points",
        ),
        Call(
            "NormalizePointsColor(color_mean=[0.5, 0.5, 0.5])",
            "cloud.with_fields(colors=cloud.colors - 0.5)",
            "colors are in [0, 1] here, not to 255",
        ),
        Call(
            "MultiViewWrapper",
            "pcdata.MergeViews()(pcdata.ToFrame(frame='base')(pcdata.Deproject()(frame)))",
            "a capture has its views from the start",
        ),
    ),
    missing=(
        (
            "`ObjectSample`, `ObjectNoise`, `BackgroundPointsFilter`, `ObjectRangeFilter`, `ObjectNameFilter`",
            "steps on 3D boxes; objects are labels of points here (`ClusterObjects`, `SplitObjects`, `KeepValues`, "
            "`MixedCloudDataset`), a box is a signal (`CropWorkspace`)",
        ),
        ("`RandomShiftScale`, `Resize3D`, `PhotoMetricDistortion3D`", "steps on images for detection in images"),
        ("mixing by sectors (`PolarMix`, `LaserMix`)", "of spinning lidars; whole scenes are mixed here"),
    ),
)
