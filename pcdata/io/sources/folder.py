"""The plain layout: one folder per kind of image, one calibration file for all."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import cast

from torch import Tensor

from pcdata.errors import CaptureError, ConfigError, UnitError
from pcdata.files.opening import check_inside
from pcdata.files.sample_names import check_known, positions
from pcdata.functional.depth.unit_fit import DepthEncoding, check_depth_encoding
from pcdata.io.arrays.signal_files import read_signals
from pcdata.io.calibration.capture_camera import REMARKS_OF, read_camera, read_capture_camera
from pcdata.io.images.reading import read_depth
from pcdata.io.sources.example_calibration import example_calibration
from pcdata.io.sources.folder_roles import ROLES, role_folders
from pcdata.io.sources.frame_files import make_frame
from pcdata.io.sources.listing import (
    LinkTargets,
    absolute,
    by_stem,
    check_links,
    has_file,
    link_targets,
    links_in,
    unread_entries,
)
from pcdata.io.sources.option_checks import check_invalid_values, check_label, check_name
from pcdata.io.sources.registry import register_layout
from pcdata.io.sources.source import Source, check_partners
from pcdata.io.sources.stated import one_calibration, one_naming, one_unit, one_value, opened_calibration
from pcdata.io.sources.timestamps import TIMESTAMPS, read_timestamps
from pcdata.structures import CAMERA_FRAME, Camera, DepthFrame, Signal
from pcdata.structures.calibration import Calibration

_CALIBRATIONS = ("intrinsics.json", "camera.json")
_POSES = re.compile(
    r"(?<![A-Za-z])pose|Pose|POSE|(?i:trajectory|extrinsic)"
)  # a word of its own, not in docker-compose


@register_layout
class FolderSource(Source):
    """``intrinsics.json``, ``depth/NAME.png``; for all or none color, labels, masks, confidence, poses, signals."""

    kind = "folder"
    needs = (
        "intrinsics.json (or camera.json) and depth/NAME.png|tiff|npy; optional color/NAME.png|jpg, labels/NAME.png, "
        "masks/NAME.png, confidence/NAME.png (8-bit levels 0..3), poses/NAME.txt (4x4, world from camera), "
        "intrinsics/NAME.json (of a camera that changes), "
        "signals/NAME.json (joints, actions, texts; docs/signals.md), timestamps.json (seconds by NAME)"
    )

    def __init__(
        self,
        path: Path,
        *,
        metres_per_unit: float | None = None,
        depth_encoding: DepthEncoding | None = None,
        invalid_values: Collection[int] = (),
        background_label: int | None = None,
        frame_id: str | None = None,
        calibration: Calibration | str | os.PathLike[str] | None = None,
        camera: str | None = None,
        folders: Mapping[str, str | None] | None = None,
        links_to: LinkTargets = (),
    ) -> None:
        """Read the calibration and the file names.

        Args:
            path: the folder.
            metres_per_unit: length of one stored depth unit, where ``intrinsics.json`` does not state it.
            depth_encoding: order of the stored bits, where ``intrinsics.json`` does not state it; None = "plain".
            invalid_values: stored depth values besides 0 that mean "no reading", where ``intrinsics.json`` does not
                state them.
            background_label: the label in the files that means "no object" and becomes -1, where ``intrinsics.json``
                does not state it; None = keep all.
            frame_id: where the poses lead to, where ``intrinsics.json`` does not state it; None = "world".
            calibration: a :class:`Calibration` or its file, whose camera replaces that of ``intrinsics.json``. Where it
                has transforms, the capture has no ``poses`` and a ``frame_id`` is stated, it also gives the pose.
            camera: its name in the calibration; None = the only one. ``intrinsics.json`` may state both, with the
                calibration as a file beside it, and ``folders`` too.
            folders: the names of folders that are called otherwise, by role, such as ``{"pose": "pose"}``; None leaves
                a role out. The roles: depth, color, labels, mask, confidence, pose, intrinsics, signals.
            links_to: folders outside that links in the capture may lead to; no other ones are followed out of it.

        Raises:
            CaptureError: the calibration is missing, wrong or of another image size, a sample lacks a file that
                others have, a link leads to nothing, or a folder looks like a part of the capture but is not read.
            CalibrationError, FrameError: the calibration cannot be read, or lacks the camera or the frame.
            ConfigError: a camera is named without a calibration, or folders names no role.
            UnitError: the unit is not stated, or stated twice and differently.
        """
        path = absolute(path)
        present = [path / name for name in _CALIBRATIONS if has_file(path / name)]
        if len(present) != 1:
            found = "both" if present else "neither"
            raise CaptureError(
                f"folder source {path}: needs intrinsics.json or camera.json, but {found} is there"
                + ("" if present else f"; {example_calibration(path, [path])}")
            )
        allowed = [path, *link_targets(links_to)]
        check_inside(str(path), present[0], allowed)
        stated = read_capture_camera(present[0])
        self._remarks = {key: stated.remarks[remark] for key, remark in REMARKS_OF.items() if remark in stated.remarks}
        self.metres_per_unit = one_unit(present[0], stated.metres_per_unit, metres_per_unit)
        encoding = one_value(present[0], "depth_encoding", stated.depth_encoding, depth_encoding, error=UnitError)
        self.depth_encoding = check_depth_encoding(str(present[0]), encoding or "plain")
        frame = one_value(present[0], "frame_id", stated.frame_id, check_name(str(path), "frame_id", frame_id))
        name = one_value(present[0], "camera", stated.camera_name, check_name(str(path), "camera", camera))
        replacing = one_calibration(present[0], stated.calibration, calibration, allowed)
        roles = role_folders(path, one_naming(present[0], stated.folders, folders))
        if "depth" not in roles:
            raise CaptureError(f"folder source {path}: has no folder 'depth'; this layout needs {self.needs}")
        self.frame_id = frame or "world"
        self.frame_is_stated = frame is not None
        self.camera = stated.camera
        self.world_from_camera: Tensor | None = None  # of a camera that stands still
        self._calibrated: dict[str, str] = {}
        if replacing is not None:
            self.camera, self.world_from_camera, self._calibrated = _override(
                present[0], stated.camera, replacing, name, None if "pose" in roles else frame
            )
        elif name is not None:
            raise ConfigError(f"folder source {path}: camera={name!r} names one of a calibration; give calibration too")
        invalid = check_invalid_values(str(path), invalid_values)
        if stated.invalid_values is not None and set(invalid) != set(stated.invalid_values):
            one_value(present[0], "invalid_values", list(stated.invalid_values), list(invalid) or None)
        self.invalid_values = invalid if stated.invalid_values is None else stated.invalid_values
        background_label = check_label(str(path), background_label)
        self.background_label = one_value(present[0], "background_label", stated.background_label, background_label)
        if replacing is not None and "intrinsics" in roles:
            raise CaptureError(
                f"folder source {path}: both intrinsics/ and a calibration say what the camera is; leave one of them "
                "out (--folder intrinsics=)"
            )
        check_links(link for folder in roles.values() for link in links_in(folder))  # all of them in one message
        self._files = {role: by_stem(folder, ROLES[role][1]) for role, folder in roles.items()}
        self._used = {present[0], *roles.values(), *([path / stated.calibration] if stated.calibration else [])}
        super().__init__(path, self._files["depth"], links_to)
        check_partners(str(self), self._ids, {role: found for role, found in self._files.items() if role != "depth"})
        if "pose" in self._files and self.frame_id == CAMERA_FRAME:
            raise CaptureError(f"{self}: frame_id names where the poses lead to, it cannot be {CAMERA_FRAME!r}")
        self._positions = positions(self._ids)
        times = path / TIMESTAMPS
        self.timestamps: dict[str, float] = {}  # seconds by id
        if has_file(times):
            check_inside(str(path), times, allowed)
            self.timestamps = read_timestamps(times, self._ids)
            self._used.add(times)

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        """A calibration file and a folder of depth."""
        return os.path.lexists(path / "depth") and any(os.path.lexists(path / name) for name in _CALIBRATIONS)

    def files(self, sample_id: str) -> dict[str, Path]:
        """Return the files of one sample by role."""
        return {role: found[sample_id] for role, found in self._files.items()}

    def _times(self) -> dict[str, float]:
        return self.timestamps

    def unread(self) -> list[str]:
        """Name the folders and files beside those that are read."""
        unread = unread_entries(self.path, self._used)
        return unread if "pose" in self._files else list(map(_told_of_poses, unread))

    def load(self, sample_id: str) -> DepthFrame:
        """Read one sample, always a depth frame.

        Raises:
            CaptureError, UnitError, PoseError, ShapeError: the sample is unknown or cannot be trusted, and why.
        """
        return cast(DepthFrame, super().load(sample_id))

    def _load(self, sample_id: str) -> DepthFrame:
        files = self.files(sample_id)
        frame = make_frame(
            files,
            depth=read_depth(
                files["depth"],
                metres_per_unit=self.metres_per_unit,
                depth_encoding=self.depth_encoding,
                invalid_values=self.invalid_values,
            ),
            camera=read_camera(files["intrinsics"]) if "intrinsics" in files else self.camera,
            sample_id=sample_id,
            frame_id=self.frame_id,
            capture_index=self._positions[sample_id],
            provenance={
                **self.provenance(sample_id),
                "metres_per_unit": self.metres_per_unit,
                **({} if self.depth_encoding == "plain" else {"depth_encoding": self.depth_encoding}),
                **self._calibrated,
                **self._remarks,
                **({"timestamps": [self.timestamps[sample_id]]} if self.timestamps else {}),
            },
            background_label=self.background_label,
        )
        if self.world_from_camera is not None:
            frame = replace(frame, world_from_camera=self.world_from_camera[None], frame_id=self.frame_id)
        return replace(frame, recorded_signals=read_signals(files["signals"])) if "signals" in files else frame

    def signals(self, sample_id: str) -> Mapping[str, Signal]:
        """Read the signals of one sample alone; none where the folder has none.

        Raises:
            CaptureError: the sample is unknown, or its file says what is no signal.
        """
        check_known(str(self), sample_id, self._known)
        self.check_links(sample_id)
        file = self.files(sample_id).get("signals")
        return {} if file is None else read_signals(file)


def _override(
    file: Path,
    stated: Camera,
    calibration: Calibration | str | os.PathLike[str],
    name: str | None,
    frame: str | None,  # where the camera's pose shall lead to; None = its pose is not asked for
) -> tuple[Camera, Tensor | None, dict[str, str]]:  # camera, its pose, provenance
    """Take the camera from a calibration, and its pose too if that is asked for and there are transforms."""
    known, origin = opened_calibration(calibration)
    name = known.camera_name(name)
    camera = known.camera(name)
    if camera.size != stated.size:
        raise CaptureError(
            f"{file}: is {stated.size[1]}x{stated.size[0]} but camera {name!r} of the calibration is "
            f"{camera.size[1]}x{camera.size[0]}; calibrate at this resolution, or rescale with Camera.resized"
        )
    pose = known.transform(frame, name) if frame and known.transforms else None
    return camera, pose, {"calibration": origin, "camera": name}


def _told_of_poses(name: str) -> str:
    """Say where poses belong, of a file that seems to hold them all."""
    if not _POSES.search(name) or name.endswith("/"):
        return name
    return f"{name}; poses are read from poses/NAME.txt: 4x4 each, world from camera"
