"""Compiled kernels on disk, so that each is compiled once per machine: ``~/.cache/pcdata/kernels``.

The folder is its owner's alone, or it is not used: what lies there is run. Files are written beside their places and
renamed, and carry a digest of their own; one that is broken counts as absent. No error of a disk stops anything.
"""

from __future__ import annotations

import hashlib
import os
import stat
from contextlib import suppress
from pathlib import Path

from pcdata.errors import PcdataError
from pcdata.files.opening import read_bytes
from pcdata.files.part_files import part_file

_MARK = b"pcdata kernels 1\n"
_DIGEST = 32  # bytes
_MOST = 1 << 26  # bytes; kernels of one header take some 100 KB


def load(identity: str) -> bytes | None:
    """Return what was kept under an identity, or None."""
    place = _place(identity)
    if place is None:
        return None
    try:
        held = read_bytes("pcdata kernels", place, max_bytes=_MOST)
    except (OSError, PcdataError):
        return None
    start = len(_MARK) + _DIGEST
    if held[: len(_MARK)] != _MARK or hashlib.sha256(held[start:]).digest() != held[len(_MARK) : start]:
        return None
    return held[start:]


def keep(identity: str, binary: bytes) -> None:
    """Keep a binary, where there is a folder and room for it."""
    place = _place(identity)
    if place is None:
        return
    with suppress(OSError), part_file(place) as part:
        part.write_bytes(_MARK + hashlib.sha256(binary).digest() + binary)
        os.replace(part, place)


def folder() -> Path | None:
    """Return the folder, made if need be; None where there can be none that only this user writes to."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    try:
        path = (Path(base) if os.path.isabs(base) else Path.home() / ".cache") / "pcdata" / "kernels"
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = path.stat()
    except (OSError, RuntimeError):  # no home, or none that can be written to
        return None
    is_own = not hasattr(os, "getuid") or status.st_uid == os.getuid()
    return path if is_own and not stat.S_IMODE(status.st_mode) & 0o022 else None


def _place(identity: str) -> Path | None:
    where = folder()
    return None if where is None else where / f"{hashlib.sha256(identity.encode()).hexdigest()}.bin"
