"""Depth that was filled in, marked as such."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner
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
    hallucinated: Tensor | None = None,  # (V, H, W) bool: filled where no reading nearby supports it
) -> DepthFrame:
    """Return the frame with another depth; pixels that had none become COMPLETED, or HALLUCINATED where said to be.

    A frame without confidence in which nothing is filled stays without.
    """
    confidence = filled_confidence(frame.depth, depth, frame.confidence, hallucinated)
    return replace(frame, depth=depth, confidence=confidence)


@inner
def filled_confidence(
    before: Tensor, after: Tensor, confidence: Tensor | None, hallucinated: Tensor | None
) -> Tensor | None:
    """Return the (V, H, W) uint8 confidence once depths were filled, None if there was none and nothing was.

    Args:
        before: (V, H, W) float32, 0 = no reading.
        after: filled.
        confidence: (V, H, W) uint8 before; None = readings are RELIABLE.
        hallucinated: (V, H, W) bool; None = nowhere.
    """
    filled = (before == 0) & (after > 0)
    if confidence is None:
        if not bool(filled.any()):
            return None
        confidence = (before > 0).to(torch.uint8) * int(Confidence.RELIABLE)
    guess: int | Tensor = int(Confidence.COMPLETED)
    if hallucinated is not None:
        guess = torch.where(hallucinated, int(Confidence.HALLUCINATED), guess)
    return torch.where(filled, guess, confidence).to(torch.uint8)
