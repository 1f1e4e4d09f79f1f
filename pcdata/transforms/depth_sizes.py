"""Depth frames of another size, or turned: the intrinsics always follow."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any, Literal

import torch
from annotated_types import Interval
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from pcdata.errors import ConfigError, FrameError, ShapeError
from pcdata.functional.depth.resampling import MAX_FACTOR, decimate_depth, resize_depth
from pcdata.rng import Streams
from pcdata.structures import DepthFrame
from pcdata.structures.kinds import CAMERA_FRAME
from pcdata.transforms.base import Params, Transform
from pcdata.transforms.families import MaskTransform
from pcdata.transforms.field_types import Count, Positive


class CropCenter(MaskTransform):
    """Keep the window in the middle of the images, pixel for pixel; an odd margin is smaller above and left.

    Args:
        size: (height, width) of the part that stays, in pixels.
        up: pixels by which the window lies above the middle; below 0 = under it.

    Raises:
        ShapeError: the window leaves the images.
    """

    size: tuple[Count, Count]
    up: int = 0

    def transform(self, data: DepthFrame, params: Params) -> DepthFrame:
        """Cut every image and move the principal point."""
        (height, width), (rows, columns) = self.size, data.size
        if height > rows or width > columns:
            raise ShapeError(
                f"CropCenter: a window of {height} x {width} (height x width) does not fit into images of {rows} x "
                f"{columns}; choose a smaller one, or resize first"
            )
        top, left = (rows - height) // 2 - self.up, (columns - width) // 2
        if not 0 <= top <= rows - height:
            lowest, highest = (rows - height) // 2 - (rows - height), (rows - height) // 2
            raise ShapeError(
                f"CropCenter: a window of {height} rows, {self.up} above the middle, leaves images of {rows} rows; "
                f"give up from {lowest} to {highest}, or a smaller window"
            )
        names = ("depth", "colors", "labels", "confidence", "mask")
        images = {name: getattr(data, name) for name in names}
        window: dict[str, Any] = {
            name: None if image is None else image[:, top : top + height, left : left + width].contiguous()
            for name, image in images.items()
        }
        return replace(data, camera=data.camera.cropped(top, left, self.size), **window)


class TurnDepth(Transform):
    """Turn every image by quarter turns, counterclockwise; intrinsics, distortion and poses follow.

    The scene stays where it is: the camera is turned about its own axis, so each point keeps its place in every frame
    but the camera's own.

    Args:
        quarter_turns: of 90 degrees each.

    Raises:
        FrameError: a signal is in the frame of the camera, which turns.
        IntrinsicsError: skewed pixel axes.
    """

    takes = DepthFrame
    gives = DepthFrame

    quarter_turns: Annotated[int, Interval(ge=1, le=3)] = 1

    def transform(self, data: DepthFrame, params: Params) -> DepthFrame:
        """Turn the images and the cameras."""
        return turned_frame(type(self).__name__, data, self.quarter_turns)


class RandomTurnDepth(Transform):
    """Turn every image of a capture by a random number of quarter turns, as TurnDepth does.

    Args:
        quarter_turns: the numbers to choose from, each as likely as the others.
    """

    is_random = True
    takes = DepthFrame
    gives = DepthFrame

    quarter_turns: tuple[Annotated[int, Interval(ge=0, le=3)], ...] = (0, 1, 2, 3)

    def check_fields(self) -> None:
        """Require a number to choose."""
        if not self.quarter_turns:
            raise ConfigError("RandomTurnDepth: quarter_turns must name numbers to choose from")

    def make_params(self, data: DepthFrame, streams: Streams) -> Params:
        """Draw one number for the capture."""
        choices = torch.tensor(self.quarter_turns, dtype=torch.int64, device="cpu")
        return {"quarter_turns": choices[(streams.uniform(0.0, 1.0) * len(choices)).long()]}

    def transform(self, data: DepthFrame, params: Params) -> DepthFrame:
        """Turn the images and the cameras."""
        return turned_frame(type(self).__name__, data, int(params["quarter_turns"][0]))


def turned_frame(where: str, data: DepthFrame, quarter_turns: int) -> DepthFrame:
    """Return the capture with its images turned counterclockwise."""
    in_camera = [name for name, signal in data.recorded_signals.items() if signal.frame == CAMERA_FRAME]
    if in_camera and quarter_turns:
        raise FrameError(
            f"{where}: signal {in_camera[0]!r} is in frame {CAMERA_FRAME!r}, which turns; bring it into another one"
        )
    names = ("depth", "colors", "labels", "confidence", "mask")
    images: dict[str, Any] = {
        name: None if image is None else torch.rot90(image, quarter_turns, (1, 2)).contiguous()
        for name, image in ((name, getattr(data, name)) for name in names)
    }
    camera, pose = data.camera, data.world_from_camera
    turn = torch.tensor([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=torch.float64, device="cpu")
    for _ in range(quarter_turns):
        camera = camera.turned()
        pose = None if pose is None else pose @ turn.to(pose.device)
    return replace(data, camera=camera, world_from_camera=pose, **images)


class DecimateDepth(Transform):
    """Make one pixel of every ``factor`` x ``factor`` block from its readings; rows and columns left over are cut off.

    Labels, confidence and mask are those of the pixel with the median reading, so they describe the surface that stays;
    colors are averaged over the block.

    Args:
        rule: what becomes of a block; the mean mixes the surfaces that meet in it.
        max_jump: as a part of the depth: what differs more is another surface.
    """

    takes = DepthFrame
    gives = DepthFrame

    factor: Annotated[int, Interval(ge=2, le=MAX_FACTOR)] = 2
    rule: Literal["median", "mean"] = "median"
    max_jump: Positive = 0.02

    def transform(self, data: DepthFrame, params: Params) -> DepthFrame:
        """Reduce every image and rewrite the intrinsics."""
        depth, pixel_index = decimate_depth(data.depth, factor=self.factor, rule=self.rule, max_jump=self.max_jump)
        size = (depth.shape[1], depth.shape[2])
        covered = (size[0] * self.factor, size[1] * self.factor)
        camera = data.camera if covered == data.size else data.camera.cropped(0, 0, covered)
        colors = None
        if data.colors is not None:
            colors = _as_bytes(avg_pool2d(_channels_first(data.colors[:, : covered[0], : covered[1]]), self.factor))
        return replace(
            data, depth=depth, camera=camera.resized(size), colors=colors, **_images_of_pixels(data, pixel_index)
        )


class ResizeDepth(Transform):
    """Sample the images at another size: depth never blends across an edge, labels never blend at all.

    Depth on one surface is interpolated, exactly on planes; across edges, beside holes, and everywhere if ``max_jump``
    is None, a pixel takes the nearest reading, up to half a pixel off. Labels, confidence and mask are those of the
    nearest pixel; colors are filtered against aliasing.

    Args:
        size: (height, width) of the result, in pixels.
        max_jump: as a part of the depth: what differs more is another surface.
    """

    takes = DepthFrame
    gives = DepthFrame

    size: tuple[Count, Count]
    max_jump: Positive | None = 0.02

    def transform(self, data: DepthFrame, params: Params) -> DepthFrame:
        """Resize every image and rewrite the intrinsics; images of that size stay."""
        if data.size == self.size:
            return replace(data)
        depth, pixel_index = resize_depth(data.depth, size=self.size, max_jump=self.max_jump)
        colors = None
        if data.colors is not None:
            # Not kornia's resize: its antialiasing is a Gaussian blur of the whole image before it interpolates.
            images = _channels_first(data.colors)
            colors = _as_bytes(interpolate(images, self.size, mode="bilinear", antialias=True))
        camera = data.camera.resized(self.size)
        return replace(data, depth=depth, camera=camera, colors=colors, **_images_of_pixels(data, pixel_index))


def _images_of_pixels(frame: DepthFrame, pixel_index: Tensor) -> dict[str, Any]:
    """Return labels, confidence and mask at the given (V, h, w) pixels ``v * W + u`` of the frame."""
    images = {"labels": frame.labels, "confidence": frame.confidence, "mask": frame.mask}
    return {
        name: None if image is None else image.flatten(1).gather(1, pixel_index.flatten(1)).reshape(pixel_index.shape)
        for name, image in images.items()
    }


def _channels_first(colors: Tensor) -> Tensor:
    return colors.permute(0, 3, 1, 2).float()


def _as_bytes(images: Tensor) -> Tensor:
    return images.round_().clamp_(0, 255).to(torch.uint8).permute(0, 2, 3, 1).contiguous()
