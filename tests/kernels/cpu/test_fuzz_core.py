"""The compiled core against the torch reference on random clouds made to be awkward: ties, holes, odd sizes.

Seeded: case n is the same on every machine. ``PCDATA_FUZZ_CASES`` sets how many cases each instruction set runs.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from pcdata import functional as F
from pcdata.contracts.dispatch import INNER, OPERATIONS, why_unavailable
from pcdata.errors import PcdataError, add_note
from pcdata.functional.image_grid import ImageGrid
from pcdata.functional.rows import ptr_from_counts
from pcdata.geometry.lens import plain_lenses
from pcdata.geometry.lens_models import lens_row

pytestmark = pytest.mark.skipif(why_unavailable("cpu") is not None, reason=str(why_unavailable("cpu")))

# Compared in ways of their own: a direction may be free, a fit may add in another order.
OWN_CHECKS = {"estimate_normals", "ransac_plane"}
# Sums of what knn and ball_query find, in torch.
OWN_CHECKS |= {"f_score", "hausdorff_distance", "interpolate_features"}
# Its second step alone, below.
OWN_CHECKS |= {"neighborhood_covariance"}
# Neighbors that the fuzzed searches find, looked at in torch.
OWN_CHECKS |= {"boundary_mask", "iterate_closest_points"}
# Planes that ransac_plane's steps find, chosen among in torch; a surface whose steps are fuzzed below.
OWN_CHECKS |= {"segment_planes", "supporting_plane", "table_surface"}
CASES = int(os.environ.get("PCDATA_FUZZ_CASES", "12"))


@pytest.fixture
def machine(instruction_set: str) -> Iterator[str]:
    """Each instruction set in turn, with whatever number of threads a case sets."""
    threads = torch.get_num_threads()
    yield instruction_set
    torch.set_num_threads(threads)


def depth_image(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """An image in metres, 0 = no reading, in which many pixels lie equally far from one another."""
    v, u = np.mgrid[:height, :width]
    kind = rng.integers(6)
    z = np.full((height, width), rng.choice([0.3, 0.5, 1.0]))
    if kind == 1:
        z = np.rint((z + rng.normal(0, 0.0007, z.shape)) * 1000) / 1000
    if kind == 2:
        z = z / (1 - 0.002 * (u - width / 2))
    if kind == 3:
        z = np.where((u // 3 + v // 2) % 2 == 0, 0.5, 0.75)
    if kind == 4:
        z = rng.choice([0.4, 0.401, 0.402], z.shape)
    if kind == 5:
        z[rng.random(z.shape) < 0.1] = 3.0
    holes = rng.choice([0.0, 0.0, 0.1, 0.6, 0.95])
    z[rng.random(z.shape) < holes] = 0
    if rng.random() < 0.2:  # the corner empty
        z[: height // 2, : width // 2] = 0
    return z


def organized(rng: np.random.Generator) -> tuple[Tensor, Tensor, ImageGrid]:
    """One to three clouds on images of one size, one pixel to a few thousand; masked, cropped, perhaps moved."""
    height, width = (
        (1, 1),
        (1, int(rng.integers(1, 70))),
        (int(rng.integers(1, 70)), 1),
        (int(rng.integers(2, 60)), int(rng.integers(2, 12))),
        (int(rng.integers(2, 40)), int(rng.integers(2, 70))),
    )[rng.integers(5)]
    focal = float(rng.choice([30.0, 64.0, 150.0]))
    clouds, pixels, counts = [], [], []
    num_clouds = int(rng.integers(1, 4))
    for _ in range(num_clouds):
        z = depth_image(rng, height, width)
        if rng.random() < 0.2:
            z[:] = 0
        v, u = np.nonzero(z)
        if rng.random() < 0.3:  # cut out of the image
            kept = (u >= width // 4) & (v >= height // 5)
            v, u = v[kept], u[kept]
        depth = z[v, u]
        x, y = (u - (width - 1) / 2) * depth / focal, (v - (height - 1) / 2) * depth / focal
        clouds.append(np.column_stack([x, y, depth]).astype(np.float32))
        pixels.append(v * width + u)
        counts.append(len(u))
    points = torch.from_numpy(np.concatenate(clouds))
    intrinsics = torch.tensor([[[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]]])
    motion = None
    if rng.random() < 0.3:
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        matrix = torch.eye(4, dtype=torch.float64)
        matrix[:3, :3] = torch.from_numpy(turn)
        points = (points.double() @ matrix[:3, :3]).float()
        motion = matrix.expand(num_clouds, 4, 4)
    index = torch.from_numpy(np.concatenate(pixels).astype(np.int64))
    grid = ImageGrid(index, (height, width), intrinsics.expand(num_clouds, 3, 3), motion)
    return points, ptr_from_counts(counts), grid


def cloud(rng: np.random.Generator, count: int) -> np.ndarray:
    """A cloud in no order, with ties, copies, far-off or tiny coordinates."""
    kind = rng.integers(7)
    if kind == 0:
        return rng.integers(0, 4, (count, 3)).astype(np.float32)
    if kind == 1:
        return np.repeat(rng.normal(size=(1, 3)), count, axis=0).astype(np.float32)
    points = rng.normal(size=(count, 3)) * rng.choice([1e-6, 0.1, 1.0])
    if kind == 2:
        points = np.rint(points * 10) / 10
    if kind == 3:
        points += 1e5
    if kind == 4 and count:
        points[rng.integers(count)] = rng.choice([1e6, -1e6])
    if kind == 5:
        points[:, 2] = 0
    if kind == 6:
        points[::2] = points[1::2][: len(points[::2])] if count % 2 == 0 else points[::2]
    return points.astype(np.float32)


def ragged(rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    sizes = [0, 1, 2, 3, 15, 16, 17, 33, int(rng.integers(300))]
    counts = [int(rng.choice(sizes)) for _ in range(rng.integers(1, 6))]
    points = np.concatenate([cloud(rng, count) for count in counts])
    return torch.from_numpy(points), ptr_from_counts(counts)


def strided(rng: np.random.Generator, points: Tensor) -> Tensor:
    """The same values laid out in another way."""
    kind = rng.integers(4)
    if kind == 1:
        return points.T.contiguous().T
    if kind == 2:
        return torch.stack([points, points], dim=1)[:, 0]
    if kind == 3:
        return points.clone().requires_grad_()
    return points


class References:
    """What the reference gives to the calls of a case, in their order: computed once for all instruction sets."""

    def __init__(self) -> None:
        self.given: dict[tuple[int, int], Any] = {}
        self.case, self.call = 0, 0

    def begin(self, case: int) -> None:
        self.case, self.call = case, 0

    def next(self, compute: Callable[[], Any]) -> Any:
        key = (self.case, self.call)
        self.call += 1
        if key in self.given:
            return self.given[key]
        found = compute()
        if CASES <= 50:  # a long run would fill the memory
            self.given[key] = found
        return found


REFERENCES = References()


def outcome(name: str, backend: str, *args: Any, **kwargs: Any) -> Any:
    try:
        result = OPERATIONS[name].public(*args, **kwargs, backend=backend)
    except PcdataError as error:
        return type(error), str(error)
    return result if isinstance(result, tuple) else (result,)


def check(name: str, points: Tensor, *args: Any, exact: bool = True, **kwargs: Any) -> None:
    """Both backends give the same answer or the same error."""
    ours = outcome(name, "cpu", points, *args, **kwargs)
    # The tree gives what the reference gives (tests/kernels/test_torch_tree.py), in time for clouds of any size.
    plain = "torch_tree" if why_unavailable("torch_tree") is None and OPERATIONS[name].serves("torch_tree") else "torch"
    theirs = REFERENCES.next(lambda: outcome(name, plain, points, *args, **kwargs))
    if isinstance(theirs[0], type) or isinstance(ours[0], type):
        assert ours == theirs, name
        return
    for place, (a, b) in enumerate(zip(ours, theirs, strict=True)):
        assert OPERATIONS[name].gradient or not a.requires_grad
        assert a.shape == b.shape, (name, place)
        assert a.dtype == b.dtype, (name, place)
        if exact:
            assert torch.equal(a.isnan(), b.isnan()), (name, place, kwargs)  # a pixel that is none
            assert torch.equal(a.masked_fill(a.isnan(), 0), b.masked_fill(b.isnan(), 0)), (name, place, kwargs)
        else:
            torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-6)


def check_normals(points: Tensor, ptr: Tensor, **kwargs: Any) -> None:
    """Every normal that is determined at all is the reference's; where eigenvalues tie, any direction may be given."""
    arguments = {"backend": "cpu", **kwargs}
    ours = F.estimate_normals(points, ptr, **arguments)
    theirs = REFERENCES.next(lambda: F.estimate_normals(points, ptr, **{**arguments, "backend": "torch_tree"}))
    assert bool(torch.isfinite(ours).all())
    kwargs.pop("grid", None)
    index, _, count = REFERENCES.next(lambda: F.ball_query(points, ptr, **kwargs, backend="torch_tree"))
    real = (torch.arange(index.shape[1]) < count[:, None]).double()[..., None]
    near = torch.cat([points, points.new_zeros(1, 3)]).detach().double()[index] * real
    offset = (near - near.sum(1, keepdim=True) / count[:, None, None]) * real
    values = torch.linalg.eigvalsh(offset.mT @ offset / count[:, None, None])
    size = values.sum(1)
    # Coordinates themselves are rounded to 1e-7 of their size.
    coordinate = points.detach().double().abs().amax(1)
    clear = (values[:, 1] - values[:, 0] > 1e-3 * size) & (size > 1e-12 * coordinate.square())
    apart = torch.minimum((ours - theirs).abs().amax(1), (ours + theirs).abs().amax(1))
    assert bool((apart[clear] <= 1e-4).all()), float(apart[clear].max())


def fuzz_neighborhoods(rng: np.random.Generator, points: Tensor, ptr: Tensor, grid: ImageGrid | None) -> None:
    seen = strided(rng, points)
    k = int(rng.choice([1, 2, 3, 8, 9, 16, 30, 48, 49, 400]))
    radius = float(rng.choice([1e-6, 0.005, 0.02, 0.1, 3.0, 1e6]))
    check("knn", seen, ptr, k=k, grid=grid)
    check("ball_query", seen, ptr, radius=radius, max_neighbors=k, grid=grid)
    check("statistical_outlier_mask", seen, ptr, num_neighbors=k, std_ratio=float(rng.choice([0.5, 2.0])), grid=grid)
    check("radius_outlier_mask", seen, ptr, min_neighbors=int(rng.integers(1, 20)), radius=radius, grid=grid)
    reach = torch.from_numpy(rng.choice([1e-6, 0.02, 0.1], len(points)))
    check("ball_query", seen, ptr, radius=reach, max_neighbors=k, grid=grid)
    check("radius_neighbors", seen, ptr, radius=min(radius, 0.1), grid=grid, exclude_self=bool(rng.random() < 0.5))
    check_normals(seen, ptr, radius=radius, max_neighbors=k, grid=grid)
    check("core_point_mask", seen, ptr, eps=radius, min_points=int(rng.integers(1, 12)))
    check("dbscan", seen, ptr, eps=radius, min_points=int(rng.integers(1, 12)))
    found = F.knn(points, ptr, k=k)[0]
    ours, theirs = (body(points.detach(), found, points.detach()) for body in both("neighborhood_shapes"))
    assert all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))


def fuzz_queries(rng: np.random.Generator, points: Tensor, ptr: Tensor) -> None:
    counts = [int(rng.choice([0, 0, 1, 5, 40])) for _ in range(len(ptr) - 1)]
    queries = torch.from_numpy(np.concatenate([cloud(rng, count) for count in counts]))
    foreign = {"queries": strided(rng, queries), "queries_ptr": ptr_from_counts(counts)}
    check("knn", points, ptr, k=int(rng.choice([1, 5, 60])), **foreign)
    check("ball_query", points, ptr, radius=float(rng.choice([0.1, 10.0])), max_neighbors=7, **foreign)
    reach = torch.from_numpy(rng.choice([1e-3, 0.1, 10.0], len(queries)))
    check("radius_neighbors", points, ptr, radius=reach, **foreign)
    check("chamfer_distance", points, ptr, queries, foreign["queries_ptr"], exact=False)


def fuzz_samples(rng: np.random.Generator, points: Tensor, ptr: Tensor) -> None:
    seen = strided(rng, points)
    counts = (ptr[1:] - ptr[:-1]).tolist()
    check("farthest_point_sample", seen, ptr, num_samples=[int(rng.integers(0, count + 1)) for count in counts])
    start = torch.tensor([int(rng.integers(max(count, 1))) for count in counts])
    check("farthest_point_groups", seen, ptr, ratio=float(rng.choice([0.05, 1.0])), start=start)
    check("voxel_downsample", seen, ptr, voxel_size=float(rng.choice([1e-3, 0.05, 0.7, 1e3])))
    check("find_voxel_size", seen, ptr, num_points=int(rng.choice([1, 2, 10])))
    if min(counts) >= 3:
        distance = float(rng.choice([0.01, 0.3]))
        ours, theirs = (
            outcome("ransac_plane", backend, seen, ptr, distance=distance, num_hypotheses=30)
            for backend in ("cpu", "torch")
        )
        if isinstance(theirs[0], type):
            assert ours == theirs
        else:
            # The fits add in another order: the last bits differ, and with them points that lie on the limit.
            assert not isinstance(ours[0], type), ours
            assert ours[0].shape == theirs[0].shape


def fuzz_wide(rng: np.random.Generator, points: Tensor, ptr: Tensor) -> None:
    """Points of other than three columns, some of them repeats of others."""
    width = int(rng.choice([1, 2, 4, 6, 9, 17, 33]))
    table = (
        points.detach().repeat(1, -(-width // 3))[:, :width] * torch.from_numpy(rng.choice([0.1, 1.0], width)).float()
    )
    if rng.random() < 0.5:
        table = table + torch.from_numpy(rng.integers(0, 2, table.shape)).float()
    seen = strided(rng, table)
    check("knn", seen, ptr, k=int(rng.choice([1, 7, 48, 60])))
    foreign = {"queries": table.flip(0), "queries_ptr": ptr_from_counts((ptr[1:] - ptr[:-1]).flip(0).tolist())}
    check("ball_query", seen, ptr, radius=float(rng.choice([1e-3, 0.5, 10.0])), max_neighbors=5, **foreign)
    counts = [int(rng.integers(0, count + 1)) for count in (ptr[1:] - ptr[:-1]).tolist()]
    check("farthest_point_sample", seen, ptr, num_samples=counts)


def fuzz_masks(rng: np.random.Generator, points: Tensor, ptr: Tensor) -> None:
    seen = strided(rng, points)
    lower = torch.from_numpy(rng.normal(size=(len(ptr) - 1, 3)))
    upper = lower + torch.from_numpy(rng.choice([1e-3, 0.5, 1e6], (len(ptr) - 1, 3)))
    check("box_mask", seen, ptr, lower=lower, upper=upper)
    check("duplicate_mask", seen, ptr)
    corners = rng.normal(size=(int(rng.integers(3, 12)), 2))
    polygon = torch.from_numpy(np.rint(2 * corners) / 2 if rng.random() < 0.5 else corners)
    check("polygon_mask", strided(rng, points[:, :2].detach().contiguous()), polygon=polygon)
    edges = torch.from_numpy(rng.choice([0.02, 0.3, 5.0], (len(ptr) - 1, 3)))
    check("voxel_downsample", seen, ptr, voxel_size=edges, min_points=int(rng.integers(1, 4)))
    origin = torch.from_numpy(rng.normal(size=(len(ptr) - 1, 3)))
    check("voxel_downsample", seen, ptr, voxel_size=float(rng.choice([1e-3, 0.7])), origin=origin)


# A lens of each kind that the core knows, and one that it does not.
LENSES = [
    [0.18, -0.02, 0.001, -0.002],
    [0.3, -0.1, 1e-4, -2e-4, 0.01, 0.6, -0.05, 0.02, 1e-4, -5e-5, 2e-4, 3e-5],
    lens_row("", "inverse_brown_conrady", [-0.0563, 0.0667, -0.0008, 0.0002, -0.0215]),
    lens_row("", "fisheye", [-0.02, 0.006, -0.004, 0.0007]),
]


def a_lens(rng: np.random.Generator, views: int) -> Tensor | None:
    kind = rng.integers(len(LENSES) + 1)
    return None if kind == len(LENSES) else torch.tensor([LENSES[kind]], dtype=torch.float64).repeat(views, 1)


def fuzz_rendering(rng: np.random.Generator, points: Tensor, ptr: Tensor) -> None:
    views = len(ptr) - 1
    size = int(rng.integers(1, 40)), int(rng.integers(1, 50))
    camera = torch.tensor([[20.0, 0.1, size[1] / 2], [0, 21.0, size[0] / 2], [0, 0, 1]], dtype=torch.float64)
    cameras = {"intrinsics": camera.expand(views, 3, 3), "distortion": a_lens(rng, views)}
    seen = strided(rng, points.detach() + torch.tensor([0.0, 0.0, float(rng.choice([0.0, 2.0]))]))
    check("project_points", seen, ptr, **cameras)
    check("render_points", seen, ptr, size=size, point_size=float(rng.choice([0.0, 0.1, 10.0])), **cameras)
    check("render_ranges", seen, ptr, size=size)
    low, high = sorted(rng.choice([-np.pi / 2, -1.0, -0.2, 0.0, 0.5, np.pi / 2], 2, replace=False).tolist())
    check("render_ranges", seen, ptr, size=size, elevations=(low, high))
    ranges = torch.from_numpy(rng.choice([0.0, 0.5, 2.0, 1e4], (int(rng.integers(1, 4)), *size))).float()
    turned = ranges.mT.contiguous().mT if rng.random() < 0.5 else ranges
    check("deproject_ranges", turned, elevations=(low, high))
    fuzz_shading(rng, points.detach())
    triangles = points.detach()[: len(points) // 3 * 3].reshape(-1, 3, 3) + torch.tensor([0.0, 0.0, 2.0])
    counts = [len(triangles) if view == 0 else 0 for view in range(views)]
    check("render_triangles", triangles, ptr_from_counts(counts), size=size, **cameras)


def fuzz_shading(rng: np.random.Generator, values: Tensor) -> None:
    pixels, items = int(rng.integers(0, 300)), int(rng.integers(0, 40))
    alone = torch.from_numpy(rng.integers(0, len(values) + 1, pixels))
    given: list[tuple[Any, ...]] = [(alone, len(values), None, None)]
    if len(values):
        corners = torch.from_numpy(rng.integers(0, len(values), (items, 3)))
        weights = torch.from_numpy(rng.random((pixels, 3))).float()
        given.append((torch.from_numpy(rng.integers(0, items + 2, pixels)), items, corners, weights))
    for arguments in given:
        for as_bytes in (False, True):
            ours, theirs = (
                body(strided(rng, values).detach(), *arguments, as_bytes=as_bytes) for body in both("shaded")
            )
            assert ours.dtype == theirs.dtype
            assert torch.equal(ours, theirs)


def fuzz_rows(rng: np.random.Generator, points: Tensor, ptr: Tensor) -> None:
    fields = {"points": strided(rng, points).detach(), "labels": torch.arange(len(points)), "none": points[:, :0]}
    mask = torch.from_numpy(rng.choice(np.array([0, 1, 255], dtype=np.uint8), len(points))).view(torch.bool)
    rows = torch.from_numpy(rng.integers(0, max(1, len(points)), rng.integers(0, 50)))
    for chosen in (mask, rows if len(points) else rows[:0]):
        ours, theirs = INNER["pick_rows"].public(fields, chosen), INNER["pick_rows"].reference(fields, chosen)
        assert all(torch.equal(ours[name], theirs[name]) for name in fields)
    matrix = torch.from_numpy(rng.normal(size=(len(ptr) - 1, 4, 4)))
    ours, theirs = (body(points, ptr, matrix) for body in both("transform_points"))
    torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6)
    ours, theirs = (body(points, (-0.1,) * 3, (0.5,) * 3) for body in both("inside_box"))
    assert torch.equal(ours, theirs)


def both(name: str) -> tuple[Callable[..., Any], Callable[..., Any]]:
    return INNER[name].public, INNER[name].reference


def equal_but_for_nan(ours: Tensor, theirs: Tensor) -> bool:
    return torch.equal(ours.isnan(), theirs.isnan()) and torch.equal(ours.nan_to_num(), theirs.nan_to_num())


def fuzz_image_windows(rng: np.random.Generator, points: Tensor, ptr: Tensor, grid: ImageGrid) -> None:
    eps, reach = float(rng.choice([1e-6, 0.005, 0.02, 0.1, 3.0])), int(rng.integers(1, 4))
    on_image = {"pixel_index": grid.pixel_index, "size": grid.size}
    check("image_clusters", strided(rng, points), ptr, **on_image, eps=eps, reach=reach)
    values = rng.normal(size=len(points)) * rng.choice([1e-6, 1.0, 1e30])
    if rng.random() < 0.5:
        values = np.rint(values)  # ties
    values[rng.random(len(points)) < rng.choice([0.0, 0.2, 1.0])] = rng.choice([np.nan, np.inf, -np.inf])
    given = torch.from_numpy(values).float(), points, ptr, grid
    assert equal_but_for_nan(*(body(*given) for body in both("window_medians")))


def fuzz_hull(rng: np.random.Generator, points: Tensor) -> None:
    flat = points.detach()[:, :2].double()
    if rng.random() < 0.3:
        flat = torch.nn.functional.normalize(flat - flat.mean(0) if len(flat) else flat)  # on a circle: all corners
    ours, theirs = (body(flat) for body in both("hull_rows"))
    assert torch.equal(ours, theirs)


def fuzz_grippers(rng: np.random.Generator, points: Tensor) -> None:
    count = int(rng.choice([0, 1, 5, 40]))
    axes = torch.from_numpy(np.linalg.qr(rng.normal(size=(count, 3, 3)))[0])
    if rng.random() < 0.3:
        axes = torch.eye(3, dtype=torch.float64)[torch.from_numpy(rng.permutation(3))].repeat(count, 1, 1)
    nearest = points.detach()[torch.from_numpy(rng.integers(0, max(len(points), 1), count))] if len(points) else None
    origin = torch.from_numpy(rng.normal(size=(count, 3)) * rng.choice([1e-3, 0.5]))
    origin = origin if nearest is None else origin + nearest
    size = float(rng.choice([1e-3, 0.1, 2.0]))
    lower = torch.from_numpy(rng.normal(size=(4, count, 3))) * size
    upper = lower + torch.from_numpy(rng.random((4, count, 3))) * size
    if rng.random() < 0.3:  # faces that points lie on
        origin, lower, upper = origin.round(), lower.round(), upper.round()
    ours, theirs = (body(points.detach(), axes, origin, lower, upper) for body in both("points_in_grippers"))
    assert all(map(torch.equal, ours, theirs))


def fuzz_images(rng: np.random.Generator) -> None:
    height, width, views = int(rng.integers(1, 40)), int(rng.integers(1, 50)), int(rng.integers(1, 3))
    depth = torch.from_numpy(np.stack([depth_image(rng, height, width) for _ in range(views)])).float()
    if rng.random() < 0.3:
        depth = depth.mT.contiguous().mT
    camera = torch.tensor([[40.0, 0, width / 2], [0, 41.0, height / 2], [0, 0, 1]], dtype=torch.float64)
    camera[0, 1] = float(rng.choice([0.0, 0.0, 0.3]))
    intrinsics = camera.expand(views, 3, 3)
    lens = a_lens(rng, views)
    check("deproject_depth", depth, intrinsics, distortion=lens)
    tolerance, least = float(rng.choice([1e-4, 0.02, 0.5])), int(rng.integers(1, 9))
    check("flying_pixel_mask", depth, tolerance=tolerance, min_neighbors=least)
    fuzz_depth_filters(rng, depth)
    motion = torch.eye(4, dtype=torch.float64).repeat(views, 1, 1)
    motion[:, :3, 3] = torch.from_numpy(rng.normal(size=(views, 3)) * 0.05)
    size = int(rng.integers(1, 40)), int(rng.integers(1, 50))
    to_color = {"color_size": size, "distortion": lens, "color_distortion": lens}
    check("register_depth", depth, intrinsics, intrinsics, motion, **to_color)
    fuzz_lenses(rng, depth, intrinsics, a_lens(rng, views))


def fuzz_depth_filters(rng: np.random.Generator, depth: Tensor) -> None:
    jump = float(rng.choice([1e-3, 0.02, 0.5, np.inf]))
    sigmas = {"sigma_pixels": float(rng.choice([1e-9, 1.5, 1e9])), "sigma_depth": float(rng.choice([1e-9, 0.01, 1e9]))}
    check("bilateral_filter", depth, reach=int(rng.integers(1, 8)), max_jump=jump, **sigmas)
    check("median_filter", depth, reach=int(rng.integers(1, 4)), max_jump=None if rng.random() < 0.5 else jump)
    alpha, delta = float(rng.choice([1e-3, 0.4, 1.0])), float(rng.choice([1e-3, 0.05, 1e3, np.inf]))
    check("spatial_filter", depth, alpha=alpha, delta=delta, iterations=int(rng.integers(1, 4)))
    rule, max_size = str(rng.choice(["left", "farthest", "nearest"])), int(rng.integers(-2, 5))
    max_size = max_size if max_size > 0 else None
    check("fill_holes", depth, rule=rule, max_size=max_size)
    scale = torch.from_numpy(rng.uniform(0.1, 100, len(depth))).float() if rng.random() < 0.5 else None
    last = depth + torch.from_numpy(rng.choice([-1.0, 0.0, 0.01], depth.shape)).float()
    seen = torch.from_numpy(rng.integers(0, 256, depth.shape)).to(torch.uint8)
    steps: dict[str, tuple[Any, ...]] = {
        "reciprocals": (depth, torch.ones(len(depth))),
        "smoothed_images": (depth, scale, alpha, delta, 1),
        "temporal_step": (depth, scale, last.clamp(min=0), seen, alpha, delta, int(rng.integers(9))),
        "without_flying_pixels": (depth, None if rng.random() < 0.5 else seen, 0.02, int(rng.integers(1, 9))),
        "fill_rows": (depth, int(rng.integers(1, 9))),
        "filled_images": (depth, rule, max_size, 2),
    }
    for name, given in steps.items():
        ours, theirs = (body(*given) for body in both(name))
        assert all_equal(ours, theirs), name
    filled = F.fill_holes(depth)[0]
    marks = [None if rng.random() < 0.5 else image for image in (seen % 4, seen > 99)]
    ours, theirs = (body(depth, filled, *marks) for body in both("filled_confidence"))
    assert all_equal(ours, theirs)


def all_equal(ours: Any, theirs: Any) -> bool:
    if ours is None or theirs is None:
        return ours is theirs
    if isinstance(ours, tuple):
        return all(map(all_equal, ours, theirs))
    return ours.dtype is theirs.dtype and torch.equal(ours, theirs)


def fuzz_lenses(rng: np.random.Generator, depth: Tensor, intrinsics: Tensor, lens: Tensor | None) -> None:
    views, height, width = depth.shape
    if lens is None:
        return
    rule = str(rng.choice(["nearest", "surface"]))
    size = None if rng.random() < 0.5 else (int(rng.integers(1, 40)), int(rng.integers(1, 50)))
    check("undistort_depth", depth, intrinsics, lens, size=size, rule=rule, max_jump=float(rng.choice([0.002, 0.5])))
    for image in (
        torch.from_numpy(rng.integers(0, 256, (views, height, width, int(rng.integers(1, 6))), dtype=np.uint8)),
        torch.from_numpy(rng.choice([0, 255], (views, height, width, 3)).astype(np.uint8)),
        torch.from_numpy(rng.normal(size=(views, height, width, 1))).float(),
    ):
        check("undistort_image", image, intrinsics, lens, size=size, rule=str(rng.choice(["nearest", "bilinear"])))
    bent = torch.from_numpy(rng.normal(size=(int(rng.integers(0, 200)), 2)) * rng.choice([1e-12, 0.3, 3.0]))
    fisheye = bent, torch.from_numpy(rng.normal(size=4) * 0.02), float(rng.choice([0.4, 1.2, 1.56]))
    ours, theirs = (body(*fisheye) for body in both("fisheye_rays"))
    assert torch.equal(ours.isnan(), theirs.isnan())
    assert torch.equal(ours.nan_to_num(), theirs.nan_to_num())
    plain = plain_lenses(lens)
    if plain is not None:
        target = torch.from_numpy(rng.normal(size=(200, 2)))
        given = target, plain[0, :12], bool(plain[0, 12]), float(plain[0, 13])
        ours, theirs = (body(*given) for body in both("unbent"))
        assert torch.equal(ours.isnan(), theirs.isnan())
        assert torch.equal(ours.nan_to_num(), theirs.nan_to_num())


def each_case(first: int, body: Callable[[np.random.Generator], None]) -> None:
    """Run the cases from number ``first`` on; a failure names its case."""
    for seed in range(first, first + CASES):
        rng = np.random.default_rng(seed)
        REFERENCES.begin(seed)
        torch.set_num_threads(int(rng.integers(1, 4)))
        try:
            body(rng)
        except BaseException as error:
            add_note(error, f"case {seed}")
            raise


def test_organized_clouds_full_of_ties_equal_the_reference(machine: str):
    def body(rng: np.random.Generator) -> None:
        points, ptr, grid = organized(rng)
        fuzz_neighborhoods(rng, points, ptr, grid)
        fuzz_image_windows(rng, points, ptr, grid)

    each_case(0, body)


def test_ragged_clouds_equal_the_reference(machine: str):
    def body(rng: np.random.Generator) -> None:
        points, ptr = ragged(rng)
        fuzz_neighborhoods(rng, points, ptr, None)
        fuzz_queries(rng, points, ptr)
        fuzz_samples(rng, points, ptr)
        fuzz_wide(rng, points, ptr)
        fuzz_masks(rng, points, ptr)
        fuzz_rendering(rng, points, ptr)
        fuzz_rows(rng, points, ptr)
        fuzz_hull(rng, points)
        fuzz_grippers(rng, points)

    each_case(1_000_000, body)


def test_images_equal_the_reference(machine: str):
    each_case(2_000_000, fuzz_images)


def test_every_operation_with_a_kernel_is_fuzzed():
    text = Path(__file__).read_text(encoding="utf-8")
    # Steps of fusion are in tests/functional/tsdf, over random fields.
    fuzzed = {name: operation for name, operation in OPERATIONS.items() if "tsdf" not in operation.reference.__module__}
    with_kernel = {name for name, operation in fuzzed.items() if operation.serves("cpu")}
    assert {name for name in with_kernel if f'check("{name}"' not in text and name not in OWN_CHECKS} == set()
