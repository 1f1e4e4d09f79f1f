"""What a plain capture's intrinsics.json may look like: with the numbers of a text beside it, where one states them."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable
from pathlib import Path

from pcdata.errors import PcdataError
from pcdata.io.calibration.foreign_cameras import read_foreign_camera
from pcdata.io.images.reading import DEPTH_SUFFIXES, image_size
from pcdata.io.sources.listing import entries, has_folder, is_folder
from pcdata.structures import Camera

_MADE_UP = '{"width": 640, "height": 480, "fx": 600, "fy": 600, "cx": 320, "cy": 240, "metres_per_unit": 0.001}'


def example_calibration(path: Path, inside: Iterable[Path]) -> str:
    """Return words that name the numbers to write: those of a file of another form, else made up ones."""
    depth = path / "depth"
    images = [one for one in entries(depth) if one.suffix in DEPTH_SUFFIXES] if has_folder(depth) else []
    for file in entries(path) if images else ():
        with contextlib.suppress(PcdataError):  # one that cannot be read is no example
            found = None if is_folder(file) else read_foreign_camera(file, inside)
            if found is not None and found.camera is not None:
                camera = found.camera(image_size("intrinsics", images[0]))
                if camera.distortion is None:
                    return f"write one with the numbers of {file.name}: {_as_json(camera, found.metres_per_unit)}"
    return f"write one with the numbers of this camera, such as {_MADE_UP}"


def _as_json(camera: Camera, metres_per_unit: float | None) -> str:
    height, width = camera.size
    (fx, _, cx), (_, fy, cy), _ = camera.intrinsics[0].double().tolist()
    numbers = {name: float(f"{value:.9g}") for name, value in zip(("fx", "fy", "cx", "cy"), (fx, fy, cx, cy))}
    unit = f'"metres_per_unit": {metres_per_unit or 0.001:g}'
    text = json.dumps({"width": width, "height": height, **numbers})
    return f"{text[:-1]}, {unit}}}" + ("" if metres_per_unit else " (0.001 for millimetres)")
