"""Records that the core finds and copies are those of the reference, to the last number of the table."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pcdata.contracts.dispatch import INNER
from pcdata.functional.stored_rows import CLOUDS, OTHERS, ROWS, Role, StoredForm, StoredGroups, parts_of

POINTS = np.arange(60, dtype=np.float32).reshape(20, 3)
POSES = np.arange(10, dtype=np.float64)
TEXT = np.arange(50, dtype=np.uint8)
EACH = np.array([0, 2, 2, 6, 11, 20])  # the points of five records; the second has none
TEXT_ENDS = np.array([0, 3, 4, 9, 9, 12])  # the fourth text is empty
PTR = np.stack([np.zeros(5, np.int64), np.diff(EACH)], axis=1).reshape(-1)
ROW_BYTES = [12, 8, 8, 1]


def stored(*arrays, roles=(Role.PER_POINT, Role.PER_CLOUD, Role.POINTERS, Role.TEXT)):
    """Two groups of five records of one form around one group of another."""
    own = [array.__array_interface__["data"][0] for array in arrays]
    table = [[own[0], 0, 0], [own[1], 1, -1], [own[2], 2, -1], [own[3], 0, len(EACH)]]
    groups = StoredGroups(
        torch.tensor([0, 5, 8]), torch.tensor([[0, 0], [1, 0], [0, 1]]), torch.tensor(np.append(EACH, TEXT_ENDS))
    )
    return groups, StoredForm(0, torch.tensor([table, table]), torch.tensor(ROW_BYTES), torch.tensor(roles))


def found_and_copied(backend, places, groups, form):
    find, gather = (INNER[name] for name in ("find_records", "gather_records"))
    table = (find.kernels["cpu"] if backend == "cpu" else find.reference)(torch.tensor(places), groups, form)
    found = parts_of(table, 4, len(places))
    if found.kind == OTHERS:
        return found, None
    into = torch.zeros(int(found.starts[-1]), dtype=torch.uint8)
    (gather.kernels["cpu"] if backend == "cpu" else gather.reference)(into, form, table)
    return found, into


@pytest.mark.parametrize("places", [[0], [4, 0, 2], [9, 1, 8, 12, 0], [3, 0], [2, 6]])
@pytest.mark.parametrize("ptr", [PTR, PTR + 1, np.zeros_like(PTR)])
def test_records_are_found_and_copied_as_the_reference_does(places, ptr):
    groups, form = stored(POINTS, POSES, ptr, TEXT)
    found, copied = found_and_copied("cpu", places, groups, form)
    wanted, copied_by_reference = found_and_copied("torch", places, groups, form)
    assert (found.kind, found.kind and found.pointers) == (wanted.kind, wanted.kind and wanted.pointers)
    if wanted.kind != OTHERS:
        assert all(np.array_equal(one, other) for one, other in zip(found[2:], wanted[2:], strict=True))
        assert torch.equal(copied, copied_by_reference)


@pytest.mark.parametrize(
    ("places", "ptr", "kind"),
    [
        ([4, 0, 2], PTR, CLOUDS),
        ([0, 9], PTR, CLOUDS),
        ([3], PTR, ROWS),  # its text is empty
        ([4, 0], PTR + 1, ROWS),  # the row pointers do not begin with 0
        ([4, 0], np.zeros_like(PTR), ROWS),  # nor end with the rows
        ([4, 6], PTR, OTHERS),
    ],
)
def test_clouds_are_told_from_other_rows(places, ptr, kind):
    found, copied = found_and_copied("cpu", places, *stored(POINTS, POSES, ptr, TEXT))
    assert found.kind == kind
    if kind == CLOUDS:
        numbers = [place - 8 if place > 7 else place for place in places]
        points = np.concatenate([POINTS[EACH[one] : EACH[one + 1]] for one in numbers])
        begin = int(found.starts[2])
        ptr = copied[begin : begin + 8 * len(places) + 8].view(torch.int64)
        assert ptr.tolist() == [0, *np.diff(EACH)[numbers].cumsum()]
        assert np.array_equal(copied[: points.nbytes].view(torch.float32).reshape(-1, 3), points)


@pytest.mark.parametrize("shift", [0, 4, 20])
def test_large_blocks_are_copied_whole_wherever_they_begin(shift):
    rows = 50_001
    points = np.arange(3 * 2 * rows + 9, dtype=np.float32)[shift // 4 :]
    one = torch.tensor([[[points.__array_interface__["data"][0], rows, -1]]])
    groups = StoredGroups(torch.tensor([0]), torch.tensor([[0, 0]]), torch.zeros(0, dtype=torch.int64))
    form = StoredForm(0, one, torch.tensor([12]), torch.tensor([Role.ANY]))
    table = INNER["find_records"].kernels["cpu"](torch.tensor([1, 0]), groups, form)
    into = torch.full((int(parts_of(table, 1, 2).starts[-1]) + 64,), 255, dtype=torch.uint8)
    INNER["gather_records"].kernels["cpu"](into[:-64], form, table)
    wanted = np.concatenate([points[3 * rows : 6 * rows], points[: 3 * rows]])
    assert np.array_equal(into.numpy()[: wanted.nbytes].view(np.float32), wanted)
    assert into[-64:].eq(255).all()
