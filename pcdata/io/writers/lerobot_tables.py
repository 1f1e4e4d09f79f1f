"""The Parquet files of a LeRobot dataset: rows of steps, episodes, tasks, in the types that its package reads.

Source: LeRobot, ``datasets/feature_utils.py`` and ``dataset_writer.py`` (0.6): one number a row is a plain column, a
row of numbers a list of fixed length, more axes are lists of lists, an image a struct of its bytes and a path.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from pcdata.extras import require
from pcdata.io.sources.lerobot_files import DATA_PATH, EPISODES_PATH, TASKS_PATH
from pcdata.io.writers.lerobot_videos import FILES_IN_CHUNK

FILE_MEGABYTES = 100
_GROUP_BYTES = 1 << 22  # of rows in a row group: what waits in memory, and what is decoded to read any one of them

Feature = Mapping[str, Any]


class RowsWriter:
    """The rows of all steps, many episodes in one file, one or more row groups an episode."""

    def __init__(self, root: Path, features: Mapping[str, Feature]) -> None:
        require("pyarrow")
        self._arrow = importlib.import_module("pyarrow")
        self._parquet = importlib.import_module("pyarrow.parquet")
        self._root = root
        self._features = {key: said for key, said in features.items() if said["dtype"] != "video"}
        self._schema = self._arrow.schema(
            [(key, _type(self._arrow, said)) for key, said in self._features.items()],
            metadata={"huggingface": json.dumps({"info": {"features": _for_hub(self._features)}})},
        )
        self._writer: Any = None
        self._stream: IO[bytes] | None = None  # the library opens no name that is not UTF-8 by itself
        self._path: Path | None = None
        self._file = -1
        self._waiting: dict[str, list[Any]] = {key: [] for key in self._features}
        self._bytes = 0

    def begin_episode(self) -> dict[str, int]:
        """Return the file that the next rows will be in; one that has grown large is ended before it."""
        if self._path is not None and self._path.stat().st_size >= FILE_MEGABYTES << 20:
            self.close()
        if self._writer is None:
            self._file += 1
            self._path = self._root / DATA_PATH.format(**self._place())
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._stream = open(self._path, "wb")  # noqa: SIM115  # closed by close
            self._writer = self._parquet.ParquetWriter(self._stream, self._schema, compression="zstd")
        return self._place()

    def add(self, row: Mapping[str, Any]) -> None:
        """Add the row of one step: arrays, texts, and the bytes of images."""
        for key in self._features:
            value = row[key]
            self._waiting[key].append(value)
            self._bytes += value.nbytes if isinstance(value, np.ndarray) else len(value)
        if self._bytes >= _GROUP_BYTES:
            self.end_episode()

    def end_episode(self) -> None:
        """Write the rows that wait as a row group."""
        columns = [
            _column(self._arrow, said, self._schema.field(key).type, self._waiting[key])
            for key, said in self._features.items()
        ]
        if len(columns[0]):
            self._writer.write_table(self._arrow.Table.from_arrays(columns, schema=self._schema))
            if self._stream is not None:
                self._stream.flush()  # begin_episode asks for the size
        self._waiting = {key: [] for key in self._features}
        self._bytes = 0

    def close(self) -> None:
        """End the file."""
        writer, self._writer = self._writer, None
        stream, self._stream = self._stream, None
        try:
            if writer is not None:
                writer.close()
        finally:
            if stream is not None:
                stream.close()

    def _place(self) -> dict[str, int]:
        return {"chunk_index": self._file // FILES_IN_CHUNK, "file_index": self._file % FILES_IN_CHUNK}


def write_episodes_table(root: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write one row an episode: where it is, its tasks and its statistics."""
    arrow, parquet = importlib.import_module("pyarrow"), importlib.import_module("pyarrow.parquet")
    path = root / EPISODES_PATH.format(chunk_index=0, file_index=0)
    path.parent.mkdir(parents=True)
    with open(path, "wb") as stream:
        parquet.write_table(arrow.Table.from_pylist([dict(row) for row in rows]), stream, compression="zstd")


def write_tasks_table(root: Path, tasks: Sequence[str]) -> None:
    """Write the tasks in the order of their indices, as pandas does where they are the index of a table."""
    arrow, parquet = importlib.import_module("pyarrow"), importlib.import_module("pyarrow.parquet")
    about = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [
            {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64",
             "metadata": None},
            {"name": "task", "field_name": "task", "pandas_type": "unicode", "numpy_type": "object", "metadata": None},
        ],
        "creator": {"library": "pyarrow", "version": arrow.__version__},
        "pandas_version": "2.0.0",
    }  # fmt: skip
    schema = arrow.schema([("task_index", arrow.int64()), ("task", arrow.string())], {"pandas": json.dumps(about)})
    columns = [arrow.array(range(len(tasks)), arrow.int64()), arrow.array(list(tasks), arrow.string())]
    with open(root / TASKS_PATH, "wb") as stream:
        parquet.write_table(arrow.Table.from_arrays(columns, schema=schema), stream)


def _type(arrow: Any, said: Feature) -> Any:
    if said["dtype"] == "image":
        return arrow.struct([("bytes", arrow.binary()), ("path", arrow.string())])
    kind = {"string": arrow.string(), "bool": arrow.bool_(), "float16": arrow.float16(), "float32": arrow.float32(),
            "float64": arrow.float64()}.get(said["dtype"]) or getattr(arrow, said["dtype"])()  # fmt: skip
    shape = said["shape"]
    if said["dtype"] == "string" or list(shape) == [1]:
        return kind
    if len(shape) == 1:
        return arrow.list_(kind, shape[0])
    for _ in shape:
        kind = arrow.list_(kind)
    return kind


def _column(arrow: Any, said: Feature, kind: Any, values: list[Any]) -> Any:
    if said["dtype"] == "image":
        return arrow.array([{"bytes": value, "path": None} for value in values], kind)
    if said["dtype"] == "string":
        return arrow.array(values, kind)
    numbers: NDArray[Any] = np.stack(values) if values else np.empty((0, *said["shape"]))
    flat = arrow.array(numbers.reshape(-1).astype(said["dtype"], copy=False))
    shape = list(said["shape"])
    if shape == [1]:
        return flat
    if len(shape) == 1:
        return arrow.FixedSizeListArray.from_arrays(flat, type=kind)
    for side in reversed(shape):
        count = len(flat) // side if side else 0
        flat = arrow.ListArray.from_arrays(np.arange(0, (count + 1) * side, max(side, 1), dtype=np.int32), flat)
    return flat


def _for_hub(features: Mapping[str, Feature]) -> dict[str, Any]:
    """Return the types as the datasets package writes them into its files."""
    found: dict[str, Any] = {}
    for key, said in features.items():
        value = {"dtype": said["dtype"], "_type": "Value"}
        shape = list(said["shape"])
        if said["dtype"] == "image":
            found[key] = {"_type": "Image"}
        elif said["dtype"] == "string" or shape == [1]:
            found[key] = value
        elif len(shape) == 1:
            found[key] = {"feature": value, "length": shape[0], "_type": "Sequence"}
        else:
            found[key] = {"shape": shape, "dtype": said["dtype"], "_type": f"Array{len(shape)}D"}
    return found
