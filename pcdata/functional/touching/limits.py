"""The numbers that tell touching objects apart: one set for every scene and sensor.

Lengths grow with the square root of the noise, as an angle fitted over a window of edge L varies with noise / L^2, and
all that is compared with depth grows with the noise itself. They were set on the 45 learning scenes of the Object
Segmentation Database; docs/segmentation.md tells how little the scores depend on each.
"""

from __future__ import annotations

import math
from typing import NamedTuple

# Standard deviation of 1/z, in 1/m, that the lengths below are meant for: a Kinect's, measured on its tables.
KINECT_NOISE = 0.0026


def chord(degrees: float) -> float:
    """Return how far apart two unit vectors are that differ by an angle: it needs no arc cosine to be compared."""
    return 2 * math.sin(math.radians(degrees) / 2)


class Limits(NamedTuple):
    """What the pixel kernels take, in this order, as float64."""

    # Metres. A normal is fitted over 9 mm on each side: half of the thinnest object that is told apart.
    normal_reach: float = 0.009
    # A crease is looked for between normals 7 mm on each side of a pixel: less, and their windows are the same points.
    crease_reach: float = 0.007
    # At a contact each side is fitted to its own points within 12 mm, more than for normals as only half are its own.
    contact_reach: float = 0.012
    # Standard deviations of 1/z. A jump is what 4 of them do not explain, nor the slope before or behind it.
    jump: float = 4.0
    # A point takes part in a fit where it is no farther than this from the middle one, beside the slope.
    gate: float = 8.0
    # Between two normals that are compared no step may be larger.
    step: float = 6.0
    # Tangent of the steepest surface that is followed, 72 degrees from facing the camera; regions are cut beyond it.
    slope: float = 3.15
    # A full crease: 40 degrees between the normals. Convex ones count half: an object has them itself.
    full_crease: float = chord(40)
    convex_part: float = 0.5
    # Seeds of regions are what is smoother than this part of a full crease.
    smooth: float = 0.35
    # At a contact a concave angle counts from 12 degrees and fully at 32.
    angle_from: float = chord(12)
    angle_full: float = chord(32)
    # A step between both sides counts from 5 deviations and fully at 10, each the mean of a dozen points and more.
    gap_from: float = 4.7
    gap_full: float = 9.4
    # Square metres: a region's smooth inside covers 1.6 cm2; 60 pixels of a Kinect at 0.85 m.
    seed_area: float = 1.6e-4
    # Only contacts look at it. Over an edge that is convex by 25 degrees a step must be twice as large: windows of few
    # pixels reach over rims and edges, and the planes fitted there miss each other.
    rim: float = chord(25)
    # Times `smooth`: how rough seeds may be. The face of a box that is 3 cm wide is nowhere smooth: creases are near.
    roughest: float = 1.5
    # Square metres. Seeds that are rougher are larger: slivers along a rim, which a sensor smears, are rough too.
    rough_area: float = 6.4e-4
    # What a jump or a steep line cuts off is a region of its own from here on: twice a seed, as its border counts too.
    part_area: float = 3.2e-4


# Times `smooth`, up to `roughest`: a narrow can is nowhere as smooth as a box; what holds no smoother seed is one too.
SMOOTH = (1.0, 1.5, 2.0)
# Levels of creases that regions are flooded through, from smooth to full.
LEVELS = 24
# Pixels that windows reach: enough to fit a plane, and no more than is worth the time.
NORMAL_PIXELS = (3, 14)
# Where it is looked whether a surface is too steep they are narrower, to lie on the ramp that a smeared jump is.
STEEP_PIXELS = (3, 4)
CREASE_PIXELS = (2, 12)
CONTACT_PIXELS = (5, 16)
# Steps that a jump may be smoothed over: stereo matching by windows makes ramps of a dozen.
RAMP = 12
