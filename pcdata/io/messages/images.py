"""Images in messages: depth as it is stored, color as RGB; raw, as PNG or JPEG, or packed as ROS packs depth.

Source: sensor_msgs/Image and image_encodings; REP 118 (depth of 16 bits is millimetres, of floats metres);
compressed_depth_image_transport (twelve bytes of what and two numbers A, B, then a PNG or RVL; floats are stored as
A / depth + B in 16 bits).
"""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CaptureError
from pcdata.io.images.reading import check_pixels, decoded_image
from pcdata.io.messages.rvl import unpacked_rvl

_CHANNELS: dict[str, tuple[Any, int]] = {  # the channels that are red, green and blue, and how many there are
    "rgb8": (slice(0, 3), 3), "bgr8": (slice(None, None, -1), 3), "rgba8": (slice(0, 3), 4),
    "bgra8": (slice(2, None, -1), 4), "mono8": ((0, 0, 0), 1), "8UC1": ((0, 0, 0), 1),
}  # fmt: skip
_WHOLE, _FLOAT = ("16UC1", "mono16"), "32FC1"
_PACKED_WHOLE = "16-bit PNG"  # that does not say of what
DEPTH_ENCODINGS = (*_WHOLE, _FLOAT, _PACKED_WHOLE)  # what can be read as depth
_GRAY = ("mono8", "8UC1")
_CONFIG = struct.Struct("<iff")  # of packed depth: what it is, and two numbers


class ImageForm(NamedTuple):
    """What an image message holds.

    ``role`` is "depth", "color", "gray" (16 bits that nobody calls depth, or 8) or "other".
    """

    role: str
    encoding: str  # of the pixels: "16UC1", "32FC1", "rgb8", ...
    size: tuple[int, int]  # (height, width)


def form_of(message: Any, topic: str) -> ImageForm:
    """Return what an image message holds.

    Raises:
        CaptureError: it is damaged.
    """
    named_depth = "depth" in topic.lower()
    if not hasattr(message, "encoding"):
        return _packed_form(message, named_depth)
    encoding, size = str(message.encoding), (int(message.height), int(message.width))
    if encoding in ("16UC1", _FLOAT) or (encoding == "mono16" and named_depth):
        return ImageForm("depth", encoding, size)
    if encoding in _CHANNELS:
        return ImageForm("gray" if encoding in _GRAY else "color", encoding, size)
    return ImageForm("gray" if encoding == "mono16" else "other", encoding, size)


def depth_numbers(message: Any) -> NDArray[Any]:  # (H, W) uint16, or float32 metres where it is packed so
    """Return the numbers of a depth image as they are stored.

    Raises:
        CaptureError: it is damaged, or no depth.
    """
    if not hasattr(message, "encoding"):
        return _packed_depth(message)
    if message.encoding in _WHOLE:
        rows, kind = _rows(message, 2), "u2"
    elif message.encoding == _FLOAT:
        rows, kind = _rows(message, 4), "f4"
    else:
        raise CaptureError(f"depth must be encoded as {', '.join(_WHOLE)} or {_FLOAT}, not {message.encoding!r:.50}")
    return rows.view(f"{'>' if message.is_bigendian else '<'}{kind}").astype(kind)


def plain_numbers(message: Any) -> NDArray[Any]:  # (H, W) int32 or uint8
    """Return the numbers of an image that is neither depth nor color: labels (32SC1), a mask or levels (mono8).

    Raises:
        CaptureError: it is damaged, or encoded in another way.
    """
    encoding = getattr(message, "encoding", "none")
    if encoding == "32SC1":
        return _rows(message, 4).view(">i4" if message.is_bigendian else "<i4").astype(np.int32)
    if encoding in _GRAY:
        return _rows(message, 1)
    raise CaptureError(f"an image of labels must be encoded as 32SC1 or mono8, not {encoding!r:.50}")


def color_pixels(message: Any) -> NDArray[np.uint8]:  # (H, W, 3)
    """Return a color image as RGB; of a gray one the channel three times.

    Raises:
        CaptureError: it is damaged, or encoded in another way.
    """
    if not hasattr(message, "encoding"):
        mode, pixels, (bits, _) = decoded_image("a packed image", _content(message), ("PNG", "JPEG"))
        if mode not in ("RGB", "RGBA", "L") or bits == 16:
            raise CaptureError(f"a packed color image must be 8-bit RGB, this one is {bits or ''} {mode}")
        return np.repeat(pixels[..., None], 3, 2) if mode == "L" else np.array(pixels[..., :3])
    if message.encoding not in _CHANNELS:
        raise CaptureError(f"color must be encoded as {', '.join(_CHANNELS)}, not {message.encoding!r:.50}; convert it")
    order, count = _CHANNELS[message.encoding]
    return np.array(_rows(message, count).reshape(message.height, message.width, count)[..., order], order="C")


def _rows(message: Any, bytes_per_pixel: int) -> NDArray[np.uint8]:  # (H, W * bytes_per_pixel)
    width, height, step = int(message.width), int(message.height), int(message.step)
    check_pixels("an image message", width, height)
    data = np.asarray(message.data)
    if step < width * bytes_per_pixel or data.size != step * height:
        raise CaptureError(f"a {width}x{height} image has {data.size} bytes in rows of {step}; it is damaged")
    return np.ascontiguousarray(data.reshape(height, step)[:, : width * bytes_per_pixel])


# -- packed images -----------------------------------------------------------------------------------------------------


def _content(message: Any) -> bytes:
    return np.asarray(message.data).tobytes()


def _packed_form(message: Any, named_depth: bool) -> ImageForm:
    encoding, packing = _format(message)
    if packing.startswith("compressedDepth"):
        return ImageForm("depth", encoding, _packed_numbers(message).shape)
    mode, pixels, (bits, _) = decoded_image("a packed image", _content(message), ("PNG", "JPEG"))
    size = (pixels.shape[0], pixels.shape[1])
    if bits == 16 or mode.startswith("I"):
        is_depth = encoding == "16UC1" or named_depth
        return ImageForm("depth" if is_depth else "gray", encoding if encoding in _WHOLE else _PACKED_WHOLE, size)
    return ImageForm("color" if mode in ("RGB", "RGBA") else "gray", mode, size)


def _format(message: Any) -> tuple[str, str]:
    """Return the encoding of the pixels and how they are packed: "16UC1; compressedDepth png"."""
    encoding, _, packing = str(message.format).partition(";")
    return encoding.strip(), packing.strip()


def _packed_depth(message: Any) -> NDArray[Any]:
    encoding, packing = _format(message)
    numbers = _packed_numbers(message)
    if not packing.startswith("compressedDepth") or encoding != _FLOAT:
        return numbers
    _, a, b = _CONFIG.unpack_from(_content(message))
    if not (np.isfinite(a) and np.isfinite(b)) or a <= 0:
        raise CaptureError(f"packed float depth states A {a:g} and B {b:g}; it is damaged")
    with np.errstate(divide="ignore"):
        depth = np.float32(a) / (numbers.astype(np.float32) - np.float32(b))
    depth[numbers == 0] = np.nan
    return depth


def _packed_numbers(message: Any) -> NDArray[np.uint16]:
    encoding, packing = _format(message)
    content = _content(message)
    if packing.startswith("compressedDepth"):
        if encoding not in (*_WHOLE, _FLOAT):
            raise CaptureError(f"packed depth must be 16UC1 or 32FC1, not {encoding!r:.50}")
        kind = packing.removeprefix("compressedDepth").strip() or "png"
        if kind not in ("png", "rvl"):
            raise CaptureError(f"depth is packed as {kind!r:.50}; known are png and rvl")
        if len(content) < _CONFIG.size + 8:
            raise CaptureError("a packed depth image ends within its header; it is damaged")
        content = content[_CONFIG.size :]
        if kind == "rvl":
            width, height = struct.unpack_from("<II", content)
            check_pixels("an RVL image", width, height)
            # Eight bytes of RVL may be a run of any length, but a reading takes four bits.
            return unpacked_rvl(content[8:], width * height).reshape(height, width)
    mode, pixels, (bits, _) = decoded_image("a packed depth image", content, ("PNG",))
    if bits != 16 or not mode.startswith("I"):
        raise CaptureError(
            f"a packed depth image must be a 16-bit gray PNG, this one is {bits}-bit {mode}; a picture of the depth "
            "made for viewing holds no lengths"
        )
    return pixels.astype(np.uint16)
