"""Calls of libraries of numbers: small_gicp, SciPy, scikit-learn, TorchIO."""

from __future__ import annotations

import numpy as np

from tests.peers.calls import Call, Section, both_signs, by, in_order, same

SMALL_GICP = Section(
    "small_gicp",
    "",
    (
        Call(
            "small_gicp.voxelgrid_sampling(points.double().numpy(), 0.05).points()[:, :3]",
            "F.voxel_downsample(points, voxel_size=0.05, origin=(0, 0, 0))[0]",
            "in the order of first rows",
            by(in_order, in_order, 1e-4),
        ),
        Call(
            "tree.batch_knn_search(queries.double().numpy(), 8)",
            "F.knn(points, queries=queries, k=8)",
            "distances, not their squares",
            by(lambda a: a[0], lambda b: b[0]),
        ),
        Call(
            "small_gicp.estimate_normals(gicp_cloud, num_neighbors=12)",
            "F.estimate_normals(points, radius=None, max_neighbors=12)",
            "the sign by a rule",
            lambda a, b, seen: by(both_signs, both_signs, 1e-3)(seen["gicp_cloud"].normals()[:, :3], b, seen),
        ),
        Call(
            "small_gicp.align((surface + 0.003).double().numpy(), surface.double().numpy(), "
            "registration_type='PLANE_ICP', downsampling_resolution=0.004)",
            "pcdata.alignment.align_clouds(surface, surface + 0.003, method='gicp')",
            "source first; clouds are not thinned out; `is_trusted`",
            by(lambda a: a.T_target_source, lambda b: b.found.target_from_source, 1e-3),
        ),
    ),
    {"small_gicp": "small_gicp"},
    """
tree = small_gicp.KdTree(points.double().numpy())
gicp_cloud = small_gicp.PointCloud(points.double().numpy())
""",
)

SCIPY = Section(
    "SciPy",
    "`tree` is a `scipy.spatial.cKDTree` of the points; it takes float64, all here is float32.",
    (
        Call(
            "tree.query(queries.numpy(), k=8)",
            "F.knn(points, queries=queries, k=8)",
            "(index, distance), in the other order; what is missing is the same: row N and infinity",
            by(lambda a: a[1], lambda b: b[0]),
        ),
        Call(
            "spatial.cKDTree(points.numpy()).query(queries.numpy(), k=4)",
            "F.NeighborIndex(points).knn(queries=queries, k=4)",
            "sorted once, searched often; `ball_query` and `radius_neighbors` too",
            by(lambda a: a[1], lambda b: b[0]),
        ),
        Call(
            "tree.query(queries.numpy(), k=8, p=1)",
            "F.knn(points, queries=queries, k=8, norm='l1')",
            "`norm='linf'` is p=inf; in `ball_query` and `radius_neighbors` too",
            by(lambda a: a[0], lambda b: b[1]),
        ),
        Call(
            "tree.query(queries.numpy(), k=8, distance_upper_bound=0.03)",
            "F.ball_query(points, queries=queries, radius=0.03, max_neighbors=8)",
            "with the number found",
            by(lambda a: a[1], lambda b: b[0]),
        ),
        Call(
            "tree.query_ball_point(queries.numpy(), 0.05)",
            "F.radius_neighbors(points, queries=queries, radius=0.05)",
            "compressed rows, nearest first; d < r, not d <= r; `radius` may be one per query",
            by(
                lambda a: np.concatenate([np.sort(row) for row in a]),
                lambda b: np.concatenate(
                    [np.sort(b[0][i:j].numpy()) for i, j in zip(b[2].tolist(), b[2].tolist()[1:])]
                ),
            ),
        ),
        Call(
            "tree.query_pairs(0.03, output_type='ndarray')",
            "F.radius_neighbors(points, radius=0.03, exclude_self=True)[0]",
            "each pair from both sides",
            by(lambda a: [2 * len(a)], lambda b: [len(b)]),
        ),
        Call(
            "spatial.distance.directed_hausdorff(points.numpy(), others.numpy())[0]",
            "F.hausdorff_distance(points, None, others, None)[0, 0]",
            "both ways at once, ragged batches, any number of columns",
            same(1e-6),
        ),
        Call(
            "spatial.distance.cdist(points.numpy(), others.numpy()).min(1).mean()",
            "F.chamfer_distance(points, None, others, None, sides='a_to_b', squared=False)",
            "without a table of all pairs",
            same(1e-6),
        ),
        Call(
            "spatial.ConvexHull(points[:, :2].numpy()).vertices",
            "F.convex_hull(points[:, :2])",
            "in a plane; another first corner",
            by(np.sort, lambda b: np.sort(b.numpy())),
        ),
        Call(
            "spatial.ConvexHull(points.numpy()).volume",
            "F.convex_hull_3d(points).volume",
            "triangles run counterclockwise seen from outside; flat sets are answered too",
            by(float, float, 1e-6),
        ),
        Call(
            "transform.Rotation.from_quat([0.0, 0.6, 0.0, 0.8]).as_matrix()",
            "pcdata.geometry.rotations.rotation_from_quaternion(torch.tensor([0.8, 0.0, 0.6, 0.0]))",
            "w comes first",
            same(1e-6),
        ),
        Call(
            "transform.Rotation.from_euler('xyz', [0.1, 0.2, 0.3]).as_matrix()",
            "pcdata.geometry.rotations.rotation_from_euler(torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64), 'xyz')",
            "small letters turn about fixed axes in both, capitals about moving ones",
            same(1e-9),
        ),
        Call(
            "transform.Rotation.from_euler('ZYX', [0.1, 0.2, 0.3]).as_matrix()",
            "pcdata.geometry.rotations.rotation_from_euler(torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64), 'ZYX')",
            "three different axes",
            same(1e-9),
        ),
        Call(
            "transform.Rotation.from_rotvec([0.1, -0.2, 0.3]).as_quat()[[3, 0, 1, 2]]",
            "pcdata.geometry.rotations.quaternion_from_rotation_vector(torch.tensor([0.1, -0.2, 0.3], "
            "dtype=torch.float64))",
            "w comes first",
            same(1e-9),
        ),
        Call(
            "transform.Rotation.from_euler('xyz', [[0.1, 0.2, 0.3], [0.3, 0.1, 0.2]]).mean().as_matrix()",
            "pcdata.geometry.rotations.mean_rotation(pcdata.geometry.rotations.rotation_from_euler(torch.tensor("
            "[[0.1, 0.2, 0.3], [0.3, 0.1, 0.2]], dtype=torch.float64), 'xyz'))",
            "weights, batches",
            same(1e-9),
        ),
        Call(
            "transform.Slerp([0, 1], transform.Rotation.from_rotvec([[0.2, 0, 0], [1, 0, 0]]))(0.25).as_quat()"
            "[[3, 0, 1, 2]]",
            "pcdata.geometry.rotations.slerp(*pcdata.geometry.rotations.quaternion_from_rotation_vector(torch.tensor("
            "[[0.2, 0.0, 0.0], [1.0, 0.0, 0.0]], dtype=torch.float64)), 0.25)",
            "quaternions, w first; between two",
            same(1e-9),
        ),
        Call(
            "transform.Rotation.align_vectors((moved - moved.mean(0)).numpy(), (points - points.mean(0)).numpy())[0]"
            ".as_matrix()",
            "F.fit_paired_points(points, moved).matrix[0, :3, :3]",
            "translation too; from first to second",
            same(1e-5),
        ),
        Call(
            "optimize.linear_sum_assignment(spatial.distance.cdist(queries.numpy(), others[:50].numpy()))",
            "pcdata.validation.measures.earth_movers.earth_movers_distance(queries, None, others[:50], None)",
            "the mean distance of the best partners",
        ),
    ),
    {"spatial": "scipy.spatial", "transform": "scipy.spatial.transform", "optimize": "scipy.optimize"},
    "tree = spatial.cKDTree(points.numpy())",
)

SCIKIT_LEARN = Section(
    "scikit-learn",
    "",
    (
        Call(
            "DBSCAN(eps=0.03, min_samples=4).fit(points.numpy()).labels_",
            "F.dbscan(points, eps=0.03, min_points=4)",
            "d < eps, not d <= eps; a border point takes the lowest label in reach",
            same(0),
        ),
        Call(
            "DBSCAN(eps=0.03, min_samples=4).fit(points.numpy()).core_sample_indices_",
            "F.core_point_mask(points, eps=0.03, min_points=4)",
            "a mask",
            by(np.asarray, lambda b: np.flatnonzero(b.numpy())),
        ),
        Call(
            "DBSCAN(eps=0.03, min_samples=2).fit(points.numpy(), sample_weight=weights.numpy()).labels_",
            "F.dbscan(points, eps=0.03, min_points=2, weights=weights)",
            "",
            same(0),
        ),
        Call(
            "NearestNeighbors(n_neighbors=8).fit(points.numpy()).kneighbors(queries.numpy())",
            "F.knn(points, queries=queries, k=8)",
            "(index, distance)",
            by(lambda a: a[1], lambda b: b[0]),
        ),
        Call(
            "NearestNeighbors(n_neighbors=5).fit(points.numpy()).kneighbors",
            "F.NeighborIndex(points)",
            "an index made once: `.knn(queries=queries, k=5)`",
        ),
        Call(
            "NearestNeighbors(n_neighbors=7).fit(points.numpy()).kneighbors()",
            "F.knn(points, k=7, exclude_self=True)",
            "",
            by(lambda a: a[1], lambda b: b[0]),
        ),
        Call(
            "NearestNeighbors(radius=0.05).fit(points.numpy()).radius_neighbors(queries.numpy(), sort_results=True)",
            "F.radius_neighbors(points, queries=queries, radius=0.05)",
            "compressed rows; d < radius, not d <= radius",
            by(lambda a: np.concatenate(a[1]), lambda b: b[0]),
        ),
    ),
    {"cluster": "sklearn.cluster", "neighbors": "sklearn.neighbors"},
    "DBSCAN, NearestNeighbors = cluster.DBSCAN, neighbors.NearestNeighbors",
)

TORCHIO = Section(
    "TorchIO",
    "Steps are frozen; what they decided is in the history of every cloud (`cloud.history`).",
    (
        Call(
            "Compose([...])(subject)",
            "pcdata.Compose([pcdata.Center(), pcdata.RandomRotation()])(cloud, generator=generator)",
            "checked when it is made",
        ),
        Call(
            "RandomAffine(degrees=10, scales=0.1, translation=5)",
            "pcdata.Compose([pcdata.RandomRotation(degrees_xyz=((-10, 10),) * 3), pcdata.RandomScale(low=0.9, "
            "high=1.1), "
            "pcdata.RandomTranslation(max_offset=0.05)])(cloud, generator=generator)",
            "one pass where steps are motions in a row",
        ),
        Call(
            "RandomFlip(axes=0, flip_probability=0.5)",
            "pcdata.RandomFlip(probability=(0.5, 0.0, 0.0))(cloud, generator=generator)",
            "",
        ),
        Call(
            "transform(subject) with p=0.3",
            "pcdata.RandomApply(step=pcdata.RandomJitter(), probability=0.3)(cloud, generator=generator)",
            "per cloud",
        ),
        Call(
            "OneOf({RandomFlip(): 0.3, RandomNoise(): 0.7})",
            "pcdata.RandomOneOf(steps=[pcdata.RandomFlip(), pcdata.RandomJitter()], weights=(0.3, 0.7))"
            "(cloud, generator=generator)",
            "per cloud; steps that keep frame and unit",
        ),
        Call(
            "RandomAffine(scales=(0.9, 1.1, 1, 1, 0.8, 1.2), isotropic=False, center='image')",
            "pcdata.RandomScale(low=(0.9, 1.0, 0.8), high=(1.1, 1.0, 1.2), per_axis=True, about='centroid')"
            "(cloud, generator=generator)",
            "`degrees_xyz`, `min_offset`, `RandomShear` for the others",
        ),
        Call(
            "RandomElasticDeformation(num_control_points=7, max_displacement=7.5)",
            "pcdata.RandomElastic(wavelength=0.2, max_offset=0.01)(cloud, generator=generator)",
            "a lattice in metres, not a number of control points; refused where it could fold; poses do not follow",
        ),
        Call("Lambda(function)", "cloud.with_fields(colors=cloud.colors ** 2)", "or a step of your own"),
        Call(
            "Crop, CropOrPad",
            "pcdata.CropWorkspace(frame='base', lower=(0, 0, 0), upper=(0.1, 0.1, 0.1), max_drop=0.9)(cloud)",
            "`max_drop`: an error, or a warning, where more goes",
        ),
        Call(
            "RandomAnisotropy, Resample",
            "pcdata.VoxelDownsample(voxel_size=(0.02, 0.02, 0.05))(cloud)",
            "an edge for each axis",
        ),
        Call("Mask(mask)", "pcdata.KeepValues(field='labels', values=(1, 2))(cloud)", "by a field of the points"),
        Call("RandomNoise(std=0.01)", "pcdata.RandomJitter(sigma=0.01)(cloud, generator=generator)", ""),
        Call(
            "RemapLabels({2: 1, 5: 1})",
            "pcdata.MapLabels(mapping=((2, 1), (5, 1)))(cloud)",
            "`RemoveLabels`: to -1, or `KeepValues(values=..., invert=True)`",
        ),
        Call(
            "transformed.get_composed_history()(other_subject)",
            "(lambda chain: chain.replay(cloud, chain(cloud, generator=generator).history))"
            "(pcdata.Compose([pcdata.RandomRotation()]))",
            "`chain.replay(data, history)`: bit for bit, also on other fields of the capture",
        ),
        Call(
            "subject.apply_inverse_transform()",
            "cloud.transformed(cloud.source_from_cloud).points",
            "every motion, back to the frame that was read; `cloud.to_frame` names another",
        ),
    ),
    missing=(
        (
            "`include`, `exclude`",
            "what a step changes follows from the kind of each field, so that none is left behind; "
            "`cloud.with_fields(colors=None)` takes one out",
        ),
        ("`RandomMotion`, `RandomGhosting`, `RandomSpike`, `RandomBiasField`", "artifacts of MRI"),
    ),
)
