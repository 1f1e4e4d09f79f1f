"""A TSDFVolume on disk: an uncompressed ``.npz`` whose sizes are checked before anything is allocated."""

from __future__ import annotations

import json
import math
import os
import uuid
import zipfile
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch

from pcdata.errors import CacheError, ConfigError, VolumeTooLargeError
from pcdata.functional.tsdf.blocks import CHUNK, Chunk, Planes, VoxelBlocks
from pcdata.functional.tsdf.grid import VOXELS
from pcdata.structures.confidence import Confidence
from pcdata.structures.tsdf_volume import TSDFVolume

_FORMAT = "pcdata TSDFVolume 1"
_LONGEST_TEXT = 1 << 16  # bytes of the description
_FIELDS = ("voxel_size", "truncation", "weighting", "carve", "frame_id")


def save_volume(volume: TSDFVolume, path: str | os.PathLike[str]) -> None:
    """Write ``about`` (JSON as bytes), ``keys`` (B,) and every plane (B, 512), chunk by chunk."""
    if volume.blocks is None:
        raise ConfigError("TSDFVolume.save: nothing was integrated yet")
    blocks = volume.blocks
    about = {name: getattr(volume, name) for name in _FIELDS}
    about |= {"format": _FORMAT, "num_views": volume.num_views, "planes": vars(blocks.planes)}
    about["min_confidence"] = None if volume.min_confidence is None else int(volume.min_confidence)
    target = Path(path)
    temporary = target.with_name(f".{target.name}.{uuid.uuid4().hex}.part")
    try:
        with zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive:
            _write(archive, "about", np.frombuffer(json.dumps(about).encode(), np.uint8))
            _write(archive, "keys", blocks.keys.cpu().numpy())
            for name in _plane_dtypes(blocks.planes):
                _write_plane(archive, name, blocks)
        os.replace(temporary, target)
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def load_volume(path: str | os.PathLike[str], *, max_bytes: int, device: str) -> TSDFVolume:
    """Read what :func:`save_volume` wrote."""
    where = f"TSDFVolume.load: {path}"
    try:
        with zipfile.ZipFile(path) as archive:
            about = _about(where, archive)
            keys = _keys(where, archive)
            volume = _volume(where, about, max_bytes=max_bytes, device=device)
            planes = Planes(**{name: bool(about["planes"][name]) for name in vars(Planes())})
            needed = len(keys) * planes.bytes_per_block
            if needed > max_bytes:
                raise VolumeTooLargeError(
                    f"{where}: {len(keys)} blocks take {needed / 2**20:.1f} MiB, but max_bytes allows "
                    f"{max_bytes / 2**20:.1f} MiB"
                )
            blocks = VoxelBlocks(planes, torch.device(device))
            _check_planes(where, archive, planes, len(keys))
            order = np.argsort(keys)
            blocks.add(torch.from_numpy(keys[order]).to(device))
            rows = np.empty_like(order)
            rows[order] = np.arange(len(order))  # blocks lie in key order now
            for name in _plane_dtypes(planes):
                _read_plane(archive, name, blocks, torch.from_numpy(rows).to(device))
    except (zipfile.BadZipFile, OSError, ValueError, KeyError, TypeError, EOFError) as error:
        if isinstance(error, VolumeTooLargeError):
            raise
        raise CacheError(f"{where}: not a complete TSDFVolume file: {error}") from error
    volume.blocks, volume.frame_id, volume.num_views = blocks, str(about["frame_id"]), int(about["num_views"])
    return volume


def _volume(where: str, about: dict[str, Any], *, max_bytes: int, device: str) -> TSDFVolume:
    level = about["min_confidence"]
    try:
        return TSDFVolume(
            voxel_size=float(about["voxel_size"]),
            truncation=float(about["truncation"]),
            weighting=about["weighting"],
            carve=about["carve"],
            min_confidence=None if level is None else Confidence(level),
            max_bytes=max_bytes,
            device=device,
        )
    except ConfigError as error:
        raise CacheError(f"{where}: {error}") from error


def _plane_dtypes(planes: Planes) -> dict[str, np.dtype[Any]]:
    """Return the planes that a volume has and how they are stored."""
    names = {"tsdf": "<i2", "weight": "<i2"}
    names |= {"color": "<i4"} if planes.colors else {}
    names |= {"views": "<i2"} if planes.views else {}
    names |= {"label": "<i4", "votes": "<i2"} if planes.labels else {}
    return {name: np.dtype(text) for name, text in names.items()}


def _write(archive: zipfile.ZipFile, name: str, array: np.ndarray) -> None:
    with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
        np.lib.format.write_array(stream, array, allow_pickle=False)


def _write_plane(archive: zipfile.ZipFile, name: str, blocks: VoxelBlocks) -> None:
    dtype = _plane_dtypes(blocks.planes)[name]
    header = {"descr": dtype.str, "fortran_order": False, "shape": (len(blocks), VOXELS)}
    with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
        np.lib.format.write_array_header_1_0(stream, header)
        for number, chunk in enumerate(blocks.chunks):
            plane = getattr(chunk, name)[: len(blocks) - number * CHUNK]
            stream.write(plane.cpu().numpy().astype(dtype, copy=False).tobytes())


def _read_plane(archive: zipfile.ZipFile, name: str, blocks: VoxelBlocks, rows: torch.Tensor) -> None:
    dtype = _plane_dtypes(blocks.planes)[name]
    with archive.open(f"{name}.npy") as stream:
        _header(stream)
        for start in range(0, len(rows), CHUNK):
            some = rows[start : start + CHUNK]
            data = _exactly(stream, len(some) * VOXELS * dtype.itemsize)
            values = torch.from_numpy(np.frombuffer(data, dtype).astype(dtype.newbyteorder("=")).reshape(-1, VOXELS))
            for chunk, inside, which in blocks.in_chunks(some):
                _plane(chunk, name)[inside] = values.to(rows.device)[which]


def _plane(chunk: Chunk, name: str) -> torch.Tensor:
    plane: torch.Tensor = getattr(chunk, name)
    return plane


def _about(where: str, archive: zipfile.ZipFile) -> dict[str, Any]:
    shape, dtype = _shape(archive, "about")
    if dtype != np.uint8 or len(shape) != 1 or shape[0] > _LONGEST_TEXT:
        raise CacheError(f"{where}: it does not describe itself as a TSDFVolume")
    with archive.open("about.npy") as stream:
        about = json.loads(np.lib.format.read_array(stream, allow_pickle=False).tobytes())
    if not isinstance(about, dict) or about.get("format") != _FORMAT:
        raise CacheError(f"{where}: its format is not {_FORMAT!r}; was it written by another version?")
    return about


def _keys(where: str, archive: zipfile.ZipFile) -> np.ndarray:
    shape, dtype = _shape(archive, "keys")
    if dtype != np.int64 or len(shape) != 1 or math.prod(shape) * 8 > archive.getinfo("keys.npy").file_size:
        raise CacheError(f"{where}: keys must be int64 (B,), found {dtype} {shape}")
    with archive.open("keys.npy") as stream:
        keys: np.ndarray = np.lib.format.read_array(stream, allow_pickle=False)
    if len(np.unique(keys)) != len(keys) or (len(keys) and keys.min() < 0):
        raise CacheError(f"{where}: block keys must be distinct and not negative")
    return keys


def _check_planes(where: str, archive: zipfile.ZipFile, planes: Planes, count: int) -> None:
    for name, dtype in _plane_dtypes(planes).items():
        shape, found = _shape(archive, name)
        if shape != (count, VOXELS) or found != dtype:
            raise CacheError(f"{where}: {name} must be {dtype} {(count, VOXELS)}, found {found} {shape}")
        if archive.getinfo(f"{name}.npy").file_size < count * VOXELS * dtype.itemsize:
            raise CacheError(f"{where}: {name} ends early")


def _shape(archive: zipfile.ZipFile, name: str) -> tuple[tuple[int, ...], np.dtype[Any]]:
    with archive.open(f"{name}.npy") as stream:
        return _header(stream)


def _header(stream: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    version = np.lib.format.read_magic(stream)
    if version != (1, 0):
        raise ValueError(f"an array of .npy version {version}")
    shape, fortran_order, dtype = np.lib.format.read_array_header_1_0(stream)
    if fortran_order or dtype.hasobject:
        raise ValueError("an array that is not plain rows of numbers")
    return shape, dtype


def _exactly(stream: IO[bytes], count: int) -> bytes:
    data = stream.read(count)
    if len(data) != count:
        raise ValueError(f"{count} bytes wanted, {len(data)} left")
    return data
