"""What a LeRobot dataset says of itself: its features, and in which row and at which second of a video each step is.

Source: LeRobot, ``datasets/utils.py``, ``dataset_metadata.py`` and ``dataset_reader.py`` (0.6), for version 3.0;
``convert_dataset_v21_to_v30.py`` for version 2, where every episode has files of its own.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CaptureError
from pcdata.files.opening import read_text
from pcdata.files.sample_names import name_some
from pcdata.files.strict_json import json_object
from pcdata.io.arrays.parquet import ParquetColumns
from pcdata.io.sources.lerobot_files import INDEX_COLUMNS, INFO, MAX_TEXT, TASKS_PATH, LeRobotFiles
from pcdata.io.sources.listing import has_file

_VIDEO_COLUMN = re.compile(r"videos/(.+)/chunk_index")
_VIDEO_PARTS = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
_MOST = 1 << 40  # of any number in the index
_LATEST = 1e9  # seconds into a video


@dataclass(frozen=True)
class RecordedEpisode:
    """One episode.

    Args:
        number: its ``episode_index``.
        file: of its rows, from the folder of the dataset.
        row: of its first step.
        seconds: (length,) of every step, by which its videos are read.
        tasks: (length,) the text of each step's task.
        videos: by key, the file and the seconds in it where the episode begins and ends.
    """

    number: int
    file: str
    row: int
    seconds: tuple[float, ...]
    tasks: tuple[str, ...]
    videos: Mapping[str, tuple[str, float, float]] = field(default_factory=dict)

    @property
    def length(self) -> int:
        """How many steps it has."""
        return len(self.seconds)


@dataclass(frozen=True)
class LeRobotIndex:
    """What is known of a dataset once it is opened.

    Args:
        info: ``meta/info.json``.
        features: of it, by key.
        fps: steps in a second.
        episodes: those whose rows are there, in order.
        absent: the numbers of episodes whose rows are not there, as after a download of some.
    """

    info: Mapping[str, Any]
    features: Mapping[str, Mapping[str, Any]]
    fps: float
    episodes: tuple[RecordedEpisode, ...]
    absent: tuple[int, ...]


def read_index(where: str, root: Path, inside: Sequence[Path]) -> LeRobotIndex:
    """Read all but pictures and features.

    Args:
        where: for messages.
        root: the folder.
        inside: what files may lie in, once links have been followed.

    Raises:
        CaptureError: a file is missing, damaged or outside, or its numbers contradict each other.
    """
    text = read_text(where, root / INFO, max_bytes=MAX_TEXT, inside=inside)
    info = json_object(f"{where}: {INFO}", text, error=CaptureError)
    version, features, fps = _version(where, info), _features(where, info), _fps(where, info)
    read = _episodes_v3 if version == 3 else _episodes_v2
    keys = [key for key, said in features.items() if "video" in str(said.get("dtype"))]
    listed, tasks = read(LeRobotFiles(where, root, inside, info, version), keys)
    episodes, absent = [], []
    files: dict[str, list[dict[str, Any]]] = {}
    for one in listed:
        files.setdefault(one["file"], []).append(one)
    for file, own in files.items():
        if has_file(root / file):
            episodes += _located(where, root / file, inside, own, tasks)
        else:
            absent += [one["number"] for one in own]
    if not episodes:
        raise CaptureError(f"{where}: none of its files of rows is there, such as {next(iter(files), 'any')}")
    return LeRobotIndex(info, features, fps, tuple(sorted(episodes, key=lambda one: one.number)), tuple(sorted(absent)))


def _version(where: str, info: Mapping[str, Any]) -> int:
    stated = info.get("codebase_version")
    match = re.fullmatch(r"v?([23])\.\d+(\.\d+)?", stated) if isinstance(stated, str) else None
    if match is None:
        raise CaptureError(
            f"{where}: {INFO}: codebase_version must be v2.0, v2.1 or v3.0, got {stated!r:.60}; convert it with the "
            "scripts of the lerobot package"
        )
    return int(match[1])


def _features(where: str, info: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    features = info.get("features")
    if not isinstance(features, dict) or not all(isinstance(said, dict) for said in features.values()):
        raise CaptureError(f"{where}: {INFO}: features must be an object of objects, got {features!r:.100}")
    for key, said in features.items():
        shape = said.get("shape", [1])
        sides = shape if isinstance(shape, list) else [shape]
        if not all(isinstance(side, int) and not isinstance(side, bool) and 0 <= side < 1 << 31 for side in sides):
            raise CaptureError(f"{where}: {INFO}: the shape of {key!r:.100} must be whole numbers, got {shape!r:.100}")
    return features


def _fps(where: str, info: Mapping[str, Any]) -> float:
    fps = info.get("fps")
    if isinstance(fps, bool) or not isinstance(fps, (int, float)) or not 0 < fps <= 1e6:
        raise CaptureError(f"{where}: {INFO}: fps must be steps in a second, got {fps!r:.60}")
    return float(fps)


def _episodes_v3(opened: LeRobotFiles, _: Sequence[str]) -> tuple[list[dict[str, Any]], dict[int, str]]:
    needed = ("episode_index", "length", "dataset_from_index", "data/chunk_index", "data/file_index")
    listed = []
    for table in opened.tables("meta/episodes"):
        try:
            # Of more than the features: depth without loss may be a video that the format does not know as one.
            found = (_VIDEO_COLUMN.fullmatch(name) for name in table.names)
            videos = [match[1] for match in found if match]
            parts = [f"videos/{key}/{part}" for key in videos for part in _VIDEO_PARTS]
            columns = {name: table.numbers(name) for name in (*needed, *parts)}
        finally:
            table.close()
        for row in range(table.num_rows):
            said = {name: _whole(opened.where, name, columns[name][row]) for name in needed}
            at = {}
            for key in videos:
                chunk, file = (
                    _whole(opened.where, part, columns[f"videos/{key}/{part}"][row])
                    for part in ("chunk_index", "file_index")
                )
                begin, end = (
                    float(columns[f"videos/{key}/{part}"][row]) for part in ("from_timestamp", "to_timestamp")
                )
                if not 0 <= begin < end < _LATEST:
                    raise CaptureError(
                        f"{opened.where}: videos/{key}: from_timestamp and to_timestamp must be seconds, one after the "
                        f"other, got {begin} and {end}"
                    )
                at[key] = (opened.video(key, chunk_index=chunk, file_index=file), begin, end)
            chunk, file = said["data/chunk_index"], said["data/file_index"]
            listed.append(
                {
                    "number": said["episode_index"],
                    "length": said["length"],
                    "first": said["dataset_from_index"],
                    "file": opened.rows(chunk_index=chunk, file_index=file),
                    "videos": at,
                }
            )
    _check_apart(opened.where, listed)
    _check_videos_apart(opened, listed)
    return listed, _tasks_v3(opened)


def _check_videos_apart(opened: LeRobotFiles, listed: list[dict[str, Any]]) -> None:
    """Require episodes that share no picture: each would show what the other did."""
    half = 0.5 / _fps(opened.where, opened.info)
    parts: dict[tuple[str, str], list[tuple[float, float, int]]] = {}
    for one in listed:
        for key, (file, begin, end) in one["videos"].items():
            parts.setdefault((key, file), []).append((begin, end, one["number"]))
    for (_, file), found in parts.items():
        for (_, end, _), (begin, _, number) in itertools.pairwise(sorted(found)):
            if begin < end - half:
                raise CaptureError(
                    f"{opened.where}: meta/episodes: episode {number} begins at {begin:g} s of {file}, before the end "
                    f"of another at {end:g} s"
                )


def _check_apart(where: str, listed: list[dict[str, Any]]) -> None:
    """Require episodes with numbers of their own that share no step."""
    if len({one["number"] for one in listed}) != len(listed):
        raise CaptureError(f"{where}: meta/episodes: two episodes have one episode_index")
    end = 0
    for one in sorted(listed, key=lambda one: int(one["first"])):
        if one["first"] < end:
            raise CaptureError(
                f"{where}: meta/episodes: episode {one['number']} begins at {one['first']}, before the end of another "
                f"at {end}"
            )
        end = one["first"] + one["length"]


def _tasks_v3(opened: LeRobotFiles) -> dict[int, str]:
    path = opened.root / TASKS_PATH
    if not has_file(path):
        return {}
    table = ParquetColumns(opened.where, path, opened.inside)
    try:
        # pandas writes an index without a name under one that it makes up.
        text = next((name for name in ("task", "__index_level_0__") if name in table.names), None)
        if text is None:
            raise CaptureError(f"{opened.where}: {path}: has no column task; it has {name_some(table.names)}")
        columns = table.table([text, "task_index"])
    finally:
        table.close()
    return _tasks(opened.where, [*zip(columns["task_index"], columns[text])])


def _episodes_v2(opened: LeRobotFiles, keys: Sequence[str]) -> tuple[list[dict[str, Any]], dict[int, str]]:
    chunks = opened.info.get("chunks_size", 1000)
    if not isinstance(chunks, int) or isinstance(chunks, bool) or not 0 < chunks < 1 << 31:
        raise CaptureError(f"{opened.where}: {INFO}: chunks_size must be a whole number from 1, got {chunks!r:.60}")
    listed, first = [], 0
    for said in opened.lines("meta/episodes.jsonl"):
        number = _whole(opened.where, "episode_index", said.get("episode_index"))
        length = _whole(opened.where, "length", said.get("length"))
        fields = {"episode_chunk": number // chunks, "chunk_index": number // chunks, "episode_index": number}
        listed.append(
            {
                "number": number,
                "length": length,
                "first": first,
                "file": opened.rows(**fields),
                "videos": {key: (opened.video(key, **fields), 0.0, math.inf) for key in keys},
            }
        )
        first += length
    _check_apart(opened.where, listed)
    told = opened.lines("meta/tasks.jsonl") if has_file(opened.root / "meta/tasks.jsonl") else []
    return listed, _tasks(opened.where, [(one.get("task_index"), one.get("task")) for one in told])


def _tasks(where: str, rows: list[tuple[Any, Any]]) -> dict[int, str]:
    found = {}
    for number, text in rows:
        if not isinstance(text, str):
            raise CaptureError(f"{where}: meta/tasks: a task must be a text, got {text!r:.100}")
        found[_whole(where, "task_index", number)] = text
    return found


def _located(
    where: str, path: Path, inside: Sequence[Path], listed: list[dict[str, Any]], tasks: Mapping[int, str]
) -> list[RecordedEpisode]:
    """Find the rows of the episodes of one file, and hold their own numbers to what the index says of them."""
    table = ParquetColumns(where, path, inside)
    try:
        numbers = {name: table.numbers(name) for name in INDEX_COLUMNS if name in table.names or name != "task_index"}
    finally:
        table.close()
    of = numbers["episode_index"]
    found = []
    for one in listed:
        rows = np.flatnonzero(of == one["number"])
        first = int(rows[0]) if len(rows) else 0
        if len(rows) != one["length"] or not len(rows) or int(rows[-1]) != first + len(rows) - 1:
            raise CaptureError(
                f"{where}: {path}: episode {one['number']} should have {one['length']} rows, one after another, but "
                f"{len(rows)} have its episode_index"
            )
        own = {name: values[first : first + len(rows)] for name, values in numbers.items()}
        if not np.array_equal(own["frame_index"], np.arange(len(rows))):
            raise CaptureError(f"{where}: {path}: frame_index of episode {one['number']} must count from 0")
        seconds = own["timestamp"].astype(np.float64)
        if not (np.isfinite(seconds).all() and (np.abs(seconds) < _LATEST).all()):
            raise CaptureError(f"{where}: {path}: timestamp of episode {one['number']} must be finite seconds")
        texts = _texts(where, own["task_index"], tasks) if "task_index" in own else ()
        found.append(RecordedEpisode(one["number"], one["file"], first, tuple(seconds.tolist()), texts, one["videos"]))
    return found


def _texts(where: str, numbers: NDArray[Any], tasks: Mapping[int, str]) -> tuple[str, ...]:
    if not tasks:
        return ()
    for number in np.unique(numbers).tolist():
        if number not in tasks:
            raise CaptureError(f"{where}: a step has task_index {number}, which meta/tasks does not have")
    return tuple(tasks[number] for number in numbers.tolist())


def _whole(where: str, name: str, value: Any) -> int:
    is_whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if isinstance(value, (float, np.floating)) and float(value).is_integer():  # pandas makes floats of gaps
        is_whole = True
    if not is_whole or not 0 <= value < _MOST:
        raise CaptureError(f"{where}: {name} must be a whole number from 0, got {value!s:.60}")
    return int(value)
