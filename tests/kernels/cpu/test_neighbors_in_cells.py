"""The compiled radius outliers and DBSCAN against their references: equal bit for bit, whatever the input."""

from __future__ import annotations

import functools
import resource
import signal
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from pcdata.contracts.dispatch import OPERATIONS, why_unavailable
from pcdata.errors import ConfigError, ShapeError
from pcdata.functional.clusters import dbscan
from pcdata.functional.image_grid import ImageGrid
from pcdata.functional.outliers import radius_outlier_mask
from pcdata.functional.rows import ptr_from_counts
from tests.warm import run_python

pytestmark = pytest.mark.skipif(why_unavailable("cpu") is not None, reason=str(why_unavailable("cpu")))


@pytest.fixture(autouse=True)
def keep_threads():
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def assert_same(points: Tensor, ptr: Tensor | None = None, *, radius: float, count: int, grid: ImageGrid | None = None):
    """Both kernels give what their references give, without and with the grid."""
    for grids in {None: (None,)}.get(grid, (None, grid)):
        masks = [
            radius_outlier_mask(points, ptr, min_neighbors=count, radius=radius, grid=grids, backend=name)
            for name in ("cpu", "torch_tree")
        ]
        assert torch.equal(*masks)
        labels = [
            dbscan(points, ptr, eps=radius, min_points=count, grid=grids, backend=name)
            for name in ("cpu", "torch_tree")
        ]
        assert torch.equal(*labels)


def normal(count: int, seed: int = 0, spread: float = 1.0) -> Tensor:
    return torch.from_numpy((spread * np.random.default_rng(seed).normal(size=(count, 3))).astype(np.float32))


def depth_image(height: int = 60, width: int = 80, seed: int = 0) -> tuple[Tensor, ImageGrid]:
    """A back-projected image of two noisy planes with an edge, a thin pole, strays and holes."""
    generator = np.random.default_rng(seed)
    v, u = np.mgrid[:height, :width]
    z = np.where(u < width // 2, 0.5, 0.8) + 0.001 * generator.integers(-2, 3, size=u.shape)
    z[:, width // 4] = 0.3
    z[generator.random(u.shape) < 0.005] = 1.5
    valid = generator.random(u.shape) > 0.2
    v, u, z = v[valid], u[valid], z[valid]
    points = np.column_stack([(u - width / 2) * z / 100, (v - height / 2) * z / 100, z]).astype(np.float32)
    intrinsics = torch.tensor([[[100.0, 0, width / 2], [0, 100.0, height / 2], [0, 0, 1]]])
    return torch.from_numpy(points), ImageGrid(torch.from_numpy(v * width + u), (height, width), intrinsics)


def uneven_surfaces(count: int) -> Tensor:
    """Two planes and a crowd of points, with an edge, a thinned-out part and strays, row after row."""
    side = torch.linspace(0, 1, int(count**0.5))
    x, y = (axis.reshape(-1) for axis in torch.meshgrid(side, side, indexing="ij"))
    points = torch.stack([x, y, 0.2 * (x > 0.5)], 1) + 1e-4 * normal(len(x))
    points[-len(x) // 50 :] *= 3.0
    points[:: len(x) // 60, 2] += 0.05 * torch.arange(1, 1 + len(points[:: len(x) // 60]))
    return torch.cat([points, normal(count // 20, 1, 0.002)])


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize(("count", "neighbors"), [(12_000, 5), (12_000, 40), (20_000, 16), (20_000, 300)])
def test_points_in_no_order_get_the_mask_of_the_reference(count, neighbors, threads):
    torch.set_num_threads(threads)
    points = uneven_surfaces(count)
    for radius in (0.003, 0.01, 0.03):
        wanted = radius_outlier_mask(points, min_neighbors=neighbors, radius=radius, backend="torch_tree")
        assert wanted.any()
        for order in (torch.arange(len(points)), torch.randperm(len(points), generator=torch.manual_seed(0))):
            mask = radius_outlier_mask(points[order], min_neighbors=neighbors, radius=radius, backend="cpu")
            assert torch.equal(mask, wanted[order])


@pytest.mark.parametrize("neighbors", [5, 16])
def test_a_large_cloud_in_no_order_gets_the_mask_of_the_same_points_in_order(neighbors):
    points = uneven_surfaces(600_000)  # so many that a few pieces tell that they are in no order
    order = torch.randperm(len(points), generator=torch.manual_seed(0))
    masks = [
        radius_outlier_mask(some, min_neighbors=neighbors, radius=0.01, backend="cpu")
        for some in (points, points[order])
    ]
    assert 0 < int(masks[0].sum()) < len(points) // 10
    assert torch.equal(masks[0][order], masks[1])


def test_both_operations_have_a_compiled_kernel():
    assert "cpu" in OPERATIONS["radius_outlier_mask"].kernels
    assert OPERATIONS["dbscan"].serves("cpu")


@pytest.mark.parametrize("spread", [0.03, 0.3, 3.0])
@pytest.mark.parametrize("count", [1, 2, 5, 50, 601])
def test_dense_to_sparse_clouds_equal_the_reference(spread: float, count: int):
    assert_same(normal(600, spread=spread), radius=0.1, count=count)


@pytest.mark.parametrize("radius", [0.004, 0.01, 0.05])
@pytest.mark.parametrize("count", [1, 5, 20])
def test_a_depth_image_equals_the_reference_in_order_and_shuffled(radius: float, count: int):
    points, grid = depth_image()
    assert_same(points, radius=radius, count=count, grid=grid)
    shuffled = points[torch.from_numpy(np.random.default_rng(0).permutation(len(points)))]
    assert_same(shuffled, radius=radius, count=count)


def test_a_grid_that_does_not_fit_changes_nothing():
    points, grid = depth_image()
    assert_same(points.flip(0) * 1.3, radius=0.01, count=5, grid=grid)


@pytest.mark.parametrize("threads", [1, 2, 7])
def test_every_number_of_threads_gives_one_answer(threads: int):
    points = torch.cat([normal(12_000, 1), normal(12_000, 2, 0.05), normal(1000, 3, 0.02) + 5.0])  # enough for threads
    answers = []
    for number in (threads, 1):
        torch.set_num_threads(number)
        mask = radius_outlier_mask(points, radius=0.05, backend="cpu")
        answers.append((mask, dbscan(points, eps=0.05, min_points=8, backend="cpu")))
    assert torch.equal(answers[0][0], answers[1][0])
    assert torch.equal(answers[0][1], answers[1][1])
    assert 0 < answers[0][0].sum() < len(points)
    assert answers[0][1].max() > 0


def test_a_ragged_batch_of_large_small_and_empty_clouds_equals_the_reference():
    counts = [0, 9_000, 1, 0, 700, 2, 300, 0]
    points = torch.cat([normal(count, seed, 0.2 if seed % 2 else 0.02) for seed, count in enumerate(counts)])
    assert_same(points, ptr_from_counts(counts), radius=0.03, count=6)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_tiny_clouds_equal_the_reference(count: int):
    assert_same(normal(count), radius=0.1, count=1)
    assert_same(normal(count), radius=0.1, count=2)


def test_copies_of_few_points_equal_the_reference():
    spots = torch.tensor([[0.0, 0, 0], [0.0999, 0, 0], [0.1, 0, 0], [0.25, 0, 0]])
    copies = spots[torch.from_numpy(np.random.default_rng(0).integers(0, 4, size=1200))]
    for count in (1, 250, 500, 900):
        assert_same(copies, radius=0.1, count=count)


@pytest.mark.parametrize("direction", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)])
def test_collinear_points_with_distances_equal_to_the_radius_equal_the_reference(direction: tuple[int, int, int]):
    line = torch.arange(-500, 500)[:, None] * torch.tensor(direction).float() / 4
    for radius in (0.25, 0.5, 0.25 * 3**0.5):
        assert_same(line, radius=radius, count=3)


def test_a_lattice_of_ties_equals_the_reference():
    axis = torch.arange(12.0) / 8
    assert_same(torch.cartesian_prod(axis, axis, axis), radius=0.25, count=20)


@pytest.mark.parametrize("scale", [1e-14, 1e-3, 1e3, 1e12])
def test_any_unit_of_length_equals_the_reference(scale: float):
    assert_same(normal(2000) * scale, radius=0.2 * scale, count=6)


@pytest.mark.parametrize("far", [1e3, 1e6, 6e8])
def test_stray_points_far_out_equal_the_reference(far: float):
    # 2e7 cells of 0.058 for each 1e6: keys need up to 3 * 34 bits, two words.
    points = torch.cat([normal(3000, spread=0.2), torch.tensor([[far, far, far], [-far, far, -far], [far, 0, 0]])])
    assert_same(points, radius=0.1, count=5)


def test_wide_keys_serve_crowded_cells_and_many_rows_too():
    blobs = [normal(2000, seed, 0.02) + 1e5 * torch.tensor([seed, -seed, seed % 3]) for seed in range(6)]
    assert_same(torch.cat(blobs), radius=0.05, count=8)


def test_too_many_cells_is_the_error_of_the_reference():
    points = torch.tensor([[0.0, 0, 0], [1e6, 0, 0]])
    messages = []
    for name in ("cpu", "torch_tree"):
        for function, length in ((radius_outlier_mask, "radius"), (dbscan, "eps")):
            with pytest.raises(ConfigError, match="same unit") as caught:
                function(points, **{length: 1e-7}, backend=name)
            messages.append(str(caught.value))
    assert messages[:2] == messages[2:]


def test_bad_arguments_are_the_errors_of_the_reference():
    points, grid = depth_image()
    for name in ("cpu", "torch_tree"):
        with pytest.raises(ConfigError, match="min_neighbors"):
            radius_outlier_mask(points, min_neighbors=0, backend=name)
        with pytest.raises(ConfigError, match="radius"):
            radius_outlier_mask(points, radius=-1.0, backend=name)
        with pytest.raises(ConfigError, match="min_points"):
            dbscan(points, min_points=0, backend=name)
        with pytest.raises(ConfigError, match="eps"):
            dbscan(points, eps=0.0, backend=name)
        for function in (radius_outlier_mask, dbscan):
            with pytest.raises(ShapeError, match="grid"):
                function(points[1:], grid=grid, backend=name)


def test_huge_counts_are_never_reached():
    points = torch.zeros(100, 3)
    assert radius_outlier_mask(points, min_neighbors=2**70, backend="cpu").all()
    assert (dbscan(points, min_points=2**70, backend="cpu") == -1).all()


def test_strided_and_differentiable_points_are_fine():
    points = normal(600).T.contiguous().T.requires_grad_()
    assert_same(points, radius=0.3, count=5)


def test_sheets_just_out_of_reach_stay_apart_and_touching_ones_join():
    tilt = torch.tensor([[1.0, 0.3, 0.2], [-0.2, 1.0, 0.3], [0, 0, 1.0]])
    sheet = torch.rand(20_000, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([0.3, 0.3, 0.0])
    both = torch.cat([sheet, sheet + torch.tensor([0.0, 0.0, 0.101])]) @ tilt
    assert_same(both, radius=0.1, count=5)
    both[77] += both[20_077] - sheet[77] @ tilt + torch.tensor([0.0, 0.0, -0.1])
    assert_same(both, radius=0.1, count=5)


@settings(max_examples=80, deadline=None)
@given(
    counts=st.lists(st.integers(0, 60), min_size=1, max_size=4),
    radius=st.floats(0.02, 1.5),
    count=st.integers(1, 12),
    lattice=st.sampled_from([0, 3, 4]),
    scale=st.sampled_from([1e-6, 1.0, 1e3]),
    seed=st.integers(0, 2**16),
)
def test_any_small_batch_equals_the_reference(
    counts: list[int], radius: float, count: int, lattice: int, scale: float, seed: int
):
    points = normal(sum(counts), seed, 0.5)
    if lattice:  # duplicates, and distances equal to the radius
        points, radius = (points * lattice).round() / lattice, 1 / lattice
    assert_same(points * scale, ptr_from_counts(counts), radius=radius * scale, count=count)


def test_the_real_frame_equals_the_reference(test_data: Path):
    image = pytest.importorskip("PIL.Image")
    depth = np.asarray(image.open(test_data / "graspnet_frame" / "depth.png")).astype(np.float32)[::8, ::8] / 1000
    v, u = np.nonzero(depth)
    z = depth[v, u]
    points = torch.from_numpy(np.column_stack([(u - 80) * z / 79, (v - 45) * z / 79, z]).astype(np.float32))
    intrinsics = torch.tensor([[[79.0, 0, 80], [0, 79.0, 45], [0, 0, 1]]])
    grid = ImageGrid(torch.from_numpy(v * 160 + u), (90, 160), intrinsics)
    assert_same(points, radius=0.01, count=20, grid=grid)
    shuffled = points[torch.from_numpy(np.random.default_rng(0).permutation(len(points)))]
    assert_same(shuffled, radius=0.01, count=20)


@functools.cache
def scattered() -> list[tuple[Tensor, Tensor, Tensor]]:
    """Clouds in any order and in order, with the references' masks and labels."""
    found = []
    for seed, spread in enumerate((0.02, 0.3, 1e5)):
        points = normal(4000, seed, spread)
        for ordered in (points, points[points[:, 0].argsort()]):
            mask = radius_outlier_mask(ordered, radius=0.02, backend="torch_tree")
            found.append((ordered, mask, dbscan(ordered, eps=0.02, min_points=5, backend="torch_tree")))
    return found


def test_every_instruction_set_equals_the_reference(instruction_set):
    for points, mask, labels in scattered():
        assert torch.equal(radius_outlier_mask(points, radius=0.02, backend="cpu"), mask)
        assert torch.equal(dbscan(points, eps=0.02, min_points=5, backend="cpu"), labels)


@functools.cache
def many_points() -> Tensor:
    return torch.rand(1_500_000, 3, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize(
    "call",
    [
        # A million neighbors wanted of each point, and none to be had: hours of counting.
        lambda points: radius_outlier_mask(points, radius=0.4, min_neighbors=1_000_000, backend="cpu"),
        lambda points: dbscan(points, eps=0.4, min_points=1_000_000, backend="cpu"),
        lambda points: dbscan(points, eps=0.003, min_points=3, backend="cpu"),
    ],
    ids=["radius outliers", "clusters", "clusters, soon done"],
)
def test_control_c_ends_a_long_kernel_within_a_second(call: Callable[[Tensor], Tensor]):
    torch.set_num_threads(2)
    points = many_points()
    call(points[:100])

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGPROF, interrupt)
    try:
        # Work, not time: the cores may be busy elsewhere. The timer counts that of both threads.
        started = time.process_time()
        signal.setitimer(signal.ITIMER_PROF, 0.5)
        with pytest.raises(KeyboardInterrupt):  # noqa: PT012 - one call may be done before the signal
            while True:
                call(points)
        assert time.process_time() - started < 0.5 + 2.0  # a second of each thread
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def test_memory_stays_flat_over_many_calls():
    clouds = [normal(count, count, 0.1) for count in (20_000, 3000, 35_000)]

    def run() -> None:
        for points in clouds:
            radius_outlier_mask(points, radius=0.01, backend="cpu")
            dbscan(points, eps=0.01, min_points=5, backend="cpu")

    for _ in range(5):
        run()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _ in range(25):
        run()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 4 * 1024  # KiB: 3 bytes a point and run


MEMORY = """
import resource, torch, pcdata.functional as F
torch.set_num_threads(2)
points = torch.rand(500_000, 3, generator=torch.Generator().manual_seed(0))
F.dbscan(points[:1000], eps=0.0064, min_points=2, backend="cpu")
F.radius_outlier_mask(points[:1000], radius=0.0064, backend="cpu")
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
{call}
used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
print(used * 1024 / len(points))
"""


@pytest.mark.parametrize(
    ("call", "result_bytes"),
    [
        ("F.radius_outlier_mask(points, radius=0.0064, backend='cpu')", 1),
        ("F.dbscan(points, eps=0.0064, min_points=2, backend='cpu')", 8),
    ],
)
def test_a_sparse_cloud_in_no_order_needs_under_a_hundred_bytes_a_point(call: str, result_bytes: int):
    result = run_python(MEMORY.format(call=call))  # a cell or more for every point: the worst there is
    assert result.returncode == 0, result.stderr
    assert float(result.stdout) - result_bytes < 100
