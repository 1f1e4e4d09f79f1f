"""What a plain capture's intrinsics.json may look like: with the numbers of a text beside it, where one states them."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Collection, Iterator
from itertools import islice
from pathlib import Path

from pcdata.errors import PcdataError
from pcdata.files.opening import check_inside
from pcdata.io.calibration.foreign_cameras import ForeignCamera, read_foreign_camera
from pcdata.io.images.reading import DEPTH_SUFFIXES, image_size
from pcdata.io.sources.listing import entries, has_folder, is_folder
from pcdata.structures import Camera

_MADE_UP = '{"width": 640, "height": 480, "fx": 600, "fy": 600, "cx": 320, "cy": 240, "metres_per_unit": 0.001}'
_OTHER_CAMERA = re.compile(r"colou?r|rgb|infra|(?<![a-z])ir(?![a-z])", re.IGNORECASE)
_NO_TEXTS = (".pkl", ".tf")  # large, or of a pose alone
_OFF_CENTER = 0.2  # of the image: a principal point farther off is of another size, where the text states none


def example_calibration(path: Path, inside: Collection[Path]) -> str:
    """Return words that name the numbers to write: those of a file of another form, else made up ones.

    Nothing is guessed: a file is named that alone may be of the depth camera, whose numbers fit the images, and that
    says nothing of depth or lens that the example would lose. Where one cannot be read, none is.
    """
    with contextlib.suppress(PcdataError):  # what cannot be read is no example
        size = _size_of_first(path / "depth", inside)
        stated = [] if size is None else list(islice(_stated_beside(path, inside), 2))
        if size is not None and len(stated) == 1:
            ((file, found),) = stated
            camera = None if found.camera is None else found.camera(size)
            if camera is not None and _is_plain(found, camera) and _fits(camera, size):
                return f"write one with the numbers of {_shown(file.name)}: {_as_json(camera, found.metres_per_unit)}"
    return f"write one with the numbers of this camera, such as {_MADE_UP}"


def _size_of_first(depth: Path, inside: Collection[Path]) -> tuple[int, int] | None:
    images = [one for one in entries(depth) if one.suffix in DEPTH_SUFFIXES] if has_folder(depth) else []
    if not images:
        return None
    check_inside("intrinsics", images[0], inside)
    return image_size("intrinsics", images[0])


def _stated_beside(path: Path, inside: Collection[Path]) -> Iterator[tuple[Path, ForeignCamera]]:
    """Yield the texts that may be of the depth camera."""
    for file in entries(path):
        if file.suffix.lower() in _NO_TEXTS or is_folder(file) or _OTHER_CAMERA.search(file.stem):
            continue
        found = read_foreign_camera(file, inside)
        if found is not None and found.camera is not None:
            yield file, found


def _is_plain(found: ForeignCamera, camera: Camera) -> bool:
    return camera.distortion is None and found.depth_encoding is None and found.invalid_values is None


def _fits(camera: Camera, size: tuple[int, int]) -> bool:
    height, width = size
    cx, cy = camera.intrinsics[0, :2, 2].tolist()
    return camera.size == size and all(
        abs(center / length - 0.5) < _OFF_CENTER for center, length in ((cx, width), (cy, height))
    )


def _shown(name: str) -> str:
    return name if name.isprintable() else repr(name)


def _as_json(camera: Camera, metres_per_unit: float | None) -> str:
    height, width = camera.size
    (fx, _, cx), (_, fy, cy), _ = camera.intrinsics[0].double().tolist()
    numbers = {name: float(f"{value:.9g}") for name, value in zip(("fx", "fy", "cx", "cy"), (fx, fy, cx, cy))}
    unit = json.dumps(metres_per_unit or 0.001)
    text = json.dumps({"width": width, "height": height, **numbers})
    return f'{text[:-1]}, "metres_per_unit": {unit}}}' + ("" if metres_per_unit else " (0.001 for millimetres)")
