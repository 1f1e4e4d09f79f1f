"""The compiled neighbor kernels against their references: equal bit for bit where the answer is discrete."""

from __future__ import annotations

import signal
import textwrap
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from pcdata import functional as F
from pcdata.contracts.dispatch import OPERATIONS, why_unavailable
from pcdata.errors import ConfigError, ShapeError
from pcdata.functional.image_grid import ImageGrid
from pcdata.functional.rows import ptr_from_counts
from tests.warm import run_python

pytestmark = pytest.mark.skipif(why_unavailable("cpu") is not None, reason=str(why_unavailable("cpu")))

OURS = ("knn", "ball_query", "chamfer_distance", "statistical_outlier_mask", "estimate_normals")


@pytest.fixture(autouse=True)
def keep_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def random_cloud(count: int, seed: int = 0, spread: float = 1.0) -> Tensor:
    return torch.from_numpy((spread * np.random.default_rng(seed).normal(size=(count, 3))).astype(np.float32))


def lattice(side: int) -> Tensor:
    axis = torch.arange(side, dtype=torch.float32)
    return torch.cartesian_prod(axis, axis, axis)


CLOUDS = {
    "random": random_cloud(700),
    "surface": torch.cat([random_cloud(900)[:, :2], 0.01 * random_cloud(900, 1)[:, :1]], 1),
    "lattice, every distance tied": lattice(9)[torch.randperm(729, generator=torch.Generator().manual_seed(0))],
    "five hundred zeros": torch.cat([random_cloud(200), torch.zeros(500, 3)])[torch.randperm(700)],
    "one spot": torch.full((300, 3), 0.1),
    "two spots": torch.tensor([[0.0, 0, 0], [1, 0, 0]]).repeat(100, 1),
    "a line": torch.linspace(-1, 1, 400)[:, None] * torch.tensor([[0.3, -0.2, 0.9]]),
    "megametres": random_cloud(600, spread=1e6),
    "a stray point far out": torch.cat([random_cloud(500), torch.tensor([[1e6, -1e6, 1e6]])]),
    "geometric spacing": torch.cat([2.0 ** -torch.arange(60.0)[:, None] * random_cloud(60), random_cloud(200)]),
    "millimetres": (random_cloud(600, spread=500)).round(),
    "micrometres in kilometres": random_cloud(500, spread=1e-9),
    "signed zeros": torch.tensor([[0.0, -0.0, 0.0], [-0.0, 0.0, -0.0]]).repeat(30, 1),
    "one point": torch.ones(1, 3),
    "two points": random_cloud(2),
    "nothing": torch.empty(0, 3),
}
MANY = torch.cat(list(CLOUDS.values()))
MANY_PTR = ptr_from_counts([len(cloud) for cloud in CLOUDS.values()])


def assert_neighbors(points: Tensor, ptr: Tensor | None = None, *, k: int, **options: object) -> None:
    ours, theirs = (F.knn(points, ptr, k=k, backend=name, **options) for name in ("cpu", "torch_tree"))
    assert torch.equal(ours[0], theirs[0])
    assert torch.equal(ours[1], theirs[1])


def assert_balls(points: Tensor, ptr: Tensor | None = None, *, radius: float, k: int, **options: object) -> None:
    results = [
        F.ball_query(points, ptr, radius=radius, max_neighbors=k, backend=name, **options)
        for name in ("cpu", "torch_tree")
    ]
    for ours, theirs in zip(*results, strict=True):
        assert torch.equal(ours, theirs)


def assert_masks(points: Tensor, ptr: Tensor | None = None, *, k: int, grid: ImageGrid | None = None) -> None:
    ours, theirs = (
        F.statistical_outlier_mask(points, ptr, num_neighbors=k, grid=grid, backend=name)
        for name in ("cpu", "torch_tree")
    )
    assert torch.equal(ours, theirs)


def assert_normals(
    points: Tensor, ptr: Tensor | None = None, *, radius: float, k: int, grid: ImageGrid | None = None
) -> None:
    """Equal to the reference, also where none stands out; a true smallest eigenvector everywhere."""
    ours, theirs = (
        F.estimate_normals(points, ptr, radius=radius, max_neighbors=k, grid=grid, backend=name).double()
        for name in ("cpu", "torch_tree")
    )
    index, _, count = F.ball_query(points, ptr, radius=radius, max_neighbors=k, backend="torch_tree")
    real = (torch.arange(k) < count[:, None]).double()[..., None]
    near = torch.cat([points, points.new_zeros(1, 3)]).double()[index] * real
    offset = (near - near.sum(1, keepdim=True) / count[:, None, None]) * real
    covariance = offset.mT @ offset / count[:, None, None]
    planar = count >= 3
    assert torch.equal(ours[~planar], ours.new_tensor([[0.0, 0, 1]]).expand(int((~planar).sum()), 3))
    torch.testing.assert_close(ours.norm(dim=1), torch.ones(len(ours), dtype=torch.float64), rtol=0, atol=1e-6)
    values = torch.linalg.eigvalsh(covariance[planar])
    unit = torch.nn.functional.normalize(ours[planar])  # float32 normals are unit to 1e-7 only
    along = torch.einsum("ni,nij,nj->n", unit, covariance[planar], unit)
    size = covariance[planar].diagonal(dim1=1, dim2=2).sum(1)
    # The kernel centers its sums on the query, this check on the mean: they differ by roundings of whole sums.
    assert bool((along - values[:, 0] <= 1e-9 * size).all())
    # Between a direction that stands out and the one agreed on lie gaps as small as rounding.
    gap = (values[:, 1] - values[:, 0]) / size
    distinct = (gap > 1e-3) | (gap < 1e-14)
    clear_sign = ours[planar][:, 2] > 1e-6
    same = ours[planar] - theirs[planar]
    assert bool((same[distinct & clear_sign].abs() <= 1e-6).all())
    flipped = ours[planar] + theirs[planar]
    assert bool((torch.minimum(same.abs().amax(1), flipped.abs().amax(1))[distinct] <= 1e-6).all())


def depth_image(height: int = 44, width: int = 66, seed: int = 0, holes: float = 0.2) -> tuple[Tensor, ImageGrid]:
    """A back-projected image of two noisy planes in whole millimetres: an edge, a thin pole, strays and holes."""
    generator = np.random.default_rng(seed)
    v, u = np.mgrid[:height, :width]
    z = np.where(u < width // 2, 0.5, 0.8) + 0.001 * v + 0.001 * generator.integers(-1, 2, size=u.shape)
    z[:, width // 4] = 0.3
    z[generator.random(u.shape) < 0.005] = 1.5
    valid = generator.random(u.shape) >= holes
    v, u, z = v[valid], u[valid], z[valid]
    points = np.column_stack([(u - width / 2) * z / 100, (v - height / 2) * z / 100, z]).astype(np.float32)
    intrinsics = torch.tensor([[[100.0, 0, width / 2], [0, 100.0, height / 2], [0, 0, 1]]])
    return torch.from_numpy(points), ImageGrid(torch.from_numpy(v * width + u), (height, width), intrinsics)


def rotation(seed: int = 0) -> Tensor:
    """A random (3, 3) float64 rotation."""
    matrix, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return torch.from_numpy(matrix * np.sign(np.linalg.det(matrix)))


def assert_all_equal(points: Tensor, ptr: Tensor | None = None, *, grid: ImageGrid) -> None:
    """Every operation gives with the grid what its reference gives."""
    for k in (1, 20, 49):
        assert_neighbors(points, ptr, k=k, grid=grid)
    assert_masks(points, ptr, k=20, grid=grid)
    assert_balls(points, ptr, radius=0.02, k=12, grid=grid)
    assert_normals(points, ptr, radius=0.03, k=30, grid=grid)


def test_each_operation_has_a_compiled_kernel():
    for name in OURS:
        assert OPERATIONS[name].serves("cpu")


@pytest.mark.parametrize("name", CLOUDS)
@pytest.mark.parametrize("k", [1, 3, 20, 48, 49, 400])
def test_knn_equals_the_reference(name: str, k: int):
    assert_neighbors(CLOUDS[name], k=k)


@pytest.mark.parametrize("name", CLOUDS)
@pytest.mark.parametrize("k", [1, 20, 30, 49])
def test_outlier_masks_equal_the_reference(name: str, k: int):
    assert_masks(CLOUDS[name], k=k)


@pytest.mark.parametrize("name", CLOUDS)
@pytest.mark.parametrize("radius", [0.3, 2.0])
def test_balls_and_normals_equal_the_reference(name: str, radius: float):
    points = CLOUDS[name]
    extent = float((points.amax(0) - points.amin(0)).amax()) if len(points) > 1 else 1.0
    radius = radius * max(min(extent, 1e3), 1e-9) / 4
    for k in (5, 30, 60):
        assert_balls(points, radius=radius, k=k)
        assert_normals(points, radius=radius, k=k)


def test_a_ragged_batch_equals_the_reference(instruction_set: str):
    for k in (1, 20, 60):
        assert_neighbors(MANY, MANY_PTR, k=k)
    assert_masks(MANY, MANY_PTR, k=20)
    assert_balls(MANY, MANY_PTR, radius=0.5, k=12)
    assert_normals(MANY, MANY_PTR, radius=0.5, k=30)


def test_clouds_large_enough_to_sort_in_parallel_equal_the_reference():
    points = torch.cat([random_cloud(33_000, spread=1e-3), torch.zeros(500, 3), random_cloud(9, 2, spread=1e6)])
    assert_neighbors(points, k=4)
    assert_neighbors(points, torch.tensor([0, 32_900, 32_903, len(points)]), k=4)


@pytest.mark.parametrize("spread", [0.5, 3.0, 1e5])
@pytest.mark.parametrize("k", [1, 12, 50])
def test_foreign_queries_equal_the_reference(spread: float, k: int, instruction_set: str):
    queries = random_cloud(900, 5, spread)
    queries_ptr = ptr_from_counts([50] * 15 + [0, 150])
    ptr = torch.cat([MANY_PTR, MANY_PTR[-1:]])[: len(queries_ptr)]
    assert_neighbors(MANY, ptr, k=k, queries=queries, queries_ptr=queries_ptr)
    assert_balls(MANY, ptr, radius=1.0, k=k, queries=queries, queries_ptr=queries_ptr)


@pytest.mark.parametrize("squared", [True, False])
def test_chamfer_equals_the_reference(squared: bool):
    kept = [name for name, cloud in CLOUDS.items() if len(cloud)]
    a, ptr_a = torch.cat([CLOUDS[n] for n in kept]), ptr_from_counts([len(CLOUDS[n]) for n in kept])
    b, ptr_b = a.flip(0) * 1.01, ptr_from_counts([len(CLOUDS[n]) for n in reversed(kept)])
    ours, theirs = (
        F.chamfer_distance(a, ptr_a, b, ptr_b, squared=squared, backend=name) for name in ("cpu", "torch_tree")
    )
    torch.testing.assert_close(ours, theirs, rtol=1e-6, atol=0)


small_clouds = st.lists(st.lists(st.tuples(*[st.integers(-3, 3)] * 3), max_size=40), min_size=1, max_size=4)


@settings(max_examples=40, deadline=None)
@given(clouds=small_clouds, k=st.integers(1, 60), scale=st.sampled_from([1.0, 1e-3, 1e5]))
def test_small_lattice_clouds_equal_the_reference(clouds: list[list[tuple[int, int, int]]], k: int, scale: float):
    points = torch.tensor([p for cloud in clouds for p in cloud], dtype=torch.float32).reshape(-1, 3) * scale
    ptr = ptr_from_counts([len(cloud) for cloud in clouds])
    assert_neighbors(points, ptr, k=k)
    assert_balls(points, ptr, radius=2 * scale, k=k)
    assert_neighbors(points, ptr, k=k, queries=points.flip(0) + 0.5 * scale, queries_ptr=len(points) - ptr.flip(0))


@pytest.mark.parametrize("threads", [2, 7])
def test_any_number_of_threads_gives_the_same_bits(threads: int):
    points, grid = depth_image(150, 200)

    def results() -> list[Tensor]:
        found = []
        for with_grid in (None, grid):
            found += F.knn(points, k=20, grid=with_grid, backend="cpu")
            found.append(F.statistical_outlier_mask(points, grid=with_grid, backend="cpu"))
            found.append(F.estimate_normals(points, radius=0.03, grid=with_grid, backend="cpu"))
        return found

    torch.set_num_threads(1)
    alone = results()
    torch.set_num_threads(threads)
    for one, many in zip(alone, results(), strict=True):
        assert torch.equal(one, many)


@pytest.mark.parametrize("holes", [0.0, 0.2, 0.6])
def test_a_depth_image_gives_the_same_answers(holes: float, instruction_set: str):
    points, grid = depth_image(holes=holes)
    assert_all_equal(points, grid=grid)


def test_a_batch_of_depth_images_gives_the_same_answers():
    parts = [depth_image(seed=seed, holes=0.1 * seed) for seed in range(3)]
    ptr = ptr_from_counts([len(parts[0][0]), 0, len(parts[1][0]), 1, len(parts[2][0])])
    points = torch.cat([parts[0][0], parts[1][0], parts[0][0][:1], parts[2][0]])
    pixel = torch.cat([parts[0][1].pixel_index, parts[1][1].pixel_index, torch.tensor([7]), parts[2][1].pixel_index])
    grid = ImageGrid(pixel, parts[0][1].size, parts[0][1].intrinsics.expand(5, 3, 3))
    assert_all_equal(points, ptr, grid=grid)


@pytest.mark.parametrize("rows", [1, 2])
def test_an_image_of_few_rows_gives_the_same_answers(rows: int):
    points, grid = depth_image(height=rows, width=200)
    assert_all_equal(points, grid=grid)


@pytest.mark.parametrize("told", [True, False])
def test_a_moved_cloud_gives_the_same_answers(told: bool):
    points, grid = depth_image()
    turn, shift = rotation(), torch.tensor([3.0, -20.0, 7.0], dtype=torch.float64)
    moved = (points.double() @ turn.T + shift).float()
    if told:
        camera_from_points = torch.eye(4, dtype=torch.float64)
        camera_from_points[:3, :3], camera_from_points[:3, 3] = turn.T, -turn.T @ shift
        grid = replace(grid, camera_from_points=camera_from_points[None])
    assert_all_equal(moved, grid=grid)


WRONG_GRIDS = {
    "shuffled": lambda p: p[torch.randperm(len(p), generator=torch.Generator().manual_seed(1))],
    "partly shuffled": lambda p: torch.cat([p[:300].flip(0), p[300:]]),
    "mirrored": lambda p: p * torch.tensor([-1.0, 1, 1]),
    "behind the camera": lambda p: p - torch.tensor([0.0, 0, 2]),
    "across the camera": lambda p: p - torch.tensor([0.0, 0, 0.6]),
    "in the plane of the camera": lambda p: p * torch.tensor([1.0, 1, 0]),
    "jittered": lambda p: p + 0.02 * random_cloud(len(p)),
    "stretched": lambda p: p * torch.tensor([0.1, 1, 10]),
    "all at one spot": lambda p: torch.full_like(p, 0.5),
    "one far point": lambda p: torch.cat([p[:-1], torch.tensor([[1e18, 0.0, 1e-18]])]),
}


@pytest.mark.parametrize("name", WRONG_GRIDS)
def test_a_wrong_grid_never_gives_a_wrong_answer(name: str):
    points, grid = depth_image()
    assert_all_equal(WRONG_GRIDS[name](points).contiguous(), grid=grid)


def test_a_motion_that_is_not_rigid_is_refused():
    points, grid = depth_image()
    scaled = torch.diag(torch.tensor([2.0, 2, 2, 1]))[None]
    for name in ("cpu", "torch_tree"):
        with pytest.raises(ConfigError, match="not rigid"):
            F.knn(points, k=3, grid=replace(grid, camera_from_points=scaled), backend=name)
        with pytest.raises(ShapeError, match="camera_from_points"):
            F.knn(points, k=3, grid=replace(grid, camera_from_points=scaled[0]), backend=name)


def test_bad_numbers_are_refused_like_by_the_reference():
    points = random_cloud(10)
    for name in ("cpu", "torch_tree"):
        with pytest.raises(ConfigError):
            F.knn(points, k=0, backend=name)
        with pytest.raises(ConfigError):
            F.ball_query(points, radius=-1.0, max_neighbors=3, backend=name)
        with pytest.raises(ConfigError):
            F.statistical_outlier_mask(points, std_ratio=0.0, backend=name)
        with pytest.raises(ConfigError):
            F.estimate_normals(points, max_neighbors=0, backend=name)
        with pytest.raises(ShapeError):
            F.knn(points, k=1, queries_ptr=torch.tensor([0, 10]), backend=name)


def test_flushing_denormals_does_not_disturb_the_order():
    points = torch.cat([torch.full((40, 3), 0.25), random_cloud(200)])
    expected = F.knn(points, k=20, backend="torch_tree")
    torch.set_flush_denormal(True)
    try:
        found = F.knn(points, k=20, backend="cpu")
    finally:
        torch.set_flush_denormal(False)
    assert torch.equal(found[0], expected[0])


def test_a_signal_ends_a_long_call_within_a_second():
    points = random_cloud(300_000)

    def ring(*_: object) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGPROF, ring)
    started = time.process_time()  # like the timer, it does not run while other processes have the cores
    signal.setitimer(signal.ITIMER_PROF, 0.3)
    try:
        with pytest.raises(TimeoutError):
            F.knn(points, k=300, backend="cpu")
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
    assert time.process_time() - started < 1.3


@pytest.mark.parametrize("organized", [False, True])
def test_working_space_is_at_most_a_hundred_bytes_per_point(organized: bool):
    side = 700
    code = f"""
        import resource, torch
        from pcdata import functional as F
        from pcdata.kernels.cpu import native
        native.library()
        torch.set_num_threads(2)
        v, u = torch.meshgrid(torch.arange({side}), torch.arange({side}), indexing="ij")
        z = 0.5 + 0.001 * torch.rand({side}, {side})
        points = torch.stack([(u - 350) / 300 * z, (v - 350) / 300 * z, z], -1).reshape(-1, 3).contiguous()
        grid = F.ImageGrid(torch.arange(len(points)), ({side}, {side}), torch.eye(3)[None])
        del u, v, z
        F.statistical_outlier_mask(points[:2000], backend="cpu")
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        F.statistical_outlier_mask(points, grid=grid if {organized} else None, backend="cpu")
        print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024 / len(points))
    """
    done = run_python(textwrap.dedent(code))
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) < 100


def frame(folder: Path) -> tuple[Tensor, ImageGrid]:
    depth = np.asarray(pytest.importorskip("PIL.Image").open(folder / "graspnet_frame/depth.png")) / 1000.0
    k = pytest.importorskip("scipy.io").loadmat(folder / "graspnet_frame/meta.mat")["intrinsic_matrix"]
    v, u = np.nonzero(depth > 0)
    z = depth[v, u]
    points = np.column_stack([(u - k[0, 2]) * z / k[0, 0], (v - k[1, 2]) * z / k[1, 1], z]).astype(np.float32)
    grid = ImageGrid(torch.from_numpy(v * depth.shape[1] + u), depth.shape, torch.from_numpy(k).float()[None])
    return torch.from_numpy(points), grid


def test_part_of_a_real_frame_equals_the_reference(test_data: Path):
    points, grid = frame(test_data)
    v, u = grid.pixel_index // grid.size[1], grid.pixel_index % grid.size[1]
    part = (v > 280) & (v < 340) & (u > 560) & (u < 660)
    points, grid = points[part], replace(grid, pixel_index=grid.pixel_index[part])
    for with_grid in (None, grid):
        assert_neighbors(points, k=20, grid=with_grid)
        assert_masks(points, k=20, grid=with_grid)
        assert_normals(points, radius=0.02, k=30, grid=with_grid)


def test_a_real_frame_gives_the_same_with_its_grid_shuffled_and_by_another_tree(test_data: Path):
    points, grid = frame(test_data)
    rows = grid.pixel_index < 200 * grid.size[1]  # its upper part
    points, grid = points[rows], replace(grid, pixel_index=grid.pixel_index[rows])
    index, distance = F.knn(points, k=20, backend="cpu")
    organized = F.knn(points, k=20, grid=grid, backend="cpu")
    assert torch.equal(organized[0], index)
    assert torch.equal(organized[1], distance)
    order = torch.randperm(len(points))
    back = torch.empty_like(order)
    back[order] = torch.arange(len(order))
    shuffled = F.knn(points[order].contiguous(), k=20, backend="cpu")
    assert torch.equal(shuffled[1][back], distance)
    kd_tree = pytest.importorskip("scipy.spatial").cKDTree(points.double().numpy())
    some = torch.randperm(len(points))[:20_000]
    expected, _ = kd_tree.query(points[some].double().numpy(), 20)
    np.testing.assert_allclose(distance[some].numpy(), expected, rtol=1e-6, atol=0)
