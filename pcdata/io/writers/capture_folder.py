"""Captures as plain folders that :func:`pcdata.open_source` reads back: one for each camera."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from pcdata.errors import CaptureError, WriteError, write_fault
from pcdata.files.sample_names import in_order_of_last_number
from pcdata.io.sources.episode_file import write_episodes
from pcdata.io.writers.file_names import file_names
from pcdata.io.writers.registry import register_writer
from pcdata.io.writers.view_folder import ViewFolder
from pcdata.io.writers.writer import KEPT, Captures, Writer
from pcdata.structures import DepthFrame


def write_capture(frame: DepthFrame, folder: str | os.PathLike[str]) -> None:
    """Write images, pose, signals and calibration of every view to ``folder/view<v>``, for ``open_source`` to read.

    Depth is a 16-bit PNG in the unit the capture came in where that loses nothing, else float32 metres.

    Raises:
        WriteError: a view is there already, or a file cannot be written.
    """
    frame = frame.cpu()
    views = [Path(folder) / f"view{v}" for v in range(frame.num_views)]
    if there := [view.name for view in views if os.path.lexists(view)]:
        raise WriteError(f"{folder}: has {there[0]} already, and nothing is written over; choose a new folder")
    try:
        for v, view in enumerate(views):
            written = ViewFolder(view)
            written.add("0", frame, v)
            written.close({})
    except OSError as error:
        raise WriteError(f"{folder}: cannot be written: {write_fault(error)}") from error


@register_writer
@dataclass(frozen=True, kw_only=True)
class _FolderWriter(Writer):
    """The layout ``folder`` for one camera, ``rig`` for several; with ``episodes.json`` and ``timestamps.json``."""

    kind: ClassVar[str] = "folder"
    layout: ClassVar[str] = "depth/NAME.png and the like, a folder for each of several cameras (layouts folder, rig)"
    keeps: ClassVar[frozenset[str]] = frozenset(KEPT)

    def write(self, captures: Captures, folder: Path) -> None:
        """Write all captures; what all share, such as the depth unit, is settled by the last."""
        names = dict(zip(captures.ids, file_names(captures.ids)))
        if renamed := sum(name != sample_id for sample_id, name in names.items()):
            captures.note(f"{renamed} captures have ids that no file can be called by, or not in this order: renamed")
        views: list[ViewFolder] = []
        for sample_id, frame in captures:
            if not views:
                views = _view_folders(frame, folder)
            if frame.num_views != len(views):
                raise CaptureError(
                    f"{sample_id}: has {frame.num_views} views, but those before it {len(views)}; write these apart "
                    "(--only, --skip)"
                )
            if len(views) > 1 and KEPT["sensor"](frame):
                captures.lose("sensor", "it is told of captures, not of each of their cameras", captures=1)
            for view, written in enumerate(views):
                written.add(names[sample_id], frame, view)
        times = captures.times()
        if times and len(times) < len(names):
            captures.lose("times", f"only {len(times)} of {len(names)} captures have one, and a folder has all or none")
            times = {}
        for written in views:
            written.close({names[sample_id]: time for sample_id, time in times.items()})
        if captures.episodes:
            write_episodes(folder, captures.episodes, list(names.values()))


def _view_folders(first: DepthFrame, folder: Path) -> list[ViewFolder]:
    if first.num_views == 1:
        return [ViewFolder(folder)]
    if first.world_from_camera is None:
        raise CaptureError(
            f"{first.sample_id}: its {first.num_views} cameras have no poses, so nobody could join them: open it with "
            "a calibration (--calibration and --frame), or write one camera at a time"
        )
    cameras = first.provenance.get("cameras")
    told = [*map(str, cameras)] if isinstance(cameras, list) and len(cameras) == first.num_views else []
    names = file_names(told or [f"view{v}" for v in range(first.num_views)], in_order_of_last_number)
    # The moment's signals are the same for all views; one folder that has them is enough.
    return [ViewFolder(folder / name, with_signals=not number) for number, name in enumerate(names)]
