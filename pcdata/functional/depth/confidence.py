"""How far a depth value is to be trusted, per pixel and per point."""

from __future__ import annotations

from enum import IntEnum

import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner


class Confidence(IntEnum):
    """Where a depth value comes from; a larger number is more to be trusted. Stored as uint8.

    ``DepthFrame.confidence`` holds one per pixel and ``PointCloud.extra["confidence"]`` one per point; without them
    every reading counts as RELIABLE.
    """

    NO_READING = 0  # the sensor gave no depth here, or one that was found wrong
    HALLUCINATED = 1  # filled in, with no reading nearby to hold on to
    COMPLETED = 2  # filled in, next to readings
    RELIABLE = 3  # measured


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
