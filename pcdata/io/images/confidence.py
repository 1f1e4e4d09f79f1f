"""Confidence images: how far every depth pixel is to be trusted."""

from __future__ import annotations

import os

import torch
from PIL import Image
from torch import Tensor

from pcdata.contracts.tensors import check_tensors
from pcdata.errors import CaptureError, locates_path
from pcdata.files.opening import replacing
from pcdata.io.images.reading import read_labels
from pcdata.structures import Confidence


@locates_path
def read_confidence(path: str | os.PathLike[str]) -> Tensor:  # (H, W) uint8
    """Read an 8-bit gray PNG of the values of :class:`Confidence`.

    Raises:
        CaptureError: the file is missing, damaged, of another type, or holds other values.
    """
    levels = read_labels(path)
    if levels.numel() and int(levels.max()) > max(Confidence):
        named = ", ".join(f"{level.value} {level.name}" for level in Confidence)
        raise CaptureError(
            f"read_confidence: {path}: must hold {named}, but reaches {int(levels.max())}; translate a sensor's own "
            "confidence into these levels first"
        )
    return levels.to(torch.uint8)


def write_confidence(path: str | os.PathLike[str], confidence: Tensor) -> None:
    """Write (H, W) uint8 values of :class:`Confidence` as an 8-bit gray PNG.

    Raises:
        CaptureError: the file cannot be written.
        DTypeError, ShapeError: the tensor is not uint8 (H, W).
    """
    where = f"write_confidence: {path}"
    check_tensors(where, {"confidence": confidence}, {"confidence": "H W : uint8"})
    with replacing(where, path) as temporary:
        Image.fromarray(confidence.detach().cpu().numpy()).save(temporary, format="PNG")
