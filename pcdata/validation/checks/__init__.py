"""The checks of a capture, one file per question; in the order in which they run, since some read what others found."""

# isort: off
from pcdata.validation.checks import stored_files
from pcdata.validation.checks import coverage
from pcdata.validation.checks import readings
from pcdata.validation.checks import depth_axis
from pcdata.validation.checks import largest_plane
from pcdata.validation.checks import objects
from pcdata.validation.checks import cameras
from pcdata.validation.checks import behind_camera
from pcdata.validation.checks import at_origin
from pcdata.validation.checks import strays
from pcdata.validation.checks import sequence
from pcdata.validation.checks import pose_direction  # not of views whose depth is of another moment or unit
from pcdata.validation.checks import focal_length
from pcdata.validation.checks import view_overlap  # not of views whose poses lead the wrong way
from pcdata.validation.checks import color_on_depth
from pcdata.validation.checks import pose_direction_over_time

# isort: on
__all__ = [
    "at_origin",
    "behind_camera",
    "cameras",
    "color_on_depth",
    "coverage",
    "depth_axis",
    "focal_length",
    "largest_plane",
    "objects",
    "pose_direction",
    "pose_direction_over_time",
    "readings",
    "sequence",
    "stored_files",
    "strays",
    "view_overlap",
]
