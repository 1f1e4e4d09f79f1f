"""Digests of the public functions that have one body, and of fusion on every backend."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from digest_inputs import pose, poses, rendered, scratch, seeded, with_confidence
from digest_names import (
    Confidence,
    TSDFVolume,
    functional,
    has_core,
    register_to_color,
    run,
    step,
    votes_row,
    write_volume,
)
from digest_operations import LENS, Case, K, points, ptr_of, random_depth
from digest_real import joined, real_folder, real_frame
from torch import Tensor


@cache
def _given() -> SimpleNamespace:
    """What the functions are called with."""
    f, frame, depth = functional, rendered(2, 5), random_depth()
    colors, rays = frame.colors, K.repeat(2, 1, 1)
    source, moved = points(300, 1), points(300, 1) @ pose(3)[:3, :3].float() * 1.0
    near = source + torch.tensor([0.004, -0.003, 0.002])
    normals = f.estimate_normals(source, None, radius=0.05, max_neighbors=12)
    _, _, inverse = f.voxel_downsample(source, None, voxel_size=0.04)
    count = int(inverse.max()) + 1
    xy = torch.rand(2, 20, 2, generator=seeded(4), dtype=torch.float64) - 0.5
    lens = LENS.repeat(2, 1)
    stack = torch.stack([depth, depth * 1.001, depth * 0.999, depth.flip(0)])
    first, state = f.temporal_filter(depth)
    noisy = rendered(2, 5, (120, 160), "stereo")
    b_from_a = torch.linalg.inv(noisy.world_from_camera[1]) @ noisy.world_from_camera[0]
    valid = noisy.depth[0] > 0
    return SimpleNamespace(**locals())


def _function_calls() -> Iterator[Case]:
    """Yield the public functions that have one body."""
    f = functional
    calls: dict[str, Callable[[Any], Any]] = {
        "average_depth": lambda g: f.average_depth(g.stack, min_count=2),
        "icp_point_to_plane": lambda g: f.icp_point_to_plane(g.near, g.source),
        "icp_point_to_plane far": lambda g: f.icp_point_to_plane(g.moved, g.source, max_distances=(0.1, 0.02)),
        "temporal_filter": lambda g: (g.first, f.temporal_filter(g.stack[3], g.state)),
        "edge_votes": lambda g: votes_row(f.edge_votes(g.noisy.depth[0], g.noisy.colors[0])),
        "offset_from_votes": lambda g: f.offset_from_votes(*f.edge_votes(g.noisy.depth[0], g.noisy.colors[0])),
        "occlusion_edges": lambda g: [f.occlusion_edges(g.frame.depth[0], margin=margin) for margin in (0, 2)],
        "view_agreement": lambda g: f.view_agreement(*g.noisy.depth, *g.noisy.camera.intrinsics, g.b_from_a),
        "point_to_plane_residuals": lambda g: f.point_to_plane_residuals(
            g.near, g.source, g.normals, max_distance=0.02
        ),
        "largest_missing_block": lambda g: [f.largest_missing_block(one) for one in (g.valid, g.depth[0] > 0)],
        "largest_missing_region": lambda g: [f.largest_missing_region(one) for one in (g.valid, g.depth[0] > 0)],
        "pile_at_extreme": lambda g: [f.pile_at_extreme(g.noisy.depth[0], end=end) for end in ("far", "near")],
        "pixel_rays": lambda g: [f.pixel_rays(g.rays, (12, 16)), f.pixel_rays(g.rays, (12, 16), g.lens)],
        "range_to_depth": lambda g: [f.range_to_depth(g.depth, g.rays), f.range_to_depth(g.depth, g.rays, g.lens)],
        "depth_to_disparity": lambda g: f.depth_to_disparity(g.depth, torch.tensor([30.0, 31.0]), 0.05),
        "disparity_to_depth": lambda g: f.disparity_to_depth(g.depth, torch.tensor([30.0, 31.0]), 0.05),
        "distort_normalized": lambda g: f.distort_normalized(g.xy, g.lens),
        "undistort_normalized": lambda g: f.undistort_normalized(g.xy, g.lens),
        "fill_rows": lambda g: f.fill_rows(g.depth, 2),
        "orient_normals": lambda g: f.orient_normals(g.source, g.normals, torch.tensor([0.0, 0.1, 1.0])),
        "random_sample_index": lambda g: [
            f.random_sample_index(ptr_of(50, 40), 20, torch.tensor([1, 2]), replace=replace)
            for replace in (True, False)
        ],
        "voxel_majority": lambda g: f.voxel_majority(torch.arange(300) % 4, g.inverse, g.count),
        "voxel_mean": lambda g: f.voxel_mean(g.source, g.inverse, g.count),
        "voxel_mean_direction": lambda g: f.voxel_mean_direction(g.normals, g.inverse, g.count),
        "voxel_minimum": lambda g: f.voxel_minimum(torch.arange(300) % 7, g.inverse, g.count),
        "NeighborIndex": lambda g: _searched_often(f.NeighborIndex(g.source, ptr_of(170, 130)), points(40, 9)),
        "convex_hull": lambda g: f.convex_hull(g.source[:, :2]),
        "convex_hull_3d": lambda g: f.convex_hull_3d(g.source),
        "smallest_box": lambda g: f.smallest_box(g.source),
        "convert_grasps": lambda g: f.convert_grasps(
            poses(5, 3), source="graspnet", target="contact_graspnet", source_tips=0.02
        ),
        "read_grasp_group": lambda g: f.read_grasp_group(_grasp_rows(poses(5, 3))),
        "shape_features": lambda g: f.shape_features(f.neighborhood_covariance(g.source, max_neighbors=12)[1]),
        "smallest_rectangle": lambda g: f.smallest_rectangle(g.source[:, :2]),
        "voxel_cells": lambda g: f.voxel_cells(g.source, 0.04),
        "voxel_maximum": lambda g: f.voxel_maximum(torch.arange(300) % 7, g.inverse, g.count),
        "register_to_color": lambda g: _registered(g.frame, g.colors),
    }
    for name, make in calls.items():
        yield f"function/{name}", lambda make=make: make(_given())


def _grasp_rows(grasps: Tensor) -> Tensor:
    numbers = torch.arange(20, dtype=torch.float64).reshape(5, 4)
    return torch.cat([numbers, grasps[:, :3, :3].reshape(5, 9), grasps[:, :3, 3], numbers[:, :1]], 1)


def _searched_often(index: Any, queries: Tensor) -> list[Any]:
    asked = {"queries": queries, "queries_ptr": ptr_of(25, 15)}
    return [
        *(index.knn(k=5, **asked), index.knn(k=5, exclude_self=True)),
        *(index.ball_query(radius=0.03, max_neighbors=7, **asked), index.radius_neighbors(radius=0.03, **asked)),
    ]


def _registered(frame: Any, colors: Tensor) -> Any:
    """Depth brought onto the pixels of a camera 3 cm beside."""
    beside = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    beside[:, 0, 3] = 0.03
    return register_to_color(frame, colors, frame.camera, beside)


def _volume(frames: list[Any], backend: str, **options: Any) -> Any:
    """The points, the mesh and the stored arrays of a volume."""
    volume = TSDFVolume(backend=backend, **options)
    for frame in frames:
        volume.integrate(frame)
    file = scratch("volume") / "volume.npz"
    write_volume(file, volume)
    with np.load(file, allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files if stored[name].dtype.kind in "biuf"}
    return {
        "points": volume.extract_points(),
        "seen twice": volume.extract_points(min_weight=2.0),
        "mesh": volume.extract_mesh(),
        "stored": arrays,
    }


def _fusions() -> Iterator[Case]:
    backends = ["torch", "cpu"] if has_core() else ["torch"]
    plans: dict[str, tuple[Callable[[], list[Any]], dict[str, Any]]] = {
        "plain": (lambda: [rendered(2, 5)], {"voxel_size": 0.02}),
        "angle": (lambda: [rendered(2, 5), rendered(2, 6)], {"voxel_size": 0.02, "weighting": "angle"}),
        "everywhere": (lambda: [rendered(2, 5), rendered(2, 6)], {"voxel_size": 0.02, "carve": "everywhere"}),
        "never": (lambda: [rendered(2, 5)], {"voxel_size": 0.015, "carve": "never", "truncation": 0.04}),
        "confidence": (
            lambda: [with_confidence(rendered(2, 5))],
            {"voxel_size": 0.02, "min_confidence": Confidence.RELIABLE},
        ),
    }
    if real_folder() is not None:
        plans["seven_scenes"] = (
            lambda: [run(step("DecimateDepth", factor=4), joined([real_frame("seven_scenes", n)])) for n in range(3)],
            {"voxel_size": 0.03},
        )
    for name, (frames, options) in plans.items():
        for backend in backends:
            yield (
                f"fusion/{name}/{backend}",
                lambda frames=frames, backend=backend, options=options: _volume(frames(), backend, **options),
            )


def cases() -> Iterator[Case]:
    """Yield ``function/NAME`` and ``fusion/plan/backend``."""
    yield from _function_calls()
    yield from _fusions()
