"""Depth, color, label and mask images <-> tensors.

Nothing is guessed: the unit of depth is an argument, and an image whose type could mean two things is refused.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from pcdata.contracts.lengths import check_metres_per_unit
from pcdata.errors import CaptureError, UnitError, locates_path
from pcdata.files.library_errors import WRITE_AGAIN, told_by_library
from pcdata.files.opening import map_npy, open_input, read_bytes, told_at
from pcdata.functional.depth.stored_depth import check_plausible, clean_float_depth, metres_of_value
from pcdata.functional.depth.unit_fit import DepthEncoding, DepthUnit, check_depth_encoding
from pcdata.io.images.exr import exr_size, read_exr_channel
from pcdata.io.images.file_wholeness import PNG_SIGNATURE, StructureError, check_jpeg, checked_png
from pcdata.io.images.tiff import check_tiff, read_reals, tiff_size

MAX_PIXELS = 1 << 26  # 67 megapixels: above every depth camera, below what a hostile header could make us allocate
_MAX_BYTES = 1 << 30
_PNG, _TIFF, _JPEG = "PNG", "TIFF", "JPEG"
_FORMATS = {".png": _PNG, ".tif": _TIFF, ".tiff": _TIFF, ".jpg": _JPEG, ".jpeg": _JPEG}
_EXR_HEADER = 1 << 16
_PARSERS = (  # what Pillow's parsers raise on damaged files; warnings too where a user made them errors
    OSError, ValueError, SyntaxError, EOFError, TypeError, IndexError, KeyError, OverflowError, MemoryError,
    AttributeError, RuntimeError, struct.error, zlib.error, Image.DecompressionBombError, Warning,
)  # fmt: skip
DEPTH_SUFFIXES = (".png", ".tif", ".tiff", ".npy", ".exr")
COLOR_SUFFIXES = (".png", ".jpg", ".jpeg")


@locates_path
def read_depth(
    path: str | os.PathLike[str],
    *,
    metres_per_unit: float,
    invalid_values: Collection[int] = (),
    depth_encoding: DepthEncoding = "plain",
) -> Tensor:  # (H, W) float32 metres, 0 = no reading
    """Read a depth image as metres along z, 0 where the sensor had no reading.

    Accepted: 16-bit gray PNG or TIFF, uint16 ``.npy``; TIFF of float32 or float64, float ``.npy`` and OpenEXR, whose
    NaN and infinite pixels mean "no reading" and become 0.

    Args:
        path: ``.png``, ``.tif``, ``.tiff``, ``.npy`` or ``.exr``, which needs OpenEXR.
        metres_per_unit: length of one stored unit: 0.001 for millimetres, 0.0002 for TUM, 1.0 for metres.
        invalid_values: stored values besides 0 that mean "no reading", e.g. ``(65535,)`` for 7-Scenes.
        depth_encoding: order of the bits of whole numbers: "plain"; "rotated", to the left by three, as SUN3D and the
            Amazon picking sets store them; "swapped", the high byte where the low one belongs.

    Raises:
        CaptureError: the file is missing, damaged, not a depth image, holds negative depth or no valid pixel at all.
        UnitError: the unit is not a positive number, a float image has an order of bits, or the median is implausible.
    """
    where = f"read_depth: {path}"
    unit = check_metres_per_unit(where, metres_per_unit)
    encoding = check_depth_encoding(where, depth_encoding)
    raw = read_raw_depth(where, Path(path))
    if raw.dtype == np.uint16:
        if not all(0 <= value <= 65535 for value in invalid_values):
            raise CaptureError(f"{where}: invalid_values must lie in 0 .. 65535, got {tuple(invalid_values)}")
        table = metres_of_value(unit, encoding)
        table[[0, *invalid_values]] = 0.0
        depth = table[raw]
    elif encoding == "plain":
        depth = clean_float_depth(where, raw, unit, invalid_values)
    else:
        raise UnitError(f"{where}: holds {raw.dtype} numbers, whose bits have no order; drop depth_encoding={encoding}")
    check_plausible(where, depth, DepthUnit(unit, encoding), raw)
    return torch.from_numpy(depth)


def read_raw_depth(where: str, path: Path) -> NDArray[Any]:
    """Return the numbers of a depth image as they are stored: uint16, float32 or float64, with whatever faults.

    Raises:
        CaptureError: the file is missing, damaged, or not a depth image.
    """
    suffix = path.suffix.lower()
    if suffix not in DEPTH_SUFFIXES:
        raise CaptureError(f"{where}: depth must be one of {', '.join(DEPTH_SUFFIXES)}, not {suffix!r}")
    if suffix == ".exr":
        return read_exr_channel(where, path, MAX_PIXELS)
    if suffix == ".npy":
        return _read_npy(where, path)
    return _raw_depth(where, *_decode(where, path, (_FORMATS[suffix],)))


def decode_raw_depth(where: str, content: bytes) -> NDArray[Any]:  # (H, W)
    """Return the numbers of a depth image in memory, a PNG or a TIFF, as :func:`read_raw_depth` does of a file.

    Raises:
        CaptureError: it is damaged, or not a depth image.
    """
    return _raw_depth(where, *decoded_image(where, content, (_PNG if content[:8] == PNG_SIGNATURE else _TIFF,)))


def decode_color(where: str, content: bytes) -> NDArray[np.uint8]:  # (H, W, 3)
    """Return a color image in memory, a PNG or a JPEG, as :func:`read_color` does of a file.

    Raises:
        CaptureError: it is damaged, or no color image of 8 bits.
    """
    return _color(where, *decoded_image(where, content, (_PNG, _JPEG)))


def _raw_depth(where: str, mode: str, pixels: NDArray[Any], header: tuple[int, int]) -> NDArray[Any]:
    bits, _ = header
    if mode.startswith("I;16"):
        return pixels.astype(np.uint16)
    if mode == "F":
        return pixels
    if mode == "I" and bits == 16:  # Pillow before 11.3 opens 16-bit gray PNG as 32-bit integers
        return pixels.astype(np.uint16)
    words = {"L": "an 8-bit gray", "P": "a palette", "1": "a 1-bit", "RGB": "a color", "RGBA": "a color with alpha"}
    other = "the color image, or " if mode in ("RGB", "RGBA") else ""
    raise CaptureError(
        f"{where}: a depth image must be 16-bit gray, but this is {words.get(mode, mode)} image; is it {other}a "
        "picture of the depth made for viewing? Its values are no lengths: export the raw 16-bit depth"
    )


def image_size(where: str, path: Path) -> tuple[int, int]:
    """Return (height, width) of an image of any kind that is read here, from its header alone.

    Raises:
        CaptureError: the file is missing, or its header cannot be read.
    """
    suffix = path.suffix.lower()
    if suffix == ".npy":
        shape = map_npy(where, path, max_bytes=_MAX_BYTES).shape
        if len(shape) < 2:
            raise CaptureError(f"{told_at(where, path)}: must be one image (H, W), got shape {shape}")
        return int(shape[0]), int(shape[1])
    if _FORMATS.get(suffix) == _TIFF:
        try:
            return tiff_size(read_bytes(where, path, max_bytes=_MAX_BYTES))
        except StructureError as error:
            raise CaptureError(f"{told_at(where, path)}: no readable image: {error}") from error
    with open_input(where, path, max_bytes=_MAX_BYTES) as stream:
        if suffix == ".exr":
            return exr_size(where, stream.read(_EXR_HEADER))
        try:
            with Image.open(stream, formats=("PNG", "JPEG")) as image:
                return image.height, image.width
        except _PARSERS as error:
            raise CaptureError(
                f"{told_at(where, path)}: no readable image: {told_by_library(error)}; {WRITE_AGAIN}"
            ) from error


def _read_npy(where: str, path: Path) -> NDArray[Any]:
    array = map_npy(where, path, max_bytes=_MAX_BYTES)
    if array.ndim == 3 and array.shape[2] == 1:  # one channel, as some camera libraries save it
        array = array[..., 0]
    if array.ndim != 2:
        raise CaptureError(f"{where}: depth must be one image (H, W), got shape {array.shape}; save one file per view")
    check_pixels(where, array.shape[1], array.shape[0])
    if array.dtype.newbyteorder("=") not in (np.uint16, np.float32, np.float64):
        raise CaptureError(f"{where}: depth must be uint16, float32 or float64, got {array.dtype}; convert it")
    return np.array(array, dtype=array.dtype.newbyteorder("="))


@locates_path
def read_color(path: str | os.PathLike[str]) -> Tensor:  # (H, W, 3) uint8
    """Read an 8-bit color PNG or JPEG as RGB; an alpha channel is dropped, orientation tags are not applied.

    Raises:
        CaptureError: the file is missing, damaged, gray, palette, CMYK or deeper than 8 bits per channel.
    """
    where = f"read_color: {path}"
    check_suffix(where, path, COLOR_SUFFIXES)
    return torch.from_numpy(_color(where, *_decode(where, Path(path), (_PNG, _JPEG))))


def _color(where: str, mode: str, pixels: NDArray[Any], header: tuple[int, int]) -> NDArray[np.uint8]:
    bits, _ = header
    if mode not in ("RGB", "RGBA") or bits == 16:
        found = f"{bits}-bit {mode}" if bits else mode
        raise CaptureError(
            f"{where}: color must be 8-bit RGB, but this image is {found}; convert it on purpose "
            "(for one gray or infrared channel: repeat it three times, or leave the colors out)"
        )
    return np.array(pixels[..., :3])


@locates_path
def read_labels(path: str | os.PathLike[str]) -> Tensor:  # (H, W) int64
    """Read an 8-bit gray, 16-bit gray or palette PNG of object ids; of a palette the index is the id.

    Raises:
        CaptureError: the file is missing, damaged, color, or gray of fewer than 8 bits (which viewers rescale).
    """
    where = f"read_labels: {path}"
    check_suffix(where, path, (".png",))
    mode, pixels, (bits, _) = _decode(where, Path(path), (_PNG,))
    if not (mode == "P" or (mode == "L" and bits == 8) or (bits == 16 and mode.startswith("I"))):
        is_gray = mode in ("1", "L")
        raise CaptureError(
            f"{where}: labels must be an 8-bit, 16-bit or palette PNG of ids, but this image is {bits}-bit "
            f"{'gray; save its ids with 8 bits' if is_gray else f'{mode}; map its colors to ids first'}"
        )
    return torch.from_numpy(pixels.astype(np.int64))


@locates_path
def read_mask(path: str | os.PathLike[str]) -> Tensor:  # (H, W) bool
    """Read a 1-bit or 8-bit gray PNG as a mask; every value but 0 is inside.

    Raises:
        CaptureError: the file is missing, damaged, or of another type.
    """
    where = f"read_mask: {path}"
    check_suffix(where, path, (".png",))
    mode, pixels, (bits, _) = _decode(where, Path(path), (_PNG,))
    if mode not in ("1", "L"):
        raise CaptureError(f"{where}: a mask must be a 1-bit or 8-bit gray PNG, but this image is {bits}-bit {mode}")
    return torch.from_numpy(pixels != 0)


def check_suffix(where: str, path: str | os.PathLike[str], suffixes: tuple[str, ...]) -> None:
    """Require that a file name ends as its format demands."""
    if Path(path).suffix.lower() not in suffixes:
        raise CaptureError(f"{where}: the file must end in {' or '.join(suffixes)}, not {Path(path).suffix!r}")


def check_pixels(where: str, width: int, height: int) -> None:
    """Require an image of a size that a camera may have."""
    if not 0 < width * height <= MAX_PIXELS:
        raise CaptureError(f"{where}: an image must have 1 .. {MAX_PIXELS} pixels, this one claims {width}x{height}")


def _decode(where: str, path: Path, formats: tuple[str, ...]) -> tuple[str, NDArray[Any], tuple[int, int]]:
    """Return Pillow's mode, the pixels, and (bit depth, color type) as a PNG's own header states them, else 0, 0.

    Pillow gets a file whose structure was checked first: it shows what it can of a damaged one.
    """
    return decoded_image(where, read_bytes(where, path, max_bytes=_MAX_BYTES), formats)


def decoded_image(where: str, data: bytes, formats: tuple[str, ...]) -> tuple[str, NDArray[Any], tuple[int, int]]:
    """Return what :func:`_decode` does of the content of a file, of one of some formats: "PNG", "TIFF", "JPEG".

    Raises:
        CaptureError: it is damaged, or of another format.
    """
    try:
        # Pillow opens 16-bit color as 8-bit without a word, so the depth is read from the header.
        depth = (0, 0)
        if _PNG in formats and (data[:8] == PNG_SIGNATURE or formats == (_PNG,)):
            data, *depth_and_type = checked_png(data, MAX_PIXELS)
            depth = (depth_and_type[0], depth_and_type[1])
            formats = (_PNG,)
        elif _TIFF in formats:
            check_tiff(data, MAX_PIXELS)
            if (reals := read_reals(data, _bytes_of_tiff)) is not None:
                return "F", reals, depth
        else:
            if _PNG in formats and data[:2] != b"\xff\xd8":
                raise StructureError("it starts as neither a PNG nor a JPEG does")
            check_jpeg(data, MAX_PIXELS)
        with Image.open(io.BytesIO(data), formats=formats) as image:
            check_pixels(where, *image.size)
            if (number := getattr(image, "n_frames", 1)) != 1:
                raise CaptureError(f"{where}: must hold one image, but holds {number}; save one file each")
            image.load()
            return image.mode, np.asarray(image), depth
    except CaptureError:
        raise
    except StructureError as error:
        way = "" if ";" in str(error) else "; copy or write it again"
        raise CaptureError(f"{where}: not a readable {' or '.join(formats)} image: {error}{way}") from error
    except _PARSERS as error:
        raise CaptureError(
            f"{where}: not a readable {' or '.join(formats)} image: {told_by_library(error)}; {WRITE_AGAIN}"
        ) from error


def _bytes_of_tiff(data: bytes) -> NDArray[np.uint8]:  # (H, W)
    with Image.open(io.BytesIO(data), formats=(_TIFF,)) as image:
        image.load()
        return np.asarray(image)
