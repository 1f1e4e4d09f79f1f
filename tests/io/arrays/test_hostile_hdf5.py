"""HDF5 files that would fill the memory, lead elsewhere or read as zeros; and files that are locked, not damaged."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from pcdata import CachedCloudDataset
from pcdata.errors import CacheError
from pcdata.io.arrays.hdf5_arrays import fletcher32
from pcdata.io.arrays.stored_arrays import stored_arrays
from pcdata.io.store.stores import STORES
from tests.io.forged import dataset, foreign, foreign_refused, refused, stored
from tests.warm import run_python

# -- HDF5 ----------------------------------------------------------------------------------------------------------


def h5_with(
    path: Path, packed: Callable[[h5py.h5p.PropDCID], None], *, shape=(64, 64, 3), chunk=None, raw=None
) -> Path:
    """Write one dataset ``pc`` with a hand-made pipeline of filters, and its first chunk raw if given."""
    shape = (64, 64, 3)
    with h5py.File(path, "w") as file:
        plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plan.set_chunk(shape)
        packed(plan)
        space = h5py.h5s.create_simple(shape)
        made = h5py.h5d.create(file.id, b"pc", h5py.h5t.IEEE_F32LE, space, plan)
        if raw is None:
            made.write(h5py.h5s.ALL, h5py.h5s.ALL, np.zeros(shape, "<f4"))
        else:
            made.write_direct_chunk((0,) * len(shape), raw)
    return path


def twice(plan):
    plan.set_deflate(9)
    plan.set_deflate(9)


def gzip_then_lzf(plan):
    plan.set_deflate(9)
    plan.set_filter(h5py.h5z.FILTER_LZF, 0, (4, 0x105, 64 * 64 * 12))


FILTERS = {
    "deflated twice": (twice, "packed twice"),
    "deflated and lzf": (gzip_then_lzf, "packed twice"),
    "scaleoffset": (lambda plan: plan.set_scaleoffset(h5py.h5z.SO_FLOAT_DSCALE, 2), "scaleoffset"),
    "nbit": (lambda plan: plan.set_filter(h5py.h5z.FILTER_NBIT, 0, ()), "nbit"),
}
if h5py.h5z.filter_avail(h5py.h5z.FILTER_SZIP):
    FILTERS["szip"] = (lambda plan: plan.set_szip(h5py.h5z.SZIP_NN_OPTION_MASK, 8), "szip")


@pytest.mark.parametrize("name", FILTERS)
def test_filters_without_a_bound_are_refused_by_name(tmp_path, name):
    packed, words = FILTERS[name]
    path = h5_with(tmp_path / "a.h5", packed)
    message = foreign_refused(path)
    assert words in message
    assert "HDF5 filter" not in message or "h5repack" in message


def test_a_deflated_chunk_that_goes_on_beyond_its_size_is_stopped(tmp_path):
    bomb = zlib.compress(bytes(1 << 27), 9)
    path = h5_with(tmp_path / "a.h5", lambda plan: plan.set_deflate(9), raw=bomb)
    assert "chunk" in foreign_refused(path)
    for raw in (zlib.compress(bytes(64 * 64 * 12))[:-1], zlib.compress(bytes(64 * 64 * 12 - 4)), b"\0" * 900):
        foreign_refused(h5_with(tmp_path / "b.h5", lambda plan: plan.set_deflate(9), raw=raw))


def test_every_combination_of_the_known_filters_is_read_as_hdf5_reads_it(tmp_path):
    rng = np.random.default_rng(0)
    count = 0
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for dtype in ("<f4", "<f8", ">f4", "<i2", "|u1", "|b1", "<f2"):
            for compression in (None, "gzip", "lzf"):
                for more in ({}, {"shuffle": True}, {"fletcher32": True}, {"shuffle": True, "fletcher32": True}):
                    for chunks in (True, (3, 5, 2)):
                        data = (rng.normal(size=(7, 11, 3)) * 50).astype(dtype)
                        file.create_dataset(f"d{count}", data=data, compression=compression, chunks=chunks, **more)
                        count += 1
    with h5py.File(tmp_path / "a.h5") as file:
        expected = {name: file[name][()] for name in file}
    with stored_arrays(tmp_path / "a.h5", list(expected)) as arrays:
        for name, values in expected.items():
            assert arrays[name][...].dtype == values.dtype
            assert np.array_equal(arrays[name][...], values)
            assert np.array_equal(arrays[name][6], values[6])


@pytest.mark.parametrize("compression", [None, "gzip", "lzf"])
def test_a_checksum_of_hdf5_that_is_wrong_is_told(tmp_path, compression):
    path = tmp_path / "a.h5"
    data = np.random.default_rng(0).random((64, 3), np.float32)
    with h5py.File(path, "w") as file:
        made = file.create_dataset("pc", data=data, compression=compression, fletcher32=True, chunks=data.shape)
        place = made.id.get_chunk_info(0).byte_offset
    assert np.array_equal(foreign(path), data)
    content = bytearray(path.read_bytes())
    content[place + 100] ^= 1
    path.write_bytes(content)
    foreign_refused(path)


@pytest.mark.parametrize("length", [0, 1, 2, 3, 255, 4096, 100_001])
def test_our_fletcher32_is_that_of_hdf5(length):
    data = np.random.default_rng(length).integers(0, 256, length, np.uint8)
    for values in (data, np.full(length, 255, np.uint8), np.zeros(length, np.uint8)):
        if not length:
            assert fletcher32(b"") == 0
            continue
        with h5py.File(f"memory-{length}", "w", driver="core", backing_store=False) as file:
            made = file.create_dataset("a", data=values, fletcher32=True, chunks=values.shape)
            _, raw = made.id.read_direct_chunk((0,))
        assert int.from_bytes(raw[-4:], "little") == fletcher32(values.tobytes())


def test_chunks_that_hdf5_would_read_as_zeros_are_named(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        made = file.create_dataset("pc", (8, 4, 3), "<f4", chunks=(2, 4, 3), compression="gzip")
        made[:4] = 1
    assert "has 2 of 4 chunks" in foreign_refused(tmp_path / "a.h5")


def test_datasets_of_one_group_do_not_count_the_same_bytes_twice(tmp_path):
    """A thousand names for one dataset are a thousand times its memory."""
    path = stored(tmp_path, "hdf5")
    with h5py.File(path, "r+") as file:
        file["a"]["big"] = np.random.default_rng(0).random(1 << 16)
        for number in range(100):
            file["a"][f"again{number}"] = file["a"]["big"]
    assert "stores" in refused(tmp_path, "hdf5")


@pytest.mark.parametrize("part", ["group", "dataset"])
def test_names_that_lead_through_links_are_refused(tmp_path, part):
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["data/pc"] = np.ones((4, 3), "<f4")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["own/pc"] = np.zeros((4, 3), "<f4")
        if part == "group":
            file["data"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "/data")
        else:
            file["data/pc"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "/data/pc")
    assert "no array 'data/pc'" in foreign_refused(tmp_path / "a.h5", "data/pc")


# -- locks ---------------------------------------------------------------------------------------------------------

HOLD = "import h5py, sys; f = h5py.File(sys.argv[1], 'r+'); print('held', flush=True); sys.stdin.read()"


def doors(path: Path, folder: Path) -> dict[str, Callable[[], object]]:
    return {
        "cached dataset": lambda: CachedCloudDataset(folder)[0],
        "store": lambda: STORES["hdf5"](path.parent).read("a"),
        "check": lambda: foreign(path, "a/points"),
    }


def test_a_file_that_another_process_holds_is_in_use_not_damaged(tmp_path):
    path = dataset(tmp_path, "hdf5")
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdout.readline() == "held\n"
        for name, door in doors(path, tmp_path).items():
            with pytest.raises(CacheError, match="is in use: another process") as caught:
                door()
            assert "damaged" not in str(caught.value), name
            assert "rebuild" not in str(caught.value), name
        holder.stdin.close()
    for door in doors(path, tmp_path).values():
        door()


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP])
def test_a_file_system_without_locks_is_named_with_a_way_out(tmp_path, monkeypatch, number):
    path = dataset(tmp_path, "hdf5")

    def no_locks(*args, **options):
        words = f"unable to lock file, errno = {number}, error message = '{os.strerror(number)}'"
        raise OSError(number, f"Unable to synchronously open file ({words})")

    monkeypatch.setattr(h5py, "File", no_locks)
    for door in doors(path, tmp_path).values():
        with pytest.raises(CacheError, match=r"cannot be locked here.*HDF5_USE_FILE_LOCKING=FALSE") as caught:
            door()
        assert "damaged" not in str(caught.value)


def test_the_advice_for_file_systems_without_locks_opens_the_file(tmp_path):
    path = dataset(tmp_path, "hdf5")
    read = f"from pcdata import CachedCloudDataset; print(CachedCloudDataset({str(tmp_path)!r})[0].num_points)"
    with h5py.File(path, "r+"):  # holds the lock, as a file system without locks would refuse it
        told = run_python(read)
        assert "is in use" in told.stderr
        without = {**os.environ, "HDF5_USE_FILE_LOCKING": "FALSE"}
        told = subprocess.run([sys.executable, "-c", read], capture_output=True, text=True, check=False, env=without)
    assert told.stdout.strip() == "64", told.stderr
