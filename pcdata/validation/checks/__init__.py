"""The checks of a capture, one file per question; in the order in which they run, since some read what others found."""

from pcdata.validation.capture_check import Check, register_check
from pcdata.validation.checks.behind_camera import BehindCamera
from pcdata.validation.checks.cameras import Intrinsics, Poses
from pcdata.validation.checks.color_on_depth import ColorOnDepth
from pcdata.validation.checks.coverage import Coverage
from pcdata.validation.checks.pose_direction import PoseDirection
from pcdata.validation.checks.pose_direction_over_time import PoseDirectionOverTime
from pcdata.validation.checks.readings import Readings
from pcdata.validation.checks.sequence import Clock, Repeats
from pcdata.validation.checks.stored_files import RawValues
from pcdata.validation.checks.view_overlap import ViewOverlap

_IN_ORDER: tuple[type[Check], ...] = (
    RawValues,
    Coverage,
    Readings,
    Intrinsics,
    Poses,
    BehindCamera,
    Repeats,
    Clock,
    PoseDirection,  # not of views whose depth is of another moment or unit
    ViewOverlap,  # not of views whose poses lead the wrong way
    ColorOnDepth,
    PoseDirectionOverTime,
)
for _check in _IN_ORDER:
    register_check(_check)
