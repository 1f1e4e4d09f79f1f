"""The plane that most points lie on, found without asking the host."""

from __future__ import annotations

import pytest
import torch

from pcdata.contracts import dispatch
from pcdata.functional import row_draws as module
from pcdata.functional.largest_planes import largest_planes
from pcdata.functional.planes import ransac_plane
from pcdata.functional.row_draws import draw_rows, words_drawn
from pcdata.rng import seeded
from tests.kernels.cuda import harness

pytestmark = pytest.mark.skipif(harness.unavailable() is not None, reason=str(harness.unavailable()))

CPU = torch.device("cpu")


def scene(count: int, seed: int, share: float = 0.6) -> torch.Tensor:
    """Points of a tilted table with noise, and others about it."""
    generator = seeded(seed)
    points = torch.rand(count, 3, generator=generator) - 0.5
    table = torch.rand(count, generator=generator) < share
    noise = 0.004 * torch.randn(count, generator=generator)
    points[:, 2] = torch.where(table, 0.3 * points[:, 0] + noise, points[:, 2])
    return points + torch.tensor([0.0, 0.0, 1.0])


def found(body, counts, room, **options):
    parts = [scene(count, seed) for seed, count in enumerate(counts)]
    behind = torch.full((room, 3), 0.7)
    ptr = torch.tensor([0, *counts]).cumsum(0)
    return body(torch.cat([*parts, behind]), ptr, **options), torch.cat(parts), ptr


@pytest.mark.parametrize("probability", [None, 0.99, 0.5], ids=["all", "nearly sure", "soon"])
@pytest.mark.parametrize("counts", [[300], [150, 3, 400]], ids=str)
def test_planes_are_those_of_ransac(ordered, counts, probability):
    check(counts, probability)


def test_planes_of_large_clouds_are_searched_on_some_points():
    check([17_000, 200], 0.99)


def check(counts, probability):
    harness.register()
    options = {"distance": 0.01, "num_hypotheses": 70, "seed": 5, "probability": probability}
    body = dispatch.INNER["largest_planes"].kernels["cuda"]
    for room in (0, 300):
        (planes, near, failed), points, ptr = found(body, counts, room, **options)
        expected, expected_near = ransac_plane(points, ptr, backend="torch", **options)
        assert int(failed) == 0
        torch.testing.assert_close(planes, expected, rtol=0, atol=1e-9)
        assert torch.equal(near[: len(points)], expected_near)
        assert not near[len(points) :].any()


def test_clouds_without_a_plane_are_told_of(ordered):
    harness.register()
    body = dispatch.INNER["largest_planes"].kernels["cuda"]
    line = torch.linspace(0, 1, 50)[:, None] * torch.tensor([1.0, 2.0, 3.0])
    options = {"distance": 0.01, "num_hypotheses": 20, "seed": 0, "probability": None}
    for clouds in ([line], [scene(60, 0), line], [line[:2]], [line[:0], scene(60, 0)]):
        ptr = torch.tensor([0, *map(len, clouds)]).cumsum(0)
        assert int(body(torch.cat(clouds), ptr, **options)[2]) == 1


def test_the_reference_is_ransac_on_what_the_clouds_fill():
    options = {"distance": 0.01, "num_hypotheses": 40, "seed": 5, "probability": None}
    (planes, near, failed), points, ptr = found(largest_planes, [200, 90], 50, **options)
    expected, expected_near = ransac_plane(points, ptr, backend="torch", **options)
    assert torch.equal(planes, expected)
    assert torch.equal(near[:290], expected_near)
    assert not near[290:].any()
    assert int(failed) == 0


@pytest.mark.parametrize("seed", [0, 7, 2**33 + 1])
def test_words_are_the_draws_of_every_size(seed):
    words = words_drawn(seed, 50, CPU)
    for size in (4, 1001, 921_600):
        first, second, third = draw_rows(size, 3, 50, seeded(seed)).unbind(1)
        assert torch.equal(words[0] % size, first)
        again = words[1] % (size - 1)
        assert torch.equal(again + (again >= first), second)
        last = words[2] % (size - 2)
        low, high = torch.minimum(first, second), torch.maximum(first, second)
        last = last + (last >= low)
        assert torch.equal(last + (last >= high), third)


def test_another_way_of_drawing_is_noticed_and_the_reference_goes_on(monkeypatch):
    harness.register()
    monkeypatch.setattr(module, "draw_rows", lambda size, each, count, generator: torch.zeros(count, each).long())
    assert words_drawn(123_321, 50, CPU) is None
    options = {"distance": 0.01, "num_hypotheses": 50, "seed": 123_321, "probability": None}
    (planes, _, _), points, ptr = found(dispatch.INNER["largest_planes"].kernels["cuda"], [200], 9, **options)
    assert torch.equal(planes, ransac_plane(points, ptr, backend="torch", **options)[0])
