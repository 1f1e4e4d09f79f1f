"""ScanNet scans as its exporter writes them: ``color/``, ``depth/``, ``pose/`` and ``intrinsic/``.

Source: Dai et al., "ScanNet: Richly-annotated 3D Reconstructions of Indoor Scenes", CVPR 2017; ScanNet,
``SensReader/python/SensorData.py``: depth in millimetres, poses world from camera, -inf where tracking was lost.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from pcdata.contracts.lengths import check_metres_per_unit
from pcdata.errors import CaptureError, PoseError
from pcdata.files.number_words import numbers_of
from pcdata.files.opening import read_text
from pcdata.geometry import rigid
from pcdata.io.calibration.foreign_cameras import matrix_of, read_foreign_camera
from pcdata.io.images.reading import read_depth
from pcdata.io.sources.listed import ListedSource, StoredView, checked_folder, files_by_id
from pcdata.io.sources.listing import LinkTargets, has_file, has_folder, is_file, is_folder, link_targets
from pcdata.io.sources.option_checks import check_switch
from pcdata.io.sources.registry import register_layout
from pcdata.io.sources.source import check_partners

_ROLES = {"depth": r"(?P<id>\d+)\.png", "color": r"(?P<id>\d+)\.(jpg|jpeg|png)", "pose": r"(?P<id>\d+)\.txt"}


@register_layout
class _ScanNetSource(ListedSource):
    """Depth with poses; with ``registered`` as the color camera, which has more pixels, sees it.

    A frame whose tracking was lost is a PoseError: ``skip_refused`` leaves those out.
    """

    kind = "scannet"
    needs = (
        "depth/N.png, pose/N.txt (4x4, world from camera), intrinsic/intrinsic_depth.txt; optional color/N.jpg with "
        "intrinsic/intrinsic_color.txt and extrinsic_color.txt"
    )

    def __init__(
        self,
        path: Path,
        *,
        registered: bool = False,
        metres_per_unit: float = 0.001,
        frame_id: str = "world",
        links_to: LinkTargets = (),
    ) -> None:
        """Read the file names and the calibration.

        Args:
            path: the folder of one scan.
            registered: register depth to the color images; without it they are left out.
            metres_per_unit: length of one stored depth unit; the data set documents millimetres.
            frame_id: the frame that the poses lead to.
            links_to: folders outside that links in the capture may lead to.

        Raises:
            CaptureError: a part of the layout is missing, or a frame lacks a file that others have.
        """
        path = checked_folder(self.kind, path, self.needs, "depth", "intrinsic")
        where = f"{self.kind} source {path}"
        check_switch(where, "registered", registered)
        unit = check_metres_per_unit(where, metres_per_unit)
        allowed = [path, *link_targets(links_to)]
        found = {role: files_by_id(path / role, fits) for role, fits in _ROLES.items() if has_folder(path / role)}
        check_partners(where, found["depth"], {role: files for role, files in found.items() if role != "depth"})
        folder = path / "intrinsic"
        cameras = {
            role: said.camera
            for role in ("depth", "color")
            if has_file(file := folder / f"intrinsic_{role}.txt") and (said := read_foreign_camera(file, allowed))
        }
        if (depth_camera := cameras.get("depth")) is None:
            raise CaptureError(f"{where}: has no intrinsic/intrinsic_depth.txt; this layout needs {self.needs}")
        color_camera = cameras.get("color")
        if registered and (color_camera is None or "color" not in found):
            raise CaptureError(f"{where}: registered needs color/ and intrinsic/intrinsic_color.txt; leave it out")
        color_from_depth = rigid.invert_rigid(_extrinsic(folder / "extrinsic_color.txt", allowed)) @ _extrinsic(
            folder / "extrinsic_depth.txt", allowed
        )
        views = {
            name: StoredView(
                files={role: found[role][name] for role in ("depth", "pose") if role in found},
                read=partial(read_depth, metres_per_unit=unit),
                camera=depth_camera,
                color=(found["color"][name], color_camera, color_from_depth) if registered and color_camera else None,
                facts={"metres_per_unit": unit},
            )
            for name in found["depth"]
        }
        told = []
        if "color" in found and not registered:
            told = ["color/: of another camera and more pixels; registered=True (--registered) reads it"]
        super().__init__(
            path,
            views,
            frame_id=frame_id,
            registered=registered,
            read=[folder, *([path / "color"] if told else [])],
            unread=told,
            links_to=links_to,
        )

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        """Depth images and the exporter's intrinsics of the depth camera."""
        return is_folder(path / "depth") and is_file(path / "intrinsic" / "intrinsic_depth.txt")


def _extrinsic(file: Path, allowed: list[Path]) -> Tensor:  # (4, 4) float64; the identity where there is no file
    if not has_file(file):
        return torch.eye(4, dtype=torch.float64, device="cpu")
    try:
        return matrix_of(str(file), numbers_of(read_text("scannet source", file, inside=allowed)))
    except (CaptureError, PoseError):
        raise
    except ValueError as error:
        raise CaptureError(f"{file}: must hold numbers: {str(error)[:200]}") from error
