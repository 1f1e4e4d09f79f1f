"""Arrays by name from files that others wrote: npz, npy, HDF5, zarr v2; read row by row where the format allows it."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from pcdata.errors import CacheError, DTypeError, PcdataError, near_matches
from pcdata.files.library_errors import WRITE_AGAIN, told_by_library
from pcdata.files.npz import array_names, read_array
from pcdata.files.opening import MAX_STREAMED_BYTES, existing_file, map_npy, open_input
from pcdata.files.packing import check_packing
from pcdata.files.zip_archive import ZipArchive
from pcdata.io.arrays.hdf5_arrays import checked_dataset, hard_linked, open_hdf5
from pcdata.io.arrays.zarr_arrays import zarr_array, zarr_names

_MAX_NAMES = 1000  # arrays that are looked at to say what there is
_SHOWN = 20  # of them in a message


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
    if path.is_dir():
        yield _arrays(path, _from_zarr(path, names))
    elif path.suffix == ".npy":
        found = {"": map_npy("check", path, max_bytes=MAX_STREAMED_BYTES, error=CacheError)}
        yield _arrays(path, {name: _named(path, found, name) for name in names})
    elif path.suffix == ".npz":
        existing_file("check", path, max_bytes=MAX_STREAMED_BYTES, error=CacheError)
        with _damage_named(str(path)):
            chosen = _from_npz(path, names)
        yield _arrays(path, chosen)
    elif path.suffix in (".h5", ".hdf5"):
        existing_file("check", path, max_bytes=MAX_STREAMED_BYTES, error=CacheError)
        with _damage_named(str(path)):
            file = open_hdf5(path)
        with file:
            with _damage_named(str(path)):
                chosen = _from_hdf5(path, file, names)
            yield _arrays(path, chosen)
    else:
        existing_file("check", path, max_bytes=MAX_STREAMED_BYTES, error=CacheError)
        raise CacheError(f"{path}: is no .npz, .npy, .h5, .hdf5 file and no zarr directory")


def stored_names(path: str | Path) -> list[str]:
    """Return the names of the arrays in a file, the first of them where there are very many; "" is that of a .npy file.

    Raises:
        CacheError, CaptureError: the file cannot be read.
    """
    path = Path(path)
    with stored_arrays(path, ()), _damage_named(str(path)):  # what kind of file is wrong comes first
        if path.is_dir():
            return sorted(zarr_names(path, _MAX_NAMES))
        if path.suffix == ".npz":
            with open_input("check", path, max_bytes=MAX_STREAMED_BYTES, error=CacheError) as file:
                return sorted(array_names(ZipArchive(file, os.fstat(file.fileno()).st_size)))
        if path.suffix == ".npy":
            return [""]
        with open_hdf5(path) as file:
            return sorted(islice(_datasets_below(file), _MAX_NAMES))


def shown_names(names: Collection[str]) -> str:
    """Return names for a message: not more than can be read, none of them long."""
    known = sorted(names)
    shown = ", ".join(f"{other:.100}" for other in known[:_SHOWN]) or "none"
    return f"{shown} and {len(known) - _SHOWN} others" if len(known) > _SHOWN else shown


def _arrays(path: Path, chosen: Mapping[str, Any]) -> dict[str, StoredArray]:
    return {name: StoredArray(f"{path}: {name}" if name else str(path), array) for name, array in chosen.items()}


def _from_zarr(path: Path, names: Collection[str]) -> dict[str, Any]:
    known = dict.fromkeys(zarr_names(path, _MAX_NAMES))
    chosen = {}
    for name in names:
        array = zarr_array(path, name)
        if array is None:
            _named(path, {other: None for other in known if other != name}, name)
        # Texts and objects are refused as such.
        chosen[name] = array.checked() if array is not None and array.dtype.kind in "biuf" else array
    return chosen


def _from_npz(path: Path, names: Collection[str]) -> dict[str, Any]:
    with open_input("check", path, max_bytes=MAX_STREAMED_BYTES, error=CacheError) as file:
        archive = ZipArchive(file, os.fstat(file.fileno()).st_size)
        members = array_names(archive)
        chosen = {name: _named(path, members, name) for name in names}
        for name, member in chosen.items():
            check_packing(f"{path}: {name}", member.size, member.packed)
        return {name: read_array(archive, member) for name, member in chosen.items()}


def _from_hdf5(path: Path, file: Any, names: Collection[str]) -> dict[str, Any]:
    import h5py

    chosen = {}
    for name in names:
        dataset = hard_linked(file, name.strip("/"))
        if not isinstance(dataset, h5py.Dataset):
            _named(path, dict.fromkeys(islice(_datasets_below(file), _MAX_NAMES)), name)
        elif dataset.dtype.kind in "biuf":
            chosen[name] = checked_dataset(file, name.strip("/"), path.stat().st_size)
        else:  # texts and objects are refused as such
            chosen[name] = dataset
    return chosen


def _datasets_below(group: Any) -> Iterator[str]:
    """Yield the names of datasets, without links; groups that hold themselves are entered once."""
    import h5py

    waiting, seen = [("", group)], {group.id.__hash__()}
    while waiting:
        before, folder = waiting.pop(0)
        for name in folder:
            item = hard_linked(folder, name)
            if isinstance(item, h5py.Dataset):
                yield before + name
            elif isinstance(item, h5py.Group) and (mark := item.id.__hash__()) not in seen:
                seen.add(mark)
                waiting.append((f"{before}{name}/", item))


def _named(path: Path, found: Mapping[str, Any], name: str) -> Any:
    if name not in found:
        hint = near_matches(name, sorted(found))
        raise CacheError(f"{path}: no array {name!r:.100}{hint}; it has {shown_names(found)}")
    return found[name]


@contextmanager
def _damage_named(where: str) -> Iterator[None]:
    """Turn whatever a damaged file makes a library raise into one error that names the file."""
    try:
        yield
    except CacheError as error:
        if str(error).startswith(where):
            raise
        raise CacheError(f"{where}: cannot be read: {error}; damaged or hostile? Copy or write it again") from error
    except PcdataError:
        raise
    except MemoryError as error:
        raise CacheError(f"{where}: there is not enough memory to read it ({error}); the file may be fine") from error
    except Exception as error:  # numpy and h5py raise many types on damaged bytes
        raise CacheError(f"{where}: cannot be read: {told_by_library(error)}; {WRITE_AGAIN}") from error
