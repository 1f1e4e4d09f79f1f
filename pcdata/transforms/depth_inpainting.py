"""InpaintDepth: holes filled the way the grasp networks on depth images are trained to see them filled."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import max_pool2d

from pcdata.extras import require
from pcdata.structures import DepthFrame
from pcdata.structures.filled_depth import with_filled_depth
from pcdata.transforms.base import Params, Transform
from pcdata.transforms.field_types import Count

_RADIUS = 1  # pixels around a hole's rim that its filling follows


class InpaintDepth(Transform):
    """Fill every pixel without a reading by OpenCV's Navier-Stokes inpainting, in and outside the capture's mask.

    Readings keep their values. Filled pixels are marked in the confidence: COMPLETED where a reading lies within
    ``max_distance`` pixels along both axes, HALLUCINATED beyond. An image without any reading stays as it is. Needs
    OpenCV; runs on the CPU.

    Source: Bertalmio, Bertozzi & Sapiro, Navier-Stokes, fluid dynamics, and image and video inpainting, 2001; the use
    on depth is that of dougsm/ggcnn, ``utils/dataset_processing/image.py`` (DepthImage.inpaint).

    Args:
        max_distance: pixels to the nearest reading, up to which holes are filled.
    """

    takes = DepthFrame
    gives = DepthFrame

    max_distance: Count = 8

    def transform(self, data: DepthFrame, params: Params) -> DepthFrame:
        """Fill view by view."""
        hole = data.depth == 0
        if not bool(hole.any()):
            return replace(data)
        cv2 = require("cv2")
        filled = np.stack([_inpainted(cv2, view) for view in data.depth.detach().cpu().numpy()])
        depth = torch.where(hole, torch.from_numpy(filled).to(data.depth), data.depth)
        reach = 2 * self.max_distance + 1
        near = max_pool2d((~hole)[:, None].float(), reach, 1, self.max_distance)[:, 0] > 0
        return with_filled_depth(data, depth, ~near)


def _inpainted(cv2: Any, depth: NDArray[np.float32]) -> NDArray[np.float32]:  # (H, W) metres, 0 = hole
    scale = float(depth.max())
    if scale == 0:
        return depth
    # OpenCV leaves the outermost pixels of an image as they are, and takes floats in [-1, 1] alone.
    padded = cv2.copyMakeBorder(depth, 1, 1, 1, 1, cv2.BORDER_DEFAULT)
    hole = (padded == 0).astype(np.uint8)
    result: NDArray[np.float32] = cv2.inpaint(padded / np.float32(scale), hole, _RADIUS, cv2.INPAINT_NS)
    return result[1:-1, 1:-1] * np.float32(scale)
