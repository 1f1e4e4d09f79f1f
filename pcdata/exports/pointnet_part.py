"""PointNet part segmentation: the classification files with a part number per point.

Source: charlesq34/pointnet, ``part_seg/train.py``, ``provider.py`` (loadDataFile_with_seg).
"""

from __future__ import annotations

import colorsys
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from pcdata.errors import CaptureError, ConfigError
from pcdata.exports.class_table import Row, classes_of
from pcdata.exports.pointnet import PointNet
from pcdata.exports.registry import register_target
from pcdata.exports.sample_needs import check_channels
from pcdata.exports.target import Item
from pcdata.structures import DepthFrame, PointCloud

_CLASSES = 16  # NUM_CATEGORIES of the loader
_MAX_PARTS = 256  # labels are uint8


@register_target
@dataclass(frozen=True, kw_only=True)
class _PointNetPart(PointNet):
    """As ``pointnet``, with ``pid`` and the three files on categories that ``part_seg/train.py`` opens.

    Labels are the parts, numbered through all classes from 0. The loader opens its files in ``part_seg/hdf5_data``.
    """

    name: ClassVar[str] = "pointnet_part"
    model: ClassVar[str] = "pointnet_part"
    layout: ClassVar[str] = "HDF5: data (B, N, 3), label (B, 1), pid (B, N); lists and names of categories and parts"
    splits: ClassVar[tuple[str, ...]] = ("train", "val")
    loaded: ClassVar[int] = 2048

    category: ClassVar[str] = "label"

    prefix: str = ""

    def rows(self, ids: Sequence[str]) -> dict[str, Row]:
        """Return class and split of every sample."""
        rows = super().rows(ids)
        if len(classes_of(rows)) > _CLASSES:
            raise ConfigError(f"{self.name}: the loader has {_CLASSES} classes, the table {len(classes_of(rows))}")
        return rows

    def choices(self, number: int, num_points: int) -> dict[str, Any]:
        """Return what the model's contract leaves open, for a shape of the class of this number."""
        return {**super().choices(number, num_points), "category": number}

    def arrays(self, num_points: int) -> Mapping[str, tuple[tuple[int, ...], str, int]]:
        """Return name -> shape of a row, dtype, level of gzip."""
        return {**super().arrays(num_points), "pid": ((num_points,), "|u1", 1)}

    def list_name(self, split: str) -> str:
        """Return the name of the list of files."""
        return f"{split}_hdf5_file_list.txt"

    def other_files(self) -> tuple[str, ...]:
        """Return the files beside data and lists."""
        return ("all_object_categories.txt", "overallid_to_catid_partid.json", "part_color_mapping.json")

    def examine(self, item: Item, sample_id: str, data: DepthFrame | PointCloud, seen: dict[str, Any]) -> PointCloud:
        """Return the cloud, whose parts belong to its class alone."""
        cloud = super().examine(item, sample_id, data, seen)
        where = f"{self.name}: sample {sample_id!r}"
        check_channels(where, cloud, ["labels"])
        assert cloud.labels is not None
        low, high = int(cloud.labels.min()), int(cloud.labels.max())
        if low < 0 or high >= _MAX_PARTS:
            raise CaptureError(
                f"{where}: labels must be part numbers 0 .. {_MAX_PARTS - 1} at every point, got {low} .. {high}; give "
                "unlabeled points (-1) a part, or cut them away, and renumber, before 'pcdata build'"
            )
        class_name = seen["rows"][sample_id].class_name
        owners: dict[int, str] = seen.setdefault("class_of_part", {})
        parts = cloud.labels.unique().tolist()
        for part in parts:
            owner = owners.get(part, class_name)
            if owner != class_name:
                free = max(owners) + 1
                raise CaptureError(
                    f"{where}: its labels are {low} .. {high}, but part {part} belongs to class {owner!r} in samples "
                    f"before, to {class_name!r} here; number parts through all classes: add {free} to the labels of "
                    f"every sample of {class_name!r}, before 'pcdata build'"
                )
        owners.update(dict.fromkeys(parts, class_name))
        return cloud

    def add_shape(self, cloud: PointCloud, file: Any, number: int) -> None:
        """Add the part of every point."""
        assert cloud.labels is not None
        file["pid"][number] = cloud.labels.numpy()

    def write_names(self, folder: Path, seen: Mapping[str, Any]) -> None:
        """Write categories, and for every part number its category and color."""
        classes, class_of_part = seen["classes"], seen["class_of_part"]
        categories = "".join(f"{name}\t{name}\n" for name in classes)  # name and WordNet number, which the tree lacks
        (folder / "all_object_categories.txt").write_text(categories, encoding="utf-8")
        count = max(class_of_part) + 1
        missing = sorted(set(range(count)) - class_of_part.keys())
        if missing:
            raise CaptureError(
                f"{self.name}: part numbers must go from 0 to {count - 1} without gaps, since the loader counts them, "
                f"but no sample has the labels {missing[:10]}; renumber those above, before 'pcdata build'"
            )
        owners = [class_of_part[part] for part in range(count)]
        parts = [[owner, owners[:part].count(owner)] for part, owner in enumerate(owners)]
        colors = [colorsys.hsv_to_rgb(part / count, 0.8, 0.9) for part in range(count)]
        (folder / "overallid_to_catid_partid.json").write_text(json.dumps(parts) + "\n", encoding="utf-8")
        (folder / "part_color_mapping.json").write_text(json.dumps(colors) + "\n", encoding="utf-8")
