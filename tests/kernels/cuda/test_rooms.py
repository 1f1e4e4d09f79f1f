"""Kernels whose arrays have room for more rows than the clouds fill: what lies behind the last row changes nothing."""

from __future__ import annotations

import pytest
import torch

from pcdata.contracts import dispatch
from pcdata.contracts.asked_later import asking_later, constant, is_set
from pcdata.functional.fixed_rows import move_kept
from pcdata.rng import seeded
from tests.kernels.cuda import harness

pytestmark = pytest.mark.skipif(harness.unavailable() is not None, reason=str(harness.unavailable()))

COUNTS = ([41, 70, 0, 29], [130], [1, 2, 3])
CALLS = {
    "statistical_outlier_mask": {"num_neighbors": 6, "std_ratio": 1.0, "grid": None},
    "radius_outlier_mask": {"min_neighbors": 3, "radius": 0.2, "grid": None},
    "estimate_normals": {"radius": 0.4, "max_neighbors": 9, "grid": None},
    "farthest_rows": {"counts": 1},
}


def clouds(counts: list[int], room: int, behind: float) -> tuple[torch.Tensor, torch.Tensor]:
    rows = sum(counts)
    points = torch.rand(rows, 3, generator=seeded(rows)) + 0.1
    return torch.cat([points, torch.full((room - rows, 3), behind)]), torch.tensor([0, *counts]).cumsum(0)


def test_every_body_that_says_so_is_tried_here():
    harness.register()
    said = {name for table in (dispatch.OPERATIONS, dispatch.INNER) for name, one in table.items() if one.roomy}
    assert said == {*CALLS, "move_kept", "largest_planes"}  # the last has tests of its own


@pytest.mark.parametrize("counts", COUNTS, ids=str)
@pytest.mark.parametrize("name", CALLS)
def test_room_behind_the_rows_changes_nothing(ordered, name, counts):
    harness.register()
    body = (dispatch.OPERATIONS.get(name) or dispatch.INNER[name]).kernels["cuda"]
    rows, fields = sum(counts), dict(CALLS[name])
    if name == "farthest_rows":
        fields["counts"] = [min(9, count) for count in counts]
    points, ptr = clouds(counts, rows, 0.0)
    expected = body(points=points, ptr=ptr, **fields)
    for behind in (0.0, 0.5, -3e5):
        points, ptr = clouds(counts, 2 * rows + 77, behind)
        found = body(points=points, ptr=ptr, **fields)
        assert torch.equal(found[: len(expected)], expected)
        if found.dtype is torch.bool:
            assert found[rows:].all()


def test_more_points_than_a_cloud_has_are_asked_for_without_harm(ordered):
    harness.register()
    points, ptr = clouds([5, 0, 3], 20, 0.0)
    picks = dispatch.INNER["farthest_rows"].kernels["cuda"](points, ptr, [7, 2, 4])
    assert sorted(picks[:5].tolist()) == [0, 1, 2, 3, 4]
    assert picks.min() >= 0
    assert picks.max() <= 8


@pytest.mark.parametrize("counts", [*COUNTS, [0], [0, 0]], ids=str)
@pytest.mark.parametrize("extra", [0, 50])
def test_rows_that_are_kept_move_together(ordered, counts, extra):
    harness.register()
    rows = sum(counts)
    points, ptr = clouds(counts, rows + extra, 0.7)
    source = torch.arange(7, 7 + len(points))
    keep = torch.rand(len(points), generator=seeded(3)) < 0.6
    own = keep.clone()
    own[rows:] = False
    for body in (move_kept, dispatch.INNER["move_kept"].kernels["cuda"]):
        kept, kept_source, kept_ptr = body(points, source, ptr, keep)
        count = int(own.sum())
        assert torch.equal(kept[:count], points[own])
        assert torch.equal(kept_source[:count], source[own])
        assert not kept[count:].any()
        assert not kept_source[count:].any()
        assert kept_ptr.tolist()[0] == 0
        assert kept_ptr.diff().tolist() == [int(part.sum()) for part in own[:rows].split(counts)]


def test_a_question_is_put_off_or_answered_at_once():
    assert is_set(torch.tensor([2]))
    assert not is_set(torch.tensor([0]))
    with asking_later() as put_off:
        assert not is_set(torch.tensor([2]))
    assert [int(flag) for flag in put_off.flags] == [2]


def test_what_repeated_work_reads_from_caches_is_kept():
    harness.register()
    points, ptr = clouds([30, 20], 60, 0.0)
    with asking_later() as put_off:
        dispatch.INNER["farthest_rows"].kernels["cuda"](points, ptr, [3, 4])
        dispatch.INNER["largest_planes"].kernels["cuda"](points, ptr, 0.1, 20, 0, None)
    assert [tuple(one.shape) for one in put_off.constants] == [(3,), (3, 20)]
    assert constant(points) is points


def test_clouds_too_wide_for_their_cells_are_told_of_later():
    harness.register()
    body = dispatch.OPERATIONS["radius_outlier_mask"].kernels["cuda"]
    points, ptr = clouds([30], 40, 0.0)
    points[3] = 1e30
    with asking_later() as put_off:
        body(points=points, ptr=ptr, min_neighbors=3, radius=1e-3, grid=None)
    assert any(int(flag) for flag in put_off.flags)
