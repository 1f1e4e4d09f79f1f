"""Depth that lies beside a LeRobot dataset and is none of its features: three layouts seen in the wild.

``depth_meta.json`` with 12-bit videos, one for each episode (EmbodiChain); ``depth/episode_000000.bin`` with
``depth_config.json``, raw 16-bit numbers; and ``.mkv`` videos whose key is in no list, in version 2.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pcdata.errors import CaptureError, UnitError
from pcdata.io.sources.lerobot_cameras import (
    DepthStream,
    camera_of,
    facts_of_sidecar,
    quantized_of,
    size_of,
    unit_named,
)
from pcdata.io.sources.lerobot_files import read_json
from pcdata.io.sources.lerobot_index import LeRobotIndex
from pcdata.io.sources.listing import entries, has_file, is_folder

_META, _RAW_FOLDER = "depth_meta.json", "depth"
_CONFIGS = ("depth_config.json", "depth/depth_config.json", "meta/depth_config.json")
_CHUNK, _EPISODE, _RAW = re.compile(r"chunk-\d+"), re.compile(r"episode_(\d+)\.mkv"), re.compile(r"episode_(\d+)\.bin")


def depth_beside(where: str, root: Path, inside: Sequence[Path], index: LeRobotIndex) -> list[DepthStream]:
    """Return the depth beside a dataset.

    Raises:
        CaptureError, UnitError: what describes it cannot be read, or leads out of the dataset.
    """
    return [
        *_described_videos(where, root, inside),
        *_raw_numbers(where, root, inside),
        *_unlisted_videos(root, index),
    ]


def _described_videos(where: str, root: Path, inside: Sequence[Path]) -> list[DepthStream]:
    said = read_json(where, root, _META, inside)
    sensors = {} if said is None else said.get("sensors")
    if not isinstance(sensors, dict) or not all(isinstance(one, dict) for one in sensors.values()):
        raise CaptureError(f"{where}: {_META}: sensors must be an object of objects")
    found = []
    for name, about in sensors.items():
        episodes = about.get("episodes")
        if not isinstance(episodes, dict):
            raise CaptureError(f"{where}: {_META}: {name!r:.100} must list its episodes, got {episodes!r:.100}")
        files = {}
        for number, one in episodes.items():
            file = one.get("file") if isinstance(one, dict) else None
            if not number.isdecimal() or not isinstance(file, str) or not _is_inside(file):
                raise CaptureError(
                    f"{where}: {_META}: episode {number!r:.60} of {name!r:.60} must name a file in the dataset, got "
                    f"{file!r:.100}"
                )
            files[int(number)] = file
        found.append(
            DepthStream(
                camera=camera_of(name),
                key=name,
                storage="video",
                quantized=quantized_of(f"{where}: {_META}: {name}", about),
                size=size_of(about),
                files=files,
                facts=facts_of_sidecar(about),
            )
        )
    return found


def _raw_numbers(where: str, root: Path, inside: Sequence[Path]) -> list[DepthStream]:
    file = next((name for name in _CONFIGS if has_file(root / name)), None)
    said = None if file is None else read_json(where, root, file, inside)
    if said is None or not is_folder(root / _RAW_FOLDER):
        return []
    flat = {**said, **{key: value for one in said.values() if isinstance(one, dict) for key, value in one.items()}}
    sides = [flat.get("height"), flat.get("width")]
    if not all(isinstance(side, int) and not isinstance(side, bool) and 0 < side < 1 << 16 for side in sides):
        raise CaptureError(f"{where}: {file}: must state height and width in pixels, got {sides!r:.100}")
    dtype = flat.get("dtype", "uint16")
    if dtype not in ("uint16", "<u2", "u2"):
        raise CaptureError(f"{where}: {file}: dtype must be uint16, got {dtype!r:.60}")
    files = {
        int(match[1]): f"{_RAW_FOLDER}/{one.name}"
        for one in entries(root / _RAW_FOLDER)
        if (match := _RAW.fullmatch(one.name))
    }
    return [
        DepthStream(
            camera="camera",
            key=_RAW_FOLDER,
            storage="raw",
            metres_per_unit=_stated_unit(where, str(file), flat),
            size=(int(flat["height"]), int(flat["width"])),
            files=files,
        )
    ] * bool(files)


def _stated_unit(where: str, file: str, said: Mapping[str, Any]) -> float | None:
    for name in ("depth_unit", "depth_units", "unit", "units"):
        if said.get(name):
            unit = unit_named(said[name])
            if unit is None:
                raise UnitError(f"{where}: {file}: {name} {said[name]!r:.60} is no unit that is known, such as mm or m")
            return unit
    return None


def _unlisted_videos(root: Path, index: LeRobotIndex) -> list[DepthStream]:
    found: dict[str, dict[int, str]] = {}
    for chunk in entries(root / "videos") if is_folder(root / "videos") else []:
        if not _CHUNK.fullmatch(chunk.name) or not is_folder(chunk):
            continue
        for folder in entries(chunk):
            if folder.name in index.features or "depth" not in folder.name or not is_folder(folder):
                continue
            for file in entries(folder):
                if match := _EPISODE.fullmatch(file.name):
                    found.setdefault(folder.name, {})[int(match[1])] = file.relative_to(root).as_posix()
    return [DepthStream(camera_of(key), key, "video", files=files) for key, files in found.items()]


def intrinsics_beside(
    where: str, root: Path, inside: Sequence[Path], stream: DepthStream
) -> tuple[tuple[float, float, float, float], tuple[int, int] | None] | None:
    """Return fx, fy, cx, cy and the (height, width) they are of, from ``meta/camera_intrinsics.json``.

    Raises:
        CaptureError: the file has the camera, but no four numbers of it.
    """
    said = read_json(where, root, "meta/camera_intrinsics.json", inside)
    if said is None:
        return None
    cameras = said.get("cameras") if isinstance(said.get("cameras"), dict) else said
    for name in (stream.camera, stream.key, stream.color, f"observation.images.{stream.camera}"):
        about = cameras.get(name) if isinstance(cameras, dict) and name is not None else None
        if about is None:
            continue
        try:
            fx, fy, cx, cy = (float(about[key]) for key in ("fx", "fy", "cx", "cy"))
            size = (int(about["height"]), int(about["width"])) if "width" in about else None
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise CaptureError(
                f"{where}: meta/camera_intrinsics.json: {name!r:.60} must have fx, fy, cx and cy in pixels, got "
                f"{about!r:.200}"
            ) from error
        return (fx, fy, cx, cy), size
    return None


def _is_inside(path: str) -> bool:
    parts = path.replace("\\", "/").split("/")
    return not path.startswith(("/", "\\", "~")) and ".." not in parts and ":" not in path and "\0" not in path
