"""Rows of Parquet files one at a time, whatever the size of their row groups."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from pcdata.io.arrays import parquet

ROWS, WIDTH = 60, 1000


@pytest.fixture
def opened(tmp_path: Path) -> Iterator[parquet.ParquetColumns]:
    arrow, writing = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    flat = arrow.array(np.random.default_rng(0).random(ROWS * WIDTH))
    table = arrow.table({"wide": arrow.FixedSizeListArray.from_arrays(flat, WIDTH), "row": np.arange(ROWS)})
    writing.write_table(table, tmp_path / "one.parquet", row_group_size=ROWS)  # one row group, as others write it
    columns = parquet.ParquetColumns("test", tmp_path / "one.parquet", [tmp_path])
    yield columns
    columns.close()


def test_rows_near_each_other_are_decoded_once(opened: parquet.ParquetColumns, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parquet, "_BATCH", 5 * 8 * WIDTH)
    begun = []
    whole = parquet.ParquetColumns._batches_of
    monkeypatch.setattr(parquet.ParquetColumns, "_batches_of", lambda *given: begun.append(given[1]) or whole(*given))
    for number in (40, 41, 47, 40, 46, 58, 41):  # back and forth, as windows of steps are read
        assert opened.row(number, ["row"])["row"] == [number]
        assert opened.row(number, ["wide", "row"])["wide"].shape == (WIDTH,)
    assert len(begun) == 2  # once for each set of columns


def test_what_stays_in_memory_is_bounded_and_right(
    opened: parquet.ParquetColumns, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parquet, "_BATCH", 5 * 8 * WIDTH)
    monkeypatch.setattr(parquet, "_KEPT", 12 * 8 * WIDTH)
    expected = np.random.default_rng(0).random(ROWS * WIDTH).reshape(ROWS, WIDTH)
    for number in np.random.default_rng(1).permutation(ROWS).tolist():
        assert np.array_equal(opened.row(number, ["wide"])["wide"], expected[number])
        assert sum(batch.nbytes for batch in opened._kept.values()) == opened._kept_bytes <= parquet._KEPT
