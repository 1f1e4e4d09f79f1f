"""Zarr directories against the zarr package itself, and against the specification where that is not installed."""

from __future__ import annotations

import json
import zlib
from pathlib import Path

import numpy as np
import pytest

from pcdata.exports.zarr_v2 import RowWriter, write_group

CASES = [((7, 3, 2), "<f4"), ((4, 5), "<f4"), ((8,), "<i8"), ((1, 1), "|u1"), ((3, 1, 1, 3), "|u1")]


def write(folder: Path, array: np.ndarray, *, chunk_rows: int, compression: str) -> None:
    writer = RowWriter(folder, array.shape, array.dtype.str, chunk_rows=chunk_rows, compression=compression)
    for row in array:
        writer.add(row)


def read_by_the_specification(folder: Path) -> np.ndarray:
    """zarr-specs v2: chunks of full size in C order, named by their grid position; missing ones are the fill value."""
    head = json.loads((folder / ".zarray").read_text())
    assert head.keys() == {
        "zarr_format", "shape", "chunks", "dtype", "compressor", "fill_value", "order", "filters",
    }  # fmt: skip
    assert (head["zarr_format"], head["order"], head["filters"]) == (2, "C", None)
    rows = head["chunks"][0]
    assert head["chunks"][1:] == head["shape"][1:]
    array = np.full(head["shape"], head["fill_value"], head["dtype"])
    for start in range(0, head["shape"][0], rows):
        path = folder / ".".join([str(start // rows)] + ["0"] * (len(head["shape"]) - 1))
        if not path.exists():
            continue
        content = path.read_bytes() if head["compressor"] is None else zlib.decompress(path.read_bytes())
        chunk = np.frombuffer(content, head["dtype"]).reshape(head["chunks"])
        array[start : start + rows] = chunk[: len(array) - start]
    return array


@pytest.mark.parametrize("compression", ["none", "zlib"])
@pytest.mark.parametrize(("shape", "dtype"), CASES)
def test_rows_come_back_by_the_specification(tmp_path, shape, dtype, compression):
    array = (np.random.default_rng(0).random(shape) * 200).astype(dtype)
    write(tmp_path / "a", array, chunk_rows=3, compression=compression)
    back = read_by_the_specification(tmp_path / "a")
    assert back.dtype == array.dtype
    assert np.array_equal(back, array)


@pytest.mark.parametrize("compression", ["none", "zlib"])
def test_the_zarr_package_reads_the_same(tmp_path, compression):
    zarr = pytest.importorskip("zarr", reason="zarr is not installed: only the specification is tested")
    write_group(tmp_path / "store")
    write_group(tmp_path / "store" / "data")
    arrays = {
        str(n): (np.random.default_rng(n).random(shape) * 200).astype(dtype) for n, (shape, dtype) in enumerate(CASES)
    }
    for name, array in arrays.items():
        write(tmp_path / "store" / "data" / name, array, chunk_rows=3, compression=compression)
    data = zarr.open(str(tmp_path / "store"), mode="r")["data"]
    assert sorted(data.array_keys()) == sorted(arrays)
    for name, array in arrays.items():
        assert data[name].dtype == array.dtype
        assert np.array_equal(data[name][:], array)


def test_rows_that_are_never_added_read_as_zero(tmp_path):
    RowWriter(tmp_path / "a", (5, 2), "|u1", chunk_rows=3, compression="none")
    assert np.array_equal(read_by_the_specification(tmp_path / "a"), np.zeros((5, 2), np.uint8))
