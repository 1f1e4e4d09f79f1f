"""Compact colors and normals: what is read back is within the stated bounds, in every store, alone and in batches."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pcdata import CachedCloudDataset, PointCloud
from pcdata.build import build_dataset, config_from_yaml, load_config
from pcdata.errors import CacheError
from pcdata.io.store.cloud_record import cloud_from_record, record_from_cloud
from pcdata.io.store.compact_fields import COLOR_ERROR, NORMAL_ERROR
from pcdata.io.store.stores import STORES
from tests.build.test_builder import Clouds

PARTS = st.sampled_from([-1.0, -0.5, -1e-4, -1e-30, -0.0, 0.0, 1e-30, 1e-4, 0.5, 1.0]) | st.floats(-1, 1, width=32)


def back(**fields) -> PointCloud:
    cloud = PointCloud(points=torch.zeros(len(next(iter(fields.values()))), 3), frame_id="base", **fields)
    return cloud_from_record(record_from_cloud(cloud, compact=True))


def angles(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    one, other = one.double(), other.double()
    return torch.atan2(torch.linalg.cross(one, other).norm(dim=1), (one * other).sum(dim=1))


@settings(max_examples=50)
@given(st.tuples(PARTS, PARTS, PARTS).filter(lambda parts: max(map(abs, parts)) > 1e-20))
def test_a_normal_keeps_its_direction_within_the_bound(parts):
    longest = max(map(abs, parts))
    normals = torch.nn.functional.normalize(torch.tensor([parts], dtype=torch.float64) / longest, dim=1).float()
    assert float(angles(normals, back(normals=normals).normals)) <= NORMAL_ERROR


def test_many_normals_keep_their_directions_and_those_that_are_none_stay_zero():
    draw = torch.Generator().manual_seed(0)
    normals = torch.nn.functional.normalize(torch.randn(100_000, 3, generator=draw), dim=1)
    normals[::10] = 0
    read = back(normals=normals).normals
    has = normals.norm(dim=1) > 0
    assert read.dtype is torch.float32
    assert torch.equal(read[~has], normals[~has])
    assert float(angles(normals[has], read[has]).max()) <= NORMAL_ERROR
    assert float((read[has].norm(dim=1) - 1).abs().max()) < 1e-6


def test_colors_that_were_bytes_come_back_bit_for_bit_and_others_within_the_bound():
    every = (torch.arange(256, dtype=torch.uint8).float() / 255)[:, None].expand(-1, 3)
    assert torch.equal(back(colors=every).colors, every)
    colors = torch.rand(10_000, 3, generator=torch.Generator().manual_seed(0))
    error = float((back(colors=colors).colors.double() - colors.double()).abs().max())
    assert 0.99 * COLOR_ERROR < error <= COLOR_ERROR + 1e-7


@pytest.mark.parametrize(
    ("fields", "what"),
    [
        ({"colors": torch.full((2, 3), 1.5)}, "colors must be within 0 and 1"),
        ({"colors": torch.full((2, 3), math.nan)}, "colors must be within 0 and 1"),
        ({"normals": torch.full((2, 3), 0.1)}, "normals must be unit vectors"),
        ({"normals": torch.full((2, 3), math.nan)}, "normals must be unit vectors"),
    ],
)
def test_what_no_bound_holds_for_is_refused(fields, what):
    with pytest.raises(CacheError, match=what):
        back(**fields)


@pytest.mark.parametrize("form", list(STORES))
def test_every_store_keeps_them_and_reads_batches_as_it_reads_samples(tmp_path, form):
    draw = torch.Generator().manual_seed(0)
    clouds = {}
    for name, count in (("a", 30), ("b", 0), ("c", 17)):
        normals = torch.nn.functional.normalize(torch.randn(count, 3, generator=draw), dim=1)
        colors = torch.randint(256, (count, 3), generator=draw).float() / 255
        points = torch.rand(count, 3, generator=draw)
        clouds[name] = PointCloud(points=points, colors=colors, normals=normals, frame_id="base")
    text = "cloud: [Center]\noutput: {{format: {form}, compact: {compact}}}\n"
    sets = {}
    for compact in ("true", "false"):
        config = config_from_yaml(text.format(form=form, compact=compact))
        build_dataset(config, Clouds(clouds), tmp_path / compact)
        sets[compact] = CachedCloudDataset(tmp_path / compact)
    assert (sets["true"].manifest.compact, sets["false"].manifest.compact) == (True, False)
    assert load_config(tmp_path / "true").output.compact
    for read in (list, lambda data: list(data.__getitems__([0, 1, 2]))):
        for small, full in zip(*map(read, sets.values()), strict=True):
            assert torch.equal(small.points, full.points)
            assert torch.equal(small.colors, full.colors)
            assert not full.num_points or float(angles(small.normals, full.normals).max()) <= NORMAL_ERROR
    sizes = {name: sum(path.stat().st_size for path in (tmp_path / name).rglob("*.*")) for name in sets}
    assert sizes["true"] < sizes["false"]
    stored = STORES[form](tmp_path / "true" / "shards" / "00000").read("a").arrays
    assert (stored["colors"].dtype, stored["normals"].dtype) == (np.uint8, np.int16)
