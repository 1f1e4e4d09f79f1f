"""Collate functions lose nothing, and say what is wrong with a batch that cannot be made."""

from __future__ import annotations

import pytest
import torch

from pcdata import PointCloud, collate_fixed, collate_packed, collate_padded
from pcdata.datasets import COLLATES, register_collate
from pcdata.errors import ConfigError, DTypeError, FrameError, ShapeError
from tests.factories import assert_same

ALL = list(COLLATES.values())


def cloud(count: int, start: float = 0.0, **changes: object) -> PointCloud:
    points = start + torch.arange(count * 3.0).reshape(count, 3)
    fields = {"points": points, "frame_id": "base", "labels": torch.arange(count), "colors": points / 100}
    return PointCloud(**(fields | changes))


def test_packed_is_the_concatenation_cut_by_ptr():
    clouds = [cloud(3), cloud(0), cloud(5, 9.0)]
    batch = collate_packed(clouds)
    assert batch.ptr.tolist() == [0, 3, 3, 8]
    for one, back in zip(clouds, batch.unbatch(), strict=True):
        assert torch.equal(one.points, back.points)
        assert torch.equal(one.labels, back.labels)


def test_padded_has_each_cloud_where_the_mask_is_true_and_fill_elsewhere():
    clouds = [cloud(3), cloud(0), cloud(5, 9.0)]
    batch = collate_padded(clouds)
    assert batch.points.shape == (3, 5, 3)
    assert batch.mask.sum(1).tolist() == [3, 0, 5]
    for one, points, labels, mask in zip(clouds, batch.points, batch.labels, batch.mask, strict=True):
        assert torch.equal(points[mask], one.points)
        assert torch.equal(labels[mask], one.labels)
        assert not points[~mask].any()
        assert (labels[~mask] == -1).all()


def test_fixed_is_a_plain_stack():
    batch = collate_fixed([cloud(4), cloud(4, 7.0)])
    assert torch.equal(batch.points, torch.stack([cloud(4).points, cloud(4, 7.0).points]))
    assert batch.mask.all()


@pytest.mark.parametrize("counts", [[4, 4, 4], [3, 0, 5], [20_000, 31_000]], ids=str)
def test_padding_samples_equals_padding_their_batch(counts):
    clouds = [cloud(count, float(count)) for count in counts]
    assert_same(collate_padded(clouds), PointCloud.cat(clouds).padded())
    assert_same(PointCloud.cat_padded(clouds, 31_007), PointCloud.cat(clouds).padded(31_007))
    batches = [PointCloud.cat(clouds), clouds[0]]
    assert_same(PointCloud.cat_padded(batches), PointCloud.cat(batches).padded())


def test_a_padded_batch_shares_nothing_with_its_samples():
    samples = [cloud(4), cloud(4, 7.0)]
    for collate in ALL:
        batch = collate(samples)
        batch.points.zero_()
    assert float(samples[1].points.min()) == 7.0
    assert float(collate_fixed(samples[:1]).points.zero_().sum()) == 0.0
    assert float(samples[0].points.sum()) == 66.0


def test_fixed_refuses_other_counts_and_says_what_to_do():
    with pytest.raises(ShapeError, match=r"3 to 5 points.*FarthestPointSample.*collate_padded"):
        collate_fixed([cloud(3), cloud(5)])


@pytest.mark.parametrize("collate", ALL)
def test_a_batch_of_nothing_is_an_error(collate):
    with pytest.raises(ShapeError, match="at least one"):
        collate([])


@pytest.mark.parametrize("collate", ALL)
def test_clouds_in_two_frames_are_not_mixed(collate):
    with pytest.raises(FrameError, match=r"'camera'.*'base'"):
        collate([cloud(3), cloud(3, frame_id="camera")])


@pytest.mark.parametrize("collate", ALL)
def test_clouds_with_different_fields_are_named(collate):
    with pytest.raises(ShapeError, match="colors"):
        collate([cloud(3), cloud(3, colors=None)])


@pytest.mark.parametrize("collate", ALL)
@pytest.mark.parametrize("wrong", [torch.zeros(3, 3), {"points": torch.zeros(3, 3)}, None])
def test_anything_but_clouds_is_refused_by_the_name_of_its_type(collate, wrong):
    with pytest.raises(DTypeError, match=f"{collate.__name__}.*{type(wrong).__name__}"):
        collate([cloud(3), wrong])


def test_a_collate_function_is_known_by_its_name_and_none_takes_that_of_another():
    assert {name: one.__name__ for name, one in COLLATES.items()} == {name: f"collate_{name}" for name in COLLATES}
    with pytest.raises(ConfigError, match="must be a function called collate_NAME"):
        register_collate(lambda clouds: clouds)

    def collate_packed(clouds):
        return clouds

    with pytest.raises(ConfigError, match="a collate function called packed is registered already"):
        register_collate(collate_packed)


@pytest.mark.parametrize(("longest", "width"), [(1, 4), (4, 4), (5, 8), (16, 16)])
def test_padded_lengths_are_rounded_up_to_a_bucket(longest, width):
    batch = collate_padded([cloud(longest), cloud(1)], buckets=(4, 8, 16))
    assert batch.points.shape == (2, width, 3)
    assert batch.counts.tolist() == [longest, 1]
    assert not bool(batch.points[~batch.mask].any())


def test_a_cloud_longer_than_the_last_bucket_and_buckets_that_fall_are_refused():
    with pytest.raises(ShapeError, match="add a bucket"):
        collate_padded([cloud(9)], buckets=(4, 8))
    for wrong in ((8, 4), (0, 4), (4, 4)):
        with pytest.raises(ConfigError, match="rise"):
            collate_padded([cloud(3)], buckets=wrong)
