"""Finding depth that is not to be trusted: MarkUnreliableDepth."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.functional.depth.roughness import depth_roughness
from pcdata.structures import Confidence, DepthFrame
from pcdata.transforms.base import Params, Transform
from pcdata.transforms.field_types import FromSensor, Name
from pcdata.transforms.sensor_noise import depth_camera

_SIGMAS = 3.0  # times the expected noise: 99.7 % of a normal error lies within


class MarkUnreliableDepth(Transform):
    """Set the confidence of doubtful readings to NO_READING; the depth itself stays, for a completion to look at.

    Two signs, neither with a number to tune. *Enclosed*: readings inside the convex hull of a hole (8-connected pixels
    without a reading, not reaching the image's border); transparent and shiny objects lose readings along their rim,
    and what is read within is seen through them or past them. *Rough*: readings three times as noisy as the sensor's
    profile allows, or at odds with every neighbor. Other pixels keep their confidence; without one, readings become
    RELIABLE. Enclosed readings are found by SciPy, on the CPU. A
    1280x720 image takes 1.5 s on one core, nearly all for the second sign.

    Measured on two scenes of transparent objects by a RealSense D435, each shot again with the objects painted opaque
    (ClearGrasp's sample data, depth registered to 1280x720 color). Wrong = within the objects' mask and more than 1 cm
    from the painted twin: of 47,361 and 10,291 wrong readings 23 % and 64 % are marked, all by the first sign (this
    depth is smooth: the camera's filters were on); of the 728,267 and 668,370 good ones 8 % and 6 % are lost. The other
    wrong ones show the table through a bottle, as smooth as the table beside it: depth alone cannot tell. For certainty
    give the objects' mask.

    Args:
        sensor: a name that `pcdata profiles` lists.
        enclosed: look for readings enclosed by holes.
        rough: look for readings rougher than the sensor's noise.
    """

    takes = DepthFrame
    gives = DepthFrame

    sensor: Annotated[Name, FromSensor(lambda sensor, _: sensor.name)]
    enclosed: bool = True
    rough: bool = True

    def check_fields(self) -> None:
        """Require a depth camera."""
        depth_camera("MarkUnreliableDepth", self.sensor)

    def transform(self, data: DepthFrame, params: Params) -> DepthFrame:
        """Mark all views."""
        doubtful = data.depth <= 0
        if self.rough:
            doubtful |= self._roughness(data) > _SIGMAS
        if self.enclosed:
            doubtful |= torch.stack([_enclosed_by_holes(view) for view in data.depth])
        known = torch.full_like(data.depth, Confidence.RELIABLE, dtype=torch.uint8)
        known = known if data.confidence is None else data.confidence
        return replace(data, confidence=torch.where(doubtful, int(Confidence.NO_READING), known))

    def _roughness(self, data: DepthFrame) -> Tensor:
        profile = depth_camera("MarkUnreliableDepth", self.sensor)
        depth, focals = data.depth.double(), data.camera.intrinsics[:, 0, 0].tolist()
        noise = [profile.noise_at(view, focal=focal) for view, focal in zip(depth, focals)]
        edge = [profile.edge_threshold(view, focal=focal) for view, focal in zip(depth, focals)]
        return depth_roughness(depth, torch.stack(noise), torch.stack(edge))


def _enclosed_by_holes(depth: Tensor) -> Tensor:
    """Mark the pixels of one (H, W) image that lie within the convex hull of a hole."""
    from scipy import ndimage

    hole = (depth <= 0).cpu().numpy()
    names, _ = ndimage.label(hole, structure=np.ones((3, 3)))
    inside = hole.copy()
    height, width = hole.shape
    for name, (rows, columns) in enumerate(ndimage.find_objects(names), start=1):
        touches = rows.start == 0 or columns.start == 0 or rows.stop == height or columns.stop == width
        own = names[rows, columns] == name
        # A hull of fewer rows or columns than three has no pixel of another kind strictly inside.
        if not touches and min(own.shape) > 2 and not own.all():
            inside[rows, columns] |= _convex_hull(own)
    return torch.from_numpy(inside).to(depth.device)


def _convex_hull(pixels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Fill the convex hull of the centers of the True pixels, which are not all on one line."""
    from scipy.spatial import ConvexHull, QhullError

    # The ends of each row span the same hull as all of its pixels.
    occupied = np.flatnonzero(pixels.any(axis=1))
    first, last = pixels.argmax(axis=1)[occupied], pixels.shape[1] - 1 - pixels[:, ::-1].argmax(axis=1)[occupied]
    corners = np.stack([np.tile(occupied, 2), np.concatenate([first, last])], axis=1)
    try:
        sides = ConvexHull(corners).equations  # outward normal and offset: inside is <= 0
    except QhullError:  # a diagonal line encloses nothing
        return pixels
    row, column = np.indices(pixels.shape)
    within = np.ones(pixels.shape, dtype=bool)
    for across, along, offset in sides:
        within &= across * row + along * column + offset <= 1e-9
    return within
