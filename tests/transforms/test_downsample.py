from __future__ import annotations

import dataclasses
import pickle

import pytest
import torch

from pcdata.errors import ConfigError, DTypeError, TooFewPointsError
from pcdata.functional.sampling import farthest_point_sample
from pcdata.functional.voxels import voxel_downsample
from pcdata.rng import seeded
from pcdata.structures import PointCloud
from pcdata.transforms import (
    FarthestPointSample,
    RandomFarthestPointSample,
    RandomPointCount,
    RandomSample,
    VoxelDownsample,
)
from tests.factories import cloud_in_base

# -- voxels --------------------------------------------------------------------------------------------------------


def two_voxels() -> PointCloud:
    """Five rows, alternating between two voxels of 0.1 that are 1 m apart."""
    points = torch.tensor([[0.00, 0, 0], [1.00, 0, 0], [0.01, 0, 0], [1.02, 0, 0], [0.02, 0, 0]])
    return PointCloud(
        points=points,
        frame_id="base",
        colors=torch.tensor([[0.0, 0, 0], [0.2, 0, 0], [0.3, 0, 0], [0.4, 0, 0], [0.6, 0, 0]]),
        normals=torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, 1.0, 0], [0, 0, 1], [1.0, 0, 0]]),
        labels=torch.tensor([7, 5, 2, 3, 7]),
        source_index=torch.tensor([40, 30, 20, 10, 0]),
        extra={
            "camera": torch.tensor([2, 9, 1, 9, 2], dtype=torch.uint8),
            "valid": torch.tensor([True, False, True, True, False]),
            "feature": torch.arange(10.0).reshape(5, 2),
            "anchor": points + 1,
        },
        kinds={"camera": "invariant", "valid": "invariant", "feature": "invariant", "anchor": "position"},
    )


def test_every_field_is_reduced_by_its_kind():
    small = VoxelDownsample(voxel_size=0.1)(two_voxels())
    torch.testing.assert_close(small.points, torch.tensor([[0.01, 0, 0], [1.01, 0, 0]]), atol=1e-7, rtol=0)
    torch.testing.assert_close(small.colors[:, 0], torch.tensor([0.3, 0.3]))
    diagonal = torch.nn.functional.normalize(torch.tensor([2.0, 1.0, 0.0]), dim=0)
    torch.testing.assert_close(small.normals, torch.stack([diagonal, torch.tensor([0.0, 0, 1])]))
    assert small.labels.tolist() == [7, 3]  # a majority, and the lower of two equals: never an average
    assert small.source_index.tolist() == [40, 30]  # the first row in the voxel
    assert small.extra["camera"].tolist() == [2, 9]
    assert small.extra["valid"].tolist() == [True, False]
    assert (small.extra["camera"].dtype, small.extra["valid"].dtype) == (torch.uint8, torch.bool)
    torch.testing.assert_close(small.extra["feature"], torch.tensor([[4.0, 5.0], [4.0, 5.0]]))
    torch.testing.assert_close(small.extra["anchor"], small.points + 1)


def test_labels_are_never_averaged_on_a_crowded_grid():
    cloud = cloud_in_base((400,)).with_fields(labels=torch.randint(2, (400,), generator=seeded(0)) * 100)
    assert set(VoxelDownsample(voxel_size=0.05)(cloud).labels.tolist()) <= {0, 100}


def test_normals_stay_unit_length():
    small = VoxelDownsample(voxel_size=0.05)(cloud_in_base((400,)))
    torch.testing.assert_close(small.normals.norm(dim=1), torch.ones(small.num_points))


def test_a_wanted_count_is_reached_by_every_cloud():
    small = VoxelDownsample(num_points=40)(cloud_in_base((120, 300)))
    assert all(40 <= count <= 44 for count in small.counts.tolist())
    assert [len(steps[-1]["params"]) for steps in small.history] == [1, 1]
    with pytest.raises(TooFewPointsError, match="500 points were asked of cloud 0"):
        VoxelDownsample(num_points=500)(cloud_in_base((120, 300)))


def test_either_a_size_or_a_count():
    for fields in ({}, {"voxel_size": 0.1, "num_points": 10}):
        with pytest.raises(ConfigError, match="give either voxel_size or num_points"):
            VoxelDownsample(**fields)


def test_fields_are_reduced_as_asked():
    cloud = cloud_in_base((200,))
    _, _, group = voxel_downsample(cloud.points, voxel_size=0.1)
    result = VoxelDownsample(
        voxel_size=0.1, reduce={"colors": "max", "labels": "first", "weight": "min", "points": "first"}
    )(cloud)
    for voxel in range(result.num_points):
        rows = (group == voxel).nonzero().squeeze(1)
        assert torch.equal(result.colors[voxel], cloud.colors[rows].amax(0))
        assert torch.equal(result.points[voxel], cloud.points[rows[0]])
        assert result.labels[voxel] == cloud.labels[rows[0]]
        assert torch.equal(result.extra["weight"][voxel], cloud.extra["weight"][rows].amin(0))
    with pytest.raises(DTypeError, match=r"the mean of torch.int64 is not taken"):
        VoxelDownsample(voxel_size=0.1, reduce={"labels": "mean"})(cloud)
    with pytest.raises(DTypeError, match=r"no field \['hue'\]; the clouds have"):
        VoxelDownsample(voxel_size=0.1, reduce={"hue": "max"})(cloud)
    with pytest.raises(ConfigError, match="points are reduced by mean, first or nearest, not max"):
        VoxelDownsample(voxel_size=0.1, reduce={"points": "max"})
    with pytest.raises(ConfigError, match="no origin, no min_points"):
        VoxelDownsample(num_points=10, min_points=2)


# -- sampling ------------------------------------------------------------------------------------------------------

SAMPLERS = [FarthestPointSample, RandomSample]


def sample(cls, data, seed=0, **fields):
    return cls(**fields)(data, generator=seeded(seed) if cls.is_random else None)


@pytest.mark.parametrize("cls", SAMPLERS)
def test_exactly_so_many_distinct_points_come_from_every_cloud(cls):
    result = sample(cls, cloud_in_base((120, 33, 150)), num_points=33)
    assert result.counts.tolist() == [33, 33, 33]
    assert len(set(result.extra["row"].tolist())) == 99


def test_farthest_points_come_in_picking_order_from_the_first_point_on():
    cloud = cloud_in_base((120,))
    index, _ = farthest_point_sample(cloud.points, num_samples=25)
    assert torch.equal(FarthestPointSample(num_points=25)(cloud).extra["row"], index)
    assert int(index[0]) == 0


def test_a_start_that_a_cloud_does_not_have_is_its_last_row():
    result = FarthestPointSample(num_points=3, start=40)(cloud_in_base((120, 33, 150)))
    assert result.extra["row"][::3].tolist() == [40, 120 + 32, 153 + 40]


def test_colors_spread_the_samples_too():
    cloud = cloud_in_base((60,))
    features = torch.cat([cloud.points, 2.0 * cloud.colors], 1)
    index, _ = farthest_point_sample(features, num_samples=9)
    assert torch.equal(FarthestPointSample(num_points=9, color_weight=2.0)(cloud).extra["row"], index)
    with pytest.raises(DTypeError, match=r"color_weight is 2\.0 but the cloud has no colors"):
        FarthestPointSample(num_points=9, color_weight=2.0)(cloud.with_fields(colors=None))
    with pytest.raises(DTypeError, match="balance_labels is on but the cloud has no labels"):
        FarthestPointSample(num_points=9, balance_labels=True)(cloud.with_fields(labels=None))


def test_a_random_start_is_another_point_every_time():
    starts = {
        int(sample(RandomFarthestPointSample, cloud_in_base((120,)), seed, num_points=1).extra["row"])
        for seed in range(20)
    }
    assert len(starts) > 10


@pytest.mark.parametrize("cls", SAMPLERS)
def test_if_short_error_names_the_sample(cls):
    with pytest.raises(
        TooFewPointsError, match=r"cloud 1 \(sample 'sample-1'\) has 10 points, fewer than the 32 asked"
    ):
        sample(cls, cloud_in_base((40, 10)), num_points=32)


@pytest.mark.parametrize("cls", SAMPLERS)
def test_if_short_keep_gives_fewer(cls):
    result = sample(cls, cloud_in_base((40, 10, 0)), num_points=32, if_short="keep")
    assert result.counts.tolist() == [32, 10, 0]


@pytest.mark.parametrize("cls", SAMPLERS)
def test_if_short_tile_repeats_the_whole_order(cls):
    result = sample(cls, cloud_in_base((40, 10)), num_points=32, if_short="tile").unbatch()[1]
    rows = result.extra["row"].tolist()
    assert rows[:10] == rows[10:20] == rows[20:30]
    assert rows[30:] == rows[:2]
    assert len(set(rows)) == 10


@pytest.mark.parametrize("cls", SAMPLERS)
def test_if_short_repeat_keeps_every_point_and_adds_duplicates(cls):
    result = sample(cls, cloud_in_base((40, 10)), num_points=32, if_short="repeat").unbatch()[1]
    rows = result.extra["row"].tolist()
    assert sorted(rows[:10]) == list(range(40, 50))
    assert len(rows) == 32
    assert set(rows[10:]) <= set(rows[:10])


def test_random_duplicates_are_drawn_independently_of_the_sample():
    drawn = [
        sample(RandomSample, cloud_in_base((10,)), seed, num_points=20, if_short="repeat").extra["row"].tolist()
        for seed in range(50)
    ]
    # Drawn from the sample's own stream, the first duplicate would be given by the sample's first row.
    predicted = sum(rows[10] == rows[rows[0]] for rows in drawn)
    assert predicted < 17  # 5 expected of 50, standard deviation 2


@pytest.mark.parametrize("cls", SAMPLERS)
def test_if_short_zeros_fills_with_rows_that_are_marked(cls):
    result = sample(cls, cloud_in_base((40, 10)), num_points=32, if_short="zeros").unbatch()[1]
    assert sorted(result.extra["row"][:10].tolist()) == list(range(40, 50))
    assert not bool(result.points[10:].any())
    assert not bool(result.colors[10:].any())
    assert set(result.labels[10:].tolist()) == set(result.source_index[10:].tolist()) == {-1}


@pytest.mark.parametrize("cls", SAMPLERS)
@pytest.mark.parametrize("if_short", ["error", "repeat", "tile", "zeros"])
def test_nothing_can_be_made_of_an_empty_cloud(cls, if_short):
    with pytest.raises(TooFewPointsError, match="has 0 points"):
        sample(cls, cloud_in_base((40, 0)), num_points=8, if_short=if_short)


def test_random_samples_are_uniform_over_the_rows():
    cloud = cloud_in_base((20,))
    rows = torch.cat([sample(RandomSample, cloud, seed, num_points=5).extra["row"] for seed in range(400)])
    counts = torch.bincount(rows, minlength=20)
    # 2000 draws over 20 rows: 100 each, standard deviation 9.
    assert int(counts.min()) > 60
    assert int(counts.max()) < 140


def test_the_number_of_points_itself_is_random():
    cloud = cloud_in_base((200, 200))
    counts = [sample(RandomPointCount, cloud, seed, num_points=100, spread=0.3).counts for seed in range(60)]
    counts = torch.stack(counts)
    assert int(counts.min()) >= 70
    assert int(counts.max()) <= 130
    assert int(counts.min()) < 80
    assert int(counts.max()) > 120
    assert not torch.equal(counts[:, 0], counts[:, 1])
    assert sample(RandomPointCount, cloud, num_points=100, spread=0.0).counts.tolist() == [100, 100]


def test_what_a_short_cloud_becomes_must_be_a_known_word():
    with pytest.raises(
        ConfigError, match=r"FarthestPointSample.if_short: .*'error', 'repeat', 'tile', 'zeros' or 'keep'"
    ):
        FarthestPointSample(num_points=8, if_short="crop")


def test_what_tells_sampled_rows_is_found_out_when_it_is_read():
    cloud = PointCloud(points=torch.rand(300, 3, generator=seeded(1)), ptr=torch.tensor([0, 120, 300]), frame_id="base")
    step = FarthestPointSample(num_points=50)
    given = cloud.ptr.clone()
    made = step(dataclasses.replace(cloud, ptr=given))
    given.zero_()  # whoever gave it may use it again
    told = [entries[-1]["rows"] for entries in made.history]
    alone = [step(one).history[0][-1]["rows"] for one in cloud]
    assert told == alone
    assert pickle.loads(pickle.dumps(step(cloud))).history == step(cloud).history
    assert step.replay(cloud, step(cloud).history).history == step(cloud).history
