"""The files of a LeRobot dataset, version 3.0, while captures are added to it step by step.

Source: LeRobot 0.6, ``datasets/dataset_writer.py``, ``dataset_metadata.py``, ``feature_utils.py``.
"""

from __future__ import annotations

import itertools
import json
import statistics
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import ConfigError
from pcdata.io.sources.lerobot_facts import FACTS, DatasetFacts, EpisodeFacts
from pcdata.io.sources.lerobot_files import DATA_PATH, INFO, VIDEO_PATH
from pcdata.io.writers.lerobot_camera_files import CameraWriter
from pcdata.io.writers.lerobot_columns import (
    camera_names,
    check_alike,
    check_same_signals,
    derived_columns,
    derived_value,
    index_features,
    named_signals,
    number_feature,
    signal_columns,
    signal_features,
    signal_value,
)
from pcdata.io.writers.lerobot_options import LeRobotOptions
from pcdata.io.writers.lerobot_points import point_columns, point_features
from pcdata.io.writers.lerobot_stats import AllStats, Stats, stats_of
from pcdata.io.writers.lerobot_tables import FILE_MEGABYTES, RowsWriter, write_episodes_table, write_tasks_table
from pcdata.io.writers.lerobot_videos import FILE_MEGABYTES as VIDEO_MEGABYTES
from pcdata.io.writers.lerobot_videos import FILES_IN_CHUNK, VideoWriter
from pcdata.io.writers.writer import Captures
from pcdata.structures import CAMERA_FRAME, DepthFrame, Episode, Signal

_USUAL_RATE = 10  # as convert's other writers space captures without times
_TIME = "recorded_time"
_STATE, _ACTION = "observation.state", "action"
_MOST_IN_STATS = 1 << 14  # numbers of a feature: an image or a cloud of numbers is normalized by nobody


class GrowingDataset:
    """The files that grow, one step at a time."""

    def __init__(
        self,
        options: LeRobotOptions,
        captures: Captures,
        folder: Path,
        sample_id: str,
        first: DepthFrame,
        parts: Sequence[Episode],
    ) -> None:
        self._options, self._captures, self._folder = options, captures, folder
        self._first_id, self._first = sample_id, first
        self._fps = self._rate(parts)
        self._signals = signal_columns(f"lerobot: {sample_id}", first.recorded_signals)
        self._derived: dict[str, Sequence[str]] = {}
        self._features: dict[str, dict[str, Any]] = signal_features(self._signals)
        for option, column, given in (("state", _STATE, options.state), ("action", _ACTION, options.action)):
            names = named_signals("lerobot", option, given)
            feature = derived_columns("lerobot", option, column, names, self._signals, options.poses)
            if feature is not None:
                self._features[column] = feature
                self._derived[column] = names
        self._has_times = any(one.times for one in parts)
        if self._has_times:
            self._features[_TIME] = number_feature("float64", [1])
        names = camera_names(first)
        self._cameras = [
            CameraWriter(
                captures,
                folder,
                self._fps,
                first,
                view,
                name,
                depth=options.depth,
                metres_per_unit=options.metres_per_unit,
                color=options.color,
                registered_to=options.registered_to,
            )
            for view, name in enumerate(names)
        ]
        for camera in self._cameras:
            self._features |= camera.features
        if options.points:
            self._features |= point_features(first, options.points)
        self._features |= index_features()
        self._rows = RowsWriter(folder, self._features)
        self._tasks: dict[str, int] = {}
        self._episodes: list[dict[str, Any]] = []
        self._episode_facts: list[EpisodeFacts] = []
        self._all_stats = AllStats()
        self._count = 0  # steps so far
        self._check_partners()

    def _rate(self, parts: Sequence[Episode]) -> int:
        """Return the steps in a second, a whole number as LeRobot has them."""
        fps = self._options.fps
        if fps is not None:
            if round(fps) != fps:
                raise ConfigError(f"lerobot: fps must be a whole number, got {fps:g}")
            return int(fps)
        gaps = [later - time for one in parts for time, later in itertools.pairwise(one.times) if later > time]
        if not gaps:
            self._captures.note(f"captures have no times: {_USUAL_RATE} steps in a second (fps says another)")
            return _USUAL_RATE
        return max(1, round(1 / statistics.median(gaps)))

    # -- what is written -------------------------------------------------------------------------------------------

    def _check_partners(self) -> None:
        if not self._signals:
            self._captures.note("captures have no signals, so the dataset has neither state nor action")
        elif _STATE not in self._features:
            self._captures.note(
                f"there is no {_STATE}, which LeRobot's policies take; state=NAME,NAME (--set) makes it of signals"
            )
        if _ACTION not in self._features and self._signals:
            self._captures.note("there is no action; action=NAME,NAME (--set) makes it of signals")

    # -- step after step -------------------------------------------------------------------------------------------

    def begin(self, episode: Episode) -> None:
        """Start an episode."""
        self._step = 0
        self._episode = episode
        self._of_episode: dict[str, list[NDArray[Any]]] = {}
        self._before: dict[str, NDArray[np.float32]] = {}  # of the step before, by column
        for camera in self._cameras:
            camera.begin()
        self._tasks_of_episode: dict[str, None] = {}
        self._place: dict[str, Any] = {f"data/{name}": value for name, value in self._rows.begin_episode().items()}
        for _, key, video in self._videos():
            self._place |= {f"videos/{key}/{name}": value for name, value in video.begin_episode().items()}

    def add(self, sample_id: str, frame: DepthFrame) -> None:
        """Add a step.

        Raises:
            CaptureError: it has other cameras, images or signals than the first.
        """
        check_alike(sample_id, frame, self._first_id, self._first)
        check_same_signals(sample_id, frame, self._first_id, self._signals)
        row: dict[str, Any] = {}
        for name, one in self._signals.items():
            if one.column is not None:
                row[one.column] = signal_value(one, frame.recorded_signals[name])
        for column, names in self._derived.items():
            before = self._before.get(column)
            row[column] = derived_value(names, frame.recorded_signals, self._options.poses, before)
            self._before[column] = row[column]
        lost = [camera.add(row, frame) for camera in self._cameras]
        off, beyond = max(metres for metres, _ in lost), sum(values for _, values in lost)
        if off or beyond:
            unit = self._options.metres_per_unit
            how = f"rounded to whole units of {unit:g} m; no reading where 16 bits do not hold it"
            self._captures.lose("depth", how, metres=off, values=beyond, captures=1)
        task = self._task(frame.recorded_signals)
        self._tasks_of_episode[task] = None
        row |= {
            "timestamp": np.array([self._step / self._fps], np.float32),
            "frame_index": np.array([self._step]),
            "episode_index": np.array([len(self._episodes)]),
            "index": np.array([self._count]),
            "task_index": np.array([self._tasks.setdefault(task, len(self._tasks))]),
        }
        if self._options.points:
            row |= point_columns(frame, self._options.points)
        if self._has_times:
            times = self._episode.times
            row[_TIME] = np.array([times[self._step] if times else self._step / self._fps])
        for key, said in self._features.items():
            if said["dtype"] not in ("string", "image", "video") and np.prod(said["shape"]) <= _MOST_IN_STATS:
                self._of_episode.setdefault(key, []).append(row[key])
        self._rows.add(row)
        self._step += 1
        self._count += 1

    def _task(self, signals: Mapping[str, Signal]) -> str:
        name = next((name for name, one in self._signals.items() if one.column is None), None)
        if name is not None:
            return str(signals[name].values[0])
        stated = next((self._episode.attributes.get(key) for key in ("task", "instruction")), None)
        return stated if isinstance(stated, str) else ""

    def end(self, episode: Episode) -> None:
        """End an episode."""
        self._rows.end_episode()
        for _, key, video in self._videos():
            self._place[f"videos/{key}/to_timestamp"] = video.end_episode()
        stats: dict[str, Stats] = {
            key: stats_of(np.stack(values), self._step) for key, values in self._of_episode.items()
        }
        colors = ((camera.facts.color, camera.color_stats) for camera in self._cameras)
        stats |= {key: one.stats() for key, one in colors if key is not None}
        self._all_stats.add(stats)
        self._episodes.append(
            {
                "episode_index": len(self._episodes),
                "tasks": list(self._tasks_of_episode),
                "length": self._step,
                **self._place,
                "dataset_from_index": self._count - self._step,
                "dataset_to_index": self._count,
                **{f"stats/{key}/{name}": value.tolist() for key, one in stats.items() for name, value in one.items()},
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
        )
        is_episode = any(episode is one for one in self._captures.episodes)
        self._episode_facts.append(EpisodeFacts(episode.id, is_episode, dict(episode.attributes)))

    def close(self) -> None:
        """Write what is known at the end."""
        self._rows.close()
        for role, key, video in self._videos():
            video.close()
            if role == "color":
                self._features[key]["info"] = video.info()
        write_episodes_table(self._folder, self._episodes)
        write_tasks_table(self._folder, list(self._tasks))
        info = {
            "codebase_version": "v3.0",
            "robot_type": self._options.robot_type,
            "total_episodes": len(self._episodes),
            "total_frames": self._count,
            "total_tasks": len(self._tasks),
            "chunks_size": FILES_IN_CHUNK,
            "data_files_size_in_mb": FILE_MEGABYTES,
            "video_files_size_in_mb": VIDEO_MEGABYTES,
            "fps": self._fps,
            "splits": {"train": f"0:{len(self._episodes)}"},
            "data_path": DATA_PATH,
            "video_path": VIDEO_PATH,
            "features": self._features,
        }
        if self._options.points:
            frame = self._first.frame_id or CAMERA_FRAME
            (self._folder / "conversion_info.json").write_text(json.dumps({"frame_id": frame, "unit": "m"}) + "\n")
        facts = DatasetFacts(
            frame_id=self._first.frame_id,
            cameras=tuple(camera.facts for camera in self._cameras),
            signals=self._signals,
            episodes=tuple(self._episode_facts),
            time=_TIME if self._has_times else None,
            derived=tuple(self._derived),
        )
        for name, content in (
            (INFO, info),
            ("meta/stats.json", self._all_stats.as_json()),
            (FACTS, facts.as_json()),
        ):
            text = json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False)
            (self._folder / name).write_text(text + "\n", encoding="utf-8")

    def abandon(self) -> None:
        """Close the files after a failure, whatever that says."""
        for _, _, video in self._videos():
            with suppress(Exception):
                video.abandon()
        with suppress(Exception):
            self._rows.close()

    def _videos(self) -> list[tuple[str, str, VideoWriter]]:
        return [video for camera in self._cameras for video in camera.videos()]
