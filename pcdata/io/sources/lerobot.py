"""LeRobot datasets, version 3 and 2: depth in videos, images, arrays or raw files, signals in Parquet, episodes.

Source: see :mod:`pcdata.io.sources.lerobot_index` for the format and :mod:`pcdata.io.sources.lerobot_cameras` for the
names under which depth and cameras were seen.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pcdata.errors import CaptureError, PcdataError
from pcdata.files.handles import Handles
from pcdata.files.opening import check_inside
from pcdata.files.sample_names import check_known, name_some
from pcdata.io.arrays.parquet import ParquetColumns
from pcdata.io.sources.episode_file import EPISODES
from pcdata.io.sources.joined_views import join_views
from pcdata.io.sources.lerobot_cameras import DepthStream, check_direction
from pcdata.io.sources.lerobot_choice import (
    all_depth,
    check_cameras,
    check_sizes,
    chosen_cameras,
    unit_of_clouds,
)
from pcdata.io.sources.lerobot_clouds import CloudColumns, cloud_columns
from pcdata.io.sources.lerobot_episodes import episodes_of
from pcdata.io.sources.lerobot_facts import FACTS, IMAGES, facts_of_json
from pcdata.io.sources.lerobot_files import INDEX_COLUMNS, INFO, dataset_of, is_dataset, read_json
from pcdata.io.sources.lerobot_index import RecordedEpisode, read_index
from pcdata.io.sources.lerobot_pictures import Pictures
from pcdata.io.sources.lerobot_signals import signal_columns, signals_of
from pcdata.io.sources.lerobot_stated import lens_of, pose_of, unsaid_of, with_unit
from pcdata.io.sources.lerobot_views import View
from pcdata.io.sources.listed import checked_folder
from pcdata.io.sources.listing import LinkTargets, absolute, has_file, link_targets
from pcdata.io.sources.option_checks import check_invalid_values, check_name, check_switch
from pcdata.io.sources.registry import register_layout
from pcdata.io.sources.source import Source
from pcdata.io.sources.stated_kinds import stated_kinds
from pcdata.structures import DepthFrame, Episode, PointCloud, Signal


@register_layout
class _LeRobotSource(Source):
    """One step a sample, ``EPISODE-STEP``; the columns of numbers and texts are signals, the task is one too."""

    kind = "lerobot"
    needs = (
        "meta/info.json, data/ and videos/ of a LeRobot dataset of version 3.0 (or 2) with depth or point clouds; "
        "reading it needs pyarrow and av"
    )

    def __init__(
        self,
        path: Path,
        *,
        camera: str | Sequence[str] | None = None,
        clouds: bool | None = None,
        metres_per_unit: float | Mapping[str, float] | None = None,
        invalid_values: Collection[int] = (),
        intrinsics: Sequence[float] | Mapping[str, Sequence[float]] | None = None,
        extrinsics: str | None = None,
        frame_id: str | None = None,
        signals: Mapping[str, Any] | None = None,
        links_to: LinkTargets = (),
    ) -> None:
        """Read what the dataset says of itself, and where its steps are.

        Args:
            path: the folder, or one that holds one such folder.
            camera: read this one, or these in their order; None = all that have depth, as views of one sample.
            clouds: read the point clouds of ``observation.pointcloud``; None = where there is no depth.
            metres_per_unit: of stored depth, or of the coordinates of clouds, where the dataset does not state it; or
                of several cameras, by name.
            invalid_values: stored depths besides 0 that mean "no reading".
            intrinsics: fx, fy, cx, cy in pixels, where the dataset has none; or of several cameras, by name.
            extrinsics: where matrices called extrinsics lead, which their name does not say: ``camera_to_frame`` maps
                points of the camera into the frame, ``frame_to_camera`` the other way; None = they are not read.
            frame_id: the frame that poses lead to or that clouds are in, where the dataset does not state it.
            signals: kinds and frames of columns, such as ``{"action": {"kind": "position + invariant 1", "frame":
                "base"}}``; None for one leaves it out.
            links_to: folders outside that links in the dataset may lead to.

        Raises:
            CaptureError: the dataset is incomplete, damaged, or has neither depth nor clouds.
            UnitError, IntrinsicsError: it lacks the unit or the intrinsics of a camera that no option states.
            ConfigError: an option has no such value, or names what is not there.
            MissingExtraError: pyarrow is not installed, or av where there are videos.
        """
        given, path = absolute(path), checked_folder(self.kind, dataset_of(path), self.needs, INFO)
        where = f"{self.kind} source {path}"
        check_inside(where, path, [given, *link_targets(links_to)])
        self._inside = [path, *link_targets(links_to)]
        self._invalid = check_invalid_values(where, invalid_values)
        direction = check_direction(where, extrinsics)
        stated = stated_kinds(where, signals)
        self._index = read_index(where, path, self._inside)
        said = read_json(where, path, FACTS, self._inside)
        self._facts = None if said is None else facts_of_json(where, said, self._index.features)
        self._episode_by_number = {one.number: one for one in self._index.episodes}
        firsts = itertools.accumulate((one.length for one in self._index.episodes), initial=0)
        self._first_of = dict(zip(self._episode_by_number, firsts))
        self.path = path  # a first image may be read before all is known, to name the units that it fits
        self._pictures = Pictures(where, path, self._inside)
        self._rows = Handles(4)
        frame = check_name(where, "frame_id", frame_id)
        self._views: list[View] = []
        self._cloud: CloudColumns | None = None
        self._told: list[str] = []
        found = all_depth(where, path, self._inside, self._index, self._facts)
        for option, given_of in (("metres_per_unit", metres_per_unit), ("intrinsics", intrinsics)):
            check_cameras(where, option, given_of, [one.camera for one in found])
        self.frame_id = frame or "world"
        if clouds is not None:
            check_switch(where, "clouds", clouds)
        if clouds or (clouds is None and not found):
            self._cloud = cloud_columns(
                where, path, self._inside, self._index, self._facts, frame, unit_of_clouds(where, metres_per_unit)
            )
            self._told += [f"depth of {name_some(one.camera for one in found)}; clouds=false reads it"] * bool(found)
        else:
            if self._facts is not None and self._facts.frame_id is not None:
                self.frame_id = frame or self._facts.frame_id
            chosen = chosen_cameras(where, camera, found)
            self._told += [f"depth of camera {one.camera}" for one in found if one not in chosen]
            if any(one.color is None for one in chosen):  # views of a sample have color all, or none
                self._told += [
                    f"color {one.color} of camera {one.camera}, since not all cameras that are read have color"
                    for one in chosen
                    if one.color is not None
                ]
                chosen = [replace(one, color=None) for one in chosen]
            for stream in chosen:
                self._views.append(
                    self._view(where, stream, metres_per_unit, intrinsics, direction, is_only=len(found) == 1)
                )
            if any(view.pose is None for view in self._views):  # of poses the same
                self._told += [
                    f"poses {view.pose.column} of camera {view.stream.camera}, since those of others are not known"
                    for view in self._views
                    if view.pose is not None
                ]
                self._views = [replace(view, pose=None) for view in self._views]
            check_sizes(where, [view.stream for view in self._views])
        self._signals = signal_columns(where, self._index, self._facts, self._used(), stated)
        ids = [f"{one.number:06d}-{step:06d}" for one in self._index.episodes for step in range(one.length)]
        super().__init__(path, ids, links_to)

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        """``meta/info.json`` beside ``data``, or a folder with one such folder."""
        return is_dataset(dataset_of(path))

    # -- what is there ---------------------------------------------------------------------------------------------

    def _view(
        self, where: str, stream: DepthStream, units: Any, intrinsics: Any, direction: str | None, *, is_only: bool
    ) -> View:
        stream = with_unit(where, stream, units, lambda: self._first_image(stream))
        lens = lens_of(where, self._inside[0], self._inside, self._index, stream, intrinsics, is_only=is_only)
        self._told += unsaid_of(stream, direction)
        return View(stream, lens, pose_of(stream, direction))

    def _first_image(self, stream: DepthStream) -> NDArray[Any]:
        return self._pictures.stored(stream, self._index.episodes[0], 0, self._row)

    def _used(self) -> set[str]:
        """Return the columns that images, clouds and cameras are read from."""
        used = {name for view in self._views for name in view.columns}
        return used | set(self._cloud.columns if self._cloud is not None else ())

    # -- what a sample is ------------------------------------------------------------------------------------------

    @classmethod
    def glance(cls, path: Path) -> list[str]:
        """Name the features, as ``meta/info.json`` has them."""
        try:
            info = read_json(f"{cls.kind} source {path}", path, INFO, [path]) or {}
        except PcdataError:
            return []
        features = info.get("features")
        if not isinstance(features, dict):
            return []
        return [
            f"{name}: {one.get('dtype')!s:.40} {one.get('shape')!s:.60}"
            for name, one in features.items()
            if isinstance(one, dict)
        ]

    def files(self, sample_id: str) -> dict[str, Path]:
        """Return the files that a sample is in, with others: that of its rows, and those of its pictures."""
        return {role: self.path / file for role, file in self._files(sample_id).items()}

    def provenance(self, sample_id: str) -> dict[str, Any]:
        """Return the layout, the folder and the files of a sample."""
        return {"source": self.kind, "root": self.name, "files": self._files(sample_id)}

    def _files(self, sample_id: str) -> dict[str, str]:
        """Return files by role, from the folder."""
        episode, _ = self._place(sample_id)
        found = {"rows": episode.file}
        for stream in (view.stream for view in self._views):
            for role, key in (("depth", stream.key), ("color", stream.color)):
                file = None if key is None else self._pictures.file_of(stream, key, episode)
                if file is not None:
                    found[f"{stream.camera}_{role}"] = file
        return found

    def check_links(self, sample_id: str) -> None:
        """Leave it to whatever opens a file, which holds it to the same; files stay open from sample to sample."""

    def depth_files(self, sample_id: str) -> list[Path]:
        """Return none: many samples are in one file."""
        return []

    def unread(self) -> list[str]:
        """Name the features that are not read, and episodes whose files are not there."""
        used = self._used() | {*INDEX_COLUMNS}
        used |= {one.column for one in self._signals.values() if one.column is not None}
        if self._facts is not None:
            used |= {*self._facts.derived, *([self._facts.time] if self._facts.time else [])}
        left = [f"feature {key}" for key in self._index.features if key not in used]
        absent = [f"{len(self._index.absent)} episodes whose rows are not there"] * bool(self._index.absent)
        return [*self._told, *left, *absent]

    def signals(self, sample_id: str) -> Mapping[str, Signal]:
        """Read the signals of one sample alone.

        Raises:
            CaptureError: the sample is unknown, or a value is not of its kind.
        """
        check_known(str(self), sample_id, self._known)
        episode, step = self._place(sample_id)
        columns = [one.column for one in self._signals.values() if one.column is not None]
        return signals_of(str(self), self._signals, episode, step, self._row(episode, step, columns))

    def _read_episodes(self) -> list[Episode]:
        if has_file(self.path / EPISODES):  # what is said beside a capture goes before what it says
            return super()._read_episodes()
        return episodes_of(str(self), self._index, self._facts, self._signals, self._own_times())

    def _own_times(self) -> list[list[float]] | None:
        """Return the seconds of every step as they were recorded, where the dataset keeps them."""
        if self._facts is None or self._facts.time is None:
            return None
        by_file: dict[str, NDArray[Any]] = {}
        for one in self._index.episodes:
            if one.file not in by_file:
                with self._opened(one.file) as table:
                    by_file[one.file] = table.numbers(self._facts.time)
        return [by_file[one.file][one.row : one.row + one.length].tolist() for one in self._index.episodes]

    def _times(self) -> dict[str, float]:
        return {
            f"{one.number:06d}-{step:06d}": seconds
            for one in self._index.episodes
            for step, seconds in enumerate(one.seconds)
        }

    def _place(self, sample_id: str) -> tuple[RecordedEpisode, int]:
        number, step = sample_id.split("-")
        return self._episode_by_number[int(number)], int(step)

    def _opened(self, file: str) -> Any:
        return self._rows.using(file, lambda: ParquetColumns(str(self), self.path / file, self._inside))

    def _row(self, episode: RecordedEpisode, step: int, columns: Sequence[str]) -> dict[str, Any]:
        if not columns:
            return {}
        with self._opened(episode.file) as table:
            found: dict[str, Any] = table.row(episode.row + step, columns)
            return found

    def _load(self, sample_id: str) -> DepthFrame | PointCloud:
        episode, step = self._place(sample_id)
        columns = [one.column for one in self._signals.values() if one.column is not None]
        columns += [name for view in self._views for name in view.numbers]
        row = self._row(episode, step, list(dict.fromkeys(columns)))
        signals = signals_of(str(self), self._signals, episode, step, row)
        facts = {
            **self.provenance(sample_id),
            "episode": episode.number,
            "timestamps": [episode.seconds[step]],
        }
        if self._cloud is not None:
            cloud = self._cloud.cloud(self._row(episode, step, self._cloud.columns))
            cloud = cloud.with_meta([{"sample_id": sample_id, "provenance": facts}])
            for name, signal in signals.items():
                cloud = cloud.with_signal(name, signal.values, signal.kind, signal.frame)
            return cloud
        index = self._first_of[episode.number] + step
        facts["cameras"] = [view.stream.camera for view in self._views]
        first = self._frame(sample_id, index, self._views[0], episode, step, row, facts, signals)
        if len(self._views) == 1:
            return first
        others = [self._frame(sample_id, index, view, episode, step, row, facts, {}) for view in self._views[1:]]
        return join_views([first, *others], _shared([one.provenance for one in (first, *others)]))

    def _frame(
        self,
        sample_id: str,
        index: int,
        view: View,
        episode: RecordedEpisode,
        step: int,
        row: Mapping[str, Any],
        facts: Mapping[str, Any],
        signals: Mapping[str, Signal],
    ) -> DepthFrame:
        stream = view.stream
        where = f"{self}: camera {stream.camera!r}"
        depth, about = self._pictures.depth(stream, episode, step, self._row, self._invalid)
        size = (depth.shape[0], depth.shape[1])
        camera, turn = view.lens.camera(where, size, row)
        colors = None
        if stream.color is not None:
            color = self._pictures.color(stream.color, episode, step, self._row)
            if color.shape[:2] != depth.shape:
                raise CaptureError(
                    f"{where}: its color image {stream.color} has {color.shape[1]}x{color.shape[0]} pixels, its depth "
                    f"{size[1]}x{size[0]}; they are of one size or not of one camera"
                )
            colors = torch.from_numpy(color)[None]
        beside = {
            role: torch.from_numpy(self._pictures.beside(key, episode, step).astype(np.int64))[None]
            for role, key in stream.images.items()
        }
        labels, mask, levels = (beside.get(role) for role in IMAGES)
        world = None if view.pose is None else (view.pose.matrix(where, row) @ turn)[None]
        return DepthFrame(
            depth=torch.from_numpy(depth)[None],
            camera=camera,
            colors=colors,
            labels=None if labels is None else labels - 1,
            mask=None if mask is None else mask != 0,
            confidence=None if levels is None else levels.clamp(0, 255).to(torch.uint8),
            world_from_camera=world,
            frame_id=None if world is None else self.frame_id,
            sample_id=sample_id,
            capture_index=index,
            provenance={**facts, **about},
            recorded_signals=signals,
        )


def _shared(facts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    return {key: value for key, value in facts[0].items() if all(one.get(key) == value for one in facts)}
