"""InpaintDepth against OpenCV used as GG-CNN uses it, and what it marks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pcdata.structures import Confidence, DepthFrame
from pcdata.synthetic import tabletop
from pcdata.transforms import InpaintDepth

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")


@pytest.fixture(scope="module")
def noisy() -> DepthFrame:
    frame = tabletop(2, num_objects=4, num_views=2, size=(96, 128), noise="stereo").frame
    depth = frame.depth.clone()
    depth[:, 40:60, 100:] = 0  # a hole at the image's edge
    depth[:, :3] = 0
    return replace(frame, depth=depth)


def inpainted(depth: np.ndarray) -> np.ndarray:
    """DepthImage.inpaint of dougsm/ggcnn, utils/dataset_processing/image.py, step by step."""
    image = cv2.copyMakeBorder(depth, 1, 1, 1, 1, cv2.BORDER_DEFAULT)
    mask = (image == 0).astype(np.uint8)
    scale = np.abs(image).max()
    return cv2.inpaint(image / scale, mask, 1, cv2.INPAINT_NS)[1:-1, 1:-1] * scale


def test_every_view_is_filled_as_ggcnn_fills_it_and_readings_stay_exactly(noisy):
    filled = InpaintDepth()(noisy)
    hole = noisy.depth == 0
    assert float(hole.float().mean()) > 0.05
    assert torch.equal(filled.depth[~hole], noisy.depth[~hole])
    for view in range(noisy.num_views):
        wanted = torch.from_numpy(inpainted(noisy.depth[view].numpy()))
        assert torch.allclose(filled.depth[view], wanted, atol=1e-6)
    assert bool((filled.depth > 0).all())


def test_a_hole_in_a_plane_becomes_the_plane():
    frame = tabletop(0, num_objects=0, size=(60, 80), floor=False).frame
    flat = torch.full_like(frame.depth, 0.75)
    hole = torch.zeros_like(flat, dtype=torch.bool)
    hole[:, 20:40, 30:50] = True
    filled = InpaintDepth()(replace(frame, depth=torch.where(hole, 0.0, flat)))
    assert torch.allclose(filled.depth, flat, atol=1e-6)


def test_filled_pixels_are_marked_by_their_distance_from_a_reading(noisy):
    filled = InpaintDepth(max_distance=3)(noisy)
    hole = noisy.depth == 0
    assert bool((filled.confidence[~hole] == Confidence.RELIABLE).all())
    assert int(filled.confidence[0, 50, 102]) == Confidence.COMPLETED
    assert int(filled.confidence[0, 50, 120]) == Confidence.HALLUCINATED


def test_the_mask_does_not_limit_it_and_an_empty_view_stays(noisy):
    masked = replace(noisy, mask=torch.zeros_like(noisy.depth, dtype=torch.bool))
    assert torch.equal(InpaintDepth()(masked).depth, InpaintDepth()(noisy).depth)
    empty = noisy.depth.clone()
    empty[0] = 0
    filled = InpaintDepth()(replace(noisy, depth=empty))
    assert not bool(filled.depth[0].any())
    assert bool((filled.depth[1] > 0).all())
