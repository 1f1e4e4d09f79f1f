"""PointNet classification: HDF5 files of up to 2048 shapes, and their lists.

Source: charlesq34/pointnet, ``provider.py`` (getDataFiles, loadDataFile), ``train.py``, ``utils/data_prep_util.py``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from pcdata.errors import ConfigError
from pcdata.exports.class_table import Given, Row, classes_of, in_splits, read_table, with_splits
from pcdata.exports.model_contracts import require_cloud
from pcdata.exports.registry import register_target
from pcdata.exports.sample_needs import check_same_count, one_cloud
from pcdata.exports.target import CloudArray, Item, Note, Samples, Target
from pcdata.files.interrupts import shielded
from pcdata.io.arrays.hdf5_writing import new_hdf5
from pcdata.models import contract
from pcdata.structures import DepthFrame, PointCloud

_FILE_ROWS = 2048  # shapes in one file, as in the original
_MAX_CLASSES = 256  # labels are uint8


@register_target
@dataclass(frozen=True, kw_only=True)
class PointNet(Target):
    """``ply_data_<split><n>.h5``, ``<split>_files.txt`` and ``shape_names.txt``.

    Args:
        table: class and split (train or test) of every sample; see :func:`pcdata.exports.class_table.read_table`.
        prefix: put before the file names in the lists. ``train.py`` opens those names as they are, from the
            repository's folder; the default is the folder in which it looks for the lists.
    """

    name: ClassVar[str] = "pointnet"
    takes: ClassVar[Literal["clouds"]] = "clouds"
    model: ClassVar[str] = "pointnet_cls"
    layout: ClassVar[str] = "HDF5: data (B, N, 3), label (B, 1); train_files.txt, test_files.txt, shape_names.txt"
    splits: ClassVar[tuple[str, ...]] = ("train", "test")
    category: ClassVar[str] = ""  # the array that the network takes besides
    loaded: ClassVar[int] = 1024  # points of a shape that the training script takes unless it is told otherwise

    table: Given | None = None
    prefix: str = "data/modelnet40_ply_hdf5_2048"

    @classmethod
    def example(cls, ids: Sequence[str]) -> dict[str, Any]:
        """All of one class."""
        return {"table": {sample_id: {"class": "mug"} for sample_id in ids}}

    @classmethod
    def cloud_arrays(cls, folder: Path, options: Mapping[str, Any]) -> dict[Path, CloudArray]:
        """The files with shapes."""
        files = sorted(file for file in folder.glob("ply_data_*.h5") if not file.is_symlink())
        return dict.fromkeys(files, CloudArray("data", ("xyz",), cls.category))

    def rows(self, ids: Sequence[str]) -> dict[str, Row]:
        """Return class and split of every sample."""
        rows = read_table(self.name, self.table, ids, needs=["class"])
        if len(classes_of(rows)) > _MAX_CLASSES:
            raise ConfigError(
                f"{self.name}: labels are 8-bit, so {_MAX_CLASSES} classes at most, got {len(classes_of(rows))}"
            )
        return rows

    def with_splits(self, part_of: Mapping[str, str]) -> Target:
        """Take the splits into the table, which says the classes."""
        return self if self.table is None else replace(self, table=with_splits(self.name, self.table, part_of))

    def items(self, ids: Sequence[str]) -> list[Item]:
        """One item: the lists name all files."""
        files = self._files(ids)
        order = tuple(sample_id for chunk in files.values() for sample_id in chunk)
        return [Item(order, (*files, *self.other_files(), *map(self.list_name, self.splits)))]

    def examine(self, item: Item, sample_id: str, data: DepthFrame | PointCloud, seen: dict[str, Any]) -> PointCloud:
        """Return the cloud, of as many points as those before it."""
        where = f"{self.name}: sample {sample_id!r}"
        cloud = one_cloud(where, data)
        if "rows" not in seen:
            seen["rows"] = self.rows(item.ids)
            seen["classes"] = classes_of(seen["rows"])
        require_cloud(where, self, cloud, **self.choices(self.number_of(sample_id, seen), cloud.num_points))
        check_same_count(where, cloud, seen.get("count", cloud.num_points))
        seen["count"] = cloud.num_points
        return cloud

    def number_of(self, sample_id: str, seen: dict[str, Any]) -> int:
        """Return the number of a sample's class."""
        number: int = seen["classes"].index(seen["rows"][sample_id].class_name)
        return number

    def write(self, item: Item, samples: Samples, folder: Path, note: Note) -> None:
        """Write file after file."""
        files = self._files(item.ids)
        seen: dict[str, Any] = {}
        for split in self.splits:
            names = [name for name in files if name.startswith(f"ply_data_{split}")]
            if not names:
                note(f"no sample is in the split {split}, so {self.list_name(split)} is empty")
            lines = "".join(f"{self.listed(name)}\n" for name in names)
            (folder / self.list_name(split)).write_text(lines, encoding="utf-8")
        for name, chunk in files.items():
            with new_hdf5(folder / name) as (file, disk):
                for number, (sample_id, data) in enumerate(islice(samples, len(chunk))):
                    cloud = self.examine(item, sample_id, data, seen)
                    with shielded():
                        if number == 0:
                            _create(file, len(chunk), self.arrays(seen["count"]))
                        file["data"][number] = cloud.points.numpy()
                        file["label"][number] = self.number_of(sample_id, seen)
                        self.add_shape(cloud, file, number)
                    disk.check()
        next(samples, None)  # at its end the last sample is counted
        if (count := seen.get("count", self.loaded)) < self.loaded:
            note(f"the shapes have {count} points, and the loader takes {self.loaded}: train with --num_point {count}")
        self.write_names(folder, seen)

    # -- what the part segmentation has otherwise ------------------------------------------------------------------

    def choices(self, number: int, num_points: int) -> dict[str, Any]:
        """Return what the model's contract leaves open, for a shape of the class of this number."""
        known = contract(self.model)
        return {"num_points": num_points} if num_points in (known.count, *known.counts) else {}

    def arrays(self, num_points: int) -> Mapping[str, tuple[tuple[int, ...], str, int]]:
        """Return name -> shape of a row, dtype, level of gzip."""
        return {"data": ((num_points, 3), "<f4", 4), "label": ((1,), "|u1", 1)}

    def list_name(self, split: str) -> str:
        """Return the name of the list of files."""
        return f"{split}_files.txt"

    def listed(self, name: str) -> str:
        """Return a file as the list names it."""
        return f"{self.prefix}/{name}" if self.prefix else name

    def other_files(self) -> tuple[str, ...]:
        """Return the files beside data and lists."""
        return ("shape_names.txt",)

    def add_shape(self, cloud: PointCloud, file: Any, number: int) -> None:
        """Add what else there is to a shape."""

    def write_names(self, folder: Path, seen: Mapping[str, Any]) -> None:
        """Write the names that belong to the numbers."""
        (folder / "shape_names.txt").write_text("".join(f"{name}\n" for name in seen["classes"]), encoding="utf-8")

    def _files(self, ids: Sequence[str]) -> dict[str, list[str]]:
        files: dict[str, list[str]] = {}
        for split, members in in_splits(self.name, self.rows(ids), self.splits).items():
            for number, start in enumerate(range(0, len(members), _FILE_ROWS)):
                files[f"ply_data_{split}{number}.h5"] = members[start : start + _FILE_ROWS]
        return files


def _create(file: Any, num_rows: int, arrays: Mapping[str, tuple[tuple[int, ...], str, int]]) -> None:
    """Make the arrays of a file; a chunk is a row, so that rows are written one by one."""
    for name, (shape, dtype, level) in arrays.items():
        # Many labels in a chunk, where a row is a few bytes.
        rows_per_chunk = 1 if int(np.prod(shape)) > 1 else min(num_rows, 1024)
        file.create_dataset(
            name,
            (num_rows, *shape),
            dtype,
            chunks=(rows_per_chunk, *shape),
            compression="gzip",
            compression_opts=level,
            track_times=False,
        )
