"""Digests of every public operation, on every backend."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import Any

import torch
from digest_inputs import rendered, seeded
from digest_names import backends_of, call, functional, inner_names, operation_names, tsdf
from torch import Tensor

Case = tuple[str, Callable[[], Any]]
K = torch.tensor([[[30.0, 0.1, 8.2], [0.0, 31.0, 6.1], [0.0, 0.0, 1.0]]], dtype=torch.float64)
LAST = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
LENS = torch.tensor([[0.05, -0.02, 0.001, -0.002, 0.01]], dtype=torch.float64)


def points(count: int, seed: int) -> Tensor:
    """Half of them on a plane, with a few repeats."""
    cloud = torch.rand(count, 3, generator=seeded(seed)) * 0.2
    cloud[::2, 2] = 0.1
    if count > 6:
        cloud[5::7] = cloud[4:-1:7][: len(cloud[5::7])]
    return cloud


def lattice(side: int = 5) -> Tensor:
    """Points on a lattice, some twice: every distance comes many times."""
    axis = torch.arange(side) * 0.02
    grid = torch.cartesian_prod(axis, axis, axis)
    return torch.cat([grid, grid[::3]])


def ptr_of(*counts: int) -> Tensor:
    return torch.tensor([0, *counts]).cumsum(0)


@cache
def on_a_grid() -> dict[str, Any]:
    """Two views of a table that still lie on their depth images."""
    frame = rendered(2, 3)
    found, ptr, pixel = functional.deproject_depth(frame.depth, frame.camera.intrinsics)
    grid = functional.ImageGrid(pixel, frame.size, frame.camera.intrinsics)
    return {"points": found, "ptr": ptr, "grid": grid}


# Input -> the clouds that operations on points are called with; nothing is made before it is asked for.
CLOUDS: dict[str, Callable[[], dict[str, Any]]] = {
    "random": lambda: {"points": points(400, 3)},
    "ties": lambda: {"points": lattice()},
    "same": lambda: {"points": torch.full((40, 3), 0.3)},
    "two": lambda: {"points": torch.cat([points(90, 6), lattice(3)]), "ptr": ptr_of(90, 36)},
    "four": lambda: {
        "points": torch.cat([points(60, 0), points(1, 1), points(90, 2), lattice(3)]),
        "ptr": ptr_of(60, 1, 90, 36),
    },
    "with empty": lambda: {"points": torch.cat([points(60, 0), lattice(3)]), "ptr": ptr_of(60, 0, 36)},
    "on a grid": on_a_grid,
}
PAIRS: dict[str, Callable[[], dict[str, Any]]] = {
    "two": lambda: {
        **{"points_a": points(90, 1), "ptr_a": ptr_of(50, 40)},
        **{"points_b": points(80, 2), "ptr_b": ptr_of(30, 50)},
    },
    "ties": lambda: {"points_a": lattice(), "ptr_a": None, "points_b": lattice(3), "ptr_b": None},
}
NEIGHBOR_OPERATIONS = {
    "ball_query": [{"radius": 0.03, "max_neighbors": 5}, {"radius": 0.04, "max_neighbors": 40}],
    "knn": [{"k": 4}, {"k": 40}, {"k": 5, "norm": "l1"}, {"k": 5, "norm": "linf"}],
    "dbscan": [{"eps": 0.03, "min_points": 4}, {"eps": 0.02, "min_points": 7}],
    "estimate_normals": [{"radius": 0.05, "max_neighbors": 12}, {"radius": None, "max_neighbors": 9}],
    "neighborhood_covariance": [{"radius": 0.05, "max_neighbors": 12}],
    "radius_neighbors": [{"radius": 0.03}, {"radius": 0.06, "exclude_self": True}],
    "core_point_mask": [{"eps": 0.03, "min_points": 4}],
    "radius_outlier_mask": [{"radius": 0.03, "min_neighbors": 2}, {"radius": 0.02, "min_neighbors": 6}],
    "statistical_outlier_mask": [{"num_neighbors": 6, "std_ratio": 1.0}],
}
CLOUD_OPERATIONS = {
    "box_mask": [{"lower": (0.0, 0.05, 0.0), "upper": (0.15, 0.2, 0.1)}],
    "duplicate_mask": [{}],
    "hard_voxels": [{"voxel_size": 0.04, "lower": (0.0,) * 3, "upper": (0.2,) * 3, "max_points": 3, "max_voxels": 20}],
    "farthest_point_sample": [{"num_samples": 20}],
    "farthest_point_groups": [{"ratio": 0.2}],
    "find_voxel_size": [{"num_points": 12}],
    "ransac_circle": [{"num_hypotheses": 100, "radius": (0.01, 0.2)}],
    "ransac_cylinder": [{"num_hypotheses": 100, "up": (0.0, 0.0, 1.0), "max_tilt": 1.0}],
    "ransac_line": [{"num_hypotheses": 100, "seed": 5}],
    "ransac_sphere": [{"num_hypotheses": 100, "radius": (0.01, 0.2)}],
    "ransac_plane": [
        {"distance": 0.01, "num_hypotheses": 100},
        {"distance": 0.01, "seed": 5, "up": (0.0, 0.0, 1.0), "max_tilt": 0.3},
    ],
    "segment_planes": [{"num_hypotheses": 50, "min_share": 0.1}],
    "supporting_plane": [{"num_hypotheses": 50, "distance": 0.005}],
    "voxel_downsample": [
        {"voxel_size": 0.04},
        {"voxel_size": 0.021},
        {"voxel_size": [[0.04, 0.06, 0.11]], "origin": (0.03, 0.1, -0.2), "min_points": 3},
    ],
}
IMAGE_OPERATIONS = {
    "decimate_depth": [{"factor": 3}, {"factor": 2, "rule": "mean", "max_jump": 0.3}],
    "bilateral_filter": [{}, {"reach": 1, "sigma_depth": 0.2, "max_jump": 0.5}],
    "median_filter": [{}, {"reach": 2, "max_jump": 0.3}],
    "fill_holes": [{"rule": "nearest"}, {"rule": "left"}, {"rule": "farthest"}],
    "flying_pixel_mask": [{}],
    "resize_depth": [{"size": (7, 30), "max_jump": 0.3}, {"size": (24, 32), "max_jump": None}],
}


def random_depth() -> Tensor:
    depth = 0.5 * (1 + torch.rand(2, 12, 16, generator=seeded(1)))
    depth[torch.rand(2, 12, 16, generator=seeded(2)) < 0.3] = 0
    return depth


def flat_depth() -> Tensor:
    """Two flat surfaces and a hole: every depth comes many times."""
    depth = torch.full((1, 13, 17), 0.5)
    depth[:, 3:6, 4:9] = 0
    depth[:, 8:, 10:] = 0.75
    return depth


IMAGES: dict[str, Callable[[], Tensor]] = {
    "random": random_depth,
    "ties": flat_depth,
    "rendered": lambda: rendered(2, 5).depth,
    "empty": lambda: torch.zeros(1, 6, 8),
}


def _on_cloud(name: str, label: str, options: dict[str, Any]) -> dict[str, Any]:
    cloud = dict(CLOUDS[label]())
    if name not in NEIGHBOR_OPERATIONS:
        cloud.pop("grid", None)
    return {**cloud, **options}


def _queries(options: dict[str, Any]) -> dict[str, Any]:
    asked = {"queries": torch.cat([points(40, 9), lattice(3)]), "queries_ptr": ptr_of(40, 36)}
    return {"points": torch.cat([points(60, 0), lattice()]), "ptr": ptr_of(60, 167), **asked, **options}


def _seen(label: str, lens: str) -> dict[str, Any]:
    depth = IMAGES[label]()
    distortion = LENS.repeat(len(depth), 1) if lens == "lens" else None
    return {"depth": depth, "intrinsics": K.repeat(len(depth), 1, 1), "distortion": distortion}


def _beside(label: str, lens: str) -> dict[str, Any]:
    seen = _seen(label, lens)
    views = len(seen["depth"])
    beside = torch.eye(4, dtype=torch.float64).repeat(views, 1, 1)
    beside[:, 0, 3] = 0.03
    wide = 1.5 * K.repeat(views, 1, 1)
    wide[:, 2, 2] = 1.0
    color = None if seen["distortion"] is None else -0.5 * seen["distortion"]
    target = {"color_intrinsics": wide, "color_from_depth": beside, "color_size": (18, 24)}
    return {**seen, **target, "color_distortion": color}


def _projected(lens: str) -> dict[str, Any]:
    distortion = LENS.repeat(2, 1) if lens == "lens" else None
    front = points(90, 4) + 0.5
    return {"points": front, "ptr": ptr_of(50, 40), "intrinsics": K.repeat(2, 1, 1), "distortion": distortion}


FIELD = tsdf.VoxelGrid(0.02, 0.1)
FUSIONS = ("touched_blocks", "find_blocks", "locate_views", "integrate_view", "find_crossings", "find_triangles")


def _view(number: int) -> Any:
    """One of two views of a table as fusion takes it: with colors, labels and weights."""
    frame = rendered(2, 5)
    (fx, skew, cx), (_, fy, cy), _ = frame.camera.intrinsics[number].tolist()
    rays = functional.pixel_rays(frame.camera.intrinsics, frame.size)[number]
    return tsdf.FusionView(
        depth=frame.depth[number],
        rays=rays.permute(2, 0, 1).float().contiguous(),
        pinhole=(fx, skew, cx, fy, cy),
        distortion=None,
        world_from_camera=frame.world_from_camera[number],
        weight=tsdf.weight_image(frame.depth[number], rays, "angle"),
        color=tsdf.pack_colors(frame.colors[number], backend="torch"),
        label=tsdf.pack_labels(frame.labels[number]),
    )


def _fusion(name: str) -> dict[str, Any]:
    """The arguments of a step of fusion: of the second view, into what the first one left."""
    first, second = _view(0), _view(1)
    if name == "touched_blocks":
        return {"view": second, "grid": FIELD}
    blocks = tsdf.VoxelBlocks(tsdf.voxel_planes(colors=True, labels=True, views=True), torch.device("cpu"))
    blocks.add(tsdf.touched_blocks(first, FIELD, backend="torch"))
    if name == "locate_views":
        return {"blocks": blocks, "views": [first, second], "grid": FIELD}
    keys = tsdf.touched_blocks(second, FIELD, backend="torch")
    if name == "find_blocks":
        return {"blocks": blocks, "keys": keys}
    blocks.add(blocks_without(blocks, keys))
    if name == "integrate_view":
        return {"blocks": blocks, "rows": blocks.find(keys), "view": second, "grid": FIELD, "carve": True}
    for view in (first, second):
        rows = blocks.find(tsdf.touched_blocks(view, FIELD, backend="torch"))
        tsdf.integrate_view(blocks, rows, view, FIELD, carve=True, backend="torch")
    if name == "find_crossings":
        return {"blocks": blocks, "grid": FIELD, "edges": True}
    return {"blocks": blocks, "edge": tsdf.find_crossings(blocks, FIELD, edges=True, backend="torch").edge}


def blocks_without(blocks: Any, keys: Tensor) -> Tensor:
    """The keys of which a field has no block."""
    return tsdf.find_blocks(blocks, keys, backend="torch")[1]


def _operation_calls() -> Iterator[tuple[str, str, Callable[[], dict[str, Any]]]]:
    """Yield operation, input, and what makes the arguments."""
    for table in (NEIGHBOR_OPERATIONS, CLOUD_OPERATIONS):
        for name, variants in table.items():
            for number, options in enumerate(variants):
                for label in CLOUDS:
                    yield name, f"{label} {number}", partial(_on_cloud, name, label, options)
    for name, options in (("knn", {"k": 7}), ("ball_query", {"radius": 0.05, "max_neighbors": 6})):
        yield name, "queries", partial(_queries, options)
    for label, clouds in PAIRS.items():
        yield "chamfer_distance", label, clouds
    for name, variants in IMAGE_OPERATIONS.items():
        for number, options in enumerate(variants):
            for label, make in IMAGES.items():
                yield name, f"{label} {number}", lambda make=make, options=options: {"depth": make(), **options}
    for label, make in IMAGES.items():
        yield "spatial_filter", label, lambda make=make: {"disparity": make(), "delta": 0.3}
        for lens in ("pinhole", "lens"):
            yield "deproject_depth", f"{label} {lens}", partial(_seen, label, lens)
            yield "register_depth", f"{label} {lens}", partial(_beside, label, lens)
    for lens in ("pinhole", "lens"):
        yield "project_points", lens, partial(_projected, lens)
    for name in FUSIONS:
        yield name, "two views", partial(_fusion, name)
    yield "pack_colors", "rendered", lambda: {"colors": rendered(2, 5).colors[0]}
    yield from _clouds_and_what_else()
    yield from _image_pairs()


def _clouds_and_what_else() -> Iterator[tuple[str, str, Callable[[], dict[str, Any]]]]:
    """Yield calls of operations on clouds that take more than clouds, or a pair of them."""
    for name, options in (("f_score", {"threshold": 0.02}), ("hausdorff_distance", {})):
        for label, clouds in PAIRS.items():
            yield name, label, lambda clouds=clouds, options=options: {**clouds(), **options}
    two = CLOUDS["two"]
    yield "chamfer_distance", "normals", lambda: {**PAIRS["two"](), **_normals(), "norm": "l1", "squared": False}
    weights = torch.rand(126, generator=seeded(9)) * 2
    yield "core_point_mask", "weights", lambda: {**two(), "eps": 0.03, "min_points": 4, "weights": weights}
    yield "dbscan", "weights", lambda: {**two(), "eps": [0.03, 0.021], "min_points": 4, "weights": weights}
    target = two()["points"][:, [1, 2, 0]] + 0.01 * torch.rand(126, 3, generator=seeded(3))
    for number, options in enumerate(({}, {"with_scale": True, "weights": weights})):
        yield "fit_paired_points", f"two {number}", lambda options=options: {**two(), "targets": target, **options}
    start = CLOUDS["two"]()["points"] + 0.003
    yield "iterate_closest_points", "two", lambda: {**two(), "targets": start, "targets_ptr": ptr_of(90, 36)}
    features = torch.rand(227, 4, generator=seeded(5))
    yield "interpolate_features", "queries", lambda: {**_queries({"k": 5}), "features": features}
    directions = torch.nn.functional.normalize(torch.randn(126, 3, generator=seeded(8)), dim=1)
    yield "boundary_mask", "two", lambda: {**two(), "normals": directions, "radius": 0.05}
    polygon = [[0.0, 0.0], [0.2, 0.0], [0.1, 0.05], [0.0, 0.2]]
    for label in ("random", "ties"):
        flat = CLOUDS[label]()["points"][:, :2].contiguous()
        yield "polygon_mask", label, lambda flat=flat: {"points": flat, "polygon": polygon}
    seen = {"intrinsics": K, "size": (9, 12), "near": 0.02}
    yield "frustum_mask", "random", lambda: {"points": CLOUDS["random"]()["points"], **seen}
    yield "hidden_point_mask", "two", lambda: {**two(), "viewpoint": (0.1, 0.1, 0.5)}
    planes = torch.tensor([[0.0, 0.0, 2.0, -0.2], [0.0, 0.0, 1.0, -0.02]], dtype=torch.float64)
    yield "table_surface", "two", lambda: {**two(), "planes": planes, "viewpoint": (0.1, 0.1, 1.0)}
    yield "table_surface", "on a grid", _table_of_a_grid


def _normals() -> dict[str, Tensor]:
    normals = torch.nn.functional.normalize(torch.randn(90, 3, generator=seeded(7)), dim=1)
    return {"normals_a": normals, "normals_b": normals.flip(0)[:80]}


def _table_of_a_grid() -> dict[str, Any]:
    cloud = on_a_grid()
    planes, _ = functional.supporting_plane(cloud["points"], cloud["ptr"], distance=0.005, num_hypotheses=50)
    return {**cloud, "planes": planes, "viewpoint": (0.0, 0.0, 0.0)}


def _image_pairs() -> Iterator[tuple[str, str, Callable[[], dict[str, Any]]]]:
    """Yield calls of operations between clouds and images, or between two cameras."""
    for label, make in IMAGES.items():
        yield "deproject_ranges", label, lambda make=make: {"ranges": make()}
        for lens in ("pinhole", "lens"):
            yield "depth_normals", f"{label} {lens}", lambda label=label, lens=lens: {**_seen(label, lens), "reach": 2}
        for rule in ("nearest", "surface"):
            yield "undistort_depth", f"{label} {rule}", partial(_undistorted, label, rule=rule, max_jump=0.3)
    for rule in ("bilinear", "nearest"):
        yield "undistort_image", f"rendered {rule}", partial(_undistorted, "rendered", rule=rule, size=(7, 30))
    yield "image_clusters", "on a grid", _on_its_pixels
    for lens in ("pinhole", "lens"):
        seen = {"size": (12, 16), "point_size": 0.02}
        yield "render_points", lens, lambda lens=lens, seen=seen: {**_projected(lens), **seen}
        yield "render_triangles", lens, partial(_triangles, lens)
    for label in ("two", "with empty"):
        yield "render_ranges", label, lambda label=label: {**CLOUDS[label](), "size": (12, 16)}


def _undistorted(label: str, **options: Any) -> dict[str, Any]:
    seen = _seen(label, "lens")
    if "size" in options:
        seen["image"] = rendered(2, 5).colors
        del seen["depth"]
    return {**seen, "new_intrinsics": 0.9 * K.repeat(len(seen["intrinsics"]), 1, 1) + 0.1 * LAST, **options}


def _on_its_pixels() -> dict[str, Any]:
    cloud = dict(on_a_grid())
    grid = cloud.pop("grid")
    return {**cloud, "pixel_index": grid.pixel_index, "size": grid.size, "eps": 0.05, "reach": 2}


def _triangles(lens: str) -> dict[str, Any]:
    seen = _projected(lens)
    corners = seen.pop("points").reshape(30, 3, 3)
    return {**seen, "triangles": corners, "ptr": ptr_of(16, 14), "size": (12, 16)}


def without_example() -> list[str]:
    """Return the operations that no case calls, and the cases of operations that are no more."""
    from digest_inner import calls

    seen = {name for name, _, _ in _operation_calls()} | {name for name, _, _ in calls()}
    return sorted(seen ^ {*operation_names(), *inner_names()})


def cases() -> Iterator[Case]:
    """Yield ``op/NAME/backend/input``."""
    for name, label, make in _operation_calls():
        for backend in backends_of(name):
            yield (
                f"op/{name}/{backend}/{label}",
                lambda name=name, backend=backend, make=make: call(name, backend, make()),
            )
