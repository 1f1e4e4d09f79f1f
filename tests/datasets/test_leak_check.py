"""Near duplicates across splits: copies in any order, thinned out, noisy or moved; other views are none."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pcdata import PointCloud, split_dataset
from pcdata.build import build_dataset, config_from_yaml
from pcdata.cli.main import main
from pcdata.datasets.leak_check import check_leaks
from pcdata.datasets.near_duplicates import (
    SIZE,
    Surface,
    candidates,
    descriptor,
    duplicate_distance,
    thinned,
    thinnings,
)
from pcdata.geometry import rigid
from pcdata.rng import seeded
from pcdata.synthetic import SyntheticSource

PIPELINE = """
depth: [MaskDepth: {near: 0.1, far: 2.0}, Deproject]
cloud: [ToFrame: {frame: base}, VoxelDownsample: {voxel_size: 0.004}, FarthestPointSample: {num_points: 512}]
"""


@pytest.fixture(scope="module")
def views():
    """Clouds of 512 points of three scenes from two views each: table, objects, shadows."""
    source = SyntheticSource(num_scenes=3, num_objects=4, size=(120, 160), num_views=2, seed=5)
    pipeline = config_from_yaml(PIPELINE).pipeline
    clouds = [pipeline(source.load(sample_id)) for sample_id in source.ids]
    return [[cloud[view].points.numpy().astype(np.float64) for view in range(2)] for cloud in clouds]


def moved(points, degrees):
    turn = rigid.from_rotation_translation(
        torch.from_numpy(_rotation(degrees)), torch.tensor([0.3, 0.1, 0.5], dtype=torch.float64)
    ).numpy()
    return points @ turn[:3, :3].T + turn[:3, 3]


def _rotation(degrees):
    axis, angle = np.array([2.0, -1.0, 2.0]) / 3, np.radians(degrees)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


COPIES = {
    "exact": lambda points, generator: points.copy(),
    "shuffled": lambda points, generator: generator.permutation(points),
    "thinned out to a quarter": lambda points, generator: generator.permutation(points)[: len(points) // 4],
    "with 1 mm of noise": lambda points, generator: points + generator.normal(0, 0.001, points.shape),
    "moved": lambda points, generator: moved(points, 110),
    "moved, shuffled and halved": lambda points, generator: generator.permutation(moved(points, 35))[
        : len(points) // 2
    ],
}


def distance(first, second):
    sparse, dense = sorted((first, second), key=len)
    return duplicate_distance(sparse, Surface(dense, True))


@pytest.mark.parametrize("name", COPIES)
def test_copies_are_found_by_their_descriptors_and_by_their_points(views, name):
    for number, (points, _) in enumerate(views):
        copy = COPIES[name](points, np.random.default_rng(number))
        descriptors = np.stack([descriptor(points), descriptor(copy)])
        counts = np.array([len(points), len(copy)])
        generator = seeded(number)
        halves = np.stack([half for one in (points, copy) for half in thinnings(one, 100, generator)])
        assert [*candidates(descriptors, counts, [np.array([0]), np.array([1])], halves)] == [(0, 1)]
        found = distance(points, copy)
        assert found is not None
        assert found <= 0.0015


def test_another_view_of_the_same_objects_is_no_duplicate_and_neither_is_another_scene(views):
    for number, (first, second) in enumerate(views):
        assert distance(first, second) is None
        assert distance(first, views[number - 1][0]) is None


def test_a_few_centimetres_that_differ_on_a_large_table_are_no_duplicate():
    generator = np.random.default_rng(0)
    table = np.column_stack([generator.uniform(0, 1, (4000, 2)), np.zeros(4000)])
    box = generator.uniform(0, 0.1, (200, 3)) * [1, 1, 0.5]
    here, there = (np.vstack([table, box + np.array(corner)]) for corner in ((0.1, 0.1, 0), (0.7, 0.6, 0)))
    assert distance(here, there) is None


@pytest.mark.parametrize("kept", [0.5, 0.25])
def test_a_thinned_copy_of_a_cloud_that_is_dense_in_one_place_is_found(kept):
    draw = np.random.default_rng(0)
    table = np.concatenate([draw.uniform(-0.4, 0.4, (400, 2)), np.zeros((400, 1))], 1)
    ball = draw.normal(size=(1000, 3))
    ball = 0.06 * ball / np.linalg.norm(ball, axis=1, keepdims=True) + [0.1, 0.0, 0.06]
    cloud = np.concatenate([table, ball])
    assert distance(cloud[draw.random(len(cloud)) < kept], cloud) == pytest.approx(0.0, abs=1e-9)
    without = np.concatenate([table[table[:, 0] > -0.2], ball])  # a fourth of the table is not there
    assert distance(without, cloud) is None


def test_clouds_that_are_in_no_metres_are_judged_by_their_size(views):
    points = views[0][0] * 40
    copy = points + np.random.default_rng(0).normal(0, 0.002 * np.std(points), points.shape)
    assert duplicate_distance(points, Surface(copy, False)) is not None
    assert duplicate_distance(views[1][0] * 40, Surface(points, False)) is None


def test_clouds_of_too_few_points_are_no_candidates():
    assert not descriptor(np.zeros((3, 3))).any()
    none, parts = np.zeros((4, SIZE), np.float32), [np.array([0, 1]), np.array([2, 3])]
    assert [*candidates(none, np.zeros(4, int), parts, np.zeros((0, SIZE), np.float32))] == []
    assert thinned(np.array([3, 99]), seeded(0)).tolist() == [0, 0]
    assert thinned(np.array([3, 100, 5000]), seeded(0)).tolist() == [0, 200, 200]
    assert sorted({*thinned(np.full(1000, 100), seeded(0)).tolist()}) == [0, 1]


def test_halves_and_quarters_are_found_among_many_clouds_that_are_alike():
    draw = np.random.default_rng(4)
    angles = draw.uniform(0, 2 * np.pi, (400, 1024))
    radii = 0.3 + draw.normal(0, 0.02, (400, 1))  # rings whose radius, height and wave differ a little
    heights = draw.normal(0.1, 0.01, (400, 1)) * draw.random((400, 1024))
    waves = radii + draw.normal(0, 0.02, (400, 1)) * np.cos(3 * angles)
    clouds = [*np.stack([waves * np.cos(angles), 0.8 * waves * np.sin(angles), heights], 2)]
    copies = [draw.permutation(cloud)[: 512 if row % 2 else 256] for row, cloud in enumerate(clouds[:40])]
    every = [*clouds, *copies]
    counts, parts = np.array([len(cloud) for cloud in every]), [np.arange(400), np.arange(400, 440)]
    generator = seeded(0)
    halves = np.stack(
        [
            half
            for cloud, times in zip(every, thinned(counts, generator).tolist())
            for half in thinnings(cloud, times, generator)
        ]
    )
    pairs = {*candidates(np.stack([descriptor(cloud) for cloud in every]), counts, parts, halves)}
    assert sum((400 + row, row) in pairs for row in range(40)) >= 38
    assert len(pairs) < 40 * 20


def test_thinned_copies_of_large_clouds_are_found_though_a_part_of_their_points_describes_them():
    draw = np.random.default_rng(5)
    sizes = draw.uniform(0.9, 1.1, (60, 1, 3))  # boxes that differ a little
    clouds = [*(draw.uniform(-0.3, 0.3, (60, 20_000, 3)) * sizes)]
    copies = [draw.permutation(cloud)[: 10_000 if row % 2 else 5_000] for row, cloud in enumerate(clouds[:20])]
    every = [*clouds, *copies]
    counts, parts = np.array([len(cloud) for cloud in every]), [np.arange(60), np.arange(60, 80)]
    generator = seeded(0)
    halves = [
        half
        for cloud, times in zip(every, thinned(counts, generator).tolist())
        for half in thinnings(cloud, times, generator)
    ]
    pairs = {*candidates(np.stack([descriptor(cloud) for cloud in every]), counts, parts, np.stack(halves))}
    assert sum((60 + row, row) in pairs for row in range(20)) >= 19
    assert len(pairs) < 20 * 10


class Copied:
    """Clouds by name; one is a shuffled copy of another."""

    name = kind = "copied"

    def __init__(self, views) -> None:
        self.clouds = {f"c{n}": views[n % 3][n % 2] * (1 + n / 10) for n in range(6)}
        self.clouds["copy"] = np.random.default_rng(0).permutation(self.clouds["c1"])
        self.clouds["tiny"] = np.zeros((3, 3))
        self.ids = list(self.clouds)

    def __len__(self) -> int:
        return len(self.ids)

    def load(self, sample_id):
        points = torch.from_numpy(self.clouds[sample_id]).float()
        return PointCloud(points=points, ptr=torch.tensor([0, len(points)]), frame_id="base")


def test_a_copy_in_another_split_is_told_with_its_distance_and_ends_the_command_with_1(tmp_path, views, capsys):
    folder = tmp_path / "set"
    build_dataset(config_from_yaml("output: {format: packed}"), Copied(views), folder)
    table = tmp_path / "table.csv"
    ids = Copied(views).ids
    table.write_text("sample,split,scene\n" + "".join(f"{one},{'ab'[one == 'copy']},{one}\n" for one in ids))
    assert main(["split", str(folder), "--named-by", "column:split", "--table", str(table)]) == 1
    told = capsys.readouterr().out
    assert "leaks    1 near duplicate across splits among 8 samples; too few points to be compared: 1 cloud" in told
    assert "copy (b) shows the same as c1 (a): 0 m apart" in told
    (leak,) = check_leaks(folder).leaks
    assert (leak.first, leak.second, leak.splits) == ("copy", "c1", ("b", "a"))
    assert main(["split", str(folder), "--check"]) == 1
    assert main(["split", str(folder), "--check", "--fresh"]) == 2
    # The advice, followed: both get one value, and the leak is gone.
    table.write_text("sample,scene\n" + "".join(f"{one},{'c1' if one == 'copy' else one}\n" for one in ids))
    words = ["--by", "column:scene", "--table", str(table), "--fresh", "--parts", "a=rest,b=2"]
    assert main(["split", str(folder), *words]) == 0
    assert split_dataset(folder, table=table).part_of()["copy"] == split_dataset(folder, table=table).part_of()["c1"]
