"""RandomElastic: a smooth random bending of every cloud."""

from __future__ import annotations

import torch
from torch import Tensor

from pcdata.errors import ConfigError
from pcdata.functional.elastic import STEEPEST, lattice_offsets
from pcdata.rng import Streams
from pcdata.structures import PointCloud
from pcdata.transforms.base import Params, Transform
from pcdata.transforms.field_types import Positive


class RandomElastic(Transform):
    """Bend every cloud smoothly at random: for segmentation, where objects may have other shapes.

    The nodes of a lattice through the origin of the frame are moved at random, and all between them follows. Points
    move, and normals stay at right angles to their surfaces; viewpoints, other positions and signals stay, as
    nothing rigid can follow, and ``source_from_cloud`` does not undo it. No surface folds over another.

    Args:
        wavelength: between the nodes, in the cloud's unit.
        max_offset: the largest offset per axis, in the cloud's unit; less than a ninth of the wavelength.

    Source: Simard et al., Best practices for convolutional neural networks, ICDAR 2003, for images.
    """

    is_random = True
    decides_by = "point"

    wavelength: Positive = 0.2
    max_offset: Positive = 0.01

    def check_fields(self) -> None:
        """Require a bending that cannot fold: three slopes along an axis add up to less than 1."""
        if not self.max_offset * STEEPEST * 3 < self.wavelength:
            raise ConfigError(
                "RandomElastic: max_offset must be less than a ninth of the wavelength, or surfaces could fold over, "
                f"got max_offset={self.max_offset}, wavelength={self.wavelength}"
            )

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Draw a seed per cloud: with it the bending can be drawn again exactly."""
        return {"seed": streams.seeds()}

    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Bend the points, and turn the normals as the bending does where their points are."""
        offsets, slopes = lattice_offsets(data.points.detach(), data.ptr, params["seed"], self.wavelength)
        bent = data.points + (self.max_offset * offsets).to(data.points.dtype)
        if data.normals is None:
            return data.with_fields(points=bent)
        bend = torch.eye(3, dtype=torch.float64, device=data.device) + self.max_offset * slopes
        return data.with_fields(points=bent, normals=_bent_normals(bend, data.normals))


def _bent_normals(bend: Tensor, normals: Tensor) -> Tensor:
    """Turn (N, 3) normals of surfaces that are mapped by (N, 3, 3) of positive determinant: by its cofactors."""
    first, second, third = bend.unbind(1)
    cofactors = [torch.linalg.cross(second, third), torch.linalg.cross(third, first), torch.linalg.cross(first, second)]
    turned = torch.stack([(row * normals.double()).sum(1) for row in cofactors], dim=1)
    length = turned.norm(dim=1, keepdim=True)
    return (turned / torch.where(length > 0, length, 1.0)).to(normals.dtype)
