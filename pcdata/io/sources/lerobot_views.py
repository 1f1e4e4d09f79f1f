"""A camera of a LeRobot dataset as a view: its depth, and its intrinsics and its pose at one step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pcdata.errors import CaptureError, IntrinsicsError, PcdataError
from pcdata.geometry import rigid
from pcdata.geometry.lens_models import lens_row
from pcdata.io.calibration.foreign_cameras import Size, matrix_of, pinhole, pinhole_of_matrix
from pcdata.io.sources.lerobot_cameras import DepthStream, Feature
from pcdata.structures import Camera

_ORDER = ("fx", "fy", "cx", "cy")


@dataclass(frozen=True)
class Lens:
    """Where the intrinsics are: in numbers that hold throughout, or in columns of every step."""

    numbers: tuple[float, float, float, float] | None = None  # fx, fy, cx, cy
    of_size: Size | None = None
    column: str | None = None
    order: tuple[int, ...] = (0, 1, 2, 3)  # of fx, fy, cx, cy in a column of four
    distortion: str | None = None
    model: str | None = None  # of the lens; None = OpenCV's polynomial
    is_window: bool = False

    @property
    def columns(self) -> list[str]:
        """The columns to read."""
        return [name for name in (self.column, self.distortion) if name is not None]

    def camera(self, where: str, size: Size, row: Mapping[str, Any]) -> tuple[Camera, Tensor]:
        """Return the camera of an image of a size, and the (4, 4) turn from its axes to those the pose is of.

        Raises:
            IntrinsicsError: the numbers cannot be of such an image.
        """
        try:
            if self.column is None:
                assert self.numbers is not None
                return pinhole(size, self.numbers, of_size=self.of_size), _turn(False)
            return self._of_row(where, size, row)
        except PcdataError as error:
            raise IntrinsicsError(f"{where}: {error}") from error

    def _of_row(self, where: str, size: Size, row: Mapping[str, Any]) -> tuple[Camera, Tensor]:
        values = np.asarray(row[str(self.column)], dtype=np.float64)
        if values.size == 4:
            fx, fy, cx, cy = (float(values[place]) for place in self.order)
            rows = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
        elif values.size == 9:
            rows = [[float(value) for value in line] for line in values.reshape(3, 3)]
        else:
            raise IntrinsicsError(f"column {self.column} must hold 4 or 9 numbers, got {values.size}")
        fx, fy = rows[0][0], rows[1][1]
        if (fx < 0) != (fy < 0):
            raise IntrinsicsError(
                f"column {self.column}: one focal length is negative, the other is not ({fx:g}, {fy:g}): a mirrored "
                "image; flip it when recording"
            )
        rows[0][0], rows[1][1] = abs(fx), abs(fy)
        camera = pinhole_of_matrix(f"column {self.column}", rows)
        if self.distortion is None and not self.is_window:
            return camera(size), _turn(fx < 0)
        lens = None
        if self.distortion is not None:
            coefficients = np.asarray(row[self.distortion], dtype=np.float64).ravel().tolist()
            lens = torch.tensor(
                [lens_row(where, self.model or "opencv", coefficients)], dtype=torch.float64, device="cpu"
            )
        matrix = torch.tensor([rows], dtype=torch.float64, device="cpu")
        return Camera(intrinsics=matrix, size=size, distortion=lens, is_window=self.is_window), _turn(fx < 0)


@dataclass(frozen=True)
class Pose:
    """The column with the pose of every step, and whether it leads from the frame to the camera."""

    column: str
    is_inverse: bool

    def matrix(self, where: str, row: Mapping[str, Any]) -> Tensor:  # (4, 4) float64, the frame from the camera
        """Return the pose at one step.

        Raises:
            PoseError: it is not rigid, or not finite.
        """
        values = np.asarray(row[self.column], dtype=np.float64)
        if values.size not in (12, 16):
            raise CaptureError(f"{where}: column {self.column} must hold 12 or 16 numbers, got {values.size}")
        matrix = matrix_of(f"{where}: column {self.column}", values.tolist())
        return rigid.invert_rigid(matrix) if self.is_inverse else matrix


@dataclass(frozen=True)
class View:
    """One camera: its depth, its intrinsics, and where it is; a pose of None = not known."""

    stream: DepthStream
    lens: Lens
    pose: Pose | None

    @property
    def numbers(self) -> list[str]:
        """The columns with the intrinsics and the pose of every step."""
        return [*self.lens.columns, *([self.pose.column] if self.pose else [])]

    @property
    def columns(self) -> list[str]:
        """All columns that are read, those of the images included."""
        return [self.stream.key, *([self.stream.color] if self.stream.color else []), *self.numbers]


def lens_of_numbers(numbers: tuple[float, float, float, float], of_size: Size | None = None) -> Lens:
    """Return intrinsics that hold throughout."""
    return Lens(numbers=numbers, of_size=of_size)


def lens_of_column(stream: DepthStream, said: Feature) -> Lens:
    """Return the intrinsics of every step; of four numbers in the order that the feature names them in."""
    names = said.get("names")
    listed = [str(name) for name in names] if isinstance(names, list) else []
    order = tuple(listed.index(name) for name in _ORDER) if sorted(listed) == sorted(_ORDER) else (0, 1, 2, 3)
    return Lens(
        column=stream.intrinsics,
        order=order,
        distortion=stream.distortion,
        model=stream.lens,
        is_window=stream.is_window,
    )


def _turn(is_turned: bool) -> Tensor:
    """Return what makes of OpenCV's axes those of a camera with negative focal lengths: half a turn about z."""
    sign = -1.0 if is_turned else 1.0
    return torch.diag(torch.tensor([sign, sign, 1.0, 1.0], dtype=torch.float64, device="cpu"))
