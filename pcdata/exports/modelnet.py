"""ModelNet texts: one file of comma-separated lines per shape, as PointNet++ and its ports read them.

Source: charlesq34/pointnet2, ``modelnet_dataset.py``; yanx27/Pointnet_Pointnet2_pytorch,
``data_utils/ModelNetDataLoader.py``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import annotated_types
import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CacheError
from pcdata.exports.class_table import Given, Row, classes_of, in_splits, read_table, with_splits
from pcdata.exports.model_contracts import require_cloud
from pcdata.exports.registry import register_target
from pcdata.exports.sample_needs import check_channels, check_count, one_cloud
from pcdata.exports.target import Item, Note, Samples, Target
from pcdata.files.opening import read_text
from pcdata.structures import DepthFrame, PointCloud

_MAX_BYTES = 1 << 30  # of one shape: some 10 million lines
_EXACT = "%.9g"  # nine digits give every float32 back


@register_target
@dataclass(frozen=True, kw_only=True)
class ModelNet(Target):
    """``<class>/<class>_0001.txt``, lists of shapes and classes; the loaders look for ``modelnet40_normal_resampled``.

    Args:
        table: class and split (train or test) of every sample; see :func:`pcdata.exports.class_table.read_table`.
        num_points: as many points as the loader takes, the first ones; no cloud may have fewer.
    """

    name: ClassVar[str] = "modelnet"
    takes: ClassVar[Literal["clouds"]] = "clouds"
    model: ClassVar[str] = "pointnet2_cls"
    also: ClassVar[Mapping[str, frozenset[str]]] = {"pointnet2_cls_tf": frozenset()}
    left_to_loader: ClassVar[frozenset[str]] = frozenset({"count", "unit", "scale", "normalization"})
    layout: ClassVar[str] = "a text per shape: x,y,z,nx,ny,nz; modelnet40_train.txt, modelnet40_test.txt, shape names"

    table: Given | None = None
    num_points: Annotated[int, annotated_types.Ge(1)] = 1024

    @classmethod
    def example(cls, ids: Sequence[str]) -> dict[str, Any]:
        """All of one class."""
        return {"table": {sample_id: {"class": "mug"} for sample_id in ids}}

    def with_splits(self, part_of: Mapping[str, str]) -> Target:
        """Take the splits into the table, which says the classes."""
        return self if self.table is None else replace(self, table=with_splits(self.name, self.table, part_of))

    def items(self, ids: Sequence[str]) -> list[Item]:
        """One file per sample."""
        return [Item((sample_id,), (path,)) for sample_id, path in _paths(self._rows(ids)).items()]

    def examine(
        self, item: Item, sample_id: str, data: DepthFrame | PointCloud, seen: dict[str, Any]
    ) -> NDArray[np.float32]:  # (N, 6)
        """Return points and normals side by side."""
        where = f"modelnet: sample {sample_id!r}"
        cloud = one_cloud(where, data)
        check_count(where, cloud, self.num_points)
        check_channels(where, cloud, ["normals"])
        require_cloud(where, self, cloud)
        assert cloud.normals is not None
        return np.hstack([cloud.points.numpy(), cloud.normals.numpy()])

    def write(self, item: Item, samples: Samples, folder: Path, note: Note) -> None:
        """Write one file."""
        for sample_id, data in samples:
            rows = self.examine(item, sample_id, data, {})
            path = folder / item.paths[0]
            path.parent.mkdir(exist_ok=True)
            np.savetxt(path, rows, fmt=_EXACT, delimiter=",")

    @classmethod
    def cloud_fields(cls, folder: Path, names: Sequence[str]) -> Iterator[tuple[str, dict[str, NDArray[Any]]]]:
        """Read the texts of the shapes; the lists lie beside their folders."""
        for name in names:
            if "/" in name:
                text = read_text("check", folder / name, max_bytes=_MAX_BYTES, inside=[folder], error=CacheError)
                try:
                    rows = np.array([line.split(",") for line in text.splitlines()], np.float32).reshape(-1, 6)
                except ValueError as error:
                    raise CacheError(f"check: {folder / name}: must be lines of 6 numbers; export again") from error
                yield name, {"points": rows[:, :3], "normals": rows[:, 3:6]}

    def finish(self, items: Sequence[Item], folder: Path, note: Note) -> None:
        """Write the lists."""
        rows = self._rows([sample_id for item in items for sample_id in item.ids])
        paths, names = _paths(rows), classes_of(rows)
        # The original loader and its PyTorch port differ in the name of this file.
        for name in ("shape_names.txt", "modelnet40_shape_names.txt"):
            (folder / name).write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
        for split, members in in_splits(self.name, rows, ("train", "test")).items():
            if not members:
                note(f"no sample is in the split {split}, so modelnet40_{split}.txt is empty")
            shapes = [Path(paths[sample_id]).stem for sample_id in members]
            text = "".join(f"{shape}\n" for shape in shapes)
            (folder / f"modelnet40_{split}.txt").write_text(text, encoding="utf-8")

    def _rows(self, ids: Sequence[str]) -> dict[str, Row]:
        return read_table(self.name, self.table, ids, needs=["class"])


def _paths(rows: dict[str, Row]) -> dict[str, str]:
    """Return the file of every sample: numbered within its class, from 1."""
    counts: Counter[str] = Counter()
    paths = {}
    for sample_id, row in rows.items():
        assert row.class_name is not None
        counts[row.class_name] += 1
        paths[sample_id] = f"{row.class_name}/{row.class_name}_{counts[row.class_name]:04d}.txt"
    return paths
