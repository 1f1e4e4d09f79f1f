"""The HDF5 file of demonstrations: opened for as long as it is read, its groups, arrays and attributes checked."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from pcdata.errors import CacheError, CaptureError, PcdataError
from pcdata.files.library_errors import WRITE_AGAIN, told_by_library
from pcdata.files.opening import MAX_STREAMED_BYTES, existing_file
from pcdata.files.sample_names import in_order
from pcdata.files.strict_json import json_object
from pcdata.io.arrays.hdf5_arrays import hard_linked, open_hdf5
from pcdata.io.sources.listing import absolute

_MAX_EPISODES = 100_000
_MAX_STREAMS = 1000  # in one episode
_MAX_TEXT = 1 << 24  # characters of one attribute: the model of a kitchen takes some millions


@contextmanager
def opened(where: str, path: Path) -> Iterator[Any]:
    """Open an HDF5 file for as long as something of it is read.

    Raises:
        CaptureError: whatever is wrong with it.
    """
    path = absolute(path)
    existing_file(where, path, max_bytes=MAX_STREAMED_BYTES)
    try:
        with open_hdf5(path) as file:
            yield file
    except CacheError as error:
        raise CaptureError(f"{where}: {error}") from error
    except PcdataError:
        raise
    except MemoryError as error:
        raise CaptureError(f"{where}: there is not enough memory to read it ({error}); the file may be fine") from error
    except Exception as error:  # h5py raises many types on damaged bytes
        raise CaptureError(f"{where}: not a readable HDF5 file: {told_by_library(error)}; {WRITE_AGAIN}") from error


def episode_names(where: str, group: Any, prefix: str) -> list[str]:
    """Return the names of the groups that are episodes, as a person counts.

    Raises:
        CaptureError: there are more than any recording has.
    """
    import h5py

    if len(group) > _MAX_EPISODES:
        raise CaptureError(f"{where}: has {len(group)} entries, more than {_MAX_EPISODES}")
    names = [name for name in group if name.startswith(prefix) and name[len(prefix) :].isdecimal()]
    return in_order(name for name in names if isinstance(hard_linked(group, name), h5py.Group))


def arrays_below(where: str, group: Any, name: str) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the arrays of numbers at or below a path in a group, by their paths.

    Raises:
        CaptureError: there are more than any recording has, or groups that hold themselves.
    """
    import h5py

    found: dict[str, tuple[int, ...]] = {}
    waiting, looked = [name], 0
    while waiting:
        path, looked = waiting.pop(), looked + 1
        if looked > _MAX_STREAMS:
            raise CaptureError(f"{where}/{name}: has more than {_MAX_STREAMS} arrays")
        item = hard_linked(group, path)
        if isinstance(item, h5py.Group):
            if len(item) > _MAX_STREAMS:
                raise CaptureError(f"{where}/{path}: has {len(item)} entries, more than {_MAX_STREAMS}")
            waiting.extend(f"{path}/{part}" for part in item)
        elif isinstance(item, h5py.Dataset) and item.dtype.kind in "biuf" and item.shape is not None:
            found[path] = item.shape
    return dict(sorted(found.items()))


def text_attribute(where: str, group: Any, name: str) -> str | None:
    """Return an attribute that is one text; None where there is none.

    Raises:
        CaptureError: it is something else, or longer than any is.
    """
    if name not in group.attrs:
        return None
    stored = group.attrs.get_id(name)
    if stored.shape != () or stored.get_storage_size() > _MAX_TEXT:
        raise CaptureError(f"{where}: the attribute {name} must be one text, got shape {stored.shape}")
    value = group.attrs[name]
    if isinstance(value, bytes):
        value = value.decode("utf-8", "strict")
    if not isinstance(value, str) or len(value) > _MAX_TEXT:
        raise CaptureError(f"{where}: the attribute {name} must be one text, got {type(value).__name__}")
    return value


def json_attribute(where: str, group: Any, name: str) -> dict[str, Any]:
    """Return an attribute that is a JSON object; an empty one where there is none.

    Raises:
        CaptureError: it is something else.
    """
    text = text_attribute(where, group, name)
    return {} if text is None else json_object(f"{where}: the attribute {name}", text, error=CaptureError)


def number_attribute(where: str, group: Any, name: str) -> float | None:
    """Return an attribute that is one number; None where there is none.

    Raises:
        CaptureError: it is something else.
    """
    if name not in group.attrs:
        return None
    stored = group.attrs.get_id(name)
    if stored.shape not in ((), (1,)) or stored.dtype.kind not in "iuf":
        raise CaptureError(f"{where}: the attribute {name} must be one number, got {stored.dtype} of {stored.shape}")
    return float(np.asarray(group.attrs[name]).reshape(-1)[0])
