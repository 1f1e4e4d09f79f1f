"""What tells a source of captures, and the files of some of them, from others: digests that places do not change."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pcdata.errors import PcdataError
from pcdata.files.inputs import states_of
from pcdata.io.sources.capture_source import CaptureSource, all_within, episodes_of, inputs_of
from pcdata.io.sources.combine import SubsetSource
from pcdata.io.sources.joined_source import JoinedSource
from pcdata.io.sources.source import Source, stored_captures


def state_of(source: CaptureSource) -> dict[str, Any]:
    """Return how captures are read: the classes of a source with their settings, what was read to open it, episodes.

    Folders count by their names alone: a disk that is mounted elsewhere holds the same captures.
    """
    return {
        "classes": [[type(one).__name__, _settings(one)] for one in all_within(source)],
        "inputs": digest_of(sorted(inputs_of(source).states())),
        "episodes": digest_of([[one.id, one.first, one.length] for one in episodes_of(source)]),
    }


def captures_digest(source: CaptureSource, ids: Sequence[str], by_content: bool) -> str:
    """Return the SHA-256 of the state of the files that captures are read from, as :class:`Inputs` compares files.

    ``by_content`` reads all of them.
    """
    files = files_of(source, ids)
    return digest_of(list(zip(files.values(), states_of(files, by_content=by_content))))


def files_of(source: CaptureSource, ids: Sequence[str]) -> dict[Path, str]:
    """Return the files that captures are read from, each with its path within its capture folder."""
    files: dict[Path, str] = {}
    for sample_id in ids:
        with suppress(PcdataError):  # one that cannot be read is told when it is loaded
            for layout, name in stored_captures(source, sample_id):
                root = layout.path if layout.path.is_dir() else layout.path.parent
                for file in layout.files(name).values():
                    files[file] = file.relative_to(root).as_posix() if file.is_relative_to(root) else file.name
    return files


def digest_of(value: Any) -> str:
    """Return the SHA-256 of plain data as canonical JSON."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


def _settings(source: Any) -> Any:
    """Return how one source was made: a layout's options, a combinator's fields, else what it holds in plain data."""
    if isinstance(source, Source):
        return _plain(source.given)
    if isinstance(source, (SubsetSource, JoinedSource)):
        return None  # its ids say what it keeps
    return _plain({name: value for name, value in getattr(source, "__dict__", {}).items() if name != "opened"})


_UNTOLD = object()


def _plain(value: Any) -> Any:
    """Return what JSON can hold of a setting; of what has no settings of its own, nothing."""
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    if isinstance(value, (str, bool, int, type(None))):
        return value
    if isinstance(value, Path):
        return value.name
    if isinstance(value, (torch.Tensor, np.ndarray)):
        array = np.ascontiguousarray(value)
        return [str(array.dtype), list(array.shape), hashlib.sha256(array.tobytes()).hexdigest()]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return [type(value).__name__, _plain({one.name: getattr(value, one.name) for one in dataclasses.fields(value)})]
    if isinstance(value, Mapping):
        return {str(name): inner for name, own in value.items() if (inner := _plain(own)) is not _UNTOLD}
    if isinstance(value, (list, tuple)):
        return [inner for own in value if (inner := _plain(own)) is not _UNTOLD]
    if isinstance(value, (set, frozenset)):
        return sorted(map(str, value))
    if isinstance(value, bytes):
        return hashlib.sha256(value).hexdigest()
    return _UNTOLD
