"""Amazon picking sets of MIT and Princeton: ``frame-XXXXXX.depth.png``, ``.color.png`` and ``cam.info.txt``.

Source: Zeng et al., "Multi-view Self-supervised Deep Learning for 6D Pose Estimation in the Amazon Picking Challenge",
ICRA 2017; apc-vision-toolbox: bits of depth rotated by three, 1/10000 m, depth registered to color by librealsense, the
depth camera's own images in ``raw/``, poses world from **color** camera.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from torch import Tensor

from pcdata.errors import CaptureError
from pcdata.files.number_words import numbers_of
from pcdata.files.opening import read_text
from pcdata.files.sample_names import name_some
from pcdata.io.calibration.foreign_cameras import check_motion, matrix_of, pinhole_of_matrix
from pcdata.io.images.reading import read_depth
from pcdata.io.sources.listed import ListedSource, StoredView, checked_folder, files_by_id
from pcdata.io.sources.listing import LinkTargets, is_file, is_folder, link_targets
from pcdata.io.sources.option_checks import check_switch
from pcdata.io.sources.registry import register_layout

_IMAGES = {"depth": r"(?P<id>frame-\d+)\.depth\.png", "color": r"(?P<id>frame-\d+)\.color\.png"}
_INFO, _RAW = "cam.info.txt", "raw"
_UNIT = 0.0001
_BLOCK = re.compile(r"#[ \t]*([^\n]*)\n([^#]*)")
_COLOR, _DEPTH = "Color camera intrinsic matrix", "Depth camera intrinsic matrix"
_MOTION, _POSE = "Depth-to-color camera extrinsic matrix", re.compile(r".*camera pose.* for (?P<id>frame-\d+)")
_GIVE = "add that matrix to it, or give it as color_from_depth (--color-from-depth '16 numbers')"
_MISSING = (
    f"{_INFO} has no '{_MOTION}': the poses are of the color camera and are used for the depth camera as they stand, "
    f"so points are off by the distance between the two (some millimetres to centimetres); {_GIVE}"
)
_NOT_NEEDED = (
    f"{_INFO} has no '{_MOTION}': the images registered to color need none, those of the depth camera "
    f"(registered=False) would be off by the distance between the two; {_GIVE}"
)


@register_layout
class _ApcSource(ListedSource):
    """Depth registered to color as the recorder stored it, or with ``registered=False`` that of the depth camera.

    ``frame-XXXXXX.depth.png`` has the pixels of the color camera: the recorder moved every reading by the matrix from
    depth to color and painted it where the color camera sees it, which leaves gaps between the pixels. So the
    intrinsics are those of color, the poses hold as they stand, and the color image lies on the depth. What the depth
    camera saw is in ``raw/``; its poses follow by the matrix. Where the file lacks that, ``pcdata validate`` says so.
    """

    kind = "apc"
    needs = f"frame-XXXXXX.depth.png and {_INFO} (cameras, depth to color, poses); optional frame-XXXXXX.color.png"

    def __init__(
        self,
        path: Path,
        *,
        registered: bool | None = None,
        color_from_depth: Sequence[float] | None = None,
        frame_id: str = "world",
        links_to: LinkTargets = (),
    ) -> None:
        """Read the file names and the calibration.

        Args:
            path: the folder of one scan.
            registered: None: the depth images that are registered to color, and color where all of them have it;
                True: those that have a color image, with it; False: those of the depth camera, in ``raw/``, or beside
                the calibration where there is no such folder.
            color_from_depth: the depth-to-color matrix, 16 numbers row by row, where the file lacks it.
            frame_id: the frame that the poses lead to.
            links_to: folders outside that links in the capture may lead to.

        Raises:
            CaptureError: a part of the layout is missing, a frame has no pose where others have, or two of these.
            PoseError: the matrix is not rigid.
        """
        path = checked_folder(self.kind, path, self.needs, _INFO)
        where = f"{self.kind} source {path}"
        own = registered is not None and not check_switch(where, "registered", registered)  # the depth camera's own
        info = path / _INFO
        blocks = _blocks(info, [path, *link_targets(links_to)])
        found = {role: files_by_id(path, fits) for role, fits in _IMAGES.items()}
        if stray := {*found["color"]} - {*found["depth"]}:
            raise CaptureError(f"{where}: there is color but no depth for {name_some(stray)}; move it out")
        raw = path / _RAW
        depth = found["depth"] if not own or not is_folder(raw) else files_by_id(raw, _IMAGES["depth"])
        poses = {match["id"]: rows for title, rows in blocks.items() if (match := _POSE.fullmatch(title))}
        if lacking := {*depth} - {*poses} if poses else set():
            raise CaptureError(f"{info}: has no pose for {name_some(lacking)}; add it, or move the frame out")
        if color_from_depth is not None and _MOTION in blocks:
            raise CaptureError(f"{info}: has '{_MOTION}', and color_from_depth says it too; drop one")
        motion = matrix_of(f"{info}: {_MOTION}", blocks[_MOTION]) if _MOTION in blocks else None
        if color_from_depth is not None:
            motion = check_motion(where, "color_from_depth", color_from_depth)
        facts: dict[str, Any] = {"metres_per_unit": _UNIT, "depth_encoding": "rotated", "unit_is_recorded": True}
        if motion is None and poses:
            facts |= {"missing": [_MISSING]} if own else {"not_needed": [_NOT_NEEDED]}
        if not own:
            facts["registered_to"] = "color"
        camera = _camera(info, blocks, _DEPTH if own else _COLOR)
        plain = {*depth} - {*found["color"]}
        if registered and not found["color"]:
            raise CaptureError(f"{where}: registered needs color images, and there is none; leave it out")
        colors = found["color"] if registered or (not plain and not own) else {}
        views = {
            name: StoredView(
                files={"depth": file, **({"color": colors[name]} if name in colors else {})},
                read=partial(read_depth, metres_per_unit=_UNIT, depth_encoding="rotated"),
                camera=camera,
                pose=partial(_pose, f"{info}: {name}", poses[name], motion if own else None) if poses else None,
                facts=facts,
            )
            for name, file in depth.items()
            if not registered or name in colors
        }
        told = []
        if found["color"] and own:
            told = [f"{len(found['color'])} color images of another camera; they lie on the depth that is registered"]
        elif found["color"] and plain and not registered:
            told = [
                f"{len(found['color'])} color images, since {len(plain)} frames have none; registered=True "
                "(--registered) reads the frames that have one"
            ]
        super().__init__(
            path,
            views,
            frame_id=frame_id,
            skipped={name: "it has no color image" for name in depth if name not in views},
            read=[info, *depth.values(), *found["depth"].values(), *found["color"].values()],
            unread=told,
            links_to=links_to,
        )

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        """The file with both cameras and the poses."""
        return is_file(path / _INFO)


def _blocks(file: Path, allowed: list[Path]) -> dict[str, list[float]]:
    """Return the numbers under each heading, of those that have numbers.

    Raises:
        CaptureError: a heading is there twice, or something else than numbers stands under one.
    """
    found: dict[str, list[float]] = {}
    for title, rows in _BLOCK.findall(read_text("apc source", file, inside=allowed)):
        try:
            numbers = numbers_of(rows)
        except ValueError as error:
            raise CaptureError(
                f"{file}: under '{title.strip()[:80]}' must stand numbers: {str(error)[:200]}"
            ) from error
        if numbers and title.strip() in found:
            raise CaptureError(f"{file}: '{title.strip()[:80]}' is there twice; remove one")
        if numbers:
            found[title.strip()] = numbers
    return found


def _camera(file: Path, blocks: dict[str, list[float]], title: str) -> Any:
    numbers = blocks.get(title, [])
    if len(numbers) != 9:
        raise CaptureError(f"{file}: needs '{title}' with nine numbers, found {len(numbers)}")
    return pinhole_of_matrix(f"{file}: {title}", [numbers[:3], numbers[3:6], numbers[6:]])


def _pose(where: str, numbers: list[float], motion: Tensor | None) -> Tensor:  # (4, 4) float64, world from depth camera
    pose = matrix_of(where, numbers)
    return pose if motion is None else pose @ motion
