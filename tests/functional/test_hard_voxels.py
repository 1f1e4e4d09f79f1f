"""Voxel tables against the loop over points that detectors' loaders run."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pcdata.errors import ConfigError
from pcdata.functional.hard_voxels import hard_voxels
from pcdata.functional.rows import ptr_from_counts
from pcdata.rng import seeded


def by_loop(points: np.ndarray, size, lower, upper, max_points: int, max_voxels: int):
    """The rule of mmcv and spconv: first voxels, and the first points of each."""
    size, lower, upper = (np.asarray(value, np.float32) for value in (size, lower, upper))
    shape = np.round((upper - lower) / size).astype(int)
    number: dict[tuple[int, ...], int] = {}
    rows: list[list[int]] = []
    for row, point in enumerate(points):
        cell = tuple(np.floor((point - lower) / size).astype(int).tolist())
        if any(not 0 <= place < most for place, most in zip(cell, shape)):
            continue
        if cell not in number:
            if len(rows) >= max_voxels:
                continue
            number[cell] = len(rows)
            rows.append([])
        if len(rows[number[cell]]) < max_points:
            rows[number[cell]].append(row)
    return list(number), rows


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("max_points", "max_voxels"), [(1, 1000), (3, 25), (5, 1000)])
def test_tables_are_those_of_the_loop(seed, max_points, max_voxels):
    counts = [200, 0, 333, 1]
    points = torch.rand(sum(counts), 3, generator=seeded(seed)) * 1.4 - 0.2
    size, lower, upper = (0.25, 0.2, 0.5), (0.0, 0.1, -0.1), (1.0, 1.1, 0.9)
    ptr = ptr_from_counts(counts)
    given = {"lower": lower, "upper": upper, "max_points": max_points, "max_voxels": max_voxels}
    found = hard_voxels(points, ptr, voxel_size=[size], **given)
    for b, (start, stop) in enumerate(zip(ptr.tolist(), ptr.tolist()[1:])):
        cells, rows = by_loop(points[start:stop].numpy(), size, lower, upper, max_points, max_voxels)
        own = slice(int(found.ptr[b]), int(found.ptr[b + 1]))
        assert [tuple(cell) for cell in found.cell[own].tolist()] == cells
        assert found.num_points[own].tolist() == [len(some) for some in rows]
        wanted = [[row + start for row in some] + [len(points)] * (max_points - len(some)) for some in rows]
        assert found.point_index[own].tolist() == wanted


def test_features_follow_their_rows():
    points = torch.tensor([[0.1, 0.1, 0.1], [0.9, 0.9, 0.9], [0.2, 0.1, 0.1]])
    found = hard_voxels(points, voxel_size=0.5, lower=(0, 0, 0), upper=(1, 1, 1), max_points=2)
    table = torch.cat([points, torch.zeros(1, 3)])[found.point_index]
    assert table.tolist() == [[points[0].tolist(), points[2].tolist()], [points[1].tolist(), [0, 0, 0]]]
    assert found.cell.flip(1).tolist() == [[0, 0, 0], [1, 1, 1]]


def test_a_grid_without_a_voxel_is_refused():
    points = torch.rand(5, 3)
    with pytest.raises(ConfigError, match="hard_voxels: the grid of cloud 0 has no voxel"):
        hard_voxels(points, voxel_size=0.5, lower=(0, 0, 0), upper=(1, 1, 0.1))
    with pytest.raises(ConfigError, match="hard_voxels: max_voxels"):
        hard_voxels(points, voxel_size=0.5, lower=(0, 0, 0), upper=(1, 1, 1), max_voxels=0)
