"""What may be wrong with a frame of a stream, by name, and what a pipeline answers to each frame."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from pcdata.errors import PcdataError
from pcdata.structures import PointCloud


class StalledError(PcdataError, TimeoutError):
    """No frame has come for longer than the timeout."""


class Fault(str, Enum):
    """Why a frame gave no cloud. Each is a text too: ``fault == "late"``."""

    WRONG_CLOCK = "wrong_clock"  # its stamp is no number, or lies in the future
    LATE = "late"  # it is older than max_age
    OUT_OF_ORDER = "out_of_order"  # a newer frame came before it
    FROZEN = "frozen"  # its stamp, or every pixel of it, is that of the frame before
    OTHER_FORM = "other_form"  # another size, dtype or number of views; an image missing, or one more
    OTHER_CAMERA = "other_camera"  # other intrinsics, another lens, poses that lead to another frame
    BAD_VALUES = "bad_values"  # NaN, infinite or negative depth; a pose that is none
    EMPTY = "empty"  # not one reading
    FAILED_STEP = "failed_step"  # a step refused it
    STALLED = "stalled"  # there was none within the timeout

    def __str__(self) -> str:
        return self.value


@dataclass(frozen=True, kw_only=True)
class LiveResult:
    """The answer to one frame: a cloud, or a fault and its reason.

    Args:
        cloud: the chain's result, which is the caller's: no later frame writes into its memory. None with a fault.
        fault: what was wrong; None = nothing.
        reason: the fault in words.
        stamp: of the frame, as it was given, in seconds.
        age: seconds between the stamp and this answer, by the pipeline's clock; None without a stamp.
        seconds: that the pipeline took.
        number: of the frame, counted from 0.
    """

    cloud: PointCloud | None = None
    fault: Fault | None = None
    reason: str = ""
    stamp: float | None = None
    age: float | None = None
    seconds: float = 0.0
    number: int = 0
