"""SUN3D sequences: ``image/``, ``depth/``, ``intrinsics.txt`` and ``extrinsics/``.

Source: Xiao, Owens, Torralba, "SUN3D: A Database of Big Spaces Reconstructed Using SfM and Object Labels", ICCV 2013;
SUN3Dsdk: bits of depth rotated by three, millimetres, files named ``FRAME-MICROSECONDS``, three rows of a pose for each
color image.
"""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path

from pcdata.contracts.lengths import check_metres_per_unit
from pcdata.errors import CaptureError
from pcdata.files.number_words import numbers_of
from pcdata.files.opening import read_text
from pcdata.io.calibration.foreign_cameras import matrix_of, read_foreign_camera
from pcdata.io.images.reading import read_depth
from pcdata.io.sources.listed import ListedSource, StoredView, checked_folder, files_by_id
from pcdata.io.sources.listing import LinkTargets, has_folder, is_file, is_folder, link_targets, visible_files
from pcdata.io.sources.option_checks import check_seconds
from pcdata.io.sources.registry import register_layout
from pcdata.io.sources.synchronized import nearest

_NAME = r"(?P<id>[0-9]+-[0-9]+)\.(png|jpg|jpeg)"
_MAX_BYTES = 1 << 27


@register_layout
class _Sun3dSource(ListedSource):
    """Color images with the depth image nearest in time, and the pose that the sequence has of each.

    Depth is registered to color. Images without depth within ``max_time_apart`` are left out; ``skipped`` tells which.
    """

    kind = "sun3d"
    is_one_recording = True
    needs = (
        "image/FRAME-MICROSECONDS.jpg, depth/FRAME-MICROSECONDS.png, intrinsics.txt (3x3); optional extrinsics/*.txt"
    )

    def __init__(
        self,
        path: Path,
        *,
        metres_per_unit: float = 0.001,
        max_time_apart: float = 0.05,
        frame_id: str = "world",
        links_to: LinkTargets = (),
    ) -> None:
        """Read the file names, the intrinsics and the newest poses.

        Args:
            path: the folder of one sequence.
            metres_per_unit: length of one stored depth unit, its bits in order; the data set documents millimetres.
            max_time_apart: seconds between color and depth.
            frame_id: the frame that the poses lead to.
            links_to: folders outside that links in the capture may lead to.

        Raises:
            CaptureError: a part of the layout is missing, the poses are not one for each image, or no image has depth.
        """
        path = checked_folder(self.kind, path, self.needs, "image", "depth", "intrinsics.txt")
        where = f"{self.kind} source {path}"
        unit = check_metres_per_unit(where, metres_per_unit)
        limit = check_seconds(where, "max_time_apart", max_time_apart)
        allowed = [path, *link_targets(links_to)]
        colors, depths = (list(files_by_id(path / name, _NAME).items()) for name in ("image", "depth"))
        said = read_foreign_camera(path / "intrinsics.txt", allowed)
        if said is None or said.camera is None:
            raise CaptureError(f"{where}: intrinsics.txt states no intrinsics")
        poses_file = _newest(path / "extrinsics")
        poses = [] if poses_file is None else _poses(poses_file, allowed, len(colors))
        partners = nearest([_seconds(name) for name, _ in colors], [_seconds(name) for name, _ in depths], limit)
        views = {
            name: StoredView(
                files={"depth": depths[partners.place[place]][1], "color": color},
                read=partial(read_depth, metres_per_unit=unit, depth_encoding="rotated"),
                camera=said.camera,
                pose=partial(matrix_of, f"{poses_file}: pose {place}", poses[place]) if poses else None,
                facts={"metres_per_unit": unit, "depth_encoding": "rotated", "timestamps": [_seconds(name)]},
            )
            for place, (name, color) in enumerate(colors)
            if place in partners.place
        }
        skipped = {
            name: f"no depth image within {limit:g} s, the nearest is {partners.apart.get(place, math.inf):.3g} s off"
            for place, (name, _) in enumerate(colors)
            if name not in views
        }
        told = [f"{partners.doubled} depth images serve a second color image"] if partners.doubled else []
        if partners.unused:
            told.append(f"{partners.unused} of {len(depths)} depth images are nearest to no color image")
        super().__init__(
            path,
            views,
            frame_id=frame_id,
            read=[path / "intrinsics.txt", path / "extrinsics"],
            skipped=skipped,
            unread=told,
            links_to=links_to,
        )

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        """Both folders and the intrinsics, and no list of TUM's."""
        folders = is_folder(path / "image") and is_folder(path / "depth")
        return folders and is_file(path / "intrinsics.txt") and not is_file(path / "depth.txt")


def _seconds(name: str) -> float:
    return int(name.partition("-")[2]) / 1e6


def _newest(folder: Path) -> Path | None:
    """Return the last file of poses: they are named after the time of their making."""
    found = visible_files(folder, lambda name: name.endswith(".txt")) if has_folder(folder) else []
    return found[-1] if found else None


def _poses(file: Path, allowed: list[Path], count: int) -> list[list[float]]:
    try:
        numbers = numbers_of(read_text("sun3d source", file, max_bytes=_MAX_BYTES, inside=allowed))
    except ValueError as error:
        if isinstance(error, CaptureError):
            raise
        raise CaptureError(f"{file}: must hold numbers: {str(error)[:200]}") from error
    if len(numbers) != 12 * count:
        raise CaptureError(
            f"{file}: {count} images take {12 * count} numbers, three rows of four each, but it has {len(numbers)}"
        )
    return [numbers[start : start + 12] for start in range(0, len(numbers), 12)]
