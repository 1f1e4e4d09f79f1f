"""Depth that was filled in, marked as such."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from pcdata.functional.depth.confidence import Confidence, filled_confidence
from pcdata.structures.depth_frame import DepthFrame


def confidence_of(frame: DepthFrame) -> Tensor:
    """Return the (V, H, W) uint8 confidence of a frame: where it has none, its readings are RELIABLE."""
    if frame.confidence is not None:
        return frame.confidence
    return (frame.depth > 0).to(torch.uint8) * int(Confidence.RELIABLE)


def with_filled_depth(
    frame: DepthFrame,
    depth: Tensor,  # (V, H, W) float32 metres, of the frame's size
    hallucinated: Tensor | None = None,  # (V, H, W) bool: filled where no reading nearby supports it
) -> DepthFrame:
    """Return the frame with another depth; pixels that had none become COMPLETED, or HALLUCINATED where said to be.

    A frame without confidence in which nothing is filled stays without.
    """
    confidence = filled_confidence(frame.depth, depth, frame.confidence, hallucinated)
    return replace(frame, depth=depth, confidence=confidence)
