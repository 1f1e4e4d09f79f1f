"""Where the files of a LeRobot dataset lie, and how those of texts and tables are opened.

Source: LeRobot, ``datasets/utils.py`` (0.6), for version 3.0; ``convert_dataset_v21_to_v30.py`` for version 2.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pcdata.errors import CaptureError
from pcdata.files.opening import check_inside, read_text
from pcdata.files.strict_json import json_object
from pcdata.io.arrays.parquet import ParquetColumns
from pcdata.io.sources.listing import entries, has_file, is_file, is_folder

INFO = "meta/info.json"
INDEX_COLUMNS = ("timestamp", "frame_index", "episode_index", "index", "task_index")
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
TASKS_PATH = "meta/tasks.parquet"
_DATA = {3: DATA_PATH,
         2: "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"}  # fmt: skip
_VIDEO = {3: VIDEO_PATH,
          2: "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"}  # fmt: skip
_FIELD = re.compile(r"\{(\w+)(?::0?(\d{1,2})d)?\}")
MAX_TEXT = 1 << 28
_MAX_LOOKED_INTO = 100  # entries of a folder that is no dataset, of which one may be


@dataclass(frozen=True)
class LeRobotFiles:
    """The files of one dataset.

    Args:
        where: for messages.
        root: the folder.
        inside: what files may lie in, once links have been followed.
        info: ``meta/info.json``.
        version: 3 or 2.
    """

    where: str
    root: Path
    inside: Sequence[Path]
    info: Mapping[str, Any]
    version: int

    def _path(self, key: str, default: Mapping[int, str], **fields: Any) -> str:
        """Fill in the pattern of a path; the result lies in the folder.

        Raises:
            CaptureError: it has other fields, or leads elsewhere.
        """
        template = self.info.get(key) or default[self.version]
        if not isinstance(template, str) or len(template) > 500:
            raise CaptureError(f"{self.where}: {INFO}: {key} must be a pattern of paths, got {template!r:.100}")

        def filled(match: re.Match[str]) -> str:
            name, width = match.groups()
            if name not in fields or (width and not isinstance(fields[name], int)):
                raise CaptureError(
                    f"{self.where}: {INFO}: {key} {template!r:.200} has a field {match[0]!r} that is not known"
                )
            return str(fields[name]).zfill(int(width or 0))

        path = _FIELD.sub(filled, template)
        parts = path.replace("\\", "/").split("/")
        if "{" in path or "}" in path or path.startswith(("/", "\\", "~")) or ".." in parts or ":" in path:
            raise CaptureError(
                f"{self.where}: {INFO}: {key} {template!r:.200} leads out of the dataset, to {path!r:.200}"
            )
        return path

    def rows(self, **fields: Any) -> str:
        """Return the file of an episode's rows."""
        return self._path("data_path", _DATA, **fields)

    def video(self, key: str, **fields: Any) -> str:
        """Return the file of a video; depth without loss is in .mkv files where the pattern says .mp4."""
        path = self._path("video_path", _VIDEO, video_key=key, **fields)
        other = f"{path.rpartition('.')[0]}.mkv"
        return other if not has_file(self.root / path) and has_file(self.root / other) else path

    def lines(self, name: str) -> list[dict[str, Any]]:
        """Read a file of one JSON object a line."""
        text = read_text(self.where, self.root / name, max_bytes=MAX_TEXT, inside=self.inside)
        return [
            json_object(f"{self.where}: {name} line {number}", line, error=CaptureError)
            for number, line in enumerate(text.splitlines(), 1)
            if line.strip()
        ]

    def tables(self, folder: str) -> list[ParquetColumns]:
        """Open the Parquet files of a folder of chunks, in order."""
        found = []
        for chunk in entries(self.root / folder) if is_folder(self.root / folder) else []:
            if is_folder(chunk):
                found += [one for one in entries(chunk) if one.suffix == ".parquet"]
        if not found:
            raise CaptureError(f"{self.where}: has no {folder}/chunk-000/file-000.parquet")
        return [ParquetColumns(self.where, path, self.inside) for path in sorted(found)]


def read_json(where: str, root: Path, name: str, inside: Sequence[Path]) -> dict[str, Any] | None:
    """Return a JSON object of the dataset; None where there is no such file."""
    if not has_file(root / name):
        return None
    check_inside(where, root / name, inside)
    return json_object(f"{where}: {name}", read_text(where, root / name, max_bytes=MAX_TEXT), error=CaptureError)


def is_dataset(path: Path) -> bool:
    """Whether a folder is a dataset."""
    return is_file(path / INFO) and (path / "data").is_dir()


def dataset_of(path: Path) -> Path:
    """Return the only dataset in a folder that is none itself, or the path as it is."""
    if is_dataset(path):
        return path
    try:
        found = entries(path) if is_folder(path) else []
    except CaptureError:
        return path
    inside = [entry for entry in found if is_dataset(entry)] if len(found) <= _MAX_LOOKED_INTO else []
    return inside[0] if len(inside) == 1 else path
