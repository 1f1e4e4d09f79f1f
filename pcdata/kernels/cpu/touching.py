"""Kernels of what parts touching objects: smooth regions of an image, and the planes of both sides of a contact."""

from __future__ import annotations

import torch
from torch import Tensor

import pcdata.functional.touching  # noqa: F401 - the functions must be registered before their kernels
from pcdata.contracts.dispatch import kernel
from pcdata.functional.touching.limits import Limits
from pcdata.functional.touching.regions import Regions
from pcdata.functional.touching.windows import PixelCamera, spread
from pcdata.kernels.cpu.native import call, room_for


@kernel("smooth_regions", "cpu")
def smooth_regions(inverse: Tensor, camera: PixelCamera, noise: float, limits: Limits) -> Regions:
    """Fit normals row by row as vectors, and flood from buckets of pixels, one for each level."""
    label, normals = room_for((inverse.shape, torch.int64), ((*inverse.shape, 3), torch.float64))
    call(
        "pc_smooth_regions",
        *(inverse.contiguous(), *inverse.shape, _numbers(camera), noise, spread(noise), _numbers(limits)),
        *(label, normals),
    )
    return Regions(label, normals)


@kernel("region_planes", "cpu")
def region_planes(
    inverse: Tensor, label: Tensor, pixel: Tensor, camera: PixelCamera, noise: float, limits: Limits
) -> Tensor:
    """Fit the planes of many pixels at once."""
    (planes,) = room_for(((len(pixel), 6), torch.float64))
    call(
        "pc_region_planes",
        *(inverse.contiguous(), label.contiguous(), *inverse.shape, _numbers(camera), spread(noise), _numbers(limits)),
        *(pixel.contiguous(), len(pixel), planes),
    )
    return planes


def _numbers(values: tuple[float, ...]) -> Tensor:
    return torch.tensor(values, dtype=torch.float64, device="cpu")
