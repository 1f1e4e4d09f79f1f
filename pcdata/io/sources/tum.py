"""TUM RGB-D sequences: ``depth.txt``, ``rgb.txt`` and ``groundtruth.txt`` list times, files and poses.

Source: Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012; file formats and intrinsics:
https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
"""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path

import numpy as np

from pcdata.contracts.lengths import check_metres_per_unit
from pcdata.errors import CaptureError
from pcdata.files.number_words import number_of
from pcdata.files.opening import read_text
from pcdata.io.calibration.foreign_cameras import pinhole
from pcdata.io.images.reading import read_depth
from pcdata.io.sources.folder_roles import is_within
from pcdata.io.sources.listed import ListedSource, StoredView, checked_folder, stated_intrinsics
from pcdata.io.sources.listing import LinkTargets, has_file, is_file, link_targets
from pcdata.io.sources.option_checks import check_seconds
from pcdata.io.sources.registry import register_layout
from pcdata.io.sources.synchronized import Trajectory, allow_more, nearest
from pcdata.io.sources.timestamps import LONGEST

_LISTS = {"depth": "depth.txt", "color": "rgb.txt"}
_POSES = "groundtruth.txt"
_MAX_BYTES = 1 << 27
_MOST_POSE_GAP = 5.0  # times the gap of images: the motion capture of the data set has a pose every 10 ms
_INTRINSICS = (
    "; the data set documents 525 525 319.5 239.5 for its own calibration-free default, and 517.3 516.5 318.6 255.3 "
    "(freiburg1), 520.9 521.0 325.1 249.7 (freiburg2), 535.4 539.2 320.1 247.6 (freiburg3) for the color camera, which "
    "depth is registered to"
)


@register_layout
class _TumSource(ListedSource):
    """Depth images with the color image nearest in time and the pose of their moment, on the clock of the depth.

    Depth images without a color image within ``max_time_apart``, or without poses around them within five times as
    much, are left out: ``skipped`` tells which and why. Poses are interpolated; times are seconds.
    """

    kind = "tum"
    is_one_recording = True
    needs = (
        "depth.txt (lines 'time file'), optional rgb.txt and groundtruth.txt (lines 'time tx ty tz qx qy qz qw', world "
        "from camera); intrinsics by the option"
    )

    def __init__(
        self,
        path: Path,
        *,
        intrinsics: tuple[float, float, float, float] | None = None,
        metres_per_unit: float = 0.0002,
        max_time_apart: float = 0.02,
        frame_id: str = "world",
        links_to: LinkTargets = (),
    ) -> None:
        """Read the lists.

        Args:
            path: the folder of one sequence.
            intrinsics: (fx, fy, cx, cy) in pixels, which the sequences do not state.
            metres_per_unit: length of one stored depth unit; the data set documents 1/5000 m.
            max_time_apart: seconds between depth and color.
            frame_id: the frame that the poses lead to.
            links_to: folders outside that links in the capture may lead to.

        Raises:
            CaptureError: a list is missing or is no such list, or no depth image has all its partners.
            IntrinsicsError: nobody states the intrinsics.
        """
        path = checked_folder(self.kind, path, self.needs, "depth.txt")
        where = f"{self.kind} source {path}"
        limit = check_seconds(where, "max_time_apart", max_time_apart)
        unit = check_metres_per_unit(where, metres_per_unit)
        allowed = [path, *link_targets(links_to)]
        lists = {role: path / name for role, name in _LISTS.items() if has_file(path / name)}
        rows = {role: _file_list(file, path, allowed) for role, file in lists.items()}
        track = _trajectory(path / _POSES, allowed) if has_file(path / _POSES) else None
        times = [time for time, _ in rows["depth"]]
        colors = nearest(times, [time for time, _ in rows.get("color", [])], limit)
        camera = partial(pinhole, numbers=stated_intrinsics(where, intrinsics, _INTRINSICS))
        views, skipped = dict[str, StoredView](), dict[str, str]()
        for place, (time, file) in enumerate(rows["depth"]):
            files, facts = {"depth": file}, {"metres_per_unit": unit, "timestamps": [time]}
            if "color" in rows and place not in colors.place:
                skipped[file.stem] = (
                    f"no color image within {limit:g} s, the nearest is {colors.apart.get(place, math.inf):.3g} s off"
                )
                continue
            if "color" in rows:
                other, files["color"] = rows["color"][colors.place[place]]
                facts["color_seconds_later"] = other - time
            if track is not None and track.gap(time) > _MOST_POSE_GAP * limit:
                skipped[file.stem] = f"no pose before and after it within {_MOST_POSE_GAP * limit:g} s"
                continue
            pose = None if track is None else track.pose(time)
            if file.stem in views:
                raise CaptureError(f"{where}: depth.txt names {file.stem!r} twice; remove one")
            views[file.stem] = StoredView(
                files=files, read=partial(read_depth, metres_per_unit=unit), camera=camera, pose=pose, facts=facts
            )
        if not views:
            reason = next(iter(skipped.values()), "depth.txt lists none")
            gaps = [0.0 if track is None else track.gap(time) / _MOST_POSE_GAP for time in times]
            apart = [0.0 if place in colors.place else colors.apart.get(place, math.inf) for place in range(len(times))]
            needed = min(map(max, gaps, apart if "color" in rows else gaps), default=math.inf)
            raise CaptureError(
                f"{where}: no depth image of {len(times)} has all its partners: {reason}; "
                f"{allow_more('max_time_apart', needed)}"
            )
        told = []
        if colors.unused and "color" in rows:
            told.append(f"{colors.unused} of {len(rows['color'])} color images are nearest to no depth image")
        if colors.doubled:
            told.append(f"{colors.doubled} color images serve a second depth image")
        super().__init__(
            path,
            views,
            frame_id=frame_id,
            read=[*lists.values(), path / _POSES],
            skipped=skipped,
            unread=told,
            links_to=links_to,
        )

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        """A list of depth images beside one of color images or poses."""
        return is_file(path / "depth.txt") and any(is_file(path / name) for name in ("rgb.txt", _POSES))


def _rows(file: Path, allowed: list[Path], width: int) -> list[list[str]]:
    """Return the words of every line that is no comment.

    Raises:
        CaptureError: a line has another number of words.
    """
    lines = read_text("tum source", file, max_bytes=_MAX_BYTES, inside=allowed).splitlines()
    rows = [(number, line.replace(",", " ").split()) for number, line in enumerate(lines, 1)]
    kept = [(number, row) for number, row in rows if row and not row[0].startswith("#")]
    for number, row in kept:
        if len(row) != width:
            raise CaptureError(f"{file}: line {number} must have {width} words, got {len(row)}: {' '.join(row)[:80]!r}")
    return [row for _, row in kept]


def _time(file: Path, word: str) -> float:
    try:
        time = float(word)
    except ValueError:
        time = math.nan
    if not -LONGEST < time < LONGEST:
        raise CaptureError(f"{file}: {word[:40]!r} is no time in seconds")
    return time


def _file_list(file: Path, folder: Path, allowed: list[Path]) -> list[tuple[float, Path]]:
    rows = _rows(file, allowed, 2)
    outside = [name for _, name in rows if not is_within(name)]
    if outside:
        raise CaptureError(f"{file}: names {outside[0][:80]!r}, which is no file in this folder")
    return [(_time(file, time), folder / name) for time, name in rows]


def _trajectory(file: Path, allowed: list[Path]) -> Trajectory:
    rows = _rows(file, allowed, 8)
    try:
        numbers = np.array([[number_of(word) for word in row] for row in rows], np.float64).reshape(-1, 8)
    except ValueError as error:
        raise CaptureError(f"{file}: must hold numbers: {str(error)[:200]}") from error
    return Trajectory(str(file), [_time(file, row[0]) for row in rows], numbers[:, 1:4], numbers[:, 4:])
