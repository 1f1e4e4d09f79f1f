"""The camera with OpenCV axes, and the lens that bends what a pinhole would see."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from pcdata.contracts.tensors import check_tensors
from pcdata.errors import CaptureError, IntrinsicsError, ShapeError
from pcdata.geometry.lens_models import check_distortion, lens_facts, lens_row, turned_lenses
from pcdata.structures.structure import Structure, derived

# Of the side of an image: principal points of depth cameras lie nearer to its middle, those of another size do not.
MOST_OFF_CENTER = 0.075


@dataclass(frozen=True, eq=False, kw_only=True)
class Camera(Structure):
    """V >= 1 pinhole cameras of one image size.

    Axes are OpenCV's: x right, y down, z forward. Pixel (u, v) with integer coordinates is the center of that pixel,
    so an image spans -0.5 .. width-0.5. The intrinsics belong to the stream that the depth is registered to.

    Args:
        intrinsics: (V, 3, 3) float64, pixels.
        size: (height, width) in pixels.
        distortion: (V, D) float64, OpenCV order k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tau_x tau_y]]]]; or rows of 16
            numbers that name another model (``fisheye``, ``f_theta`` and others, see docs/lenses.md), which
            :meth:`pinhole` and :meth:`f_theta` make.
        is_window: cut from a larger image, so the principal point may lie outside.
    """

    intrinsics: Tensor
    size: tuple[int, int]
    distortion: Tensor | None = None
    is_window: bool = False

    def __post_init__(self) -> None:
        check_tensors(
            "Camera",
            {"intrinsics": self.intrinsics, "distortion": self.distortion},
            {"intrinsics": "V 3 3 : float64", "distortion": "V D : float64"},
        )
        if self.distortion is not None:
            check_distortion("Camera", self.distortion)
        # The class is frozen; a list would never equal the size of an image.
        object.__setattr__(self, "size", tuple(self.size))
        if [type(side) for side in self.size] != [int, int] or min(self.size) < 1:
            raise CaptureError(f"Camera: size must be (height, width) of at least one pixel, got {self.size}")
        if self.num_views < 1:
            raise ShapeError("Camera: intrinsics must describe at least one view, got shape (0, 3, 3)")
        for view, k in enumerate(self.intrinsics.tolist()):
            _check_intrinsics(view, k, self.size, is_window=self.is_window)

    @classmethod
    def pinhole(
        cls,
        *,
        fx: float,
        fy: float,
        cx: float,
        cy: float,
        size: tuple[int, int],
        distortion: Sequence[float] | None = None,
        lens: str | None = None,
    ) -> Camera:
        """Make one camera from focal lengths and principal point in pixels; ``size`` is (height, width).

        ``lens`` is the model that the coefficients in ``distortion`` are of: ``opencv`` (the default), ``fisheye``
        (k1 k2 k3 k4, also called equidistant or Kannala-Brandt), ``inverse_brown_conrady`` (k1 k2 p1 p2 k3, as
        RealSense's SDK computes it) or ``f_theta`` (its one coefficient); or a name that ROS, OpenCV or RealSense has
        for one of them.

        Raises:
            CaptureError: an unknown model, another number of coefficients, or a model without coefficients.
            IntrinsicsError: numbers that cannot be the intrinsics of this image.
        """
        if lens is not None:
            distortion = lens_row("Camera.pinhole", lens, () if distortion is None else distortion)
        intrinsics = torch.tensor([[[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]], dtype=torch.float64, device="cpu")
        coefficients = (
            None if distortion is None else torch.tensor([list(distortion)], dtype=torch.float64, device="cpu")
        )
        return cls(intrinsics=intrinsics, size=size, distortion=coefficients)

    @classmethod
    def f_theta(
        cls,
        *,
        polynomial: Sequence[float],
        cx: float,
        cy: float,
        size: tuple[int, int],
        inverse: bool = False,
        c: float = 1.0,
        d: float = 0.0,
        e: float = 0.0,
    ) -> Camera:
        """Make one camera of NVIDIA's f-theta model.

        Args:
            polynomial: up to six coefficients k0 .. k5, k0 = 0, lowest power first: from the angle off axis in radians
                to the distance from the principal point in pixels.
            cx: principal point, in pixels; integers are centers of pixels, so subtract 0.5 where theirs are corners.
            cy: likewise.
            size: (height, width).
            inverse: the polynomial leads from pixels to angles.
            c: of the linear map [[c, d], [e, 1]] from offsets to pixels; where all three are 0 it is the identity.
            d: likewise.
            e: likewise; must be 0.

        Raises:
            CaptureError: more coefficients, a k0 that is not 0, a k1 that is not positive, or an e.
            IntrinsicsError: numbers that cannot be the intrinsics of this image.

        Source: NVIDIA DriveWorks, dwFThetaCameraConfig.
        """
        values = [float(value) for value in polynomial]
        if not 2 <= len(values) <= 6 or values[0] != 0 or not 0 < values[1] < float("inf"):
            raise CaptureError(
                "Camera.f_theta: polynomial must be 2 to 6 coefficients, lowest power first, the first 0 and the "
                f"second above 0, got {values}"
            )
        if e != 0:
            raise CaptureError(f"Camera.f_theta: e must be 0, got {e}: rows of pixels that lean are not known here")
        c = 1.0 if c == d == 0 else c
        values += [0.0] * (6 - len(values))
        focal = 1 / values[1] if inverse else values[1]
        scale = [focal ** (power if inverse else 0) / (1 if inverse else focal) for power in range(2, 6)]
        coefficients = [value * factor for value, factor in zip(values[2:], scale, strict=True)]
        model = "inverse_f_theta_polynomial" if inverse else "f_theta_polynomial"
        intrinsics = [[[c * focal, d * focal, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]]]
        return cls(
            intrinsics=torch.tensor(intrinsics, dtype=torch.float64, device="cpu"),
            size=size,
            distortion=torch.tensor(
                [lens_row("Camera.f_theta", model, coefficients)], dtype=torch.float64, device="cpu"
            ),
        )

    @property
    def num_views(self) -> int:
        """The number of cameras V."""
        return self.intrinsics.shape[0]

    @property
    def lenses(self) -> list[tuple[str, list[float]]]:
        """The model of every view's lens and its coefficients; empty where there is no lens."""
        return [] if self.distortion is None else [lens_facts(row) for row in self.distortion]

    def off_center(self) -> list[float]:
        """Return, per view, how far its principal point is from the middle, as a part of the image's side."""
        height, width = self.size
        return [
            max(abs(k[0][2] + 0.5 - width / 2) / width, abs(k[1][2] + 0.5 - height / 2) / height)
            for k in self.intrinsics.tolist()
        ]

    def view(self, index: int) -> Camera:
        """Return one camera of the V as a camera of its own.

        Raises:
            ShapeError: there is no such view; views count from 0.
        """
        check_view("Camera", index, self.num_views)
        keep = slice(index, index + 1)
        distortion = None if self.distortion is None else self.distortion[keep]
        return derived(self, intrinsics=self.intrinsics[keep], distortion=distortion)

    def resized(self, size: tuple[int, int]) -> Camera:
        """Return the camera of the same image sampled at another (height, width).

        Pixel centers are at integers, so c' = (c + 0.5) s - 0.5, not c s.
        """
        scale_v, scale_u = size[0] / self.size[0], size[1] / self.size[1]
        intrinsics = self.intrinsics.clone()
        intrinsics[:, 0] *= scale_u
        intrinsics[:, 1] *= scale_v
        intrinsics[:, 0, 2] += 0.5 * (scale_u - 1.0)
        intrinsics[:, 1, 2] += 0.5 * (scale_v - 1.0)
        return replace(self, intrinsics=intrinsics, size=size)

    def cropped(self, top: int, left: int, size: tuple[int, int]) -> Camera:
        """Return the camera of the window of (height, width) whose first pixel is (left, top).

        Raises:
            CaptureError: the window leaves the image.
        """
        if top < 0 or left < 0 or top + size[0] > self.size[0] or left + size[1] > self.size[1]:
            raise CaptureError(f"Camera.cropped: window at ({top}, {left}) of {size} leaves the image {self.size}")
        intrinsics = self.intrinsics.clone()
        intrinsics[:, 0, 2] -= left
        intrinsics[:, 1, 2] -= top
        return replace(self, intrinsics=intrinsics, size=size, is_window=True)

    def turned(self) -> Camera:
        """Return the camera of the image turned by 90 degrees counterclockwise, as ``numpy.rot90`` turns it.

        Its x axis is the y axis of this one, its y axis the opposite of this one's x axis.

        Raises:
            IntrinsicsError: axes that are skewed have no upper triangular intrinsics afterwards.
            CaptureError: a tilted sensor.
        """
        if bool((self.intrinsics[:, 0, 1] != 0).any()):
            raise IntrinsicsError("Camera.turned: skewed axes cannot be turned; undistort and resample the image first")
        intrinsics = self.intrinsics.clone()
        intrinsics[:, 0, 0], intrinsics[:, 1, 1] = self.intrinsics[:, 1, 1], self.intrinsics[:, 0, 0]
        intrinsics[:, 0, 2] = self.intrinsics[:, 1, 2]
        intrinsics[:, 1, 2] = self.size[1] - 1 - self.intrinsics[:, 0, 2]
        distortion = None if self.distortion is None else turned_lenses("Camera.turned", self.distortion)
        size = (self.size[1], self.size[0])
        return replace(self, intrinsics=intrinsics, size=size, distortion=distortion)

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers for JSON; :meth:`from_dict` reads them back exactly."""
        distortion = None if self.distortion is None else self.distortion.tolist()
        plain = {"intrinsics": self.intrinsics.tolist(), "size": list(self.size), "distortion": distortion}
        return {**plain, "is_window": True} if self.is_window else plain

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Camera:
        """Rebuild the camera written by :meth:`to_dict`."""
        distortion = data.get("distortion")
        return cls(
            intrinsics=torch.tensor(data["intrinsics"], dtype=torch.float64, device="cpu"),
            size=(int(data["size"][0]), int(data["size"][1])),
            distortion=None if distortion is None else torch.tensor(distortion, dtype=torch.float64, device="cpu"),
            is_window=bool(data.get("is_window", False)),
        )

    def __repr__(self) -> str:
        height, width = self.size
        lens = "".join(f", {len(values)} coefficients of {model}" for model, values in self.lenses[:1])
        focal = ", ".join(f"{k[0][0]:.1f}" for k in self.intrinsics.tolist())
        return f"Camera({self.num_views} view{'s' * (self.num_views != 1)}, {width}x{height}, fx {focal}{lens})"


def check_view(where: str, index: int, num_views: int) -> None:
    """Require a view that exists: a slice would give an empty one without a word."""
    if not 0 <= index < num_views:
        raise ShapeError(f"{where}.view: there is no view {index}; views count from 0 to {num_views - 1}")


def _check_intrinsics(view: int, k: list[list[float]], size: tuple[int, int], *, is_window: bool) -> None:
    """Refuse matrices that cannot be the intrinsics of this image."""
    fx, fy, cx, cy = k[0][0], k[1][1], k[0][2], k[1][2]
    where = f"Camera: intrinsics of view {view}"
    if not all(map(math.isfinite, (*k[0], *k[1], *k[2]))) or k[2] != [0.0, 0.0, 1.0] or k[1][0] != 0.0:
        raise IntrinsicsError(f"{where} must be [[fx, s, cx], [0, fy, cy], [0, 0, 1]], got {k}")
    if fx <= 0 or fy <= 0:
        raise IntrinsicsError(
            f"{where}: focal lengths must be positive, got fx={fx:g}, fy={fy:g}; a simulator's negative focal length "
            "means flipped axes: flip the image or the axes first"
        )
    height, width = size
    if not is_window and not (-0.5 <= cx <= width - 0.5 and -0.5 <= cy <= height - 0.5):
        raise IntrinsicsError(
            f"{where}: the principal point ({cx:g}, {cy:g}) lies outside the {width}x{height} image; "
            "do these intrinsics belong to another resolution? Rescale them with Camera.resized"
        )
