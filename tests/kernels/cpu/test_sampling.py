"""The compiled sampling kernels give the reference's results bit for bit: any cloud, thread count, instruction set."""

from __future__ import annotations

import itertools
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from pcdata.contracts.dispatch import why_unavailable
from pcdata.errors import NoPlaneError
from pcdata.functional import row_draws
from pcdata.functional.depth.deproject import deproject_depth
from pcdata.functional.planes import _draw_triples, ransac_plane
from pcdata.functional.row_draws import draw_rows
from pcdata.functional.rows import ptr_from_counts
from pcdata.functional.sampling import farthest_point_sample
from pcdata.functional.voxels import find_voxel_size, voxel_downsample
from pcdata.geometry.plane_fit import planes_through
from pcdata.kernels.cpu import native
from pcdata.kernels.cpu import planes as cpu_planes
from pcdata.rng import seeded

REASON = why_unavailable("cpu")
pytestmark = pytest.mark.skipif(REASON is not None, reason=str(REASON))

few = settings(max_examples=30, deadline=None)


@pytest.fixture(params=[(1, None), (7, None), *((2, name) for name in native.INSTRUCTION_SETS)], ids=str)
def machine(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A number of threads, and the library of one instruction set (None: the best)."""
    threads, name = request.param
    if name is not None:
        monkeypatch.setenv(native.FORCE_VARIABLE, name)
        native.library.cache_clear()
        try:
            native.library()
        except OSError as error:
            pytest.skip(str(error))
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    yield
    torch.set_num_threads(before)
    if name is not None:
        monkeypatch.undo()
        native.library.cache_clear()


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def organized(rows: int, columns: int) -> Tensor:
    """A tilted table with a ball on it and millimetre depth, in scan order."""
    v, u = torch.meshgrid(torch.arange(rows) / rows, torch.arange(columns) / columns, indexing="ij")
    ball = (0.04 - (u - 0.5) ** 2 - (v - 0.5) ** 2).clamp(min=0).sqrt()
    z = ((0.8 - 0.2 * v - ball) * 1000).round() / 1000
    return torch.stack([(u - 0.5) * z, (v - 0.5) * z, z], dim=-1).reshape(-1, 3)


def line(count: int) -> Tensor:
    return torch.arange(float(count))[:, None] * torch.tensor([1.0, 2.0, -1.0])


# name -> points and points per cloud
CLOUDS: dict[str, tuple[Tensor, list[int]]] = {
    "organized": (organized(60, 80), [4800]),
    "shuffled": (organized(60, 80)[torch.randperm(4800, generator=torch.Generator().manual_seed(0))], [4800]),
    "duplicates": (torch.randint(3, (500, 3), generator=torch.Generator().manual_seed(0)).float(), [500]),
    "all the same": (torch.ones(100, 3), [100]),
    "collinear": (line(300), [300]),
    "a kilometre in millimetres": (random(900, 3) * 1e6, [900]),
    "a million metres": (torch.cat([random(500, 3), torch.tensor([[1e6, -1e6, 1e6]])]), [501]),
    "beyond the square root of float32": (random(300, 3) * 1e30, [300]),
    "so small that squares vanish": (random(300, 3) * 1e-24, [300]),
    "signed zeros": (torch.tensor([[0.0, -0.0, 0.0], [-0.0, 0.0, -0.0], [1.0, -0.0, 0.0]]), [3]),
    "one point": (torch.tensor([[1.0, 2.0, 3.0]]), [1]),
    "ragged": (random(1500, 3), [0, 700, 1, 0, 33, 766, 0]),
    "large": (organized(200, 300), [60_000]),
    "large and small": (torch.cat([random(5, 3), organized(150, 200), random(40, 3)]), [5, 30_000, 40]),
    "empty": (torch.empty(0, 3), [0]),
}


def outcome(function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """The result, or the error's type and text: kernels must raise what the reference raises."""
    try:
        return function(*args, **kwargs)
    except Exception as error:
        return type(error), str(error)


REFERENCES: dict[tuple[object, ...], Any] = {}  # of cases with a name: computed once for all machines


def reference_of(case: tuple[object, ...] | None, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    if case is None:
        return outcome(function, *args, **kwargs, backend="torch")
    key = (function.__name__, *case)
    if key not in REFERENCES:
        REFERENCES[key] = outcome(function, *args, **kwargs, backend="torch")
    return REFERENCES[key]


def assert_equal_to_reference(
    function: Callable[..., Any], *args: Any, case: tuple[object, ...] | None = None, **kwargs: Any
) -> None:
    assert_same(outcome(function, *args, **kwargs, backend="cpu"), reference_of(case, function, *args, **kwargs))


def assert_same(ours: Any, reference: Any) -> None:
    if isinstance(reference, Tensor):
        assert isinstance(ours, Tensor), ours
        assert ours.dtype == reference.dtype
        assert torch.equal(ours, reference)
    elif isinstance(reference, tuple):
        assert len(ours) == len(reference)
        for one, other in zip(ours, reference):
            assert_same(one, other)
    else:
        assert ours == reference


def extent_of(points: Tensor) -> float:
    return float((points.double().amax(0) - points.double().amin(0)).max()) if len(points) else 1.0


@pytest.mark.parametrize("name", CLOUDS)
def test_farthest_points_equal_the_reference(name, machine):
    points, counts = CLOUDS[name]
    wanted = [count if count <= 900 else 60 for count in counts]
    assert_equal_to_reference(farthest_point_sample, points, ptr_from_counts(counts), num_samples=wanted, case=(name,))


@few
@given(
    st.lists(st.integers(0, 90), min_size=1, max_size=4),
    st.integers(0, 999),
    st.sampled_from([1, 2, 5, 50, 10**6]),
    st.sampled_from([1e-30, 1e-3, 1.0, 1e6]),
)
def test_farthest_points_of_small_clouds_equal_the_reference(counts, seed, levels, scale):
    generator = torch.Generator().manual_seed(seed)
    points = torch.randint(levels, (sum(counts), 3), generator=generator).float() * scale
    assert_equal_to_reference(farthest_point_sample, points, ptr_from_counts(counts), num_samples=counts)


def test_farthest_points_of_none_or_too_few():
    points, ptr = random(10, 3), ptr_from_counts([4, 6])
    for wanted in (0, [0, 3], [5, 1], -1, [1]):
        assert_equal_to_reference(farthest_point_sample, points, ptr, num_samples=wanted)


def test_many_farthest_points_of_a_large_cloud_equal_the_reference():
    points = organized(120, 160)
    assert_equal_to_reference(farthest_point_sample, points, num_samples=2000)


@pytest.mark.parametrize("order", ["image", "holes", "strays", "repeated", "shuffled"])
def test_pixels_side_by_side_are_sampled_as_any_points_are(order, machine):
    """Pieces of rows of an image are sorted as one, but for those over an edge; the last is no whole piece."""
    points, generator = organized(100, 155)[:-3], seeded(3)
    points[5000:9000] += 0.4  # an edge
    if order == "holes":
        points = points[torch.rand(len(points), generator=generator) < 0.8]
    elif order == "strays":
        points[::701] *= 1e4
    elif order == "repeated":
        points[2000:14_000] = points[2000]
    elif order == "shuffled":
        points = points[torch.randperm(len(points), generator=generator)]
    assert_equal_to_reference(farthest_point_sample, points, num_samples=150, case=(order, "pixels"))


def test_a_dense_spot_far_from_the_rest_is_sampled_exactly():
    # Every level of the spatial sort sees two clusters: the recursion is as deep as float32 allows.
    points = torch.cat([random(400, 3, seed=k) * 2.0**-k for k in range(0, 100, 4)])
    assert_equal_to_reference(farthest_point_sample, points, num_samples=200)


def test_ctrl_c_stops_farthest_point_sampling_within_a_second():
    if threading.current_thread() is not threading.main_thread():
        pytest.skip("signals reach the main thread only")

    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    points = random(400_000, 3)
    before = signal.signal(signal.SIGPROF, interrupt)
    try:
        started = time.process_time()  # like the timer, it does not run while other processes have the cores
        signal.setitimer(signal.ITIMER_PROF, 0.2)
        with pytest.raises(KeyboardInterrupt):
            farthest_point_sample(points, num_samples=400_000, backend="cpu")
        assert time.process_time() - started < 1.2
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


@pytest.mark.parametrize("cells_per_extent", [0.5, 7.0, 300.0, 1e7, 1e17])
@pytest.mark.parametrize("name", CLOUDS)
def test_voxels_equal_the_reference(name, cells_per_extent, machine):
    points, counts = CLOUDS[name]
    size = (extent_of(points) or 1.0) / cells_per_extent
    case = (name, cells_per_extent)
    assert_equal_to_reference(voxel_downsample, points, ptr_from_counts(counts), voxel_size=size, case=case)


@few
@given(
    st.lists(st.integers(0, 60), min_size=1, max_size=4),
    st.integers(0, 999),
    st.sampled_from([1e-3, 0.3, 1.0, 1e9]),
    st.sampled_from([1e-6, 1e-3, 1.0, 1e6]),
)
def test_voxels_of_small_clouds_with_a_size_each_equal_the_reference(counts, seed, relative, scale):
    points = random(sum(counts), 3, seed=seed) * scale
    sizes = [scale * relative * (1 + cloud) for cloud in range(len(counts))]
    assert_equal_to_reference(voxel_downsample, points, ptr_from_counts(counts), voxel_size=sizes)


def test_points_on_voxel_borders_fall_where_the_reference_puts_them():
    axis = torch.arange(40.0) * 0.1
    points = torch.cartesian_prod(axis, axis, axis)
    for size in (0.1, 0.2, 0.05, 1 / 3):
        assert_equal_to_reference(voxel_downsample, points, voxel_size=size)


@pytest.mark.parametrize("name", CLOUDS)
def test_the_voxel_size_found_equals_the_reference(name):
    points, counts = CLOUDS[name]
    if max(counts) > 10_000:
        points, counts = points[:10_000], [10_000]
    for num_points in (1, 3, 200):
        assert_equal_to_reference(find_voxel_size, points, ptr_from_counts(counts), num_points=num_points)
    assert_equal_to_reference(find_voxel_size, points, ptr_from_counts(counts), num_points=0)


def assert_planes_equal_to_reference(
    points: Tensor, ptr: Tensor | None, *, case: tuple[object, ...] | None = None, **arguments: Any
) -> None:
    """Masks are identical; least squares agree to float64 rounding, since the order of the sums is free."""
    ours = outcome(ransac_plane, points, ptr, **arguments, backend="cpu")
    reference = reference_of(case, ransac_plane, points, ptr, **arguments)
    if not isinstance(reference[0], Tensor):
        assert ours == reference
        return
    assert torch.equal(ours[1], reference[1])
    scale = float(points.abs().max()) or 1.0
    assert torch.allclose(ours[0][:, :3], reference[0][:, :3], rtol=0, atol=1e-9)
    assert torch.allclose(ours[0][:, 3], reference[0][:, 3], rtol=0, atol=1e-9 * scale)


@pytest.mark.parametrize("relative_distance", [1e-5, 0.01])
@pytest.mark.parametrize("name", CLOUDS)
def test_planes_equal_the_reference(name, relative_distance, machine):
    points, counts = CLOUDS[name]
    distance = max((extent_of(points) or 1.0) * relative_distance, 1e-21)
    assert_planes_equal_to_reference(
        points, ptr_from_counts(counts), distance=distance, num_hypotheses=50, seed=3, case=(name, relative_distance)
    )


@few
@given(st.integers(3, 80), st.integers(0, 999), st.sampled_from([1, 3, 16, 37]), st.sampled_from([1e-3, 1.0, 1e6]))
def test_planes_of_small_clouds_equal_the_reference(count, seed, num_hypotheses, scale):
    points = random(count, 3, seed=seed) * torch.tensor([1.0, 1.0, 0.02]) * scale
    assert_planes_equal_to_reference(
        points, None, distance=0.03 * scale, num_hypotheses=num_hypotheses, seed=seed, up=(0, 0.1, 1), max_tilt=0.5
    )


@pytest.mark.parametrize("probability", [None, 0.99])
@pytest.mark.parametrize("seeds", [3, [5, 2**40, 5, 0], list(range(4))])
def test_all_of_a_search_equals_the_reference(probability, seeds, monkeypatch):
    """Of large and small clouds, with guesses, a direction, and whatever way words come."""
    points = torch.cat([organized(130, 170), organized(90, 100), organized(20, 30), organized(3, 3)]).contiguous()
    counts = [22_100, 9_000, 600, 9]
    ptr = ptr_from_counts(counts)
    guess = torch.tensor([[0.0, 0.0, 2.0, -1.0], [torch.nan] * 4, [0.0, 1.0, 0.1, 0.2], [1.0, 0.0, 0.0, 9.0]])
    up = torch.tensor([[0.0, 0.0, -1.0], [0.3, 0.0, -1.0], [0.0, 0.2, 1.0], [0.0, 0.0, 2.0]])
    search = {"distance": 0.02, "num_hypotheses": 70, "seed": seeds, "probability": probability}
    for more in ({}, {"guess": guess}, {"up": up, "max_tilt": 0.7, "guess": guess}, {"up": up}):
        case = probability, str(seeds), tuple(more)
        assert_planes_equal_to_reference(points, ptr, case=case, **search, **more)
    found = ransac_plane(points, ptr, backend="cpu", **search)
    for pretended in ("words_drawn", "_KEPT"):  # a torch that draws otherwise, and more seeds than are kept
        monkeypatch.setattr(row_draws, pretended, 0 if pretended == "_KEPT" else lambda *asked: None)
        again = ransac_plane(points, ptr, backend="cpu", **search)
        assert all(torch.equal(*pair) for pair in zip(found, again, strict=True))
    monkeypatch.setattr(cpu_planes, "MOST_HYPOTHESES", 100)
    monkeypatch.setattr("pcdata.kernels.cpu.native.core_threads", lambda: 3)
    again = ransac_plane(points, ptr, backend="cpu", **search)
    assert all(torch.equal(*pair) for pair in zip(found, again, strict=True))


def test_a_cloud_without_a_plane_is_told_as_by_the_reference():
    line = torch.arange(9.0)[:, None] * torch.tensor([1.0, 2.0, 3.0])
    cube = 1e6 * random(50, 3, seed=1) + 7
    for clouds, search in (
        ([cube, line], {"distance": 0.01}),
        ([cube, cube], {"distance": 1e-12, "num_hypotheses": 1}),
        ([cube, line], {"distance": 1e-12, "num_hypotheses": 1, "probability": 0.9}),
        ([cube], {"distance": 0.01, "up": (0, 0, 1), "max_tilt": 0.0}),
    ):
        told = []
        for backend in ("cpu", "torch"):
            with pytest.raises(NoPlaneError) as caught:
                ransac_plane(
                    torch.cat(clouds), ptr_from_counts([len(one) for one in clouds]), backend=backend, **search
                )
            told.append(str(caught.value))
        assert told[0] == told[1]


def test_inlier_counts_equal_the_reference():
    from pcdata.functional import plane_steps as planes

    points, ptr = organized(100, 101), torch.tensor([0, 4000, 4003, 10100])
    triples, which = _draw_triples([4000, 3, 6097], 77, [0, 1, 2])
    drawn = [planes.draw_planes(points, ptr, triples, which, backend=name) for name in ("cpu", "torch")]
    torch.testing.assert_close(*drawn, rtol=0, atol=1e-12, equal_nan=True)
    competes, floors = ~drawn[1][..., 0].isnan(), torch.tensor([0, 0, 40])
    assert_records_equal(points, ptr, drawn[1], competes, 0.004, floors)


def assert_records_equal(
    points: Tensor, ptr: Tensor, drawn: Tensor, competes: Tensor, distance: float, floors: Tensor
) -> None:
    from pcdata.functional import plane_steps as planes

    found = []
    for name in ("cpu", "torch"):
        runs = planes.bound_runs(points, ptr, backend=name)
        found.append(planes.record_planes(points, ptr, runs, drawn, competes, distance, floors, backend=name))
        near = [planes.near_planes(points, ptr, drawn[:, 0], distance, own, backend=name) for own in ((), runs)]
        assert torch.equal(*near)
    assert torch.equal(*found)


@pytest.mark.parametrize(
    ("order", "scale"),
    [*((order, 1.0) for order in ("image", "shuffled", "sorted", "equal")), *(("image", s) for s in (1e-6, 1e6, 1e18))],
)
def test_runs_of_points_change_no_count(order, scale, machine):
    """Large clouds are counted by runs: on an image, where those say nothing, of one point, and where floats end."""
    points, generator = organized(130, 170) * scale, seeded(1)
    if order == "shuffled":
        points = points[torch.randperm(len(points), generator=generator)]
    elif order == "sorted":
        points = points[points[:, 2].argsort()]
    elif order == "equal":
        points = torch.cat([points[:12_000], points[:1].expand(9_000, 3)])
    largest = len(points)
    points = torch.cat([points, organized(20, 30) * scale, points[:8193], points[:8192]]).contiguous()
    ptr = ptr_from_counts([largest, 600, 0, 8193, 8192])
    drawn = planes_through(points[draw_rows(largest, 3, 61, generator)])[None].repeat(5, 1, 1)
    drawn[:, 7] = torch.nan
    competes = ~drawn[..., 0].isnan()
    competes[:, ::5] = False
    for distance in (1e-4 * scale, 0.01 * scale, 3 * scale):
        assert_records_equal(points, ptr, drawn, competes, distance, torch.tensor([0, 3, 0, 500, 10_000]))


@pytest.mark.parametrize("order", ["image", "shuffled"])
@pytest.mark.parametrize(("scale", "offset"), [(1.0, 0.0), (1e-6, 0.0), (1e16, 0.0), (1.0, 3e4)])
def test_many_planes_close_to_the_best_are_counted_as_the_reference_does(order, scale, offset, machine):
    """Most of many planes are told from the best by offsets from it: of a rough table, a wall and points about."""
    from pcdata.functional import plane_steps as planes

    generator = seeded(4)
    u, v = torch.meshgrid(torch.linspace(-0.6, 0.6, 240), torch.linspace(-0.4, 0.4, 160), indexing="ij")
    table = torch.stack([u, v, 0.3 * u + 0.004 * torch.randn(u.shape, generator=generator)], -1).reshape(-1, 3)
    table[::9] = 2 * torch.rand(table[::9].shape, generator=generator) - 1
    table[6000:12000, 0] = 0.2 + 0.01 * torch.rand(6000, generator=generator)
    points = (table + offset) * scale
    if order == "shuffled":
        points = points[torch.randperm(len(points), generator=generator)]
    drawn = planes_through(points[draw_rows(len(points), 3, 150, generator)])
    best = planes_through(points[None, torch.tensor([20_000, 20_150, 38_000])])
    drawn[90:] = best + 0.002 * torch.randn(60, 4, generator=generator, dtype=torch.float64)
    drawn[:, 3][90:] = -(drawn[90:, :3] * points[20_000].double()).sum(1)  # turned about one of its points
    drawn = torch.cat([drawn, drawn[100:101]])[None].contiguous()  # equals do not compete with the first
    competes, ptr = ~drawn[..., 0].isnan(), torch.tensor([0, len(points)])
    competes[:, ::7] = False
    runs = planes.bound_runs(points, ptr, backend="cpu")
    for distance, floor in ((0.001 * scale, 0), (0.01 * scale, 0), (0.01 * scale, 20_000), (5 * scale, 0)):
        rules = drawn, competes, distance, torch.tensor([floor])
        case = order, scale, offset, distance, floor
        expected = reference_of(case, planes.record_planes, points, ptr, (), *rules)
        assert torch.equal(planes.record_planes(points, ptr, runs, *rules, backend="cpu"), expected)


@pytest.mark.parametrize("probability", [0.2, 0.9, 1 - 1e-15])
@pytest.mark.parametrize("not_drawn", [0, 1])
def test_a_search_that_may_stop_equals_the_reference(probability, not_drawn, machine):
    from pcdata.functional import plane_steps as planes

    points = torch.cat([organized(130, 170), organized(90, 100), organized(20, 30)]).contiguous()
    ptr = ptr_from_counts([22_100, 9_000, 0, 600])
    drawn = planes_through(points[draw_rows(22_100, 3, 101, seeded(2))])[None].repeat(4, 1, 1)
    drawn[:, 7] = torch.nan
    competes = ~drawn[..., 0].isnan()
    competes[:, ::5] = False
    for distance, bits in ((0.004, 14), (0.02, 14), (0.02, 7), (1e-9, 10), (0.05, 62)):
        arguments = points, ptr, drawn, competes, distance, probability, not_drawn, bits
        expected = reference_of((probability, not_drawn, distance, bits), planes.search_planes, *arguments)
        assert torch.equal(planes.search_planes(*arguments, backend="cpu"), expected)


@pytest.mark.parametrize("order", ["image", "shuffled", "sorted", "line"])
def test_refinement_equals_the_reference(order, machine):
    """Of large and small clouds, whatever their order says of the points."""
    from pcdata.functional import plane_steps as planes

    points, generator = organized(130, 170), seeded(2)
    if order == "shuffled":
        points = points[torch.randperm(len(points), generator=generator)]
    elif order == "sorted":
        points = points[points[:, 2].argsort()]
    elif order == "line":
        points[:9000] = torch.linspace(0, 1, 9000)[:, None] * torch.tensor([0.5, 1.0, 2.0])
    counts = [len(points), 700, 0, 8193, 5]
    points = torch.cat([points, points[:700], points[:8193], points[-5:]]).contiguous()
    ptr = ptr_from_counts(counts)
    begun = planes_through(points[draw_rows(8193, 3, 1, seeded(0)) + ptr[3]]).repeat(len(counts), 1)
    if order == "line":
        begun = planes_through(torch.tensor([[[0.0, 0, 0], [0.5, 1, 2], [1.0, 0, 0]]])).repeat(len(counts), 1)
    assert not bool(begun.isnan().any())
    begun[3:, 3] += 0.004
    up = torch.nn.functional.normalize(torch.tensor([[0.1, 0.2, -1.0]], dtype=torch.float64)).repeat(len(counts), 1)
    for distance, max_tilt in ((0.02, None), (0.005, None), (0.02, 0.3), (1e-5, None)):
        arguments = points, ptr, begun, distance, None if max_tilt is None else up, max_tilt
        expected = reference_of((order, distance, max_tilt), planes.refine_planes, *arguments)
        found = [planes.refine_planes(*arguments, backend="cpu")]
        found.append(planes.refine_planes(*arguments, planes.bound_runs(points, ptr, backend="cpu"), backend="cpu"))
        for own_planes, inliers in found:
            assert torch.equal(own_planes, found[0][0])
            assert torch.equal(inliers, expected[1])
        cosine = (found[0][0][:, :3] * expected[0][:, :3]).sum(1)
        assert torch.allclose(cosine.abs(), torch.ones_like(cosine), rtol=0, atol=1e-12)
        torch.testing.assert_close(found[0][0][:, 3] * cosine.sign(), expected[0][:, 3], rtol=0, atol=1e-9)


@pytest.mark.parametrize("backend", ["cpu", "torch"])
def test_a_batch_of_many_small_clouds_is_each_cloud_alone(backend):
    """More clouds than are looked at one by one, of different sizes, and more hypotheses than are drawn at a time."""
    counts = [3 + cloud % 29 for cloud in range(150)]
    ptr, points = ptr_from_counts(counts), random(sum(counts), 3, seed=3)
    arguments = {"distance": 0.2, "num_hypotheses": 40, "backend": backend}
    planes, inliers = ransac_plane(points, ptr, **arguments)
    sizes = find_voxel_size(points, ptr, num_points=3, backend=backend)
    bounds = ptr.tolist()
    for cloud, (start, stop) in enumerate(itertools.pairwise(bounds)):
        plane, mask = ransac_plane(points[start:stop], **arguments)
        assert torch.equal(plane, planes[cloud : cloud + 1])
        assert torch.equal(mask, inliers[start:stop])
        alone = find_voxel_size(points[start:stop], num_points=3, backend=backend)
        assert torch.equal(alone, sizes[cloud : cloud + 1])


@pytest.mark.parametrize("operation", [ransac_plane, find_voxel_size])
def test_ten_thousand_small_clouds_take_a_small_multiple_of_one_large_one(operation):
    """A look at each cloud from Python took 300 times as long; 10 million planes to make are what is left."""
    points, ptr = random(200_000, 3), torch.arange(10_001) * 20
    options = {ransac_plane: {"distance": 0.05}, find_voxel_size: {"num_points": 7}}[operation]

    def seconds(*args: Any) -> float:
        start = time.process_time()
        operation(*args, **options)
        return time.process_time() - start

    seconds(points)
    assert min(seconds(points, ptr) for _ in range(3)) < 12 * max(seconds(points), 0.05)


def test_the_plane_is_the_same_bits_for_any_thread_count():
    points = organized(300, 400)
    before = torch.get_num_threads()
    found = []
    for count in (1, 2, 7):
        torch.set_num_threads(count)
        found.append(ransac_plane(points, num_hypotheses=30, backend="cpu")[0])
    torch.set_num_threads(before)
    assert torch.equal(found[0], found[1])
    assert torch.equal(found[0], found[2])


def depth_images(views: int, height: int, width: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    depth = torch.rand((views, height, width), generator=generator) + 0.3
    return torch.where(torch.rand(depth.shape, generator=generator) < 0.3, 0.0, depth)


def camera(views: int, width: int, height: int, skew: float = 0.0, dtype: torch.dtype = torch.float64) -> Tensor:
    one = torch.tensor([[0.9 * width, skew, width / 2 - 0.3], [0, 0.8 * width, height / 2 + 0.7], [0, 0, 1]])
    return (one.double() + torch.arange(views)[:, None, None] * torch.tensor([[3.0, 0, 1], [0, 2, 1], [0, 0, 0]])).to(
        dtype
    )


LENSES = {
    "none": None,
    "4": [0.1, -0.02, 0.001, -0.002],
    "8": [0.1, -0.02, 0.001, -0.002, 0.003, 0.01, 0.002, 0.001],
}


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("skew", [0.0, 0.7])
@pytest.mark.parametrize("size", [(1, 1), (61, 83)])
def test_deprojection_equals_the_reference(lens, skew, size, machine):
    coefficients = LENSES[lens]
    distortion = None if coefficients is None else torch.tensor([coefficients, coefficients])
    for dtype in (torch.float32, torch.float64):
        intrinsics = camera(2, size[1], size[0], skew, dtype)
        case = (lens, skew, size, dtype)
        assert_equal_to_reference(deproject_depth, depth_images(2, *size), intrinsics, distortion=distortion, case=case)


@pytest.mark.parametrize(
    "depth",
    [
        torch.zeros(2, 5, 6),
        torch.ones(2, 5, 6),
        torch.ones(2, 0, 6),
        torch.ones(2, 5, 0),
        -torch.ones(2, 5, 6),
        torch.full((2, 5, 6), math.nan),
        torch.full((2, 5, 6), 1e-45),
        torch.full((2, 5, 6), -0.0),
        depth_images(2, 12, 10)[:, ::2].transpose(1, 2),
    ],
    ids=["nothing", "full", "no rows", "no columns", "negative", "NaN", "denormal", "minus zero", "strided"],
)
def test_unusual_depth_images_give_what_the_reference_gives(depth):
    assert_equal_to_reference(deproject_depth, depth, camera(2, 6, 5))


def test_impossible_cameras_raise_what_the_reference_raises():
    depth = depth_images(1, 40, 50)
    for intrinsics in (-camera(1, 50, 40), camera(1, 50, 40).mT.contiguous(), camera(1, 50, 40) * 0):
        assert_equal_to_reference(deproject_depth, depth, intrinsics)
    folding = torch.tensor([[-2.0, 0.5, 0.0, 0.0]])
    assert_equal_to_reference(
        deproject_depth, depth, camera(1, 50, 40) * torch.tensor([0.2, 1.0, 1.0]), distortion=folding
    )


@pytest.fixture(scope="module")
def frame(test_data: Path) -> tuple[Tensor, Tensor]:
    """Depth (1, H, W) metres and intrinsics of a real frame."""
    depth = np.array(pytest.importorskip("PIL.Image").open(test_data / "graspnet_frame/depth.png"))
    meta = pytest.importorskip("scipy.io").loadmat(test_data / "graspnet_frame/meta.mat")
    metres = torch.from_numpy(depth.astype(np.float32) / 1000)[None]
    return metres, torch.from_numpy(meta["intrinsic_matrix"].astype(np.float64))[None]


def test_a_real_frame_gives_the_references_results(frame, machine):
    assert_equal_to_reference(deproject_depth, *frame, case=("real",))
    points, _, _ = deproject_depth(*frame)
    assert_equal_to_reference(farthest_point_sample, points, num_samples=64, case=("real",))
    assert_equal_to_reference(farthest_point_sample, points[::40], num_samples=2000, case=("real, thin",))
    assert_equal_to_reference(voxel_downsample, points, voxel_size=0.003, case=("real",))
    assert_planes_equal_to_reference(points, None, num_hypotheses=40, case=("real",))
