"""The texts of a dataset that people may edit, and the hashes that tell an edit from what was written.

``texts.sha256`` lists them as ``sha256sum --check`` reads it. It is written before they change, with the old hashes and
the new ones, and afterwards with the new ones alone: whenever a writer is killed, nothing of its own counts as an edit.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Mapping
from pathlib import Path

from pcdata.errors import CacheError
from pcdata.files.opening import read_bytes, replacing
from pcdata.files.syncing import sync_file
from pcdata.io.store.shards import hash_of

FILE_NAME = "texts.sha256"

_LINE = re.compile(r"([0-9a-f]{64})  ([A-Za-z0-9_.-]+)")
_MAX_BYTES = 1 << 16


def write_new_texts(folder: Path, texts: Mapping[str, str]) -> None:
    """Write the texts of a dataset that is being made, by the name of their file, and remember what was written.

    Raises:
        OSError: the disk is full.
    """
    contents = {name: text.encode() for name, text in texts.items()}
    hashes = {name: [hashlib.sha256(content).hexdigest()] for name, content in contents.items()}
    for name, content in {**contents, FILE_NAME: _lines(hashes)}.items():
        with open(folder / name, "xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())


def write_texts(folder: Path, texts: Mapping[str, str]) -> None:
    """Write texts of a dataset anew, force them to disk, and remember what was written.

    Raises:
        WriteError: one cannot be written.
        CacheError: the list of those that are there is damaged.
    """
    contents = {name: text.encode() for name, text in texts.items()}
    new = {name: [hashlib.sha256(content).hexdigest()] for name, content in contents.items()}
    if known := _known(folder):
        _write(folder, FILE_NAME, _lines({**known, **{name: known.get(name, []) + own for name, own in new.items()}}))
    for name, content in contents.items():
        _write(folder, name, content)
    _write(folder, FILE_NAME, _lines({**known, **new}))


def written_texts(folder: Path) -> dict[str, bool | None]:
    """Say of every text that was written whether it is as it was; None = it is gone.

    Raises:
        CacheError: the list is damaged, or one of them cannot be read.
    """
    known = _known(folder)
    return {
        name: hash_of(folder / name)[1] in hashes if (folder / name).exists() else None
        for name, hashes in known.items()
    }


def edited_texts(folder: Path) -> list[str]:
    """Name the texts that somebody edited since they were written.

    Raises:
        CacheError: as for :func:`written_texts`.
    """
    return [name for name, same in written_texts(folder).items() if same is False]


def _known(folder: Path) -> dict[str, list[str]]:
    """Return the hashes that each text may have; {} where there is no list."""
    path, known = folder / FILE_NAME, dict[str, list[str]]()
    if path.exists():
        for line in read_bytes("dataset", path, max_bytes=_MAX_BYTES, error=CacheError).decode("latin-1").splitlines():
            found = _LINE.fullmatch(line)
            if found is None:
                raise CacheError(
                    f"{path}: has a line that is no hash of a text: {line!r:.100}; delete it, and no edit can be told"
                )
            known.setdefault(found[2], []).append(found[1])
    return known


def _lines(hashes: Mapping[str, list[str]]) -> bytes:
    return "".join(f"{one}  {name}\n" for name in sorted(hashes) for one in hashes[name]).encode()


def _write(folder: Path, name: str, content: bytes) -> None:
    with replacing("dataset", folder / name) as temporary:
        temporary.write_bytes(content)
        sync_file(temporary)
