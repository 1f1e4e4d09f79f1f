"""Volumes on disk: read back as they were, refused when damaged, hostile or too large."""

from __future__ import annotations

import numpy as np
import pytest

from pcdata.errors import CacheError, VolumeTooLargeError
from pcdata.io import read_volume, write_volume
from pcdata.structures import DepthFrame, TSDFVolume
from tests.factories import tabletop_frame


def fused(frame: DepthFrame, **options) -> TSDFVolume:
    volume = TSDFVolume(**{"voxel_size": 0.01, **options})
    volume.integrate(frame)
    return volume


def test_a_volume_read_back_goes_on_as_the_one_that_was_written(tmp_path):
    volume = fused(tabletop_frame(2), weighting="angle")
    write_volume(str(tmp_path / "table.npz"), volume)
    loaded = read_volume(str(tmp_path / "table.npz"))
    assert loaded.num_views == 2
    volume.integrate(tabletop_frame(2, seed=5))
    loaded.integrate(tabletop_frame(2, seed=5))
    expected, found = volume.extract_points(), loaded.extract_points()
    assert all(value.equal(found.fields()[name]) for name, value in expected.fields().items())
    assert found.frame_id == "base"


def test_damaged_hostile_and_large_files_are_refused(tmp_path):
    path = tmp_path / "table.npz"
    write_volume(path, fused(tabletop_frame(1)))
    with pytest.raises(VolumeTooLargeError, match="max_bytes allows"):
        read_volume(path, max_bytes=1000)
    arrays = dict(np.load(path))
    wrong = {
        "tsdf": {**arrays, "tsdf": arrays["tsdf"][:-1]},
        "not a complete": {name: value for name, value in arrays.items() if name != "weight"},
        "keys must be int64": {**arrays, "keys": arrays["keys"].astype(np.int32)},
        "distinct": {**arrays, "keys": np.zeros_like(arrays["keys"])},
        "describe": {**arrays, "about": np.array([1.0, 2.0])},
    }
    for words, content in wrong.items():
        np.savez(path, **content)
        with pytest.raises(CacheError, match=words):
            read_volume(path)
    np.savez(path, about=np.array([object()]))
    with pytest.raises(CacheError, match="not a complete"):
        read_volume(path)
    path.write_bytes(b"PK nothing")
    with pytest.raises(CacheError, match="not a complete"):
        read_volume(path)
