"""Digests of every inner function: the steps of operations, and what picks, joins and moves rows."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import torch
from digest_inputs import poses, rendered, seeded, with_confidence
from digest_names import (
    Limits,
    ParallelJaw,
    PixelCamera,
    Role,
    StoredForm,
    StoredGroups,
    backends_of,
    call_inner,
    find_records,
    functional,
    parts_of,
)
from digest_operations import CLOUDS, LENS, Case, _queries, on_a_grid, points, ptr_of
from torch import Tensor

Arguments = tuple[tuple[Any, ...], dict[str, Any]]


def _fields() -> dict[str, Tensor]:
    return {"points": points(90, 1), "labels": torch.arange(90), "byte": torch.arange(90).to(torch.uint8)}


def _depth_filters() -> Iterator[tuple[str, str, Callable[[], Arguments]]]:
    depth = rendered(2, 5).depth
    depth = torch.where(torch.rand(depth.shape, generator=seeded(9)) < 0.2, 0.0, depth)
    seen = torch.randint(0, 256, depth.shape, generator=seeded(10), dtype=torch.uint8)
    scale, last = torch.tensor([3.0, 5.0]), depth.flip(2)
    yield "reciprocals", "two", lambda: ((depth, scale), {})
    yield "smoothed_images", "values", lambda: ((depth, None, 0.5, 0.01, 2), {})
    yield "smoothed_images", "reciprocals", lambda: ((depth, scale, 0.5, 0.1, 2), {})
    yield "temporal_step", "values", lambda: ((depth, None, last, seen, 0.4, 0.01, 3), {})
    yield "temporal_step", "reciprocals", lambda: ((depth, scale, last, seen, 0.4, 0.1, 5), {})
    yield "without_flying_pixels", "confidence", lambda: ((depth, seen % 4, 0.02, 3), {})
    yield "look_at_depth", "same", lambda: ((depth, depth.clone()), {})
    yield "look_at_depth", "other", lambda: ((depth, last), {})
    yield "fill_rows", "three", lambda: ((depth, 3), {})
    yield "filled_images", "farthest", lambda: ((depth, "farthest", 4, 1), {})
    yield "filled_confidence", "two", lambda: ((depth, last, seen % 4, seen > 99), {})


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


def _into_box(lens: str, *, moved: bool, flying: tuple[float, int] | None = None) -> Arguments:
    box = {"lower": (-0.3, -0.3, 0.0), "upper": (0.3, 0.2, 0.9), "near": 0.2, "far": 1.5, "mask": _mask()}
    matrix = rendered(2, 5).world_from_camera if moved else None
    return _images(lens)[0], {**box, "matrix": matrix, "flying": flying}


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


def calls() -> Iterator[tuple[str, str, Callable[[], Arguments]]]:
    """Yield inner function, input, and what makes the arguments."""
    rows = torch.tensor([3, 3, 89, 0])
    yield "pick_rows", "index", lambda: ((_fields(), rows), {})
    yield "pick_rows", "mask", lambda: ((_fields(), points(90, 1)[:, 0] > 0.1), {})
    marks, ptr = points(90, 1)[:, 0] > 0.1, ptr_of(50, 40)
    yield "kept_rows", "gone", lambda: ((marks, ptr), {"gone": True})
    yield "kept_rows", "within", lambda: ((marks, ptr), {"within": points(90, 1)[:, 1] > 0.05})
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
        "random_order",
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
    yield from _depth_filters()
    for lens in ("pinhole", "lens"):
        yield "deproject_images", lens, partial(_images, lens)
        yield "deproject_into_box", f"{lens} camera", partial(_into_box, lens, moved=False)
        yield "deproject_into_box", f"{lens} base", partial(_into_box, lens, moved=True)
        yield (
            "deproject_into_box",
            f"{lens} without flying pixels",
            partial(_into_box, lens, moved=True, flying=(0.01, 3)),
        )
    some = torch.arange(400) % 5 > 0
    yield "rows_in_company", "all", lambda: ((points(400, 3), ptr_of(250, 150), 4, 0.03, None), {})
    yield "rows_in_company", "within", lambda: ((points(400, 3), ptr_of(400), 4, 0.03, None, some), {})
    yield "usual_rows", "two", lambda: ((points(400, 3), ptr_of(250, 150), 8, 1.5, None), {})
    yield "nearest_chunks", "radius", lambda: ((points(400, 3), ptr_of(400), 6), {"radius": 0.03})
    asked = _queries({})
    searched = asked.pop("points"), asked.pop("ptr"), 5
    yield "nearest_chunks", "queries", lambda: (searched, asked)
    cloud, ptr, distance = CLOUDS["two"]()["points"], ptr_of(90, 36), 0.01
    planes = torch.nn.functional.normalize(torch.randn(2, 30, 4, generator=seeded(4), dtype=torch.float64), dim=2)
    planes[:, :, 3] *= 0.1
    competes, floors = planes[:, :, 0] < 0.9, torch.zeros(2, dtype=torch.int64)
    yield "record_planes", "two", lambda: ((cloud, ptr, planes, competes, distance, floors), {})
    yield "search_planes", "two", lambda: ((cloud, ptr, planes, competes, distance, 0.9, 0, 5), {})
    yield "near_planes", "two", lambda: ((cloud, ptr, planes[:, 0], distance), {})
    yield "fit_planes", "two", lambda: ((cloud, ptr, cloud[:, 2] > 0.05), {})
    yield "refine_planes", "two", lambda: ((cloud, ptr, planes[:, 0], distance, None, None), {})
    yield "largest_planes", "all", lambda: ((cloud, ptr, distance, 200, 3, None), {})
    yield "largest_planes", "until sure", lambda: ((cloud, ptr_of(90, 30), distance, 200, 3, 0.99), {})
    yield "move_kept", "room", lambda: ((points(90, 1), torch.arange(90), ptr_of(50, 30), points(90, 1)[:, 0] > 0), {})
    yield from _calls_of_motions()
    yield from _calls_of_searches()
    yield from _calls_of_images()


def _calls_of_motions() -> Iterator[tuple[str, str, Callable[[], Arguments]]]:
    keys = torch.arange(-3, 4) * 0x1234567
    # Step, word, kind (an entry, a sign, a turn about an axis), and the numbers of each.
    rows = [(0, 0, 2, -3.0, 3.0, 0.6, 0.8, 0), (1, 1, 0, 0.9, 1.1, 0, 0, 0), (1, 2, 1, 0.5, 0, 2, 0, 0)]
    yield "draw_motions", "seven", lambda: ((keys, torch.tensor(rows, dtype=torch.float64), 2), {})
    yield "led_back", "two steps", lambda: ((poses(2), torch.stack([poses(4)[2:], poses(6)[4:]])), {})
    yield "are_plain_motions", "poses", lambda: ((poses(3),), {})
    yield "dropped_rows", "two", lambda: ((keys[:2], ptr_of(50, 40), 0.1, 0.6), {})
    kept = torch.arange(20) % 3 > 0, torch.tensor([0, 5, 13])
    addresses = torch.tensor([_ROWS.ctypes.data, _ROWS.ctypes.data + 8 * 12])
    for name, rest in (("all", None), ("thinned", kept)):
        yield "gather_kept", name, partial(_gathered, addresses, rest)


def _gathered(addresses: Tensor, kept: tuple[Tensor, Tensor] | None) -> Arguments:
    return ({"points": torch.zeros(20, 3)}, {"points": addresses}, ptr_of(8, 12), kept), {}


def _calls_of_searches() -> Iterator[tuple[str, str, Callable[[], Arguments]]]:
    cloud, ptr = CLOUDS["two"]()["points"], ptr_of(90, 36)
    asked = _queries({})
    searched = asked.pop("points"), asked.pop("ptr")
    for name, more in (("nearest_rows", ()), ("nearest_in", ({},))):
        yield name, "radius", lambda more=more: ((cloud, ptr, *more, 6), {"radius": 0.03})
        yield name, "queries", lambda more=more: ((*searched, *more, 5), asked)
    for name, more in (("rows_within", ()), ("within_in", ({},))):
        yield name, "own", lambda more=more: ((cloud, ptr, *more, 0.03), {"exclude_self": True})
        yield name, "queries", lambda more=more: ((*searched, *more, 0.04), asked)
    found = functional.knn(cloud, ptr, k=7)[0]
    reach = torch.full((len(cloud),), torch.inf)
    for norm in ("l1", "linf"):
        yield "nearest_by_norm", norm, lambda norm=norm: ((cloud, ptr, norm, 4, cloud, ptr, reach), {})
    yield "neighborhood_shapes", "two", lambda: ((cloud, found, cloud), {})
    yield "sorted_rows", "two", lambda: ((cloud, ptr), {})
    yield "density_clusters", "two", lambda: ((cloud, ptr, 0.03, 4, None), {})
    yield "farthest_rows", "two", lambda: ((cloud, ptr, [20, 7]), {})
    some = torch.arange(len(cloud)) % 3 != 1
    kept_ptr = torch.cat([ptr[:1], some.cumsum(0)[ptr[1:] - 1]])
    yield "farthest_rows_within", "two", lambda: ((cloud, kept_ptr, some, [11, 4]), {})
    yield "voxel_means", "two", lambda: ((cloud, ptr, 0.04 * torch.ones(2, 1, dtype=torch.float64), None), {})
    values = torch.rand(126, generator=seeded(4), dtype=torch.float64)
    yield "window_medians", "two", lambda: ((values, cloud, ptr, None), {})
    yield "window_medians", "on a grid", _medians
    yield "facing_normals", "one place", lambda: ((cloud, cloud.flip(0), torch.tensor([[0.1, 0.2, 0.3]])), {})
    place = torch.tensor([0.1, 0.2, 0.3])
    yield "normals_facing", "one place", lambda: ((cloud, ptr, 0.05, 9, None, place), {})
    yield "hull_rows", "two", lambda: ((cloud[:, :2].double(),), {})
    places = torch.tensor([[0.0, 0.0, 1.0], [0.1, 0.0, 0.9]], dtype=torch.float64)
    yield "reaches", "two", lambda: ((cloud, ptr, places, 0.01), {})
    seen, leaning = cloud[:, 2] > 0.05, torch.tensor([0.6, 0.0, 0.8, -0.05], dtype=torch.float64)
    yield "plane_surfaces", "two", lambda: ((cloud, ptr, seen, torch.stack([leaning, leaning]), 0.05), {})
    level, ones = torch.tensor([0.0, 0.0, 1.0, -0.05], dtype=torch.float64), torch.ones(126, dtype=torch.float64)
    yield "fit_surface", "level", lambda: ((cloud, ones, level, 0.03, "digest"), {})
    jaw = ParallelJaw(
        opening=0.08, finger_length=0.04, finger_thickness=0.01, finger_width=0.02, palm_length=0.05, tip=0.03
    )
    grasps = poses(5, 3)
    grasps[:, :3, 3] = cloud[:5] + 0.01
    lower, upper = jaw.boxes(torch.full((5,), 0.06))
    yield "points_in_grippers", "five", lambda: ((cloud, jaw.axes(grasps), grasps[:, :3, 3], lower, upper), {})


def _medians() -> Arguments:
    cloud = on_a_grid()
    return (cloud["points"][:, 2], cloud["points"], cloud["ptr"], cloud["grid"]), {}


def _calls_of_images() -> Iterator[tuple[str, str, Callable[[], Arguments]]]:
    values = torch.rand(90, 3, generator=seeded(6))
    front = torch.randint(0, 100, (70,), generator=seeded(7))
    yield "shaded", "points", lambda: ((values, front, 90), {"as_bytes": True})
    corners = torch.randint(0, 90, (95, 3), generator=seeded(8))
    yield "shaded", "triangles", lambda: ((values, front, 95, corners, values[:70]), {})
    yield "linked_pixels", "on a grid", _linked
    bent = torch.rand(30, 2, generator=seeded(4), dtype=torch.float64) - 0.5
    twelve = torch.nn.functional.pad(LENS[0], (0, 7))
    yield "unbent", "lens", lambda: ((bent, twelve, False, 1e3), {})
    bends = torch.tensor([0.02, -0.01, 0.003, -0.0005], dtype=torch.float64)
    yield "fisheye_rays", "lens", lambda: ((3 * bent, bends, 1.2), {})
    yield "front_triangles", "two", _triangles_in_boxes
    for name, make in (("smooth_regions", _touching), ("region_planes", _sides)):
        yield name, "table", make


def _linked() -> Arguments:
    cloud = on_a_grid()
    grid = cloud["grid"]
    return (cloud["points"], cloud["ptr"], grid.pixel_index, grid.size, 0.05, 2), {}


def _triangles_in_boxes() -> Arguments:
    """Two triangles over a small image, the one in front in part."""
    corners = torch.tensor(
        [
            [[-0.5, -0.5, 1.0], [0.5, -0.5, 1.0], [0.0, 0.6, 1.0]],
            [[-0.6, 0.0, 0.8], [0.6, 0.1, 1.3], [0.0, -0.6, 0.9]],
        ],
        dtype=torch.float64,
    )
    a, b, c = corners.unbind(1)
    cross = torch.linalg.cross
    normal = cross(b - a, c - a)
    axis = torch.linspace(-0.6, 0.6, 12, dtype=torch.float64)
    rays = torch.cartesian_prod(axis, axis).flip(1)
    boxes = tuple(torch.tensor(values) for values in ([0, 0], [12, 12], [12, 12]))
    return (boxes, 12, rays, normal, (normal * a).sum(1), torch.stack([cross(b, c), cross(c, a), cross(a, b)], 1)), {}


def _touching() -> Arguments:
    """A table with objects as inverse depth, and the pinhole that saw it."""
    depth = rendered(1, 3, (120, 160)).depth[0].double()
    (fx, _, cx), (_, fy, cy), _ = rendered(1, 3, (120, 160)).camera.intrinsics[0].tolist()
    inverse = torch.where(depth > 0, 1 / depth, 0.0)
    return (inverse, PixelCamera(fx, fy, cx, cy), 0.0026, Limits()), {}


def _sides() -> Arguments:
    (inverse, camera, noise, limits), _ = _touching()
    label = (torch.arange(160) // 40).expand(120, 160).contiguous()
    pixel = torch.arange(0, 120 * 160, 97)
    return (inverse, label, pixel[inverse.flatten()[pixel] > 0], camera, noise, limits), {}


def cases() -> Iterator[Case]:
    """Yield ``inner/NAME/backend/input``."""
    for name, label, given in calls():
        for backend in backends_of(name):
            yield (
                f"inner/{name}/{backend}/{label}",
                lambda name=name, backend=backend, given=given: call_inner(name, backend, *given()),
            )
