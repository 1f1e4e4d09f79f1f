"""Clouds that are already files: one ``.pcd`` or ``.ply``, or a folder of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pcdata.errors import CaptureError
from pcdata.files.opening import check_inside
from pcdata.io.clouds.pcd import read_pcd
from pcdata.io.clouds.ply import read_ply
from pcdata.io.sources.listing import (
    LinkTargets,
    absolute,
    entries,
    has_file,
    is_folder,
    unread_entries,
    visible_files,
)
from pcdata.io.sources.registry import register_layout
from pcdata.io.sources.source import Source
from pcdata.io.sources.timestamps import TIMESTAMPS, read_timestamps
from pcdata.structures import PointCloud

_READERS = {".pcd": read_pcd, ".ply": read_ply}


@register_layout
class CloudFilesSource(Source):
    """``NAME.pcd`` and ``NAME.ply`` files, each one cloud called NAME; other files in the folder do not matter."""

    kind = "clouds"
    needs = "one .pcd or .ply file, or a folder with such files in it; optional timestamps.json (seconds by NAME)"

    def __init__(
        self,
        path: Path,
        *,
        frame_id: str | None = None,
        metres_per_unit: float | None = None,
        labels_from: str | None = None,
        links_to: LinkTargets = (),
    ) -> None:
        """List the files.

        Args:
            path: a file or a folder.
            frame_id: the frame that the coordinates are in; None = as each file says, else ``camera``.
            metres_per_unit: None = as each file says, else metres, refused where the numbers do not look like metres.
            labels_from: the column that holds the labels; "" = none of them, None = found by its name.
            links_to: folders outside that links in the folder may lead to.

        Raises:
            CaptureError: there is no cloud file, or two differ in the suffix alone.
        """
        path = absolute(path)
        self.frame_id, self.metres_per_unit, self.labels_from = frame_id, metres_per_unit, labels_from
        self._files: dict[str, Path] = {}
        for file in visible_files(path, _is_cloud) if is_folder(path) else [path]:
            if file.stem in self._files:
                raise CaptureError(f"{path}: {self._files[file.stem].name} and {file.name} are both {file.stem!r}")
            self._files[file.stem] = file
        super().__init__(path, self._files, links_to)
        self.timestamps: dict[str, float] = {}  # seconds by id
        times = path / TIMESTAMPS
        if is_folder(path) and has_file(times):
            check_inside(str(self), times, [path, *self.links_to])
            self.timestamps = read_timestamps(times, self._ids)

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        """A cloud file, or a folder that holds one."""
        try:
            return any(_is_cloud(entry.name) for entry in (entries(path) if is_folder(path) else [path]))
        except CaptureError:
            return False

    def files(self, sample_id: str) -> dict[str, Path]:
        """Return the file of one sample."""
        return {"cloud": self._files[sample_id]}

    def unread(self) -> list[str]:
        """Name what is in the folder besides the clouds."""
        used = {*self._files.values(), self.path / TIMESTAMPS}
        return unread_entries(self.path, used) if is_folder(self.path) else []

    def _times(self) -> dict[str, float]:
        return self.timestamps

    def _load(self, sample_id: str) -> PointCloud:
        file = self._files[sample_id]
        read = _READERS[file.suffix.lower()]
        cloud = read(file, frame_id=self.frame_id, metres_per_unit=self.metres_per_unit, labels_from=self.labels_from)
        facts: dict[str, Any] = {**self.provenance(sample_id), "metres_per_unit": self.metres_per_unit or 1.0}
        if self.timestamps:
            facts["timestamps"] = [self.timestamps[sample_id]]
        return cloud.with_meta([{"sample_id": sample_id, "provenance": facts}])


def _is_cloud(name: str) -> bool:
    return Path(name).suffix.lower() in _READERS
