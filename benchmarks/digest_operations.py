"""Digests of every operation, public and inner, on every backend."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import Any

import numpy as np
import torch
from digest_inputs import poses, rendered, seeded, with_confidence
from digest_names import (
    Role,
    StoredForm,
    StoredGroups,
    backends_of,
    call,
    call_inner,
    find_records,
    functional,
    inner_names,
    operation_names,
    parts_of,
    tsdf,
)
from torch import Tensor

Case = tuple[str, Callable[[], Any]]
K = torch.tensor([[[30.0, 0.1, 8.2], [0.0, 31.0, 6.1], [0.0, 0.0, 1.0]]], dtype=torch.float64)
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
NEIGHBOR_OPERATIONS = {
    "ball_query": [{"radius": 0.03, "max_neighbors": 5}, {"radius": 0.04, "max_neighbors": 40}],
    "knn": [{"k": 4}, {"k": 40}],
    "dbscan": [{"eps": 0.03, "min_points": 4}, {"eps": 0.02, "min_points": 7}],
    "estimate_normals": [{"radius": 0.05, "max_neighbors": 12}, {"radius": None, "max_neighbors": 9}],
    "neighborhood_covariance": [{"radius": 0.05, "max_neighbors": 12}],
    "radius_neighbors": [{"radius": 0.03}, {"radius": 0.06, "exclude_self": True}],
    "radius_outlier_mask": [{"radius": 0.03, "min_neighbors": 2}, {"radius": 0.02, "min_neighbors": 6}],
    "statistical_outlier_mask": [{"num_neighbors": 6, "std_ratio": 1.0}],
}
CLOUD_OPERATIONS = {
    "farthest_point_sample": [{"num_samples": 20}],
    "farthest_point_groups": [{"ratio": 0.2}],
    "find_voxel_size": [{"num_points": 12}],
    "ransac_plane": [
        {"distance": 0.01, "num_hypotheses": 100},
        {"distance": 0.01, "seed": 5, "up": (0.0, 0.0, 1.0), "max_tilt": 0.3},
    ],
    "voxel_downsample": [
        {"voxel_size": 0.04},
        {"voxel_size": 0.021},
        {"voxel_size": [[0.04, 0.06, 0.11]], "origin": (0.03, 0.1, -0.2), "min_points": 3},
    ],
}
IMAGE_OPERATIONS = {
    "decimate_depth": [{"factor": 3}, {"factor": 2, "rule": "mean", "max_jump": 0.3}],
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
FUSIONS = ("touched_blocks", "find_blocks", "integrate_view", "find_crossings", "find_triangles")


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
    pair = {"points_a": points(90, 1), "ptr_a": ptr_of(50, 40), "points_b": points(80, 2), "ptr_b": ptr_of(30, 50)}
    yield "chamfer_distance", "two", lambda: pair
    same = {"points_a": lattice(), "ptr_a": None, "points_b": lattice(3), "ptr_b": None}
    yield "chamfer_distance", "ties", lambda: same
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


Arguments = tuple[tuple[Any, ...], dict[str, Any]]


def _fields() -> dict[str, Tensor]:
    return {"points": points(90, 1), "labels": torch.arange(90), "byte": torch.arange(90).to(torch.uint8)}


def _parts() -> dict[str, list[Tensor]]:
    return {name: [field[:50], field[50:]] for name, field in _fields().items()}


def _fillers() -> dict[str, int]:
    """What stands for no value: -1 where that is a signed integer."""
    signed = (torch.int16, torch.int32, torch.int64)
    return {name: -1 if values[0].dtype in signed else 0 for name, values in _parts().items()}


def _mask() -> Tensor:
    return torch.rand(rendered(2, 5).depth.shape, generator=seeded(8)) < 0.7


def _images(lens: str) -> Arguments:
    frame = with_confidence(rendered(2, 5))
    distortion = LENS.repeat(2, 1) * 0.1 if lens == "lens" else None
    more = {"labels": frame.labels, "confidence": frame.confidence}
    return (frame.depth, frame.camera.intrinsics, distortion, frame.colors, more), {}


def _into_box(lens: str, *, moved: bool) -> Arguments:
    box = {"lower": (-0.3, -0.3, 0.0), "upper": (0.3, 0.2, 0.9), "near": 0.2, "far": 1.5, "mask": _mask()}
    matrix = rendered(2, 5).world_from_camera if moved else None
    return _images(lens)[0], {**box, "matrix": matrix}


_ROWS = np.arange(60, dtype=np.float32).reshape(20, 3)  # of five records
_PLACES = torch.tensor([4, 0, 2])


def _groups() -> tuple[StoredGroups, StoredForm]:
    table = torch.tensor([[[_ROWS.ctypes.data, 0, 0]]])
    groups = StoredGroups(torch.tensor([0]), torch.tensor([[0, 0]]), torch.tensor([0, 2, 2, 6, 11, 20]))
    return groups, StoredForm(0, table, torch.tensor([12]), torch.tensor([Role.ANY]))


def _found_records() -> Arguments:
    groups, form = _groups()
    table = find_records(_PLACES, groups, form)
    return (torch.zeros(int(parts_of(table, 1, len(_PLACES)).starts[-1]), dtype=torch.uint8), form, table), {}


def _inner_calls() -> Iterator[tuple[str, str, Callable[[], Arguments]]]:
    """Yield inner function, input, and what makes the arguments."""
    rows = torch.tensor([3, 3, 89, 0])
    yield "pick_rows", "index", lambda: ((_fields(), rows), {})
    yield "pick_rows", "mask", lambda: ((_fields(), points(90, 1)[:, 0] > 0.1), {})
    yield "join_rows", "two", lambda: ((_parts(),), {})
    yield "pad_rows", "two", lambda: ((_parts(), 60, _fillers()), {})
    for name in ("transform_points", "transform_directions"):
        yield name, "one", lambda: ((points(90, 1), ptr_of(90), poses(2)[:1]), {})
        yield name, "two", lambda: ((points(90, 1), ptr_of(50, 40), poses(2)), {})
    seeds, two = torch.tensor([5, -7]), ptr_of(50, 40)
    yield (
        "move_points",
        "two",
        lambda: ((points(90, 1), two, [poses(2), (seeds, 0.01, None), (seeds + 1, 0.02, 0.03)]), {}),
    )
    yield (
        "random_rows",
        "three",
        lambda: ((torch.tensor([50, 0, 4000]), torch.tensor([7, 0, 3900]), torch.tensor([5, 6, 7])), {}),
    )
    yield "find_records", "three", lambda: ((_PLACES, *_groups()), {})
    yield "gather_records", "three", _found_records
    yield "inside_box", "random", lambda: ((points(90, 1), (0.05, 0.0, 0.0), (0.15, 0.2, 0.1)), {})
    spoilt = points(90, 1).index_fill(0, rows[:1], torch.nan)
    yield "inside_box", "not finite", lambda: ((spoilt, (0.0,) * 3, (1.0,) * 3), {})
    yield "mask_depth", "range", lambda: ((rendered(2, 5).depth, 0.5, 0.9, None), {})
    yield "mask_depth", "mask", lambda: ((rendered(2, 5).depth, None, None, _mask()), {})
    for lens in ("pinhole", "lens"):
        yield "deproject_images", lens, partial(_images, lens)
        yield "deproject_into_box", f"{lens} camera", partial(_into_box, lens, moved=False)
        yield "deproject_into_box", f"{lens} base", partial(_into_box, lens, moved=True)
    yield "nearest_chunks", "radius", lambda: ((points(400, 3), ptr_of(400), 6), {"radius": 0.03})
    asked = _queries({})
    searched = asked.pop("points"), asked.pop("ptr"), 5
    yield "nearest_chunks", "queries", lambda: (searched, asked)
    cloud, ptr, distance = CLOUDS["two"]()["points"], ptr_of(90, 36), 0.01
    triples = torch.stack([torch.arange(90).reshape(30, 3) % count for count in (90, 36)])
    planes = torch.nn.functional.normalize(torch.randn(2, 30, 4, generator=seeded(4), dtype=torch.float64), dim=2)
    planes[:, :, 3] *= 0.1
    yield "draw_planes", "two", lambda: ((cloud, ptr, triples, torch.tensor([0, 1])), {})
    yield "count_near_planes", "two", lambda: ((cloud, ptr, planes, distance), {})
    yield "near_planes", "two", lambda: ((cloud, ptr, planes[:, 0], distance), {})
    yield "fit_planes", "two", lambda: ((cloud, ptr, cloud[:, 2] > 0.05), {})


def cases() -> Iterator[Case]:
    """Yield ``op/NAME/backend/input`` and ``inner/NAME/backend/input``."""
    seen = set()
    for name, label, make in _operation_calls():
        seen.add(name)
        for backend in backends_of(name):
            yield (
                f"op/{name}/{backend}/{label}",
                lambda name=name, backend=backend, make=make: call(name, backend, make()),
            )
    for name, label, given in _inner_calls():
        seen.add(name)
        for backend in backends_of(name):
            yield (
                f"inner/{name}/{backend}/{label}",
                lambda name=name, backend=backend, given=given: call_inner(name, backend, *given()),
            )
    for name in sorted(seen ^ {*operation_names(), *inner_names()}):
        print(f"digests: the operation {name} has no example, or is no more", file=sys.stderr)
