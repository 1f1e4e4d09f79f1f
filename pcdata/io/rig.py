"""Captures of several fixed cameras: one folder per camera, the same sample ids in each."""

from __future__ import annotations

import os
from typing import Any

import torch

from pcdata.errors import CaptureError
from pcdata.io.calibration import Calibration
from pcdata.io.detect import open_source
from pcdata.io.source import absolute, check_partners
from pcdata.structures import Camera, DepthFrame


class RigSource:
    """``FOLDER/<camera>/...`` for every camera of a calibration; each folder is a capture of any layout with poses.

    The samples of one id are the views of one capture, in the order of the cameras' names.
    """

    def __init__(
        self, path: str | os.PathLike[str], calibration: Calibration, *, frame_id: str, **options: Any
    ) -> None:
        """Open the folder of every camera.

        Args:
            path: the folder that holds them.
            calibration: names the cameras and says where they are.
            frame_id: the frame that their poses lead to.
            options: passed on to :func:`open_source`.

        Raises:
            CaptureError: a folder is missing or holds no captures, or a camera lacks samples that others have.
            CalibrationError, FrameError: the calibration does not lead from a camera to the frame.
        """
        self.path = absolute(path)
        self.names = sorted(calibration.cameras)
        self.frame_id = frame_id
        missing = [name for name in self.names if not (self.path / name).is_dir()]
        if missing or len(self.names) < 2:
            raise CaptureError(
                f"rig {self.path}: needs one folder for each of two or more cameras of the calibration, "
                f"{', '.join(self.names) or 'none'}; missing: {', '.join(missing) or 'a second camera'}"
            )
        self.sources = [
            open_source(self.path / name, calibration=calibration, camera=name, frame_id=frame_id, **options)
            for name in self.names
        ]
        self.ids = self.sources[0].ids
        check_partners(
            f"rig {self.path}", self.ids, {name: source.ids for name, source in zip(self.names, self.sources)}
        )

    def load(self, sample_id: str) -> DepthFrame:
        """Read one capture: depth, cameras and poses of all views.

        Raises:
            CaptureError: a sample cannot be trusted, is no depth image, or the cameras differ in image size.
        """
        views = [source.load(sample_id) for source in self.sources]
        frames = [view for view in views if isinstance(view, DepthFrame)]
        if len(frames) < len(views) or len({frame.size for frame in frames}) > 1:
            raise CaptureError(f"rig {self.path}: sample {sample_id!r} must be depth images of one size in all cameras")
        poses = [frame.world_from_camera for frame in frames if frame.world_from_camera is not None]
        if len(poses) < len(frames):
            raise CaptureError(f"rig {self.path}: the calibration gives no pose for every camera of {sample_id!r}")
        lenses = [frame.camera.distortion for frame in frames]
        widest = max((0 if lens is None else lens.shape[1] for lens in lenses), default=0)
        padded = [
            torch.zeros(1, widest, dtype=torch.float64)
            if lens is None
            else torch.nn.functional.pad(lens, (0, widest - lens.shape[1]))
            for lens in lenses
        ]
        return DepthFrame(
            depth=torch.cat([frame.depth for frame in frames]),
            camera=Camera(
                intrinsics=torch.cat([frame.camera.intrinsics for frame in frames]),
                size=frames[0].size,
                distortion=torch.cat(padded) if widest else None,
            ),
            world_from_camera=torch.cat(poses),
            frame_id=self.frame_id,
            capture_index=frames[0].capture_index,
            sample_id=sample_id,
        )
