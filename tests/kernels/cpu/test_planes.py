"""The compiled search for planes finds those of the reference: any cloud, thread count, instruction set."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from pcdata.contracts.dispatch import why_unavailable
from pcdata.errors import NoPlaneError
from pcdata.functional import plane_steps, row_draws
from pcdata.functional.depth.deproject import deproject_depth
from pcdata.functional.planes import ransac_plane
from pcdata.functional.row_draws import draw_rows
from pcdata.functional.rows import ptr_from_counts
from pcdata.geometry.plane_fit import planes_through
from pcdata.kernels.cpu import planes as cpu_planes
from pcdata.rng import seeded
from tests.kernels.cpu.clouds import CLOUDS, extent_of, organized, outcome, random, reference_of

REASON = why_unavailable("cpu")
pytestmark = pytest.mark.skipif(REASON is not None, reason=str(REASON))

few = settings(max_examples=30, deadline=None)


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


@pytest.fixture
def unrefined(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is found is the best of the planes tried, as it was drawn: a refinement would make near ones equal."""
    for module in (plane_steps, cpu_planes):
        monkeypatch.setattr(module, "MAX_REFINEMENTS", 0)


@pytest.mark.parametrize(
    ("order", "scale"),
    [*((order, 1.0) for order in ("image", "shuffled", "sorted", "equal")), *(("image", s) for s in (1e-6, 1e6, 1e18))],
)
def test_runs_of_points_change_no_count(order, scale, machine, unrefined):
    """Large clouds are counted by runs: on an image, where those say nothing, of one point, and where floats end."""
    points, generator = organized(130, 170) * scale, seeded(1)
    if order == "shuffled":
        points = points[torch.randperm(len(points), generator=generator)]
    elif order == "sorted":
        points = points[points[:, 2].argsort()]
    elif order == "equal":
        points = torch.cat([points[:12_000], points[:1].expand(9_000, 3)])
    counts = [len(points), 600, 8193, 8192]
    points = torch.cat([points, organized(20, 30) * scale, points[:8193], points[:8192]]).contiguous()
    for distance in (1e-4 * scale, 0.01 * scale, 3 * scale):
        search = {"distance": distance, "num_hypotheses": 61, "seed": [0, 1, 2, 3]}
        assert_planes_equal_to_reference(
            points, ptr_from_counts(counts), case=("runs", order, scale, distance), **search
        )


@pytest.mark.parametrize("order", ["image", "shuffled"])
@pytest.mark.parametrize(("scale", "offset"), [(1.0, 0.0), (1e-6, 0.0), (1e16, 0.0), (1.0, 3e4)])
def test_many_planes_close_to_the_best_are_counted_as_the_reference_does(order, scale, offset, machine, unrefined):
    """Most of many planes are told from the best by offsets from it: of a rough table, a wall and points about."""
    generator = seeded(4)
    u, v = torch.meshgrid(torch.linspace(-0.6, 0.6, 240), torch.linspace(-0.4, 0.4, 160), indexing="ij")
    table = torch.stack([u, v, 0.3 * u + 0.004 * torch.randn(u.shape, generator=generator)], -1).reshape(-1, 3)
    table[::9] = 2 * torch.rand(table[::9].shape, generator=generator) - 1
    table[6000:12000, 0] = 0.2 + 0.01 * torch.rand(6000, generator=generator)
    points = (table + offset) * scale
    if order == "shuffled":
        points = points[torch.randperm(len(points), generator=generator)]
    for distance in (0.001 * scale, 0.01 * scale, 5 * scale):
        for seed in range(3):
            search = {"distance": distance, "num_hypotheses": 150, "seed": seed}
            assert_planes_equal_to_reference(
                points, None, case=("close", order, scale, offset, distance, seed), **search
            )


@pytest.mark.parametrize("probability", [0.2, 0.9, 1 - 1e-15])
@pytest.mark.parametrize("guessed", [False, True])
def test_a_search_that_may_stop_equals_the_reference(probability, guessed, machine, unrefined):
    points = torch.cat([organized(130, 170), organized(90, 100), organized(20, 30)]).contiguous()
    ptr = ptr_from_counts([22_100, 9_000, 600])
    guess = planes_through(points[draw_rows(600, 3, 3, seeded(2))])
    for distance in (0.004, 0.02, 0.05, 1e-5):
        search = {"distance": distance, "probability": probability, "num_hypotheses": 101, "seed": 5}
        case = ("stops", probability, guessed, distance)
        assert_planes_equal_to_reference(points, ptr, case=case, guess=guess if guessed else None, **search)


@pytest.mark.parametrize("order", ["image", "shuffled", "sorted", "line"])
def test_refinement_equals_the_reference(order, machine):
    """Of large and small clouds, whatever their order says of the points."""
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
        expected = reference_of((order, distance, max_tilt), plane_steps.refine_planes, *arguments)
        found, inliers = plane_steps.refine_planes(*arguments, backend="cpu")
        assert torch.equal(inliers, expected[1])
        cosine = (found[:, :3] * expected[0][:, :3]).sum(1)
        assert torch.allclose(cosine.abs(), torch.ones_like(cosine), rtol=0, atol=1e-12)
        torch.testing.assert_close(found[:, 3] * cosine.sign(), expected[0][:, 3], rtol=0, atol=1e-9)


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


def test_the_plane_of_a_real_frame_is_the_reference_s(frame, machine):
    points, _, _ = deproject_depth(*frame)
    assert_planes_equal_to_reference(points, None, num_hypotheses=40, case=("real",))
