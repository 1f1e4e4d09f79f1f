"""One row per kind: what clouds do with a field follows from it, whatever the field is called."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from pcdata.errors import DTypeError, ShapeError
from pcdata.functional.rows import ptr_from_counts
from pcdata.geometry import rigid
from pcdata.io.store.cloud_record import cloud_from_record, record_from_cloud
from pcdata.rng import seeded
from pcdata.structures import Kind, PointCloud
from pcdata.structures.kinds import FIELDS, KINDS, kinds_table
from tests.factories import assert_same, base_from_camera, cloud_in_base

COUNTS = [3, 0, 5]


def rows_of(kind: Kind, dtype: torch.dtype, count: int) -> Tensor:
    shape = (count, *(KINDS[kind].row or (2,)))
    values = torch.randint(-3, 4, shape, generator=seeded(7)).double() + 0.25 * dtype.is_floating_point
    return (torch.nn.functional.normalize(values, dim=1) if kind is Kind.DIRECTION else values).to(dtype)


def cases() -> list[tuple[Kind, torch.dtype]]:
    dtypes = [torch.float32, torch.float64, torch.int16, torch.int64, torch.uint8, torch.bool]
    return [(kind, dtype) for kind in Kind for dtype in dtypes if KINDS[kind].fits(dtype)]


def carrying(kind: Kind, dtype: torch.dtype) -> PointCloud:
    cloud = PointCloud(points=rows_of(Kind.POSITION, torch.float32, 8), ptr=ptr_from_counts(COUNTS), frame_id="base")
    return cloud.with_extra("value", rows_of(kind, dtype, 8), kind)


def test_every_kind_has_a_row_and_every_field_a_kind():
    assert set(KINDS) == set(Kind)
    assert {field.kind for field in FIELDS.values()} <= set(Kind)


@pytest.mark.parametrize(("kind", "dtype"), cases(), ids=str)
def test_clouds_join_split_pad_store_and_move_back_fields_of_every_kind(kind, dtype):
    cloud = carrying(kind, dtype)
    assert_same(PointCloud.cat(list(cloud)), cloud)
    assert_same(PointCloud.from_padded(cloud.padded()), cloud)
    padding = cloud.padded().extra["value"][~cloud.padded().mask]
    assert padding.eq(KINDS[kind].padding(dtype)).all()
    assert_same(cloud_from_record(record_from_cloud(cloud)), cloud)
    back = cloud.transformed(base_from_camera(3)).in_source_frame().extra["value"]
    assert back.dtype == dtype
    torch.testing.assert_close(back, cloud.extra["value"], atol=1e-6, rtol=0)


@pytest.mark.parametrize(("kind", "dtype"), cases(), ids=str)
def test_averages_of_equal_rows_are_those_rows(kind, dtype):
    cloud = carrying(kind, dtype)
    twice = cloud.select(torch.arange(8).repeat_interleave(2), 2 * cloud.ptr)
    merged = twice.averaged(torch.arange(16) // 2, cloud.ptr, points=cloud.points)
    torch.testing.assert_close(merged.extra["value"], cloud.extra["value"], atol=1e-6, rtol=0)
    assert merged.extra["value"].dtype == dtype


def test_positions_scale_directions_turn_and_the_rest_stays():
    cloud = cloud_in_base()
    moved = cloud.transformed(rigid.scaling(torch.tensor([2.0, 2.0, 2.0])).repeat(3, 1, 1))
    for name, value in cloud.fields().items():
        factor = 2.0 if cloud.kind(name) is Kind.POSITION else 1.0
        torch.testing.assert_close(moved.fields()[name].double(), factor * value.double(), atol=1e-6, rtol=0)


def test_an_average_is_a_mean_a_vote_the_lowest_or_the_first_and_never_the_mean_of_integers():
    fields = {
        "mean": (torch.tensor([[0.0], [1.0], [2.0]]), "invariant", [[1.0]]),
        "vote": (torch.tensor([7, 9, 9]), "invariant", [9]),
        "tie": (torch.tensor([9, 7, 3]), "invariant", [3]),
        "weakest": (torch.tensor([3, 1, 2], dtype=torch.uint8), "minimum", [1]),
        "place": (torch.tensor([[0.0, 0, 0], [3.0, 0, 0], [0.0, 3, 0]]), "position", [[1.0, 1.0, 0.0]]),
        "way": (torch.tensor([[1.0, 0, 0], [0.0, 1, 0], [0.0, 0, 0]]), "direction", [[0.5**0.5, 0.5**0.5, 0.0]]),
    }
    cloud = PointCloud(
        points=torch.zeros(3, 3),
        frame_id="base",
        source_index=torch.tensor([5, 8, 8]),
        extra={name: values for name, (values, _, _) in fields.items()},
        kinds={name: Kind(kind) for name, (_, kind, _) in fields.items()},
    )
    one = cloud.averaged(torch.zeros(3, dtype=torch.int64), torch.tensor([0, 1]), points=torch.zeros(1, 3))
    for name, (_, _, expected) in fields.items():
        torch.testing.assert_close(one.extra[name].double(), torch.tensor(expected).double(), atol=1e-6, rtol=0)
    assert one.source_index.tolist() == [5]


def test_the_page_tells_every_kind():
    assert kinds_table() in (Path(__file__).parents[2] / "docs" / "clouds.md").read_text(encoding="utf-8")


def test_what_a_kind_cannot_hold_is_refused():
    for kind, row in KINDS.items():
        for dtype in (torch.float32, torch.int64):
            if not row.fits(dtype):
                with pytest.raises(DTypeError, match=f"is a {kind.value}: it must be"):
                    carrying(Kind.INVARIANT, dtype).with_extra("other", torch.zeros(8, 3, dtype=dtype), kind)
        if row.row is not None:
            with pytest.raises(ShapeError, match=f"is a {kind.value}: it must be"):
                carrying(Kind.INVARIANT, torch.int64).with_extra("other", torch.zeros(8), kind)
