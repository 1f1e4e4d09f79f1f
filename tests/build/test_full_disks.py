"""A disk that fills up at any moment of a build ends in one error that says so, and leaves nothing."""

from __future__ import annotations

import gc
import os
import subprocess

import pytest
import torch

from pcdata import CachedCloudDataset, PointCloud
from pcdata.build import build_dataset
from pcdata.errors import CacheError
from pcdata.io.clouds.ply import write_ply
from tests.build.test_builder import FORMATS, Clouds, tree
from tests.disk_limits import largest_file
from tests.warm import run_python

CHILD = """
import sys
from pcdata.cli import main
from tests.disk_limits import limit_files
limit_files(int(sys.argv[1]))
sys.argv = ["pcdata", *sys.argv[2:]]
sys.exit(main())
"""


def clouds(count: int) -> Clouds:
    points = torch.rand(3000, 3, generator=torch.Generator().manual_seed(0))
    return Clouds({f"cloud{n}": PointCloud(points=points, frame_id="base") for n in range(count)})


PLAIN = "cloud: [Center]\n"


@pytest.mark.parametrize(
    "form", ["hdf5", "hdf5, compression: gzip", "npz", "npz, compression: gzip", "packed", "pt", "webdataset"]
)
@pytest.mark.parametrize("size", [0, 700, 5_000, 30_000])
def test_a_file_that_cannot_grow_is_one_error_and_leaves_nothing(tmp_path, form, size):
    from pcdata.build import config_from_yaml

    config = config_from_yaml(PLAIN + f"output: {{format: {form}}}")
    with largest_file(size), pytest.raises(CacheError, match="cannot be written: a file may not become so large"):
        build_dataset(config, clouds(3), tmp_path / "deep" / "out")
    assert tree(tmp_path) == {}


@pytest.mark.parametrize("size", [0, 300])
def test_raw_captures_that_do_not_fit_are_no_reason_to_leave_captures_out(tmp_path, source, configure, size):
    config = configure("output: {format: hdf5, keep_raw: true}")
    with largest_file(100_000):
        build_dataset(config, source, tmp_path / "fits")
    with largest_file(size), pytest.raises(CacheError, match="cannot be written: a file may not become so large") as e:
        build_dataset(config, source, tmp_path / "out")
    assert "--skip" not in str(getattr(e.value, "__notes__", ""))
    assert [path.name for path in tmp_path.iterdir()] == ["fits"]


@pytest.mark.parametrize("size", range(2_000, 130_000, 16_411))
def test_hdf5_survives_a_fault_at_any_offset_and_the_process_goes_on(tmp_path, size):
    from pcdata.build import config_from_yaml

    config = config_from_yaml(PLAIN + "output: {format: hdf5}")
    with largest_file(size), pytest.raises(CacheError, match="cannot be written"):
        build_dataset(config, clouds(4), tmp_path / "out")
    assert tree(tmp_path) == {}
    build_dataset(config, clouds(4), tmp_path / "out")
    assert len(list(CachedCloudDataset(tmp_path / "out"))) == 4


def test_the_command_line_ends_with_code_1_and_one_message(tmp_path):
    (tmp_path / "in").mkdir()
    for name, cloud in clouds(3).samples.items():
        write_ply(tmp_path / "in" / f"{name}.ply", cloud)
    (tmp_path / "config.yaml").write_text(
        PLAIN + "output: {format: hdf5}"
    )  # whose library writes once more as Python ends
    before = tree(tmp_path)
    call = ["build", tmp_path / "config.yaml", "--source", tmp_path / "in", "--out", tmp_path / "out"]
    done = run_python(CHILD, "20000", *map(str, call))
    assert done.returncode == 1, done.stderr
    assert "cannot be written: a file may not become so large" in done.stderr
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr
    assert tree(tmp_path) == before


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 200 kB."""
    place = tmp_path / "disk"
    place.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=200k", "tmpfs", str(place)], capture_output=True, check=False
    )
    if mounted.returncode:
        pytest.skip(f"nothing can be mounted here: {mounted.stderr.decode(errors='replace').strip()}")
    yield place
    gc.collect()  # what an error's traceback held of a dataset, such as its index, is mapped until then
    subprocess.run(["umount", str(place)], check=True)


@pytest.mark.skipif(not os.path.exists("/bin/mount") and not os.path.exists("/usr/bin/mount"), reason="no mount here")
@pytest.mark.parametrize("form", FORMATS)
def test_a_full_disk_is_called_full(small_disk, form):
    from pcdata.build import config_from_yaml

    config = config_from_yaml(PLAIN + f"output: {{format: {form}}}")
    with pytest.raises(CacheError, match="the disk is full"):
        build_dataset(config, clouds(8), small_disk / "out")
    assert tree(small_disk) == {}
    build_dataset(config, clouds(2), small_disk / "out")
    before = tree(small_disk)
    with pytest.raises(CacheError, match="the disk is full"):
        build_dataset(config, clouds(7), small_disk / "out", overwrite=True)
    assert tree(small_disk) == before
