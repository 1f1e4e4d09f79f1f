"""Depth that was filled in, marked as such."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from pcdata.structures.confidence import Confidence
from pcdata.structures.depth_frame import DepthFrame


def confidence_of(frame: DepthFrame) -> Tensor:
    """Return the (V, H, W) uint8 confidence of a frame: where it has none, its readings are RELIABLE."""
    if frame.confidence is not None:
        return frame.confidence
    return (frame.depth > 0).to(torch.uint8) * int(Confidence.RELIABLE)


def with_filled_depth(
    frame: DepthFrame,
    depth: Tensor,  # (V, H, W) float32 metres, of the frame's size
    filled: Tensor,  # (V, H, W) bool: this depth is a guess where the frame has no reading
    hallucinated: Tensor | None = None,  # (V, H, W) bool: those of them that no reading nearby supports
) -> DepthFrame:
    """Return the frame with another depth; filled pixels become COMPLETED, or HALLUCINATED where they are said to be.

    A frame without confidence in which nothing is filled stays without.
    """
    if frame.confidence is None and not bool(filled.any()):
        return replace(frame, depth=depth)
    confidence = torch.where(filled, int(Confidence.COMPLETED), confidence_of(frame))
    if hallucinated is not None:
        confidence = torch.where(filled & hallucinated, int(Confidence.HALLUCINATED), confidence)
    return replace(frame, depth=depth, confidence=confidence.to(torch.uint8))
