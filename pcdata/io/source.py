"""What every capture layout offers: named samples, each loaded on demand."""

from __future__ import annotations

import copy
import os
import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Protocol

from pcdata.errors import CaptureError, DTypeError, PcdataError, add_note, near_matches
from pcdata.structures import DepthFrame, PointCloud

_LITTER = ("thumbs.db", "desktop.ini")
_SHOWN = 5  # ids or files named in a message before "and n more"


class CaptureSource(Protocol):
    """Anything with ids that loads a capture by id: a :class:`Source`, a synthetic one, one around another."""

    @property
    def ids(self) -> list[str]:
        """The sample ids, unique and in a fixed order."""

    def load(self, sample_id: str) -> DepthFrame | PointCloud:
        """Load one sample."""


def checked_ids(where: str, source: Any) -> list[str]:
    """Return the ids of a source that can be read as a whole.

    Raises:
        DTypeError: it is no source.
        CaptureError: it has no samples, or two with one id.
    """
    if not hasattr(source, "ids") or not hasattr(source, "load"):
        raise DTypeError(
            f"{where}: source must have ids and load(id), got {type(source).__name__}; pcdata.open_source(path) makes "
            "one of a folder or file"
        )
    ids = list(source.ids)
    if not ids:
        raise CaptureError(f"{where}: {source!r} has no samples")
    if len(set(ids)) != len(ids):
        twice = next(name for name in ids if ids.count(name) > 1)
        raise CaptureError(f"{where}: {source!r}: sample ids must be unique, but {twice!r} comes more than once")
    return ids


class Source(ABC):
    """The samples of one capture: sorted unique ids, and a loader.

    A source holds paths and numbers only, no open file, so it can be pickled, sent to workers and used by many at once.
    Building one reads names and calibration, never an image.
    """

    kind: ClassVar[str]  # how open_source(kind=...) calls the layout
    needs: ClassVar[str]  # the layout in words, for error messages

    def __init__(self, path: Path, ids: Iterable[str]) -> None:
        self.path = absolute(path)
        self._ids = sorted(ids)
        self._known = frozenset(self._ids)
        if not self._ids:
            raise CaptureError(f"{self}: no sample found; this layout needs {self.needs}")

    @classmethod
    @abstractmethod
    def recognises(cls, path: Path) -> bool:
        """Say whether the exact signs of this layout are there; must not raise for any path."""

    @abstractmethod
    def files(self, sample_id: str) -> dict[str, Path]:
        """Return the files of one sample by role, e.g. ``{"depth": ..., "color": ...}``; a cache may hash them."""

    def depth_files(self, sample_id: str) -> list[Path]:
        """Return the depth images of one sample, one for each view; none where depth is no file of its own."""
        files = self.files(sample_id)
        return [files["depth"]] if "depth" in files else []

    @abstractmethod
    def _load(self, sample_id: str) -> DepthFrame | PointCloud:
        """Load one known sample."""

    @property
    def name(self) -> str:
        """The name of the folder or file."""
        return self.path.name

    @property
    def ids(self) -> list[str]:
        """The sample ids, sorted and unique."""
        return list(self._ids)

    def load(self, sample_id: str) -> DepthFrame | PointCloud:
        """Read one sample.

        Raises:
            CaptureError, UnitError, PoseError, ShapeError: the sample is unknown or cannot be trusted, and why.
        """
        if sample_id not in self._known:
            raise CaptureError(f"{self}: no sample {sample_id!r}{near_matches(str(sample_id), self._ids)}")
        try:
            return self._load(sample_id)
        except PcdataError as error:
            add_note(error, f"while loading sample {sample_id!r} of {self}")
            raise

    def subset(self, ids: Sequence[str]) -> Source:
        """Return the same source with some of its samples only."""
        unknown = sorted(set(ids) - self._known)
        if unknown or not ids:
            raise CaptureError(f"{self}: subset needs ids of this source, got {name_some(unknown) or 'none'}")
        smaller = copy.copy(self)
        smaller._ids = sorted(set(ids))
        smaller._known = frozenset(smaller._ids)
        return smaller

    def provenance(self, sample_id: str) -> dict[str, Any]:
        """Return JSON-able facts on where a sample came from: layout, folder, file names within it."""
        root = self.path if self.path.is_dir() else self.path.parent
        files = {role: file.relative_to(root).as_posix() for role, file in self.files(sample_id).items()}
        return {"source": self.kind, "root": self.name, "files": files}

    def __len__(self) -> int:
        return len(self._ids)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self.path)!r}, {len(self._ids)} samples)"

    def __str__(self) -> str:
        return f"{self.kind} source {self.path}"


def absolute(path: str | os.PathLike[str]) -> Path:
    """Return the path so that it survives a change of the working folder, e.g. in a worker; no ``..`` is left in it."""
    return Path(os.path.abspath(Path(path).expanduser()))


def name_some(names: Iterable[str]) -> str:
    """Return the first few names and how many more there are."""
    listed = sorted(names)
    more = f" and {len(listed) - _SHOWN} more" if len(listed) > _SHOWN else ""
    return ", ".join(listed[:_SHOWN]) + more


def visible_files(folder: Path) -> list[Path]:
    """Return the files of a folder by name, without hidden ones and those that desktops leave behind."""
    try:
        entries = sorted(folder.iterdir())
    except OSError as error:
        raise CaptureError(f"{folder}: cannot be listed: {error}") from error
    return [e for e in entries if not e.name.startswith(".") and e.name.lower() not in _LITTER and e.is_file()]


def by_stem(folder: Path, suffixes: Sequence[str]) -> dict[str, Path]:
    """Return the files of a folder by name without suffix.

    Raises:
        CaptureError: a file has another suffix, or two differ in the suffix alone.
    """
    found: dict[str, Path] = {}
    for file in visible_files(folder):
        if file.suffix.lower() not in suffixes:
            raise CaptureError(f"{folder}: may hold {', '.join(suffixes)} only, but there is {file.name}; move it out")
        if file.stem in found:
            raise CaptureError(f"{folder}: {found[file.stem].name} and {file.name} are both {file.stem!r}; remove one")
        found[file.stem] = file
    return found


def check_partners(where: str, ids: Iterable[str], partners: Mapping[str, Iterable[str]]) -> None:
    """Require every role that is present at all to be present for exactly the given ids."""
    wanted = set(ids)
    faults = []
    for role, present in partners.items():
        missing, spare = wanted - set(present), set(present) - wanted
        if missing:
            faults.append(f"{role} is missing for {name_some(missing)}")
        if spare:
            faults.append(f"there is {role} but no depth for {name_some(spare)}")
    if faults:
        raise CaptureError(f"{where}: every sample needs the same files: {'; '.join(faults)}")


def sequence_positions(ids: Sequence[str]) -> dict[str, int]:
    """Return the position of every id: the number it ends in if all do, else its place in sorted order."""
    numbers = [re.search(r"([0-9]{1,18})$", name) for name in ids]
    if all(numbers):
        return {name: int(match[1]) for name, match in zip(ids, numbers, strict=True) if match}
    return {name: place for place, name in enumerate(sorted(ids))}
