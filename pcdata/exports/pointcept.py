"""Pointcept: a folder of ``.npy`` files per scene, below a folder per split.

Source: Pointcept/Pointcept, ``pointcept/datasets/defaults.py`` (DefaultDataset).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from pcdata.errors import CacheError, CaptureError
from pcdata.exports.class_table import Given, read_table, with_splits
from pcdata.exports.model_contracts import require_cloud
from pcdata.exports.registry import register_target
from pcdata.exports.sample_needs import check_channels, one_cloud
from pcdata.exports.target import Item, Note, Samples, Target
from pcdata.files.npy import write_npy
from pcdata.files.opening import MAX_STREAMED_BYTES, map_npy
from pcdata.io.store.sample_keys import key_of
from pcdata.structures import DepthFrame, PointCloud


@register_target
@dataclass(frozen=True, kw_only=True)
class Pointcept(Target):
    """``<split>/<sample>/{coord,color,normal,segment,instance}.npy``; give the folder to the loader as ``data_root``.

    Args:
        table: split of every sample, any name; None = all in ``train``; see :mod:`pcdata.exports.class_table`.
        segment: the per-point field of semantic classes, -1 = ignored; None = do without.
        instance: the per-point field of objects, -1 = none; None = do without.
        frame: the frame that the clouds must be in; None = any.
    """

    name: ClassVar[str] = "pointcept"
    takes: ClassVar[Literal["clouds"]] = "clouds"
    model: ClassVar[str] = "pointcept"
    # Pointcept's own configurations of them. That of Utonia scales what it reads, so clouds of its preset are no input.
    also: ClassVar[Mapping[str, frozenset[str]]] = {"sonata": frozenset(), "concerto": frozenset()}
    left_to_loader: ClassVar[frozenset[str]] = frozenset({"normalization", "duplicates"})
    layout: ClassVar[str] = "a folder per scene: coord, color, normal, segment, instance .npy"

    table: Given | None = None
    segment: str | None = None
    instance: str | None = None
    frame: str | None = None

    def with_splits(self, part_of: Mapping[str, str]) -> Target:
        """Take the splits into the table."""
        return replace(self, table=with_splits(self.name, self.table, part_of))

    def items(self, ids: Sequence[str]) -> list[Item]:
        """One folder per sample."""
        splits = dict.fromkeys(ids, "train")
        if self.table is not None:
            splits = {
                name: row.split or "train" for name, row in read_table(self.name, self.table, ids, needs=[]).items()
            }
        return [Item((sample_id,), (f"{splits[sample_id]}/{key_of(sample_id)}",)) for sample_id in ids]

    def examine(
        self, item: Item, sample_id: str, data: DepthFrame | PointCloud, seen: dict[str, Any]
    ) -> dict[str, NDArray[Any]]:
        """Return the arrays by name."""
        where = f"pointcept: sample {sample_id!r}"
        cloud = one_cloud(where, data)
        fields = {"rgb": cloud.colors, "normals": cloud.normals}
        channels = ["xyz", "cells", *(name for name, field in fields.items() if field is not None)]
        frame = {} if self.frame is None else {"frame": self.frame}
        require_cloud(where, self, cloud, channels=channels, **frame)
        arrays: dict[str, NDArray[Any]] = {"coord": cloud.points.numpy()}
        if cloud.colors is not None:
            arrays["color"] = (cloud.colors * 255).round().clamp(0, 255).to(torch.uint8).numpy()
        if cloud.normals is not None:
            arrays["normal"] = cloud.normals.numpy()
        for key, name in (("segment", self.segment), ("instance", self.instance)):
            if name is not None:
                arrays[key] = _integers(where, key, cloud, name)
        return arrays

    def write(self, item: Item, samples: Samples, folder: Path, note: Note) -> None:
        """Write one folder."""
        for sample_id, data in samples:
            arrays = self.examine(item, sample_id, data, {})
            missing = [key for key in ("color", "normal", "segment") if key not in arrays]
            if missing:
                note(f"some scenes have no {', '.join(missing)}: leave it out of feat_keys, or build it in")
            scene = folder / item.paths[0]
            scene.mkdir(parents=True)
            for key, array in arrays.items():
                write_npy(scene / f"{key}.npy", array)

    @classmethod
    def cloud_fields(cls, folder: Path, names: Sequence[str]) -> Iterator[tuple[str, dict[str, NDArray[Any]]]]:
        """Read the scenes of which coord is among the files."""
        for name in names:
            if name.endswith("/coord.npy"):
                scene = folder / name.removesuffix("/coord.npy")
                keys = {"points": "coord", "colors": "color", "normals": "normal"}
                paths = {field: scene / f"{key}.npy" for field, key in keys.items()}
                fields = {field: _mapped(folder, path) for field, path in paths.items() if path.is_file()}
                yield name.removesuffix("/coord.npy"), fields


def _mapped(folder: Path, path: Path) -> NDArray[Any]:
    return map_npy("check", path, max_bytes=MAX_STREAMED_BYTES, inside=[folder], error=CacheError)


def _integers(where: str, key: str, cloud: PointCloud, name: str) -> NDArray[np.int32]:
    check_channels(where, cloud, [name], f"; or leave out {key}={name}")
    values = cloud.fields()[name]
    values = values[:, 0] if values.ndim == 2 and values.shape[1] == 1 else values
    if values.is_floating_point() or values.ndim != 1:
        raise CaptureError(
            f"{where}: {key} must be whole numbers (N,), but {name} is {values.dtype} {tuple(values.shape)}"
        )
    limits = np.iinfo(np.int32)
    if bool((values < limits.min).any()) or bool((values > limits.max).any()):
        raise CaptureError(
            f"{where}: {key} is int32, but {name} reaches {int(values.min())}..{int(values.max())}; renumber it"
        )
    integers: NDArray[np.int32] = values.numpy().astype(np.int32)
    return integers
