"""Batches as sequences of clouds: length, index, iteration; padded batches know what packed ones do."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pcdata import PointCloud, collate_padded, to_frame
from pcdata.errors import DTypeError, FrameError, OutOfRangeError
from pcdata.models.batch import ModelBatch
from pcdata.structures import METRE
from tests.factories import assert_same, cloud_in_base, frame_with_counts


def test_a_batch_is_a_sequence_of_its_clouds():
    batch = cloud_in_base((3, 0, 5))
    assert len(batch) == 3
    assert [cloud.num_points for cloud in batch] == [3, 0, 5]
    for number, cloud in enumerate(batch):
        assert_same(batch[number], cloud)
        assert_same(batch[number - 3], cloud)
    assert_same(PointCloud.cat([batch[0], batch[1:]]), batch)
    assert_same(batch[:], batch)
    assert_same(batch[np.int64(2)], batch[torch.tensor(2)])


@pytest.mark.parametrize("batch", [cloud_in_base((3, 5)), cloud_in_base((3, 5)).padded()], ids=["packed", "padded"])
def test_what_names_no_cloud_is_refused(batch):
    for number in (2, -3):
        with pytest.raises(OutOfRangeError, match="there are 2 clouds"):
            batch[number]
    for clouds in (slice(1, 1), slice(None, None, 2)):
        with pytest.raises(OutOfRangeError, match="at least one cloud"):
            batch[clouds]
    for rows in (batch.points[..., 0] > 0, [0, 1], "points", True):
        with pytest.raises(DTypeError, match="select"):
            batch[rows]
    with pytest.raises(DTypeError, match="several arrays"):
        np.asarray(batch)


def test_padded_clouds_know_what_packed_ones_do():
    packed = cloud_in_base((3, 0, 5))
    padded = packed.padded(7)
    assert (len(padded), padded.num_clouds, padded.counts.tolist()) == (3, 3, [3, 0, 5])
    for name in ("frame_id", "unit", "source_frame", "meta", "history", "kinds"):
        assert getattr(padded, name) == getattr(packed, name), name
    assert_same(PointCloud.from_padded(padded), packed)
    assert_same(PointCloud.from_padded(padded[1:]), packed[1:])
    assert [PointCloud.from_padded(one).num_points for one in padded] == [3, 0, 5]
    assert_same(collate_padded(list(packed)), packed.padded())


def test_packed_and_padded_clouds_go_to_a_frame_alike():
    packed = cloud_in_base((3, 0, 5))
    padded = packed.padded(7)
    for frame in ("camera", "base"):
        moved = padded.to_frame(frame)
        assert (moved.frame_id, moved.unit) == (frame, METRE)
        assert_same(PointCloud.from_padded(moved), packed.to_frame(frame))
        for name, value in moved.fields().items():
            assert torch.equal(value[~padded.mask], padded.fields()[name][~padded.mask])
    assert_same(packed.to_frame("camera"), packed.in_source_frame())
    predicted = torch.rand(3, 2, 3)
    assert torch.equal(
        to_frame(padded, "camera", points=predicted).points, to_frame(packed, "camera", points=predicted).points
    )
    for batch in (packed, padded):
        with pytest.raises(FrameError, match="'elsewhere'"):
            batch.to_frame("elsewhere")


def test_every_structure_moves_to_another_device():
    cloud, frame = cloud_in_base((2, 3)), frame_with_counts()
    for structure in (cloud, cloud.padded(), frame, frame.camera, ModelBatch(tensors={"pc": torch.zeros(1, 2, 3)})):
        assert_same(structure.cpu(), structure)
        assert type(structure.to("meta")) is type(structure)
        if not torch.cuda.is_available():
            with pytest.raises((RuntimeError, AssertionError), match=r"CUDA|cuda|NVIDIA"):
                structure.cuda()
        else:
            assert_same(structure.cuda().cpu(), structure)
