"""What the loaders take for granted of a cloud or a capture, asked for before anything is written."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pcdata.errors import (
    CaptureError,
    DTypeError,
    FrameError,
    IntrinsicsError,
    ShapeError,
    TooFewPointsError,
    UnitError,
)
from pcdata.structures import DepthFrame, PointCloud
from pcdata.structures.fields import METRE, NORMALIZED


def one_cloud(where: str, data: Any) -> PointCloud:
    """Require one cloud of finite coordinates with at least one point, and return it on the CPU."""
    if not isinstance(data, PointCloud):
        raise DTypeError(
            f"{where}: clouds are exported, not a {type(data).__name__}; run 'pcdata build' on the captures and export "
            "the dataset it makes"
        )
    if data.num_clouds != 1:
        raise ShapeError(
            f"{where}: a sample must be one cloud, but this is a batch of {data.num_clouds}; add MergeViews()"
        )
    if data.num_points == 0:
        raise TooFewPointsError(f"{where}: the cloud is empty; widen the crop, or leave the sample out")
    if not bool(torch.isfinite(data.points).all()):
        raise CaptureError(
            f"{where}: the cloud has coordinates that are not finite; rebuild the dataset from its captures"
        )
    return data.to("cpu")


def check_count(where: str, cloud: PointCloud, *, exactly: int | None = None, at_least: int = 1) -> None:
    """Require a number of points.

    Raises:
        TooFewPointsError, ShapeError: there are fewer, or more.
    """
    count, wanted = cloud.num_points, at_least if exactly is None else exactly
    fix = f"end the pipeline in FarthestPointSample(num_points={wanted}, if_short='repeat')"
    if count < wanted:
        raise TooFewPointsError(f"{where}: the loader needs {wanted} points, the cloud has {count}; {fix}")
    if exactly is not None and count > exactly:
        raise ShapeError(f"{where}: the loader needs {exactly} points in every cloud, this one has {count}; {fix}")


def check_metres(where: str, cloud: PointCloud, why: str) -> None:
    """Require metres."""
    if cloud.unit != METRE:
        raise UnitError(
            f"{where}: must be in metres, since {why}, but the cloud is {cloud.unit}; build it without "
            "NormalizeUnitSphere, NormalizeWorkspace or RandomScale"
        )


def check_unit_sphere(where: str, cloud: PointCloud) -> None:
    """Require coordinates within the unit sphere."""
    reach = float(torch.linalg.vector_norm(cloud.points.double(), dim=1).max())
    if cloud.unit != NORMALIZED or reach > 1 + 1e-4:
        raise UnitError(
            f"{where}: must lie in the unit sphere, since the loader does not normalise, but the cloud is in "
            f"{cloud.unit} and reaches {reach:.3g}; add NormalizeUnitSphere() as the last step of the pipeline"
        )


class SameFrame:
    """Holds all clouds of an export to one coordinate frame: a given one, or that of the first."""

    def __init__(self, frame: str | None) -> None:
        self._frame, self._given = frame, frame is not None

    def check(self, where: str, cloud: PointCloud) -> None:
        """Raise a FrameError where the cloud is in another frame."""
        if self._frame is None:
            self._frame = cloud.frame_id
        if cloud.frame_id != self._frame:
            reason = "frame asks for" if self._given else "the samples before are in"
            raise FrameError(
                f"{where}: the cloud is in frame {cloud.frame_id!r}, but {reason} {self._frame!r}; add "
                f"ToFrame(frame={self._frame!r}) to the pipeline"
            )


def check_channels(where: str, cloud: PointCloud, names: Sequence[str], instead: str = "") -> None:
    """Require fields of the cloud such as colours; ``instead`` says how to do without."""
    fixes = {"normals": "add EstimateNormals() to the pipeline", "colors": "build from captures with colour"}
    for name in names:
        if name not in cloud.fields():
            fix = fixes.get(name, "build from captures that have them")
            raise CaptureError(f"{where}: the loader needs {name}, the cloud has none; {fix}{instead}")


def one_view(where: str, data: Any, view: int | None) -> DepthFrame:
    """Require one view of a pinhole camera without skew and lens distortion, and return it on the CPU."""
    if not isinstance(data, DepthFrame):
        raise DTypeError(
            f"{where}: depth images are exported, not a {type(data).__name__}; give the captures that the clouds were "
            "built from"
        )
    if view is None and data.num_views > 1:
        raise ShapeError(f"{where}: the loader needs one view, the capture has {data.num_views}; choose one: view=0")
    frame = data.view(view or 0).to("cpu")
    if frame.camera.distortion is not None and bool((frame.camera.distortion != 0).any()):
        raise IntrinsicsError(
            f"{where}: the loader knows no lens distortion, but this camera has some; rectify the images when "
            "recording, and give the intrinsics of the rectified stream"
        )
    if float(frame.camera.intrinsics[0, 0, 1]) != 0.0:
        raise IntrinsicsError(f"{where}: the loader knows no skew, but this camera has some; rectify the images")
    return frame


def check_size(where: str, frame: DepthFrame, size: tuple[int, int], reason: str, any_size: bool) -> None:
    """Require (height, width), unless any size is wanted."""
    if not any_size and frame.size != size:
        raise ShapeError(
            f"{where}: the image must be {size[1]}x{size[0]}, since {reason}, but it is {frame.size[1]}x"
            f"{frame.size[0]}; record or resize to it, or say any_size=true for a loader changed to yours"
        )


def colors_of(where: str, frame: DepthFrame, instead: str = "") -> NDArray[np.uint8]:  # (H, W, 3) RGB
    """Return the colours of the one view, which must be there."""
    if frame.colors is None:
        raise CaptureError(f"{where}: the loader needs colour, the capture has none; record colour{instead}")
    array: NDArray[np.uint8] = frame.colors[0].numpy()
    return array


def object_ids(where: str, frame: DepthFrame, offset: int, highest: int) -> NDArray[np.int64]:  # (H, W)
    """Return the labels of the one view, plus an offset, with 0 as the background."""
    assert frame.labels is not None
    labels = frame.labels[0].numpy()
    ids: NDArray[np.int64] = np.where(labels < 0, 0, labels + offset)
    taken = (labels >= 0) & (ids < 1)
    if taken.any() or ids.max() > highest:
        raise CaptureError(
            f"{where}: objects must have the numbers 1 .. {highest}, since 0 is the background, but labels plus "
            f"label_offset={offset} reach {int(ids[labels >= 0].min())} .. {int(ids.max())}; choose another"
        )
    return ids
