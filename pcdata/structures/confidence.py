"""How far a depth value is to be trusted, per pixel and per point."""

from __future__ import annotations

from enum import IntEnum


class Confidence(IntEnum):
    """Where a depth value comes from; a larger number is more to be trusted. Stored as uint8.

    ``DepthFrame.confidence`` holds one per pixel and ``PointCloud.extra["confidence"]`` one per point; without them
    every reading counts as RELIABLE.
    """

    NO_READING = 0  # the sensor gave no depth here, or one that was found wrong
    HALLUCINATED = 1  # filled in, with no reading nearby to hold on to
    COMPLETED = 2  # filled in, next to readings
    RELIABLE = 3  # measured
