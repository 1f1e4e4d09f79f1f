"""Captures whose layout is a list: of every sample the depth images, what lies beside them, and what is known of each.

A layout of this kind says how its files are found; reading them, registering color, the checks and what is told of them
are the same for all.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from torch import Tensor

from pcdata.contracts.lengths import check_metres_per_unit, ways
from pcdata.errors import CaptureError, ConfigError, IntrinsicsError, PcdataError, UnitError
from pcdata.files.sample_names import check_known, name_some, positions
from pcdata.functional.depth.unit_fit import WORTH_NAMING, likely_fits, unit_fits, units_in_words
from pcdata.io.images.reading import read_color, read_raw_depth
from pcdata.io.sources.frame_files import make_frame
from pcdata.io.sources.joined_views import join_views
from pcdata.io.sources.listing import LinkTargets, absolute, is_folder, unread_entries, visible_files
from pcdata.io.sources.option_checks import check_name, check_pinhole
from pcdata.io.sources.source import Source
from pcdata.structures import Camera, DepthFrame, Signal, register_to_color

Size = tuple[int, int]  # (height, width)
ONE_IMAGE = "Give the path of one image instead of the folder"  # the advice where images are of several units


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredView:
    """One depth image in files: how it is read, of what camera it is, and what lies beside it.

    Args:
        files: by role: ``depth``, and images of the same pixels as ``color``, ``labels``, ``mask``, ``confidence``.
        read: from the depth file to (H, W) float32 metres, 0 = no reading.
        camera: of an image of this size; a function that can be pickled, such as a ``partial`` of ``pinhole``.
        pose: (4, 4) float64, where the camera is; or a function that reads it; None = not known.
        readers: images that are stored in a way of their own, by role; functions of the depth's size.
        color: the color image of another camera, its camera, and the (4, 4) color from depth.
        facts: JSON-able, for the provenance.
        signals: of the moment, B = 1; those of the first view of a sample are the sample's.
    """

    files: Mapping[str, Path]
    read: Callable[[Path], Tensor]
    camera: Callable[[Size], Camera]
    pose: Tensor | Callable[[], Tensor] | None = None
    readers: Mapping[str, Callable[[Size], Tensor]] = field(default_factory=dict)
    color: tuple[Path, Callable[[Size], Camera], Tensor] | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)
    signals: Mapping[str, Signal] = field(default_factory=dict)


class ListedSource(Source):
    """Samples as a layout of its own lists them; for readers, see :class:`StoredView`."""

    def __init__(
        self,
        path: Path,
        views: Mapping[str, StoredView | Mapping[str, StoredView]],
        *,
        frame_id: str = "world",
        registered: bool = False,
        background_label: int | None = None,
        read: Iterable[Path] = (),
        skipped: Mapping[str, str] | None = None,
        unread: Iterable[str] = (),
        links_to: LinkTargets = (),
    ) -> None:
        """Take the list.

        Args:
            path: the folder or file.
            views: by sample, the one view, or several by the names of their cameras.
            frame_id: where the poses lead to.
            registered: register depth to the color image of another camera, where a view has one.
            background_label: the label in the files that means "no object" and becomes -1; None = keep all.
            read: what else was read, such as a calibration.
            skipped: samples that were left out, and why.
            unread: what is not read although it could be, in words.
            links_to: folders outside that links in the capture may lead to.

        Raises:
            CaptureError: there is no sample, or two names cannot be told apart.
        """
        self._views = views
        self._registered = registered
        self._background_label = background_label
        self._read = tuple(read)
        self._told = tuple(unread)
        super().__init__(path, views, links_to)
        self._skipped = dict(skipped or {})
        self.frame_id = check_name(str(self), "frame_id", frame_id) or "world"
        self._positions = positions(self._ids)

    def files(self, sample_id: str) -> dict[str, Path]:
        """Return the files of one sample by role, of several cameras by camera and role."""
        found: dict[str, Path] = {}
        for name, view in self._named(sample_id).items():
            color = {"color": view.color[0]} if view.color is not None and self._registered else {}
            found |= {f"{name}/{role}" if name else role: file for role, file in {**view.files, **color}.items()}
        return found

    def depth_files(self, sample_id: str) -> list[Path]:
        """Return the depth image of every view."""
        return [view.files["depth"] for view in self._named(sample_id).values()]

    def unread(self) -> list[str]:
        """Name what is in the folder besides what is read, and what is not read although it could be."""
        if not is_folder(self.path):
            return list(self._told)
        used = {file for sample_id in self._views for file in self.files(sample_id).values()}
        inside = {file for file in (*used, *self._read) if file.is_relative_to(self.path)}
        return [*self._told, *unread_entries(self.path, inside)]

    def _times(self) -> dict[str, float]:
        taken = {}
        for name in self._ids:
            times = next(iter(self._named(name).values())).facts.get("timestamps")
            if not times:
                return {}
            taken[name] = float(times[0])
        return taken

    def _named(self, sample_id: str) -> Mapping[str, StoredView]:
        views = self._views[sample_id]
        return {"": views} if isinstance(views, StoredView) else views

    def signals(self, sample_id: str) -> Mapping[str, Signal]:
        """Return the signals of one sample, which were read with the list.

        Raises:
            CaptureError: the sample is unknown.
        """
        check_known(str(self), sample_id, self._known)
        return dict(next(iter(self._named(sample_id).values())).signals)

    def _load(self, sample_id: str) -> DepthFrame:
        views = self._named(sample_id)
        frames = [self._frame(sample_id, view) for view in views.values()]
        frame = frames[0]
        if len(frames) > 1 or "" not in views:
            facts = [frame.provenance for frame in frames]
            shared = {key: value for key, value in facts[0].items() if all(one.get(key) == value for one in facts)}
            frame = join_views(frames, {**shared, "cameras": list(views)})
        signals = self.signals(sample_id)
        return replace(frame, recorded_signals=signals) if signals else frame

    def _frame(self, sample_id: str, view: StoredView) -> DepthFrame:
        files = {role: file for role, file in view.files.items() if role not in view.readers}
        depth = view.read(view.files["depth"])
        size = (depth.shape[0], depth.shape[1])
        pose = view.pose() if callable(view.pose) else view.pose
        frame = make_frame(
            files,
            depth=depth,
            camera=_camera(view.files["depth"], view.camera, size),
            sample_id=sample_id,
            frame_id=self.frame_id,
            capture_index=self._positions[sample_id],
            provenance={**self.provenance(sample_id), **view.facts},
            background_label=self._background_label,
            images={role: read(size) for role, read in view.readers.items()},
        )
        if pose is not None:
            frame = replace(frame, world_from_camera=pose[None], frame_id=self.frame_id)
        if view.color is None or not self._registered:
            return frame
        file, camera, color_from_depth = view.color
        colors = read_color(file)
        return register_to_color(
            frame, colors[None], _camera(file, camera, (colors.shape[0], colors.shape[1])), color_from_depth
        )


def _camera(file: Path, camera: Callable[[Size], Camera], size: Size) -> Camera:
    try:
        return camera(size)
    except PcdataError as error:
        raise IntrinsicsError(f"{file}: {error}") from error


def stated_intrinsics(where: str, values: Any, advice: str) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy that somebody had to state.

    Raises:
        IntrinsicsError: nobody has.
        ConfigError: they are no four numbers.
    """
    if values is None:
        raise IntrinsicsError(
            f"{where}: no file states the intrinsics; say intrinsics=(fx, fy, cx, cy) in pixels "
            f"(--intrinsics FX FY CX CY){advice}"
        )
    return check_pinhole(where, values)


def stated_unit(where: str, unit: float | None, depth: Path, others: Sequence[Path] = ()) -> float:
    """Return the length of one stored unit, which somebody had to state.

    Raises:
        UnitError: nobody has; names the units that the first image fits, or that the others do not fit the same.
    """
    if unit is not None:
        return check_metres_per_unit(where, unit)
    raw = read_raw_depth(where, depth)
    fits = likely_fits(raw)
    if not fits:
        raise UnitError(f"{where}: no file states the unit of depth; {ways(float(raw.max(initial=0)))}")
    best = fits[0].unit
    own = {fit.unit: fit.probability for fit in unit_fits(raw)}
    for other in others:
        theirs = {fit.unit: fit.probability for fit in unit_fits(read_raw_depth(where, other))}
        likely = max(theirs, key=lambda unit: theirs[unit], default=best)
        if theirs and min(theirs.get(best, 0.0), own.get(likely, 0.0)) < WORTH_NAMING:
            raise UnitError(
                f"{where}: no file states the unit of depth, and by their numbers the images are not of the same: "
                f"{depth.name} may be {best}, {other.name} {likely}. {ONE_IMAGE}, and its unit with it"
            )
    order = "" if best.encoding == "plain" else f" --depth-encoding {best.encoding}"
    raise UnitError(
        f"{where}: no file states the unit of depth; by its numbers {depth.name} may be {units_in_words(fits)}. Say "
        f"the one that it is, such as {best} (--metres-per-unit {best.metres:.10g}{order})"
    )


def files_by_id(folder: Path, pattern: str) -> dict[str, Path]:
    """Return the files of a folder whose whole name fits, by the group ``id`` of the pattern.

    Raises:
        CaptureError: the folder cannot be listed, or two files are of one id.
    """
    fits = re.compile(pattern)
    found: dict[str, Path] = {}
    for file in visible_files(folder, lambda name: fits.fullmatch(name) is not None):
        match = fits.fullmatch(file.name)
        name = "" if match is None else match["id"]
        if name in found:
            raise CaptureError(f"{folder}: {found[name].name} and {file.name} are of one frame; remove one")
        found[name] = file
    return found


def checked_folder(kind: str, path: Path, needs: str, *parts: str) -> Path:
    """Return a folder as an absolute path; it must have these files and folders in it.

    Raises:
        CaptureError: it is none, or lacks one.
    """
    path = absolute(path)
    if not is_folder(path):
        raise CaptureError(f"{kind} source {path}: is no folder; this layout needs {needs}")
    if missing := [part for part in parts if not os.path.lexists(path / part)]:
        raise CaptureError(f"{kind} source {path}: has no {name_some(missing)}; this layout needs {needs}")
    return path


def one_of(where: str, option: str, name: str | None, names: Sequence[str]) -> str:
    """Return the one that is named, or the only one there is.

    Raises:
        CaptureError: there are several and none is named.
        ConfigError: none is called so.
    """
    if name is None and len(names) == 1:
        return names[0]
    if name is None:
        raise CaptureError(f"{where}: holds {', '.join(names)}; say which: {option}={names[0]} (--{option} {names[0]})")
    if name not in names:
        raise ConfigError(f"{where}: {option} {name!r} is not there; it has {', '.join(names)}")
    return name


def unread_cameras(names: Sequence[str], chosen: Sequence[str]) -> list[str]:
    """Name the cameras that are there and not chosen, in one line; no line where there are none."""
    others = [name for name in names if name not in chosen]
    return [f"{len(others)} other cameras: {name_some(others)}"] if others else []
