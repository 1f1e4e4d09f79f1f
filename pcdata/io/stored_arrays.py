"""Arrays by name from files that others wrote: npz, npy, HDF5, zarr v2; read row by row where the format allows it."""

from __future__ import annotations

import zipfile
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from pcdata.errors import CacheError, DTypeError, PcdataError, near_matches
from pcdata.files import map_npy
from pcdata.io.claimed_sizes import checked_dataset, checked_members, read_npy
from pcdata.io.zarr_arrays import zarr_arrays

_MAX_FILE_BYTES = 1 << 44  # what is read of a file is bounded by what it claims, see _check_packing

# Measured numbers do not pack tightly; zeros do, and a few kilobytes of them unpack to all the memory there is.
_MAX_PACKING = 100
_ALWAYS = 1 << 28  # bytes that may be unpacked however small the file is: a cloud that is all padding


class StoredArray:
    """One array of numbers: ``array[3]`` reads a row, ``array[...]`` everything."""

    def __init__(self, where: str, content: Any) -> None:
        self.where = where
        self.shape: tuple[int, ...] = tuple(content.shape)
        self._content = content
        if content.dtype.kind not in "biuf":
            raise DTypeError(
                f"{where}: must hold numbers, got {content.dtype}; name another array, or convert this one"
            )

    @property
    def ndim(self) -> int:
        """The number of axes."""
        return len(self.shape)

    def __getitem__(self, index: Any) -> np.ndarray:
        """Read a part.

        Raises:
            CacheError: the bytes are damaged.
        """
        with _damage_named(self.where):
            return np.asarray(self._content[index])


@contextmanager
def stored_arrays(path: str | Path, names: Collection[str]) -> Iterator[dict[str, StoredArray]]:
    """Open a file for as long as arrays of it are read.

    Args:
        path: a .npz, .npy, .h5 or .hdf5 file, or a zarr v2 directory.
        names: of the arrays; a .npy file has one, without a name: "".

    Raises:
        CacheError, CaptureError: the file cannot be read, has no such array, or claims sizes that cannot be true.
        DTypeError: an array of texts or objects.
    """
    path = Path(path)
    if not path.exists():
        raise CacheError(f"{path}: cannot be read: no such file; check the path (relative to {Path.cwd()})")
    if path.is_dir():
        found: Mapping[str, Any] = zarr_arrays(path)
        chosen = {name: _named(path, found, name) for name in names}
        for name, array in chosen.items():
            _check_packing(f"{path}: {name}", array.nbytes, array.stored_bytes())
        yield _arrays(path, chosen)
    elif path.suffix == ".npy":
        found = {"": map_npy("check", path, max_bytes=_MAX_FILE_BYTES)}
        yield _arrays(path, {name: _named(path, found, name) for name in names})
    elif path.suffix == ".npz":
        with _damage_named(str(path)):
            chosen = _from_npz(path, names)
        yield _arrays(path, chosen)
    elif path.suffix in (".h5", ".hdf5"):
        import h5py

        with _damage_named(str(path)):
            file = h5py.File(path, "r")
        with file:
            with _damage_named(str(path)):
                chosen = _from_hdf5(path, file, names)
            yield _arrays(path, chosen)
    else:
        raise CacheError(f"{path}: is no .npz, .npy, .h5, .hdf5 file and no zarr directory")


def _arrays(path: Path, chosen: Mapping[str, Any]) -> dict[str, StoredArray]:
    return {name: StoredArray(f"{path}: {name}" if name else str(path), array) for name, array in chosen.items()}


def _from_npz(path: Path, names: Collection[str]) -> dict[str, Any]:
    with zipfile.ZipFile(path) as archive:
        members = {member.filename.removesuffix(".npy"): member for member in checked_members(archive, path)}
        chosen = {name: _named(path, members, name) for name in names}
        for name, member in chosen.items():
            _check_packing(f"{path}: {name}", member.file_size, member.compress_size)
        return {name: read_npy(archive, member) for name, member in chosen.items()}


def _from_hdf5(path: Path, file: Any, names: Collection[str]) -> dict[str, Any]:
    import h5py

    found: list[str] = []
    file.visititems(lambda name, item: found.append(name) if isinstance(item, h5py.Dataset) else None)
    chosen = {}
    for name in names:
        _named(path, dict.fromkeys(found), name.strip("/"))
        if file[name].dtype.kind in "biuf":  # texts and objects are refused as such
            checked_dataset(file[name].parent, name.strip("/").rpartition("/")[2])
        chosen[name] = file[name]
        claimed = int(np.prod(chosen[name].shape or (), dtype=object)) * chosen[name].dtype.itemsize
        _check_packing(f"{path}: {name}", claimed, chosen[name].id.get_storage_size())
    return chosen


def _named(path: Path, found: Mapping[str, Any], name: str) -> Any:
    if name not in found:
        known = sorted(found)
        raise CacheError(f"{path}: no array {name!r}{near_matches(name, known)}; it has {', '.join(known) or 'none'}")
    return found[name]


def _check_packing(where: str, claimed: int, stored: int) -> None:
    if claimed > max(_ALWAYS, _MAX_PACKING * stored):
        raise CacheError(
            f"{where}: claims {claimed} bytes, stored in {stored}; measured numbers pack at most {_MAX_PACKING} to 1, "
            "so its header is damaged or it would fill the memory; write it again, uncompressed if it is meant"
        )


@contextmanager
def _damage_named(where: str) -> Iterator[None]:
    """Turn whatever a damaged file makes a library raise into one error that names the file."""
    try:
        yield
    except CacheError as error:
        if str(error).startswith(where):
            raise
        raise CacheError(f"{where}: {error}; it is damaged or hostile: copy or write it again") from error
    except (PcdataError, MemoryError):
        raise
    except Exception as error:  # zipfile, numpy and h5py raise many types on damaged bytes
        raise CacheError(
            f"{where}: cannot be read ({type(error).__name__}: {error}); damaged, cut short or of another format? "
            "Copy or write it again"
        ) from error
