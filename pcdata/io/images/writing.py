"""Write depth, color, label and mask images from which the readers return the same values."""

from __future__ import annotations

import io
import os

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from pcdata.contracts.lengths import check_metres_per_unit
from pcdata.contracts.tensors import check_tensors
from pcdata.errors import CaptureError, DTypeError, locates_path
from pcdata.files.opening import replacing
from pcdata.functional.depth.stored_depth import metres_of_value
from pcdata.io.images.reading import check_suffix


@locates_path
def write_depth(
    path: str | os.PathLike[str],
    depth: Tensor,  # (H, W) float32 metres, 0 = no reading
    *,
    metres_per_unit: float,
    round_to_unit: bool = False,
) -> None:
    """Write depth as a 16-bit PNG from which :func:`read_depth` returns the same values.

    Args:
        path: a ``.png`` file; it appears complete or not at all.
        depth: metres, 0 = no reading.
        metres_per_unit: length of one stored unit.
        round_to_unit: accept depths between two units and round them, which loses up to half a unit.

    Raises:
        CaptureError: a value is negative, above 65535 units, or between two units without ``round_to_unit``.
        DTypeError, ShapeError, NonFiniteError: the tensor is not a finite float32 (H, W).
    """
    where = f"write_depth: {path}"
    check_suffix(where, path, (".png",))
    raw = depth_units(where, depth, metres_per_unit=metres_per_unit, round_to_unit=round_to_unit)
    with replacing(where, path) as temporary:
        Image.fromarray(raw).save(temporary, format="PNG")


def depth_units(
    where: str,
    depth: Tensor,  # (H, W) float32 metres, 0 = no reading
    *,
    metres_per_unit: float,
    round_to_unit: bool = False,
) -> NDArray[np.uint16]:  # (H, W)
    """Return depth in the units that :func:`write_depth` stores; raises what that raises."""
    unit = check_metres_per_unit(where, metres_per_unit)
    check_tensors(where, {"depth": depth}, {"depth": "H W"})
    metres = depth.detach().cpu().numpy()
    units = np.rint(metres.astype(np.float64) / unit)
    if (metres < 0).any() or (units > 65535).any():
        raise CaptureError(
            f"{where}: depth must lie in 0 .. {65535 * unit:g} m, got {metres.min():g} .. {metres.max():g}; "
            "choose a larger metres_per_unit"
        )
    raw: NDArray[np.uint16] = units.astype(np.uint16)
    # Two float32 steps: depth computed as float32(n) * float32(unit) is n units, though not the float nearest to them.
    exact = np.abs(metres_of_value(unit)[raw] - metres) <= 2 * np.spacing(metres)
    if not round_to_unit and not exact.all():
        raise CaptureError(
            f"{where}: {int((~exact).sum())} pixels of {exact.size} are not whole multiples of {unit:g} m; choose the "
            "unit of the sensor, pass round_to_unit=True to lose up to half a unit, or save float32 .npy"
        )
    if ((raw == 0) & (metres > 0)).any():
        raise CaptureError(f"{where}: depth below half of {unit:g} m would become 'no reading'; use a smaller unit")
    return raw


@locates_path
def write_color(
    path: str | os.PathLike[str],
    colors: Tensor,  # (H, W, 3) uint8
) -> None:
    """Write RGB as an 8-bit PNG, which loses nothing.

    Raises:
        CaptureError: the path does not end in ``.png``, or cannot be written.
        DTypeError, ShapeError: the tensor is not uint8 (H, W, 3).
    """
    where = f"write_color: {path}"
    check_suffix(where, path, (".png",))
    if isinstance(colors, Tensor) and colors.is_floating_point():
        raise DTypeError(f"{where}: colors must be uint8 0..255, not {colors.dtype}; (colors * 255).round().byte()")
    check_tensors(where, {"colors": colors}, {"colors": "H W 3 : uint8"})
    with replacing(where, path) as temporary:
        Image.fromarray(colors.detach().cpu().numpy()).save(temporary, format="PNG")


def packed_color(
    colors: Tensor,  # (H, W, 3) uint8
    form: str,
    quality: int,
) -> tuple[bytes, int]:
    """Return RGB as the bytes of a "png" or a "jpeg" of some quality, and by how many of 255 levels it differs."""
    pixels = colors.detach().cpu().numpy()
    packed = io.BytesIO()
    Image.fromarray(pixels).save(packed, format=form, quality=quality)
    with Image.open(io.BytesIO(packed.getvalue())) as again:
        apart = np.abs(np.asarray(again).astype(np.int16) - pixels)
    return packed.getvalue(), int(apart.max(initial=0))


@locates_path
def write_labels(
    path: str | os.PathLike[str],
    labels: Tensor,  # (H, W) int64, -1 = none
    *,
    background_label: int,
) -> None:
    """Write object ids as a 16-bit gray PNG, with ``background_label`` for "no object".

    Raises:
        CaptureError: an id is not in -1 .. 65535 or is the background's own, or the file cannot be written.
        DTypeError, ShapeError: the tensor is not int64 (H, W).
    """
    where = f"write_labels: {path}"
    check_suffix(where, path, (".png",))
    check_tensors(where, {"labels": labels}, {"labels": "H W : int64"})
    ids = labels.detach().cpu().numpy()
    if not 0 <= background_label <= 65535 or (ids < -1).any() or (ids > 65535).any() or (ids == background_label).any():
        raise CaptureError(
            f"{where}: ids must lie in 0 .. 65535 beside -1 for none, and none may be background_label="
            f"{background_label}; got {ids.min()} .. {ids.max()}"
        )
    with replacing(where, path) as temporary:
        Image.fromarray(np.where(ids < 0, background_label, ids).astype(np.uint16)).save(temporary, format="PNG")


@locates_path
def write_mask(
    path: str | os.PathLike[str],
    mask: Tensor,  # (H, W) bool
) -> None:
    """Write a mask as a 1-bit PNG.

    Raises:
        CaptureError: the path does not end in ``.png``, or cannot be written.
        DTypeError, ShapeError: the tensor is not bool (H, W).
    """
    where = f"write_mask: {path}"
    check_suffix(where, path, (".png",))
    check_tensors(where, {"mask": mask}, {"mask": "H W : bool"})
    with replacing(where, path) as temporary:
        Image.fromarray(mask.detach().cpu().numpy()).save(temporary, format="PNG")
