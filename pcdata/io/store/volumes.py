"""A TSDFVolume on disk: an uncompressed ``.npz`` whose sizes are checked before anything is allocated.

Its members are ``about`` (JSON as bytes), ``keys`` (B,) and every plane (B, 512), written chunk by chunk.
"""

from __future__ import annotations

import json
import os
import zipfile
from typing import Any

import numpy as np
import torch

from pcdata.errors import CacheError, ConfigError, PcdataError, VolumeTooLargeError, locates_path
from pcdata.files.npy import NpyHeader
from pcdata.files.npz import npy_header, read_array
from pcdata.files.opening import MAX_STREAMED_BYTES, open_input, replacing
from pcdata.files.strict_json import json_object
from pcdata.files.zip_archive import ZipArchive
from pcdata.functional.tsdf.blocks import CHUNK, Planes, VoxelBlocks, bytes_per_block, voxel_planes
from pcdata.functional.tsdf.grid import VOXELS
from pcdata.structures import Confidence, TSDFVolume

_FORMAT = "pcdata TSDFVolume 1"
_LONGEST_TEXT = 1 << 16  # bytes of the description
# What a volume may hold besides, and the plane that tells so.
_PLANES = {"colors": "color", "labels": "label", "views": "views"}
_FIELDS = ("voxel_size", "truncation", "weighting", "carve", "frame_id")


@locates_path
def write_volume(path: str | os.PathLike[str], volume: TSDFVolume) -> None:
    """Write a fused volume to an ``.npz`` file, to go on with later; it appears complete or not at all.

    Raises:
        ConfigError: nothing was integrated yet.
        CacheError: the file cannot be written; what was there before stays.
    """
    if volume.blocks is None or volume.num_views == 0:
        raise ConfigError("write_volume: nothing was integrated yet")
    blocks = volume.blocks
    about = {name: getattr(volume, name) for name in _FIELDS}
    about |= {
        "format": _FORMAT,
        "num_views": volume.num_views,
        "planes": {name: one in blocks.planes for name, one in _PLANES.items()},
    }
    about["min_confidence"] = None if volume.min_confidence is None else int(volume.min_confidence)
    with (
        replacing("write_volume", path, error=CacheError) as temporary,
        zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive,
    ):
        _write(archive, "about", np.frombuffer(json.dumps(about).encode(), np.uint8))
        _write(archive, "keys", blocks.keys.cpu().numpy())
        for name in _stored_dtypes(blocks.planes):
            _write_plane(archive, name, blocks)


@locates_path
def read_volume(path: str | os.PathLike[str], *, max_bytes: int = 4 << 30, device: str = "cpu") -> TSDFVolume:
    """Read what :func:`write_volume` wrote; sizes are checked before anything is allocated, nothing is unpickled.

    Raises:
        CacheError: the file is damaged or holds something else.
        VolumeTooLargeError: it holds more than ``max_bytes``, which is also the limit of the volume that is returned.
    """
    where = f"read_volume: {path}"
    try:
        with open_input("read_volume", path, max_bytes=MAX_STREAMED_BYTES, error=CacheError) as file:
            return _loaded(where, ZipArchive(file, os.fstat(file.fileno()).st_size), max_bytes, device)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        if isinstance(error, PcdataError):
            raise
        raise CacheError(f"{where}: not a complete TSDFVolume file: {error}") from error
    except CacheError as error:
        if str(error).startswith("read_volume"):
            raise
        raise CacheError(f"{where}: not a complete TSDFVolume file: {error}") from error
    except MemoryError as error:
        if isinstance(error, PcdataError):
            raise
        raise VolumeTooLargeError(f"{where}: there is not enough memory for it ({error}); lower max_bytes") from error


def _loaded(where: str, archive: ZipArchive, max_bytes: int, device: str) -> TSDFVolume:
    about = _about(where, archive)
    volume = _volume(where, about, max_bytes=max_bytes, device=device)
    planes = voxel_planes(**{name: bool(about["planes"][name]) for name in _PLANES})
    dtypes = _stored_dtypes(planes)
    if (found := set(archive.members)) != (wanted := {f"{name}.npy" for name in ("about", "keys", *dtypes)}):
        raise CacheError(f"it must have {', '.join(sorted(wanted))}, but has {', '.join(sorted(found)):.500}")
    headers = {name: _header(archive, name) for name in ("keys", *dtypes)}
    count = headers["keys"].shape[0] if headers["keys"].shape else -1
    if headers["keys"].dtype != np.int64 or headers["keys"].shape != (count,):
        raise CacheError(f"keys must be int64 (B,), found {headers['keys'].dtype} {headers['keys'].shape}")
    for name, dtype in dtypes.items():
        if headers[name].shape != (count, VOXELS) or headers[name].dtype != dtype:
            raise CacheError(
                f"{name} must be {dtype} {(count, VOXELS)}, found {headers[name].dtype} {headers[name].shape}"
            )
    needed = count * bytes_per_block(planes)
    if needed > max_bytes:
        raise VolumeTooLargeError(
            f"{where}: {count} blocks take {needed / 2**20:.1f} MiB, but max_bytes allows {max_bytes / 2**20:.1f} MiB"
        )
    keys = read_array(archive, archive.members["keys.npy"])
    if len(np.unique(keys)) != len(keys) or (len(keys) and keys.min() < 0):
        raise CacheError("block keys must be distinct and not negative")
    blocks = VoxelBlocks(planes, torch.device(device), room=volume.room)
    order = np.argsort(keys)
    blocks.add(torch.from_numpy(keys[order]).to(device))
    rows = np.empty_like(order)
    rows[order] = np.arange(len(order))  # blocks lie in key order now
    for name, dtype in dtypes.items():
        _read_plane(archive, name, headers[name].begin, dtype, blocks, torch.from_numpy(rows).to(device))
    num_views = about["num_views"]
    if type(num_views) is not int or num_views < 1:
        raise CacheError(f"num_views must be a whole number from 1 on, got {num_views!r:.100}")
    volume.blocks, volume.frame_id, volume.num_views = blocks, str(about["frame_id"]), num_views
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


def _stored_dtypes(planes: Planes) -> dict[str, np.dtype[Any]]:
    """Return the planes that a volume has and how they are stored."""
    return {name: np.dtype(f"<i{dtype.itemsize}") for name, dtype in planes.items()}


def _write(archive: zipfile.ZipFile, name: str, array: np.ndarray) -> None:
    with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
        np.lib.format.write_array(stream, array, allow_pickle=False)


def _write_plane(archive: zipfile.ZipFile, name: str, blocks: VoxelBlocks) -> None:
    dtype = _stored_dtypes(blocks.planes)[name]
    header = {"descr": dtype.str, "fortran_order": False, "shape": (len(blocks), VOXELS)}
    with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
        np.lib.format.write_array_header_1_0(stream, header)
        for number, chunk in enumerate(blocks.chunks):
            plane = chunk[name][: max(0, len(blocks) - number * CHUNK)]
            stream.write(plane.cpu().numpy().astype(dtype, copy=False).tobytes())


def _read_plane(
    archive: ZipArchive, name: str, begin: int, dtype: np.dtype[Any], blocks: VoxelBlocks, rows: torch.Tensor
) -> None:
    member = archive.members[f"{name}.npy"]
    row_bytes = VOXELS * dtype.itemsize
    pieces = archive.pieces(member, begin, CHUNK * row_bytes)
    next(pieces)
    start = 0
    for data in pieces:  # to the end, where the checksum is compared
        some = rows[start : start + CHUNK]
        start += CHUNK
        values = torch.from_numpy(np.frombuffer(data, dtype).astype(dtype.newbyteorder("=")).reshape(-1, VOXELS))
        for chunk, inside, which in blocks.in_chunks(some):
            chunk[name][inside] = values.to(rows.device)[which]


def _about(where: str, archive: ZipArchive) -> dict[str, Any]:
    header = _header(archive, "about")
    if header.dtype != np.uint8 or len(header.shape) != 1 or header.shape[0] > _LONGEST_TEXT:
        raise CacheError("it does not describe itself as a TSDFVolume")
    about = json_object("its text", read_array(archive, archive.members["about.npy"]).tobytes(), error=CacheError)
    if about.get("format") != _FORMAT:
        raise CacheError(f"{where}: its format is not {_FORMAT!r}; was it written by another version?")
    return about


def _header(archive: ZipArchive, name: str) -> NpyHeader:
    member = archive.members.get(f"{name}.npy")
    if member is None or member.deflated:
        raise CacheError(f"it has no member {name}.npy, stored as it is; it has {', '.join(archive.members):.300}")
    header = npy_header(archive, member)
    if header.by_columns:
        raise CacheError(f"{name} is not stored row by row")
    return header
