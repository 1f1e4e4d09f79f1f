"""Rows picked, points moved and boxes cut out by the compiled kernels equal the reference bit for bit."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from pcdata.contracts.dispatch import INNER, why_unavailable
from pcdata.functional.rows import kept_rows, pick_rows, ptr_after_mask, ptr_from_counts, transform_points
from pcdata.geometry import rigid
from pcdata.rng import seeded

REASON = why_unavailable("cpu")
pytestmark = pytest.mark.skipif(REASON is not None, reason=str(REASON))

few = settings(max_examples=30, deadline=None)


def fields(count: int) -> dict[str, Tensor]:
    """Fields of many dtypes and shapes, one of them with gaps between its rows."""
    generator = seeded(count)
    return {
        "points": torch.randn(count, 3, generator=generator),
        "row": torch.arange(count),
        "flag": torch.rand(count, generator=generator) < 0.5,
        "confidence": torch.randint(256, (count,), generator=generator, dtype=torch.uint8),
        "weight": torch.rand(count, generator=generator),
        "half": torch.rand(count, 5, generator=generator).half(),
        "matrix": torch.rand(count, 4, 4, generator=generator, dtype=torch.float64),
        "wide": torch.rand(count, 6, generator=generator)[:, ::2],
        "nothing": torch.empty(count, 0),
        "complex": torch.view_as_complex(torch.rand(count, 2, generator=generator)).conj(),
    }


def assert_same(ours: dict[str, Tensor], theirs: dict[str, Tensor]) -> None:
    assert list(ours) == list(theirs)
    for name, value in theirs.items():
        assert ours[name].dtype == value.dtype
        assert ours[name].shape == value.shape
        assert torch.equal(ours[name], value), name


def both(name: str, *args: Any) -> tuple[Any, Any]:
    return INNER[name].kernels["cpu"](*args), INNER[name].reference(*args)


@pytest.mark.parametrize("probability", [0.0, 0.02, 0.5, 0.9, 0.999, 1.0])
@pytest.mark.parametrize("count", [1, 7, 8, 63, 16384, 16385, 50_000])
def test_rows_of_a_mask_equal_the_reference(count, probability):
    mask = torch.rand(count, generator=seeded(1)) < probability
    assert_same(*both("pick_rows", fields(count), mask))


@pytest.mark.parametrize("told", [0, 3, 700, 20_000, None])
def test_rows_are_those_of_the_mask_whatever_count_is_told(told):
    mask = torch.rand(20_000, generator=seeded(1)) < 0.3
    found = INNER["pick_rows"].kernels["cpu"](fields(20_000), mask, count=told)
    assert_same(found, INNER["pick_rows"].reference(fields(20_000), mask))


CLOUDS = [[0], [1], [63], [64], [65], [0, 5, 0], [20_000, 1, 0, 40_000, 64], [7] * 300]


@pytest.mark.parametrize("gone", [False, True])
@pytest.mark.parametrize("among", [None, 0.0, 0.9, 1.0])
@pytest.mark.parametrize("probability", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("counts", CLOUDS, ids=str)
def test_kept_rows_equal_the_reference(counts, probability, among, gone):
    marks = torch.rand(sum(counts), generator=seeded(3)) < probability
    within = None if among is None else torch.rand(sum(counts), generator=seeded(4)) < among
    options = {"gone": gone, "within": within}
    found = INNER["kept_rows"].kernels["cpu"](marks, ptr_from_counts(counts), **options)
    expected = INNER["kept_rows"].reference(marks, ptr_from_counts(counts), **options)
    assert all(map(torch.equal, found, expected))


def test_marks_that_are_other_bytes_than_0_and_1_are_true():
    marks = torch.tensor([0, 1, 2, 128, 255], dtype=torch.uint8).view(torch.bool)
    for gone in (False, True):
        found = kept_rows(marks, ptr_from_counts([5]), gone=gone, within=marks)
        assert found.keep.view(torch.uint8).tolist() == ([0] * 5 if gone else [0, 1, 1, 1, 1])
        assert found.sums.tolist() == kept_rows(torch.full((4,), not gone), ptr_from_counts([4])).sums.tolist()


@few
@given(data=st.data())
def test_what_is_kept_of_some_rows_is_told_as_if_there_were_no_others(data):
    counts = data.draw(st.lists(st.integers(0, 200), min_size=1, max_size=4))
    some, marks = (
        torch.tensor(data.draw(st.lists(st.booleans(), min_size=sum(counts), max_size=sum(counts)))).bool()
        for _ in range(2)
    )
    ptr = ptr_from_counts(counts)
    found = kept_rows(marks, ptr, within=some)
    alone = kept_rows(marks[some], ptr_after_mask(some, ptr))
    assert torch.equal(found.keep[some], alone.keep)
    assert not found.keep[~some].any()
    assert torch.equal(found.ptr, alone.ptr)
    assert torch.equal(found.sums, alone.sums)


def test_rows_of_runs_equal_the_reference():
    mask = (torch.arange(40_000) // 37 % 3 == 0) | (torch.arange(40_000) > 30_000)
    assert_same(*both("pick_rows", fields(40_000), mask))


@pytest.mark.parametrize(("count", "wanted"), [(1, 5), (10, 0), (1000, 3000), (50_000, 40_000)])
def test_rows_of_an_index_equal_the_reference(count, wanted):
    index = torch.randint(count, (wanted,), generator=seeded(2))
    assert_same(*both("pick_rows", fields(count), index))
    assert_same(*both("pick_rows", fields(count), index.repeat_interleave(2)[::2]))  # with gaps between the indices
    assert_same(*both("pick_rows", fields(count), -1 - index))


@pytest.mark.parametrize(
    "rows",
    [torch.tensor([0, 10]), torch.tensor([-11]), torch.tensor([0.5])],
    ids=["beyond", "before", "float"],
)
def test_impossible_rows_raise_what_torch_raises(rows):
    given = {"points": torch.rand(10, 3)}
    with pytest.raises(IndexError) as theirs:
        INNER["pick_rows"].reference(given, rows)
    with pytest.raises(IndexError) as ours:
        pick_rows(given, rows)
    assert str(ours.value) == str(theirs.value)


def test_no_rows_and_no_fields():
    assert pick_rows({}, torch.tensor([0])) == {}
    assert_same(*both("pick_rows", fields(0), torch.empty(0, dtype=torch.int64)))
    assert_same(*both("pick_rows", fields(0), torch.empty(0, dtype=torch.bool)))


PARTS = [[5], [0, 3, 0], [20_000, 7, 0, 45_000], [1] * 70]


def parts_of(counts: list[int]) -> dict[str, list[Tensor]]:
    split = {name: list(value.split(counts)) for name, value in fields(sum(counts)).items() if name != "complex"}
    return {name: value if name != "wide" else [one[:, :2] for one in value] for name, value in split.items()}


@pytest.mark.parametrize("counts", PARTS, ids=str)
def test_joined_parts_equal_the_reference(counts):
    assert_same(*both("join_rows", parts_of(counts)))


@pytest.mark.parametrize("more", [0, 9])
@pytest.mark.parametrize("counts", PARTS, ids=str)
def test_padded_parts_equal_the_reference(counts, more):
    parts = parts_of(counts)
    parts["small"] = [part.to(torch.int16) for part in parts["row"]]
    signed = (torch.int16, torch.int32, torch.int64)
    fillers = {name: -int(values[0].dtype in signed) for name, values in parts.items()}
    assert_same(*both("pad_rows", parts, max(counts) + more, fillers))


def test_parts_of_different_dtypes_are_joined_as_torch_joins_them():
    mixed = {"weight": [torch.rand(400_000), torch.rand(3).double()], "row": [torch.arange(400_000), torch.arange(3)]}
    ours, theirs = both("join_rows", mixed)
    assert ours["weight"].dtype == torch.float64
    assert_same(ours, theirs)


def test_gradients_reach_the_picked_rows():
    points = torch.rand(100, 3, requires_grad=True)
    mask = torch.arange(100) % 3 == 0
    pick_rows({"points": points}, mask)["points"].sum().backward()
    assert torch.equal(points.grad[:, 0] > 0, mask)


@few
@given(st.lists(st.integers(0, 40), min_size=1, max_size=6), st.integers(0, 99))
def test_row_pointers_after_a_mask_count_what_stays(counts, seed):
    ptr = ptr_from_counts(counts)
    mask = torch.rand(sum(counts), generator=seeded(seed)) < 0.5
    expected = [int(part.sum()) for part in torch.split(mask, counts)]
    assert torch.equal(ptr_after_mask(mask, ptr), ptr_from_counts(expected))


def motions(count: int) -> Tensor:
    linear = torch.randn(count, 3, 3, generator=seeded(4), dtype=torch.float64)
    return rigid.from_rotation_translation(linear, torch.randn(count, 3, generator=seeded(5), dtype=torch.float64))


@pytest.mark.parametrize("counts", [[0], [1], [5, 0, 3], [20_000, 1, 0, 40_000, 0]], ids=str)
@pytest.mark.parametrize("function", ["transform_points", "transform_directions"])
def test_moved_rows_equal_the_reference(function, counts):
    rows = torch.randn(sum(counts), 3, generator=seeded(6))
    rows[::7] = 0.0
    ours, theirs = both(function, rows, ptr_from_counts(counts), motions(len(counts)))
    assert ours.dtype == theirs.dtype == torch.float32
    assert torch.equal(ours.view(torch.int32), theirs.view(torch.int32))  # signs of zeros too


def test_float64_points_and_foreign_shapes_go_to_the_reference():
    ptr = torch.tensor([0, 4])
    ours, theirs = both("transform_points", torch.rand(4, 3).double(), ptr, motions(1))
    assert ours.dtype == theirs.dtype == torch.float64
    assert torch.equal(ours, theirs)
    with pytest.raises((RuntimeError, IndexError)):
        transform_points(torch.rand(4, 3), torch.tensor([0, 2, 4]), motions(1))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_box_equals_the_reference_and_refuses_what_is_not_finite(bad):
    points = torch.randn(30_000, 3, generator=seeded(8))
    box = (-0.5, -1.0, -0.2), (0.5, 0.1, 2.0)
    ours, theirs = both("inside_box", points, *box)
    assert torch.equal(ours, theirs)
    assert 0 < int(ours.sum()) < len(points)
    points[20_001, 1] = bad
    assert both("inside_box", points, *box) == (None, None)


@pytest.mark.parametrize("count", [1, 64, 65, 40_000])
@pytest.mark.parametrize("share", [0.0, 0.07, 0.9, 1.0])
def test_rows_are_kept_in_their_own_memory_as_in_other(count, share):
    mask = torch.rand(count, generator=seeded(count)) < share
    fields = {
        str(number): torch.rand(count, *shape, generator=seeded(number)).mul(100).to(dtype)
        for number, (shape, dtype) in enumerate(
            [((3,), torch.float32), ((), torch.int64), ((1,), torch.float32), ((), torch.uint8), ((7,), torch.float32)]
        )
    }
    wanted = {name: field[mask] for name, field in fields.items()}
    for body in (INNER["pick_rows"].kernels["cpu"], INNER["pick_rows"].reference):
        own = {name: field.clone() for name, field in fields.items()}
        for in_place in (False, True):
            kept = body(own, mask, in_place=in_place)
            assert all(torch.equal(kept[name], wanted[name]) for name in fields)
        assert all(kept[name].data_ptr() == own[name].data_ptr() for name in fields if len(kept[name]))
