"""Open3D's RGB-D sequences: ``depth/``, ``color/``, an intrinsics file of Open3D, and a trajectory.

Source: Open3D, reconstruction system and its test data: depth in 1/1000 m by default, ``camera_intrinsic.json`` with
the matrix column by column, ``.log`` of frame numbers and 4x4 world from camera.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

from torch import Tensor

from pcdata.contracts.lengths import check_metres_per_unit
from pcdata.errors import CaptureError, PcdataError
from pcdata.files.number_words import numbers_of
from pcdata.files.opening import read_text
from pcdata.files.sample_names import in_order, name_some
from pcdata.io.calibration.foreign_cameras import matrix_of, read_foreign_camera
from pcdata.io.images.reading import read_depth
from pcdata.io.sources.listed import ListedSource, StoredView, checked_folder, files_by_id
from pcdata.io.sources.listing import LinkTargets, entries, has_file, has_folder, is_file, is_folder, link_targets
from pcdata.io.sources.registry import register_layout
from pcdata.io.sources.source import check_partners

_IMAGES = r"(?P<id>[^.]+)\.(png|jpg|jpeg)"
_CAMERAS = re.compile(r"(camera|intrinsic)[\w-]*\.json")
_TRAJECTORY = "trajectory.log"
_MAX_BYTES = 1 << 27


@register_layout
class _Open3dSource(ListedSource):
    """Depth with the color image of the same name; the trajectory numbers the frames in their order."""

    kind = "open3d"
    needs = "depth/NAME.png, camera_NAME.json with an intrinsic_matrix; optional color/NAME.jpg|png and trajectory.log"

    def __init__(
        self,
        path: Path,
        *,
        metres_per_unit: float = 0.001,
        frame_id: str = "world",
        links_to: LinkTargets = (),
    ) -> None:
        """Read the file names, the intrinsics and the trajectory.

        Args:
            path: the folder of one sequence.
            metres_per_unit: length of one stored depth unit; Open3D's default is a millimetre (depth_scale 1000).
            frame_id: the frame that the poses lead to.
            links_to: folders outside that links in the capture may lead to.

        Raises:
            CaptureError: a part of the layout is missing, or a frame lacks a file that others have.
        """
        path = checked_folder(self.kind, path, self.needs, "depth")
        where = f"{self.kind} source {path}"
        unit = check_metres_per_unit(where, metres_per_unit)
        allowed = [path, *link_targets(links_to)]
        named = {"depth": "depth", "color": "color"}
        found = {role: files_by_id(path / name, _IMAGES) for role, name in named.items() if has_folder(path / name)}
        check_partners(where, found["depth"], {role: files for role, files in found.items() if role != "depth"})
        cameras = [entry for entry in entries(path) if _CAMERAS.fullmatch(entry.name)]
        if len(cameras) != 1:
            raise CaptureError(
                f"{where}: needs one file of intrinsics, found {name_some(c.name for c in cameras) or 'none'}"
            )
        said = read_foreign_camera(cameras[0], allowed)
        if said is None or said.camera is None:
            raise CaptureError(f"{where}: {cameras[0].name} states no intrinsics")
        track = _trajectory(path / _TRAJECTORY, allowed) if has_file(path / _TRAJECTORY) else {}
        names = in_order(found["depth"])
        if track and set(track) != set(range(len(names))):
            raise CaptureError(
                f"{where}: {_TRAJECTORY} has {len(track)} poses for {len(names)} depth images; number them from 0"
            )
        views = {
            name: StoredView(
                files={role: files[name] for role, files in found.items()},
                read=partial(read_depth, metres_per_unit=unit),
                camera=said.camera,
                pose=track.get(number),
                facts={"metres_per_unit": unit},
            )
            for number, name in enumerate(names)
        }
        read = [cameras[0], path / _TRAJECTORY]
        super().__init__(path, views, frame_id=frame_id, read=read, links_to=links_to)

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        """Depth images beside a file with Open3D's matrix."""
        try:
            files = [entry for entry in entries(path) if _CAMERAS.fullmatch(entry.name) and is_file(entry)]
            return is_folder(path / "depth") and any(
                "intrinsic_matrix" in read_text("recognizes", one) for one in files
            )
        except PcdataError:
            return False


def _trajectory(file: Path, allowed: list[Path]) -> dict[int, Tensor]:
    """Return the poses by the number of their frame, from groups of three whole numbers and sixteen others."""
    try:
        numbers = numbers_of(read_text("open3d source", file, max_bytes=_MAX_BYTES, inside=allowed))
    except ValueError as error:
        if isinstance(error, CaptureError):
            raise
        raise CaptureError(f"{file}: must hold numbers: {str(error)[:200]}") from error
    if len(numbers) % 19:
        raise CaptureError(
            f"{file}: must have five lines a pose, three numbers and a 4x4 matrix; it has {len(numbers)} numbers"
        )
    found = {}
    for start in range(0, len(numbers), 19):
        number = numbers[start]
        if number != int(number) or int(number) in found:
            raise CaptureError(f"{file}: frame {number:g} is no whole number, or is there twice")
        found[int(number)] = matrix_of(f"{file}: frame {number:g}", numbers[start + 3 : start + 19])
    return found
