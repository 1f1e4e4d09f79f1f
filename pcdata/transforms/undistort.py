"""Depth frames without lens distortion: Undistort."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor

from pcdata.functional.depth.undistortion import undistort_depth, undistort_image
from pcdata.structures import Camera, DepthFrame
from pcdata.transforms.base import Params, Transform
from pcdata.transforms.field_types import Positive


class Undistort(Transform):
    """Take the lens out of the images: the capture as a pinhole camera in the same place would have seen it.

    Depth takes the nearest reading, or is interpolated within one surface; it never blends across an edge. Labels,
    confidence and mask follow the nearest pixel, colors are interpolated. What the lens did not see has no reading,
    the color black, the label -1 and lies outside the mask. A capture without lens distortion stays as it is.

    Args:
        rule: how depth is sampled: the nearest reading, or within one ``surface`` interpolated.
        zoom: focal lengths of the result as a part of those of the image: less than 1 shows more of a wide lens.
        max_jump: as a part of the depth: what differs more is another surface.
    """

    takes = DepthFrame
    gives = DepthFrame

    rule: Literal["nearest", "surface"] = "nearest"
    zoom: Positive = 1.0
    max_jump: Positive = 0.02

    def transform(self, data: DepthFrame, params: Params) -> DepthFrame:
        """Resample every image and drop the lens."""
        camera = data.camera.to(data.device)
        if camera.distortion is None:
            return replace(data)
        new = camera.intrinsics.clone()
        new[:, :2, :2] *= self.zoom
        k, lens = camera.intrinsics, camera.distortion
        depth, pixel_index = undistort_depth(
            data.depth, k, lens, new_intrinsics=new, rule=self.rule, max_jump=self.max_jump
        )
        colors = None if data.colors is None else undistort_image(data.colors, k, lens, new_intrinsics=new)[0]
        return replace(
            data,
            depth=depth,
            camera=Camera(intrinsics=new.to(data.camera.intrinsics.device), size=data.size, is_window=camera.is_window),
            colors=colors,
            labels=_followed(data.labels, pixel_index, -1),
            confidence=_followed(data.confidence, pixel_index, 0),
            mask=_followed(data.mask, pixel_index, False),
        )


def _followed(image: Tensor | None, pixel_index: Tensor, empty: int) -> Tensor | None:
    """Return the values of an image (V, H, W) at pixels (V, H, W), and ``empty`` where that is -1."""
    if image is None:
        return None
    found = image.flatten(1).gather(1, pixel_index.flatten(1).clamp(min=0)).reshape(pixel_index.shape)
    return torch.where(pixel_index >= 0, found, torch.full((), empty, dtype=image.dtype, device=image.device))
