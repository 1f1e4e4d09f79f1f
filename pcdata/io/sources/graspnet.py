"""GraspNet-1Billion frames: ``color.png``, ``depth.png`` and ``meta.mat`` in one folder.

Source: graspnet-baseline, ``doc/example_data`` and ``dataset/graspnet_dataset.py``.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pcdata.contracts.lengths import check_metres_per_unit
from pcdata.errors import CaptureError
from pcdata.files.opening import read_bytes
from pcdata.files.sample_names import name_some, positions
from pcdata.geometry import rigid
from pcdata.io.arrays.matlab import numeric_arrays
from pcdata.io.images.reading import read_depth
from pcdata.io.sources.frame_files import make_frame
from pcdata.io.sources.listing import LinkTargets, absolute, check_links, entries, has_file, is_folder, unread_entries
from pcdata.io.sources.registry import register_layout
from pcdata.io.sources.source import Source, check_partners
from pcdata.structures import Camera, DepthFrame

_REQUIRED = {"depth": "depth.png", "color": "color.png", "meta": "meta.mat"}
_OPTIONAL = {"mask": "workspace_mask.png", "labels": "label.png"}
_MAX_META_BYTES = 1 << 24


@register_layout
class _GraspNetSource(Source):
    """One GraspNet frame folder, or a folder of such folders; a sample is called after its folder.

    Labels are the numbers in ``label.png``, which are those of ``provenance["cls_indexes"]`` (object index + 1); its 0,
    the background, becomes -1. ``provenance["camera_from_object"]`` has the object poses, 4x4 in metres.
    """

    kind = "graspnet"
    needs = (
        "depth.png, color.png and meta.mat (optional workspace_mask.png, label.png) in it, or in each of its folders"
    )

    def __init__(self, path: Path, *, links_to: LinkTargets = ()) -> None:
        """List the frames.

        Args:
            path: the folder of a frame, or of such folders.
            links_to: folders outside that links in the capture may lead to.

        Raises:
            CaptureError: there is none, or one lacks a file that it needs or that others have.
        """
        path = absolute(path)
        if not is_folder(path):
            raise CaptureError(f"{self.kind} source {path}: is no folder; this layout needs {self.needs}")
        self._folders = {folder.name: folder for folder in _frame_folders(path)}
        found = {name: _known_files(folder) for name, folder in self._folders.items()}
        super().__init__(path, found, links_to)
        roles = {role for files in found.values() for role in files} | {*_REQUIRED}
        having = {role: [name for name, files in found.items() if role in files] for role in roles}
        check_partners(str(self), self._ids, having)
        self._positions = positions(self._ids)

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        """All three files in the folder, or in a folder of it."""
        return any(map(_is_frame, [path, *(_entries(path))]))

    def files(self, sample_id: str) -> dict[str, Path]:
        """Return the files of one sample by role."""
        folder = self._folders[sample_id]  # what was there is told as missing where it is gone by now
        return {role: folder / name for role, name in _REQUIRED.items()} | _known_files(folder)

    def unread(self) -> list[str]:
        """Name what is in the folders besides the files that are read."""
        inside = [
            entry if folder == self.path else f"{name}/{entry}"
            for name, folder in self._folders.items()
            for entry in unread_entries(folder, set(_known_files(folder).values()))
        ]
        beside = [] if self.path in self._folders.values() else unread_entries(self.path, {*self._folders.values()})
        return beside + inside

    def _load(self, sample_id: str) -> DepthFrame:
        files = self.files(sample_id)
        meta = read_meta(files["meta"])
        depth = read_depth(files["depth"], metres_per_unit=meta["metres_per_unit"])
        (fx, _, cx), (_, fy, cy), _ = meta.pop("intrinsic_matrix").tolist()
        return make_frame(
            files,
            depth=depth,
            camera=Camera.pinhole(fx=fx, fy=fy, cx=cx, cy=cy, size=(depth.shape[0], depth.shape[1])),
            sample_id=sample_id,
            frame_id="",
            capture_index=self._positions[sample_id],
            provenance={**self.provenance(sample_id), **meta},
            background_label=0,
        )


def _is_frame(folder: Path) -> bool:
    return all(os.path.lexists(folder / name) for name in _REQUIRED.values())


def _entries(folder: Path) -> list[Path]:
    try:
        return entries(folder)
    except CaptureError:
        return []


def _frame_folders(path: Path) -> list[Path]:
    """Return the folder itself, or those in it that have any file of a frame; what they lack is an error later."""
    if any(os.path.lexists(path / name) for name in _REQUIRED.values()):
        return [path]
    inside = entries(path)
    check_links(inside)
    return [folder for folder in inside if any(os.path.lexists(folder / name) for name in _REQUIRED.values())]


def _known_files(folder: Path) -> dict[str, Path]:
    """Return the files of a frame that are there, by role; a link to nothing is an error."""
    return {role: folder / name for role, name in (_REQUIRED | _OPTIONAL).items() if has_file(folder / name)}


def read_meta(path: Path) -> dict[str, Any]:
    """Return intrinsics, unit, object ids and object poses of a MATLAB 5 file; the last two are optional."""
    where = str(path)
    names = ["intrinsic_matrix", "factor_depth", "cls_indexes", "poses"]
    data = read_bytes("graspnet source", path, max_bytes=_MAX_META_BYTES)
    raw = numeric_arrays(where, data, names, max_bytes=_MAX_META_BYTES)
    matrix = _numbers(where, raw, "intrinsic_matrix", (3, 3))
    factor = float(_numbers(where, raw, "factor_depth", (1, 1))[0, 0])
    if not factor >= 1:
        raise CaptureError(f"{where}: factor_depth, the stored units per metre, must be at least 1, got {factor:g}")
    if matrix[0, 1] or matrix[1, 0] or matrix[2].tolist() != [0, 0, 1]:
        raise CaptureError(f"{where}: intrinsic_matrix must be fx 0 cx / 0 fy cy / 0 0 1, got {matrix.tolist()}")
    meta: dict[str, Any] = {
        "metres_per_unit": check_metres_per_unit(where, 1 / factor),
        "intrinsic_matrix": matrix,
    }
    if "cls_indexes" in raw:
        ids = np.asarray(raw["cls_indexes"]).ravel()
        if ids.dtype.kind not in "iu":
            raise CaptureError(f"{where}: cls_indexes must be whole numbers, got {ids.dtype}")
        meta["cls_indexes"] = ids.tolist()
    if "poses" in raw:
        poses = _numbers(where, raw, "poses", None)
        if poses.ndim == 2:  # MATLAB drops the last dimension of a single pose
            poses = poses[:, :, None]
        count = len(meta.get("cls_indexes", poses[0, 0]))
        if poses.shape != (3, 4, count):
            raise CaptureError(f"{where}: poses must be (3, 4, {count}), one per object, got {poses.shape}")
        square = np.tile(np.eye(4), (count, 1, 1))
        square[:, :3] = poses.transpose(2, 0, 1)
        rigid.check_rigid(f"{where}: poses", torch.from_numpy(square))
        meta["camera_from_object"] = square.tolist()
    return meta


def _numbers(where: str, raw: dict[str, Any], name: str, shape: tuple[int, ...] | None) -> NDArray[np.float64]:
    if name not in raw:
        raise CaptureError(f"{where}: must have {name}, but has {name_some(raw) or 'no variable that is used here'}")
    values = np.asarray(raw[name])
    if values.dtype.kind not in "iuf" or (shape is not None and values.shape != shape) or not np.isfinite(values).all():
        raise CaptureError(
            f"{where}: {name} must be finite numbers of shape {shape}, got {values.dtype} {values.shape}"
        )
    return values.astype(np.float64)
