"""A small tabletop world, ray-cast analytically: depth, color, labels, normals and poses with known truth."""

from pcdata.synthetic.shapes import Box, Cylinder, Shape, Sphere
from pcdata.synthetic.stereo_camera import SensorNoise
from pcdata.synthetic.tabletop import BASE_FRAME, Tabletop, tabletop
from pcdata.synthetic.tabletop_source import SyntheticSource, tabletop_frames
from pcdata.synthetic.teleop import TeleopSource, TeleopState
from pcdata.synthetic.turned import Turned, bowl_profile, mug_profile
from pcdata.synthetic.viewpoints import Miscalibration, look_at

__all__ = [
    "BASE_FRAME",
    "Box",
    "Cylinder",
    "Miscalibration",
    "SensorNoise",
    "Shape",
    "Sphere",
    "SyntheticSource",
    "Tabletop",
    "TeleopSource",
    "TeleopState",
    "Turned",
    "bowl_profile",
    "look_at",
    "mug_profile",
    "tabletop",
    "tabletop_frames",
]
