from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pcdata.functional import rows as ragged

ragged_counts = st.lists(st.integers(0, 6), min_size=1, max_size=6)
few = settings(max_examples=30, deadline=None)


@few
@given(ragged_counts)
def test_counts_and_row_pointers_are_two_views_of_one_thing(counts):
    ptr = ragged.ptr_from_counts(counts)
    assert ptr.dtype == torch.int64
    assert ptr[0] == 0
    assert ptr[-1] == sum(counts)
    assert ragged.counts_from_ptr(ptr).tolist() == counts


def test_row_pointers_come_from_tensors_of_any_integer_type():
    assert ragged.ptr_from_counts(torch.tensor([2, 0, 3], dtype=torch.int32)).tolist() == [0, 2, 2, 5]


@few
@given(ragged_counts)
def test_every_row_knows_its_cloud(counts):
    rows = ragged.cloud_of_rows(ragged.ptr_from_counts(counts))
    assert rows.tolist() == [cloud for cloud, count in enumerate(counts) for _ in range(count)]


@few
@given(ragged_counts, st.integers(0, 99))
def test_masking_keeps_clouds_apart(counts, seed):
    ptr = ragged.ptr_from_counts(counts)
    mask = torch.rand(sum(counts), generator=torch.Generator().manual_seed(seed)) < 0.5
    expected = [int(part.sum()) for part in mask.split(counts)]
    assert ragged.counts_from_ptr(ragged.ptr_after_mask(mask, ptr)).tolist() == expected


@few
@given(ragged_counts, st.integers(0, 99))
def test_reductions_agree_with_a_loop_over_clouds(counts, seed):
    ptr = ragged.ptr_from_counts(counts)
    values = torch.randn(sum(counts), 2, generator=torch.Generator().manual_seed(seed))
    parts = values.double().split(counts)
    total = torch.stack([part.sum(0) for part in parts])
    torch.testing.assert_close(ragged.segment_sum(values, ptr), total)
    mean = torch.stack([part.mean(0) if len(part) else torch.zeros(2).double() for part in parts])
    torch.testing.assert_close(ragged.segment_mean(values, ptr), mean)
    lowest = torch.finfo(torch.float32).min
    top = [float(part[:, 0].max()) if len(part) else lowest for part in parts]
    torch.testing.assert_close(ragged.segment_max(values[:, 0].contiguous(), ptr), torch.tensor(top))


def test_integer_sums_stay_integers():
    total = ragged.segment_sum(torch.tensor([2**53, 1, 5]), torch.tensor([0, 2, 2, 3]))
    assert total.tolist() == [2**53 + 1, 0, 5]


def test_extremes_of_few_and_of_many_clouds_have_a_gradient():
    for copies in (1, 50):
        values = torch.tensor([1.0, 3.0, 2.0, -1.0] * copies, requires_grad=True)
        ptr = ragged.ptr_from_counts([3, 0, 1] * copies)
        filled = ragged.counts_from_ptr(ptr) > 0
        for extreme, wanted in ((ragged.segment_max, [0, 1, 0, 1]), (ragged.segment_min, [1, 0, 0, 1])):
            (grad,) = torch.autograd.grad(extreme(values, ptr)[filled].sum(), values)
            assert grad.tolist() == wanted * copies


def test_the_maximum_of_an_empty_integer_cloud_is_the_lowest_integer():
    top = ragged.segment_max(torch.tensor([-7, -9]), torch.tensor([0, 0, 2]))
    assert top.tolist() == [torch.iinfo(torch.int64).min, -7]
