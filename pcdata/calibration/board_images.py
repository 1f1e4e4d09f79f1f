"""Images of a calibration board, read as gray."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pcdata.calibration.boards import GrayImage
from pcdata.errors import CaptureError
from pcdata.extras import require
from pcdata.files.opening import read_bytes
from pcdata.io.sources.listing import absolute, visible_files

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
_MAX_BYTES = 1 << 28


def read_board_images(paths: Sequence[str | os.PathLike[str]]) -> dict[str, GrayImage]:
    """Read image files, and those of folders, by file name; color becomes gray.

    Orientation tags are ignored: intrinsics belong to the pixels as the sensor has them.

    Raises:
        CaptureError: there is none, one cannot be read, or two have the same name.
        MissingExtraError: OpenCV is not installed.
    """
    images: dict[str, GrayImage] = {}
    for path in paths:
        for file in _image_files(absolute(path)):
            if file.name in images:
                raise CaptureError(f"{file}: there are two images of this name; rename one")
            images[file.name] = read_gray(file)
    if not images:
        raise CaptureError(f"{', '.join(map(str, paths))}: holds no image; looked for {', '.join(IMAGE_SUFFIXES)}")
    return images


def read_gray(path: Path) -> GrayImage:
    """Read one image as 8-bit gray.

    Raises:
        CaptureError: it is missing or no image.
    """
    cv2: Any = require("cv2")
    data = np.frombuffer(read_bytes("read_gray", path, max_bytes=_MAX_BYTES), np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise CaptureError(f"read_gray: {path}: not an image that OpenCV can read")
    return image


def _image_files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    return visible_files(path, lambda name: Path(name).suffix.lower() in IMAGE_SUFFIXES)
