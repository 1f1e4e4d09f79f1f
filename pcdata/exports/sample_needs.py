"""What the files need of a sample, asked for before anything is written; the models' rules are in ``contracts``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CaptureError, DTypeError, IntrinsicsError, ShapeError, TooFewPointsError
from pcdata.structures import DepthFrame, PointCloud


def one_cloud(where: str, data: Any) -> PointCloud:
    """Require one cloud with at least one point, and return it on the CPU."""
    if not isinstance(data, PointCloud):
        raise DTypeError(
            f"{where}: clouds are exported, not a {type(data).__name__}; run 'pcdata build' on the captures and export "
            "the dataset it makes"
        )
    if data.num_clouds != 1:
        raise ShapeError(
            f"{where}: a sample must be one cloud, but this is a batch of {data.num_clouds}; "
            + (
                "after SplitObjects write each object as a file (pcdata clouds) and build from these"
                if all("object" in meta for meta in data.meta)
                else "add MergeViews()"
            )
        )
    if data.num_points == 0:
        raise TooFewPointsError(f"{where}: the cloud is empty; widen the crop, or leave the sample out")
    return data.to("cpu")


def check_count(where: str, cloud: PointCloud, at_least: int) -> None:
    """Require a number of points of a cloud that the loader cuts.

    Raises:
        TooFewPointsError: there are fewer.
    """
    if cloud.num_points < at_least:
        raise TooFewPointsError(
            f"{where}: the loader needs {at_least} points, the cloud has {cloud.num_points}; end the pipeline in "
            f"RandomSample(num_points={at_least}, if_short='repeat')"
        )


def check_same_count(where: str, cloud: PointCloud, count: int) -> None:
    """Require as many points as the samples before have, since they share an array.

    Raises:
        ShapeError: there are more or fewer.
    """
    if cloud.num_points != count:
        raise ShapeError(
            f"{where}: the samples before have {count} points, this one has {cloud.num_points}; end the pipeline in "
            f"FarthestPointSample(num_points={count}, if_short='repeat')"
        )


def check_channels(where: str, cloud: PointCloud, names: Sequence[str], instead: str = "") -> None:
    """Require fields of the cloud such as colors; ``instead`` says how to do without."""
    fixes = {"normals": "add EstimateNormals() to the pipeline", "colors": "build from captures with color"}
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
            f"{where}: the loader knows no lens distortion, but this camera has some; take it out first "
            "with the step Undistort, or rectify the images when recording"
        )
    if float(frame.camera.intrinsics[0, 0, 1]) != 0.0:
        raise IntrinsicsError(f"{where}: the loader knows no skew, but this camera has some; rectify the images")
    return frame


def check_size(where: str, frame: DepthFrame, size: tuple[int, int] | None, reason: str, any_size: bool) -> None:
    """Require (height, width), unless any size is wanted."""
    if not any_size and size is not None and frame.size != size:
        raise ShapeError(
            f"{where}: the image must be {size[1]}x{size[0]}, since {reason}, but it is {frame.size[1]}x"
            f"{frame.size[0]}; record or resize to it, or say any_size=true for a loader changed to yours"
        )


def colors_of(where: str, frame: DepthFrame, instead: str = "") -> NDArray[np.uint8]:  # (H, W, 3) RGB
    """Return the colors of the one view, which must be there."""
    if frame.colors is None:
        raise CaptureError(f"{where}: the loader needs color, the capture has none; record color{instead}")
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
