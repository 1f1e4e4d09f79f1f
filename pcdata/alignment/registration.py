"""One door to aligning two clouds, by several methods, each judged in the same way."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from pcdata.alignment.cloud_pair import CloudPair
from pcdata.alignment.icp import ANY_ANGLE, Alignment, icp_point_to_plane, judged, normals_of
from pcdata.alignment.surface_descent import Descent
from pcdata.contracts.numbers import require_length
from pcdata.contracts.tensors import check_tensors
from pcdata.errors import ConfigError, TooFewPointsError
from pcdata.extras import require
from pcdata.functional.neighbors import knn
from pcdata.geometry import rigid
from pcdata.geometry.rotations import closest_rotation

Method = Literal["point_to_plane", "point_to_point", "gicp"]
Search = Literal["local", "global"]
_BY_SMALL_GICP: dict[str, str] = {"point_to_point": "ICP", "gicp": "GICP"}
_MIN_POINTS = 20
_NEIGHBORS = 20  # of a covariance, as small_gicp has it
_MAX_ROUNDS = 50
_SMALL = 1e-7  # radians and units
_NORMAL_ANGLE = 0.6  # radians, of partners when a pose is judged
# Of the global search, in voxels, as in Open3D's tutorial; the voxel is a part of the target's diagonal.
_VOXEL_SHARE = 1 / 40
_NORMAL_VOXELS, _FEATURE_VOXELS, _PAIR_VOXELS = 2.0, 5.0, 1.5
_SEEDS = (0, 1, 2)
_AS_GOOD = 0.9  # of the best share of points that fit
_LEAST_OVERLAP = 0.5  # a corner of a room turned by 90 degrees onto another met 0.37 of it


@dataclass(frozen=True, eq=False)
class CloudAlignment:
    """Where a source cloud lies in a target's frame, by which method, and how far to trust it."""

    found: Alignment
    method: Method
    search: Search
    basin: float  # metres: how far points may be from their partners at the start; inf for a global search
    is_trusted: bool
    reason: str  # why it is not trusted, in words; empty where it is

    @property
    def target_from_source(self) -> Tensor:
        """The pose, (4, 4) float64 rigid."""
        return self.found.target_from_source

    @property
    def covariance(self) -> Tensor:
        """Of the twist about ``found.pivot`` (rotation vector, translation), (6, 6) float64; 0 where it is open."""
        return self.found.covariance

    @property
    def overlap(self) -> float:
        """The share of source points that have a partner, 0..1."""
        return self.found.overlap


def align_clouds(
    source: Tensor,  # (N, 3) float32
    target: Tensor,  # (M, 3) float32
    *,
    method: Method = "point_to_plane",
    search: Search = "local",
    initial: Tensor | None = None,  # (4, 4) target_from_source; None = the identity
    max_distance: float | None = None,
) -> CloudAlignment:
    """Find the rigid motion that brings one cloud onto another, and say whether it should be trusted.

    Every method is judged alike, by the surfaces that meet at its pose: the share of the source that has partners, of
    the points near the target those that lie on it, the directions that the surfaces leave open, and the covariance of
    the rest. ``is_trusted`` is False, with the reason, where that speaks against the pose; of a global search also
    where one with other random numbers ends elsewhere and fits as well, or less than half of the source has a partner.

    Args:
        source: the cloud that moves.
        target: the cloud that stays.
        method: ``point_to_plane``: :func:`icp_point_to_plane`, without another library. ``gicp`` and
            ``point_to_point`` run in small_gicp.
        search: ``local`` starts at the initial pose and finds what lies within the basin. ``global`` needs no start:
            descriptors (FPFH) are matched and a pose drawn that most agree with (RANSAC), by Open3D, whose own random
            generator this seeds; the method refines it.
        initial: where a local search starts.
        max_distance: largest distance of partners at first, in the points' unit: the basin. None = by the clouds.

    Raises:
        ShapeError, DTypeError, DeviceError, NonFiniteError, PoseError: an argument breaks the contract above.
        ConfigError: an unknown method or search, a length that is not positive, or a start of a global search.
        TooFewPointsError: a cloud of fewer than 20 points, or clouds that do not meet at all.
        MissingExtraError: small_gicp or Open3D is not installed.

    Source: Segal, Haehnel & Thrun, Generalized-ICP, 2009; Besl & McKay, 1992; Rusu, Blodow & Beetz, Fast point feature
    histograms, 2009; Koide, small_gicp, 2024.
    """
    where = "align_clouds"
    if method not in get_args(Method) or search not in get_args(Search):
        raise ConfigError(
            f"{where}: method must be one of {', '.join(get_args(Method))} and search one of "
            f"{', '.join(get_args(Search))}, got {method!r} and {search!r}"
        )
    if max_distance is not None:
        require_length(where, "max_distance", max_distance)
    check_tensors(where, {"source": source, "target": target}, {"source": "N 3", "target": "M 3"})
    for name, cloud in (("source", source), ("target", target)):
        if len(cloud) < _MIN_POINTS:
            raise TooFewPointsError(f"{where}: {name} has {len(cloud)} points; at least {_MIN_POINTS} must overlap")
    pose = torch.eye(4, dtype=torch.float64, device=source.device) if initial is None else initial.double()
    rigid.check_rigid(f"{where}: initial", pose)
    if search == "global" and initial is not None:
        raise ConfigError(f"{where}: a global search has no start; leave initial out, or search locally")
    normals = [normals_of(where, name, cloud, None) for name, cloud in (("source", source), ("target", target))]
    pair = CloudPair(source, normals[0], target, normals[1], "tukey", None, _NORMAL_ANGLE)
    if search == "local":
        distances = _distances(pair, pose, max_distance)
        found = _refined(pair, pose, distances, method)
        return CloudAlignment(found, method, search, distances[0], not found.reason, found.reason)
    starts, reach = _global_poses(source, target)
    ends = []
    for start in starts:
        with suppress(TooFewPointsError):  # that start is none
            ends.append(_refined(pair, start, _distances(pair, start, reach), method))
    if not ends:
        raise TooFewPointsError(f"{where}: none of {len(starts)} global searches found a pose at which the clouds meet")
    ends.sort(key=lambda end: (not end.reason, end.overlap * end.support), reverse=True)
    reason = ends[0].reason or _doubt(pair, ends, reach)
    return CloudAlignment(ends[0], method, search, math.inf, not reason, reason)


def _refined(pair: CloudPair, pose: Tensor, distances: tuple[float, ...], method: Method) -> Alignment:
    """Run the method from a pose."""
    if method != "point_to_plane":
        return _by_small_gicp(pair, pose, distances, method)
    return icp_point_to_plane(
        pair.source,
        pair.target,
        source_normals=pair.source_normals,
        target_normals=pair.target_normals,
        initial=pose,
        max_distances=distances,
    )


def _doubt(pair: CloudPair, ends: list[Alignment], reach: float) -> str:
    """Say what speaks against the best of the poses (best first) that searches ended at; empty where nothing does."""
    best = ends[0]
    if best.overlap < _LEAST_OVERLAP:
        return f"only {best.overlap:.0%} of the source has a partner, as a chance fit may have"
    placed = pair.moved(best.target_from_source).double()
    for other in ends[1:]:
        apart = float((pair.moved(other.target_from_source).double() - placed).norm(dim=1).max())
        if apart > reach and other.overlap * other.support > _AS_GOOD * best.overlap * best.support:
            return f"searches with other random numbers fit as well {apart:.3g} away: the shape fits in several ways"
    return ""


def _distances(pair: CloudPair, pose: Tensor, max_distance: float | None) -> tuple[float, ...]:
    """Return the search distances, coarse to fine, beginning with the asked one."""
    by_clouds = pair.distances_for(pose)
    if max_distance is None:
        return by_clouds
    return (float(max_distance), *(one for one in by_clouds if one < max_distance))


def _by_small_gicp(pair: CloudPair, pose: Tensor, distances: tuple[float, ...], method: str) -> Alignment:
    """Run small_gicp at every distance, coarse to fine, and judge where it ends."""
    library: Any = require("small_gicp")
    clouds = [library.PointCloud(cloud.detach().cpu().double().numpy()) for cloud in (pair.source, pair.target)]
    for cloud in clouds:
        library.estimate_normals_covariances(cloud, num_neighbors=_NEIGHBORS)
    tree, start, rounds = library.KdTree(clouds[1]), pose.cpu().numpy(), 0
    for distance in distances:
        result = library.align(
            clouds[1],
            clouds[0],
            tree,
            init_T_target_source=start,
            registration_type=_BY_SMALL_GICP[method],
            max_correspondence_distance=distance,
            max_iterations=_MAX_ROUNDS,
            rotation_epsilon=_SMALL,
            translation_epsilon=_SMALL,
        )
        start, rounds = result.T_target_source, rounds + int(result.iterations)
    end = torch.from_numpy(np.array(start, dtype=np.float64)).to(pose.device)
    lost = not np.isfinite(start).all() or len(pair.match(end, distances[-1], ANY_ANGLE).residual) < _MIN_POINTS
    descent = Descent(end[None], distances[-1], rounds, bool(result.converged), lost)
    pivot = pair.moved(end).double().mean(0)
    num_open = 0 if lost else pair.num_open(end, distances[-1], pivot)
    return judged(pair, descent, pivot, distances[-1], rounds, num_open, still_better=False)


def _global_poses(source: Tensor, target: Tensor) -> tuple[list[Tensor], float]:
    """Return poses from descriptors, of searches with other random numbers, and how far off each may be."""
    open3d: Any = require("open3d")
    registration = open3d.pipelines.registration
    spacing = float(knn(target, k=2, queries=target)[1][:, 1].median())
    diagonal = float((target.amax(0) - target.amin(0)).norm())
    voxel = max(2 * spacing, _VOXEL_SHARE * diagonal)
    clouds, features = [], []
    for points in (source, target):
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.detach().cpu().double().numpy()))
        cloud = cloud.voxel_down_sample(voxel)
        near = open3d.geometry.KDTreeSearchParamHybrid(radius=_NORMAL_VOXELS * voxel, max_nn=30)
        cloud.estimate_normals(near)
        wide = open3d.geometry.KDTreeSearchParamHybrid(radius=_FEATURE_VOXELS * voxel, max_nn=100)
        clouds.append(cloud)
        features.append(registration.compute_fpfh_feature(cloud, wide))
    reach, poses = _PAIR_VOXELS * voxel, []
    # Open3D has one generator of its own and takes no other: without its seed the same clouds would get other poses.
    for seed in _SEEDS:
        open3d.utility.random.seed(seed)
        result = registration.registration_ransac_based_on_feature_matching(
            *clouds,
            *features,
            False,
            reach,
            registration.TransformationEstimationPointToPoint(False),
            3,
            [
                registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                registration.CorrespondenceCheckerBasedOnDistance(reach),
            ],
            registration.RANSACConvergenceCriteria(100000, 0.999),
        )
        matrix = torch.from_numpy(np.array(result.transformation, dtype=np.float64))
        matrix[:3, :3] = closest_rotation(matrix[:3, :3])  # Open3D's is rigid to rounding only
        poses.append(matrix.to(source.device))
    return poses, 2 * reach
