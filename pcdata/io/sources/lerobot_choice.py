"""Which of the depth in a LeRobot dataset is read: what there is, and what options name of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pcdata.contracts.lengths import check_metres_per_unit
from pcdata.errors import CaptureError, ConfigError, near_matches
from pcdata.io.sources.lerobot_cameras import DepthStream, depth_streams, with_partners
from pcdata.io.sources.lerobot_facts import DatasetFacts
from pcdata.io.sources.lerobot_index import LeRobotIndex
from pcdata.io.sources.lerobot_sidecars import depth_beside


def all_depth(
    where: str, path: Path, inside: Sequence[Path], index: LeRobotIndex, facts: DatasetFacts | None
) -> list[DepthStream]:
    """Return the depth of every camera: as the dataset's own facts say, else of its features and beside them."""
    if facts is not None:
        return [one.stream() for one in facts.cameras]
    files = index.episodes[0].videos
    lossless = [
        key for key in files if any(one.videos[key][0].endswith(".mkv") for one in index.episodes if key in one.videos)
    ]
    found = depth_streams(where, index.features, lossless)
    found += [
        DepthStream(camera=key, key=key, storage="video")
        for key in files
        if key not in index.features and "depth" in key
    ]
    found += depth_beside(where, path, inside, index)
    return [with_partners(one, len(found), index.features) for one in found]


def chosen_cameras(where: str, camera: Any, found: list[DepthStream]) -> list[DepthStream]:
    """Return the cameras that an option names, in its order; None = all.

    Raises:
        ConfigError: it names none, or one that is not there.
    """
    names = [one.camera for one in found]
    if camera is None:
        return found
    wanted = [camera] if isinstance(camera, str) else camera
    if not isinstance(wanted, (list, tuple)) or not wanted or not all(isinstance(name, str) for name in wanted):
        raise ConfigError(f"{where}: camera must be a name, or a list of names, got {camera!r:.100}")
    for name in wanted:
        if name not in names:
            raise ConfigError(
                f"{where}: there is no depth of a camera {name!r:.100}{near_matches(name, names)}; there is of "
                f"{', '.join(names) or 'none'}"
            )
    return [found[names.index(name)] for name in dict.fromkeys(wanted)]


def check_cameras(where: str, option: str, given: Any, names: Sequence[str]) -> None:
    """Require an option that is told of cameras by name to name those that are there."""
    for name in given if isinstance(given, Mapping) else ():
        if name not in names:
            raise ConfigError(
                f"{where}: {option}: there is no depth of a camera {name!r:.100}{near_matches(str(name), names)}; "
                f"there is of {', '.join(names) or 'none'}"
            )


def check_sizes(where: str, streams: Sequence[DepthStream]) -> None:
    """Require images of one size, as far as it is stated."""
    sizes = {one.camera: one.size for one in streams if one.size is not None}
    if len(set(sizes.values())) > 1:
        told = ", ".join(f"{name} {size[1]}x{size[0]}" for name, size in sizes.items())
        raise CaptureError(
            f"{where}: its cameras have images of different sizes ({told}), which are no views of one sample; say "
            "which to read: camera=NAME (--camera NAME)"
        )


def unit_of_clouds(where: str, unit: Any) -> float | None:
    """Return the unit of coordinates, which are of no camera."""
    if isinstance(unit, Mapping):
        raise ConfigError(f"{where}: metres_per_unit of clouds must be one number, got {unit!r:.100}")
    return None if unit is None else check_metres_per_unit(where, unit)
