"""One camera's captures as a plain folder, one after another: images, calibration, poses, signals."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from pcdata.errors import CaptureError
from pcdata.files.npy import write_npy
from pcdata.functional.depth.stored_depth import metres_of_value
from pcdata.io.arrays.signal_files import write_signals
from pcdata.io.calibration.capture_camera import REMARKS_OF, CaptureCamera, write_capture_camera, write_pose
from pcdata.io.images.confidence import write_confidence
from pcdata.io.images.reading import read_labels, read_raw_depth
from pcdata.io.images.writing import write_color, write_depth, write_labels, write_mask
from pcdata.io.sources.timestamps import write_timestamps
from pcdata.structures import Camera, DepthFrame

_HIGHEST = 65535  # what 16 bits hold
_Write = Callable[[Path, Tensor], None]
_ROLES: dict[str, tuple[str, str, _Write]] = {  # attribute of a frame: folder, suffix, how
    "mask": ("masks", ".png", write_mask),
    "colors": ("color", ".png", write_color),
    "confidence": ("confidence", ".png", write_confidence),
    "world_from_camera": ("poses", ".txt", write_pose),
}


class ViewFolder:
    """Writes the captures of one camera; what all share, such as the depth unit, is known when the last one is there.

    Depth is 16-bit PNG in the unit that the first capture came in, as long as that loses nothing; else float32 metres.
    """

    def __init__(self, folder: Path, *, with_signals: bool = True) -> None:
        """Take a folder that is not there yet, or empty."""
        self.folder = folder
        self._with_signals = with_signals
        self._names: list[str] = []
        self._roles: set[str] = set()
        self._unit: float | None = None  # None = depth is float32 metres
        self._background: int | None = None
        self._labels_used: set[int] = set()
        self._camera: Camera | None = None  # of the first capture
        self._frame_id: str | None = None
        self._remarks: dict[str, str] = {}

    def add(self, name: str, frame: DepthFrame, view: int) -> None:
        """Write one view of a capture under a name.

        Raises:
            CaptureError: it has not the kinds of images that those before it have, or a label beyond 16 bits.
            WriteError: a file cannot be written.
        """
        roles = {role for role in (*_ROLES, "labels") if getattr(frame, role) is not None}
        if not self._names:
            self._begin(frame, roles)
        self._check_alike(name, frame, roles)
        self._add_depth(name, frame.depth[view])
        for role, (folder, suffix, write) in _ROLES.items():
            if role in roles:
                write(self.folder / folder / f"{name}{suffix}", getattr(frame, role)[view])
        if frame.labels is not None:
            self._add_labels(name, frame.labels[view])
        if self._with_signals:
            self._add_signals(name, frame)
        self._add_camera(name, frame.camera.view(view))
        self._names.append(name)

    def close(self, times: Mapping[str, float]) -> None:
        """Write the calibration, and the seconds of every capture by name where they are known."""
        if self._camera is None:
            raise CaptureError(f"{self.folder}: no capture was written into it")
        calibration = CaptureCamera(
            camera=self._camera,
            metres_per_unit=self._unit or 1.0,
            frame_id=self._frame_id,
            background_label=self._background,
            remarks=self._remarks,
        )
        write_capture_camera(self.folder / "intrinsics.json", calibration)
        if times:
            write_timestamps(self.folder / "timestamps.json", times)

    def _begin(self, frame: DepthFrame, roles: set[str]) -> None:
        self._roles, self._frame_id = roles, frame.frame_id
        unit = frame.provenance.get("metres_per_unit")
        self._unit = unit if isinstance(unit, float) and 0 < unit < 1 else None
        if frame.num_views == 1:  # of several views nobody knows which camera is meant
            said = {remark: frame.provenance.get(key) for key, remark in REMARKS_OF.items()}
            self._remarks = {remark: text for remark, text in said.items() if isinstance(text, str) and text}
        for folder in ("depth", *("labels" if role == "labels" else _ROLES[role][0] for role in roles)):
            (self.folder / folder).mkdir(parents=True)

    def _check_alike(self, name: str, frame: DepthFrame, roles: set[str]) -> None:
        if roles != self._roles:
            told = ", ".join(sorted(roles ^ self._roles)).replace("world_from_camera", "poses")
            which = "lacks what those before it have" if roles < self._roles else "has what those before it lack"
            raise CaptureError(
                f"{name}: {which}: {told}; a folder has them of all captures or of none: write these apart (--only, "
                "--skip)"
            )
        if frame.frame_id != self._frame_id:
            raise CaptureError(
                f"{name}: its pose leads to {frame.frame_id!r}, but those before it to {self._frame_id!r}; write these "
                "apart (--only, --skip)"
            )

    def _add_depth(self, name: str, depth: Tensor) -> None:
        metres = depth.numpy()
        if self._unit is not None:
            if whole_units(metres, self._unit) is not None:
                write_depth(self.folder / "depth" / f"{name}.png", depth, metres_per_unit=self._unit)
                return
            unit, self._unit = self._unit, None
            for before in self._names:  # now float32 metres, which holds all that they hold
                file = self.folder / "depth" / f"{before}.png"
                raw = read_raw_depth("convert", file)
                write_npy(file.with_name(f"{before}.npy"), metres_of_value(unit)[raw])
                os.unlink(file)
        write_npy(self.folder / "depth" / f"{name}.npy", metres)

    def _add_labels(self, name: str, labels: Tensor) -> None:
        self._labels_used |= set(labels.unique().tolist())
        if self._background is None or self._background in self._labels_used:
            # There is one, or the ids do not fit into 16 bits anyway.
            free = next((label for label in range(_HIGHEST, -1, -1) if label not in self._labels_used), _HIGHEST)
            for before in self._names:
                file = self.folder / "labels" / f"{before}.png"
                stored = read_labels(file)
                stored[stored == self._background] = -1
                write_labels(file, stored, background_label=free)
            self._background = free
        write_labels(self.folder / "labels" / f"{name}.png", labels, background_label=self._background)

    def _add_signals(self, name: str, frame: DepthFrame) -> None:
        folder = self.folder / "signals"
        if not frame.recorded_signals and not folder.is_dir():
            return
        if not folder.is_dir():
            folder.mkdir()
            for before in self._names:
                write_signals(folder / f"{before}.json", {})
        write_signals(folder / f"{name}.json", frame.recorded_signals)

    def _add_camera(self, name: str, camera: Camera) -> None:
        if self._camera is None:
            self._camera = camera
        folder = self.folder / "intrinsics"
        if camera.to_dict() == self._camera.to_dict() and not folder.is_dir():
            return
        if not folder.is_dir():
            folder.mkdir()
            for before in self._names:
                write_capture_camera(folder / f"{before}.json", CaptureCamera(camera=self._camera))
        write_capture_camera(folder / f"{name}.json", CaptureCamera(camera=camera))


def whole_units(metres: NDArray[np.float32], unit: float) -> NDArray[np.uint16] | None:
    """Return depth in whole units from which a reader gets the same metres; None where there are none in 16 bits.

    Filtered or resampled depth is not in whole units any more.
    """
    units = np.rint(metres.astype(np.float64) / unit)
    if (units > _HIGHEST).any():
        return None
    stored: NDArray[np.uint16] = units.astype(np.uint16)
    return stored if np.array_equal(metres_of_value(unit)[stored], metres) else None
