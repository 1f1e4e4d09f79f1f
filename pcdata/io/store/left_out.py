"""The captures that a dataset lacks, by id, with why: in ``dataset.json`` while they are few, else as arrays.

A million of them would make ``dataset.json`` larger than any JSON that is read. So more than ``MOST_IN_JSON`` of the
manifest lie in ``index/`` as texts end to end with row pointers, of which nothing is looked at before somebody asks.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pcdata.errors import CacheError
from pcdata.files.npy import npy_bytes
from pcdata.io.store.sample_index import FOLDER, mapped_array, written
from pcdata.io.store.text_table import TextTable

_PARTS = {"ids": "|u1", "id_ends": "<i8", "reasons": "|u1", "reason_ends": "<i8"}
FILES = tuple(f"{kind}_{part}.npy" for kind in ("skipped", "quarantined") for part in _PARTS)


class LeftOut(Mapping[str, str]):
    """Why each of many captures is not in a dataset, by id; the files are mapped and looked at when they are asked.

    Args:
        folder: of the dataset.
        kind: ``skipped`` or ``quarantined``.
        told: what :func:`write_left_out` returned.
    """

    def __init__(self, folder: Path, kind: str, told: Mapping[str, Any]) -> None:
        if set(told) != {"num_captures", *_PARTS} or type(told["num_captures"]) is not int:
            raise CacheError(f"{kind} must tell of num_captures, {', '.join(_PARTS)}, got {told!r:.200}")
        self._folder, self._kind, self._told = folder, kind, told
        self._tables: tuple[TextTable, TextTable] | None = None

    def __len__(self) -> int:
        return int(self._told["num_captures"])

    def __iter__(self) -> Iterator[str]:
        return iter(self._read()[0])

    def __getitem__(self, sample_id: str) -> str:
        ids, reasons = self._read()
        place = ids.place_of(sample_id)
        if place is None:
            raise KeyError(sample_id)
        return reasons[place]

    def items(self) -> Any:
        """Yield pairs of id and reason, in one pass."""
        return zip(*self._read())

    def values(self) -> Any:
        """Yield the reasons, in one pass."""
        return iter(self._read()[1])

    def __repr__(self) -> str:
        return f"<{len(self)} captures {self._kind}>"

    def _read(self) -> tuple[TextTable, TextTable]:
        """Map both tables.

        Raises:
            CacheError: a file is missing, changed or hostile.
        """
        if self._tables is None:
            arrays = {
                part: mapped_array(self._folder, f"{self._kind}_{part}.npy", self._told[part], (dtype, ()))
                for part, dtype in _PARTS.items()
            }
            tables = (
                _checked(self._kind, arrays["ids"], arrays["id_ends"], len(self)),
                _checked(self._kind, arrays["reasons"], arrays["reason_ends"], len(self)),
            )
            self._tables = tables
        return self._tables


def write_left_out(folder: Path, kind: str, left: Mapping[str, str]) -> dict[str, Any]:
    """Write captures as arrays into the index and force them to disk; return what ``dataset.json`` has instead.

    Raises:
        OSError: the disk is full.
    """
    ids, reasons = TextTable.of(left.keys()), TextTable.of(reason or "unknown" for reason in left.values())
    arrays = {"ids": ids.letters, "id_ends": ids.ends, "reasons": reasons.letters, "reason_ends": reasons.ends}
    told: dict[str, Any] = {"num_captures": len(left)}
    for part, dtype in _PARTS.items():
        content = npy_bytes(np.ascontiguousarray(arrays[part], dtype))
        told[part] = written(folder / FOLDER / f"{kind}_{part}.npy", content)
    return told


def _checked(kind: str, letters: Any, ends: Any, count: int) -> TextTable:
    lengths = np.diff(ends, prepend=np.int64(0))
    if len(ends) != count or (count and (bool((lengths < 1).any()) or int(ends[-1]) != len(letters))):
        raise CacheError(f"{kind}: its texts are damaged; copy the dataset again, or rebuild it")
    if bool((ends > len(letters)).any()):
        raise CacheError(f"{kind}: its texts are damaged; copy the dataset again, or rebuild it")
    return TextTable(letters, ends)
