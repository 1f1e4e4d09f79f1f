from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pcdata.functional.rows import group_count, group_first, group_sum


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(0, 4), max_size=30))
def test_reductions_agree_with_a_loop_over_groups(rows):
    group = torch.tensor(rows, dtype=torch.int64)
    values = torch.arange(2 * len(rows)).reshape(-1, 2) + 2**53  # beyond what floats can count
    members = [[row for row, one in enumerate(rows) if one == name] for name in range(6)]
    assert group_count(group, 6).tolist() == [len(some) for some in members]
    assert group_first(group, 6).tolist() == [min(some, default=len(rows)) for some in members]
    assert group_sum(values, group, 6).tolist() == [values[some].sum(0).tolist() for some in members]
