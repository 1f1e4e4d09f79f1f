"""A disk that fills up while samples are exported ends in one error that names the folder, and leaves nothing."""

from __future__ import annotations

import pytest

from pcdata.errors import CacheError
from pcdata.exports import export_dataset
from tests.disk_limits import largest_file
from tests.exports.samples import Samples, cloud, frame, shape, tree

TABLE = {name: {"class": "mug"} for name in "abc"}
CLOUDS = Samples({name: cloud(600, seed) for seed, name in enumerate("abc")})
SHAPES = Samples({name: shape(seed=seed) for seed, name in enumerate("abc")})
CAPTURES = Samples({name: frame((24, 32), seed) for seed, name in enumerate("abc")})

CASES = {
    "pointcept": (CLOUDS, {}),
    "modelnet": (CLOUDS, {"table": TABLE, "num_points": 600}),
    "pointnet": (SHAPES, {"table": TABLE}),
    "pointnet_part": (Samples({name: shape(seed=seed) for seed, name in enumerate("abc")}), {"table": TABLE}),
    "contact_graspnet": (CAPTURES, {}),
    "graspnet": (CAPTURES, {"any_size": True}),
    "ggcnn": (CAPTURES, {"any_size": True}),
}


@pytest.mark.parametrize("target", CASES)
@pytest.mark.parametrize("size", [0, 500])
def test_a_file_that_cannot_grow_is_one_error_and_leaves_nothing(tmp_path, target, size):
    samples, options = CASES[target]
    with largest_file(size), pytest.raises(CacheError, match="cannot be written: a file may not become so large") as e:
        export_dataset(samples, target, tmp_path / "deep" / "out", **options)
    assert str(tmp_path / "deep") in str(e.value)
    assert tree(tmp_path) == {}


@pytest.mark.parametrize("size", range(900, 76_000, 12_007))
def test_hdf5_of_an_export_survives_a_fault_at_any_offset_and_the_process_goes_on(tmp_path, size):
    with largest_file(size), pytest.raises(CacheError, match="cannot be written"):
        export_dataset(SHAPES, "pointnet", tmp_path / "out", table=TABLE)
    assert tree(tmp_path) == {}


def test_an_export_that_is_continued_keeps_what_fitted(tmp_path):
    for size, ended in ((400, CacheError), (6_000, CacheError)):
        with largest_file(size), pytest.raises(ended, match="so large"):
            export_dataset(CAPTURES, "contact_graspnet", tmp_path / "out", resume=True)
    export_dataset(CAPTURES, "contact_graspnet", tmp_path / "out", resume=True)
    export_dataset(CAPTURES, "contact_graspnet", tmp_path / "whole")
    assert tree(tmp_path / "out") == tree(tmp_path / "whole")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "whole"]
