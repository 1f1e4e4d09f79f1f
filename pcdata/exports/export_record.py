"""``pcdata_export.json``: which samples an export holds, what made it, and whether it is complete."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pcdata.errors import CacheError, locate
from pcdata.files.opening import read_bytes, replacing
from pcdata.files.whole_folders import EXPORT
from pcdata.io.store.cloud_record import parse_info

_MAX_BYTES = 1 << 28  # about a million samples
FILE_NAME = EXPORT
SCHEMA = "pcdata.export/1"

_LITTER = {"__pycache__", ".DS_Store", "Thumbs.db"}


@dataclass(frozen=True)
class ExportRecord:
    """The contents of the file."""

    target: str
    options: Mapping[str, Any]
    source: str  # fingerprint of a built dataset, or the layout of the captures
    samples: Sequence[str]  # in the order in which they were numbered
    complete: bool
    draws: Mapping[str, Any] = field(default_factory=dict)  # random steps, seed, epoch, copies; {} = nothing was drawn
    left_out: Mapping[str, str] = field(default_factory=dict)  # id of a sample that was left out -> why
    coordinates: Sequence[Sequence[str]] = ()  # frame and unit of the samples, every pair that there is
    files: Sequence[str] = ()  # all there was when it was completed
    schema: str = SCHEMA

    def write(self, folder: Path) -> None:
        """Write the file; it appears whole."""
        with replacing("export", folder / FILE_NAME) as temporary:
            temporary.write_text(json.dumps(asdict(self), indent=1, allow_nan=False) + "\n", encoding="utf-8")

    @classmethod
    def read(cls, folder: Path) -> ExportRecord:
        """Read the file.

        Raises:
            CacheError: missing, or not one.
        """
        path = folder / FILE_NAME
        if not path.is_file():
            raise CacheError(
                f"{folder} is not a pcdata export (it has no {FILE_NAME}), so it is left alone; choose another"
            )
        try:
            content = parse_info(read_bytes("export", path, max_bytes=_MAX_BYTES, error=CacheError))
            if content.get("schema") != SCHEMA:
                raise CacheError(f"schema must be {SCHEMA!r}, got {content.get('schema')!r:.100}")
            pairs = content.get("coordinates", [])
            if not isinstance(pairs, list) or not all(map(_is_pair, pairs)):
                raise CacheError(f"coordinates must list frames with their units, got {pairs!r:.100}")
            return cls(**content)
        except (CacheError, OSError, TypeError) as error:
            failed = CacheError(f"{path}: cannot be read: {error}; choose another folder")
            locate(failed, path=path)
            raise failed from error

    def difference(self, other: ExportRecord) -> str | None:
        """Say in what the plan of another export differs from this one, or None."""
        for name in ("target", "options", "source", "draws", "samples"):
            mine, theirs = _as_json(getattr(self, name)), _as_json(getattr(other, name))
            if mine != theirs:
                return (
                    "its samples are others"
                    if name == "samples"
                    else f"its {name} {'are' if name.endswith('s') else 'is'} {theirs!r:.200}, not {mine!r:.200}"
                )
        return None


def check_only_export(folder: Path) -> None:
    """Require that a folder is a complete export and holds nothing else.

    Raises:
        CacheError: deleting it would delete something that the export did not write, or an unfinished one.
    """
    try:
        record = ExportRecord.read(folder)
        if not record.complete:
            raise CacheError(f"{folder} holds an unfinished export; finish it (--continue), or remove it yourself")
        foreign = sorted(set(files_of(folder)) - set(record.files))
    except OSError as error:
        raise CacheError(f"{folder}: cannot be examined: {error}") from error
    if foreign:
        raise CacheError(
            f"{folder} also holds {', '.join(foreign[:5])}, which the export did not write and overwriting would "
            "delete; move that out first, or choose another folder"
        )


def files_of(folder: Path) -> list[str]:
    """Return the files below an export, without its record and what desktops leave behind."""
    relative = (path.relative_to(folder) for path in folder.rglob("*") if path.is_symlink() or not path.is_dir())
    return sorted(p.as_posix() for p in relative if p.as_posix() != FILE_NAME and not _LITTER & set(p.parts))


def _is_pair(entry: Any) -> bool:
    return isinstance(entry, list) and len(entry) == 2 and all(isinstance(text, str) for text in entry)


def _as_json(value: Any) -> Any:
    return json.loads(json.dumps(value))
