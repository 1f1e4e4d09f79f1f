"""Point clouds in the rows of a LeRobot dataset, as data sets on the Hugging Face hub keep them.

``observation.pointcloud.xyz`` with ``.rgb`` and ``.valid_mask`` beside it, or ``observation.pointcloud`` with 3 columns
or more; ``conversion_info.json`` may say the frame.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pcdata.errors import CaptureError, FrameError, UnitError
from pcdata.io.sources.lerobot_cameras import unit_named
from pcdata.io.sources.lerobot_facts import DatasetFacts
from pcdata.io.sources.lerobot_files import read_json
from pcdata.io.sources.lerobot_index import LeRobotIndex
from pcdata.structures import PointCloud

CLOUD = "observation.pointcloud"
XYZ, RGB, VALID = (f"{CLOUD}.{part}" for part in ("xyz", "rgb", "valid_mask"))
_NAMES = (CLOUD, XYZ, "observation.point_cloud", "observation.point_cloud.xyz")
_INFOS = ("conversion_info.json", "meta/conversion_info.json")
_FRAMES = ("frame_id", "frame", "target_frame", "base_frame", "pointcloud_frame", "reference_frame")
_UNITS = ("unit", "units", "pointcloud_unit", "pointcloud_units")


@dataclass(frozen=True)
class CloudColumns:
    """Which columns hold clouds, and what their numbers are."""

    where: str
    points: str
    shape: tuple[int, int]
    frame_id: str
    metres_per_unit: float
    colors: str | None = None
    valid: str | None = None

    @property
    def columns(self) -> list[str]:
        """The columns to read."""
        return [name for name in (self.points, self.colors, self.valid) if name is not None]

    def cloud(self, row: Mapping[str, Any]) -> PointCloud:
        """Return the cloud of one step, without the points that are marked as none.

        Raises:
            CaptureError: columns that are no cloud.
            UnitError: coordinates that do not look like metres.
        """
        count, width = self.shape
        points = _numbers(self.where, self.points, row, (count, width))
        colors = None if self.colors is None else _numbers(self.where, self.colors, row, (count, 3))
        keep = np.ones(count, dtype=bool)
        if self.valid is not None:
            keep = _numbers(self.where, self.valid, row, (count,)).astype(bool)
        return PointCloud.from_numpy(
            points[keep, :3],
            frame_id=self.frame_id,
            metres_per_unit=self.metres_per_unit,
            colors=None if colors is None else colors[keep],
        )


def cloud_columns(
    where: str,
    root: Path,
    inside: Sequence[Path],
    index: LeRobotIndex,
    facts: DatasetFacts | None,
    frame_id: str | None,
    metres_per_unit: float | None,
) -> CloudColumns:
    """Return where the clouds are.

    Raises:
        CaptureError: there are none.
        FrameError, UnitError: nothing states their frame or their unit.
    """
    points = next((name for name in _NAMES if name in index.features), None)
    if points is None:
        pictures = [key for key, said in index.features.items() if "depth" in key and said.get("dtype") == "video"]
        seen = f"; {', '.join(pictures)} are pictures of depth made for viewing, whose values are no lengths"
        raise CaptureError(f"{where}: has no feature with depth, and no {CLOUD}{seen if pictures else ''}")
    shape = index.features[points].get("shape")
    if not isinstance(shape, list) or len(shape) != 2 or not 3 <= shape[1] <= 64:
        raise CaptureError(f"{where}: {points} must have the shape (N, 3) or (N, more), got {shape!r:.60}")
    said = next((one for name in _INFOS if (one := read_json(where, root, name, inside)) is not None), {})
    flat = {**said, **{key: value for one in said.values() if isinstance(one, dict) for key, value in one.items()}}
    if facts is not None:
        flat |= {"frame_id": facts.frame_id or "camera", "unit": "m"}
    frame = frame_id or next((value for name in _FRAMES if isinstance(value := flat.get(name), str) and value), None)
    if frame is None:
        raise FrameError(
            f"{where}: nothing states the frame that the points of {points} are in; say frame_id=NAME (--frame NAME)"
        )
    unit = metres_per_unit or next((unit for name in _UNITS if (unit := unit_named(flat.get(name)))), None)
    if unit is None:
        raise UnitError(
            f"{where}: nothing states the unit of {points}, which some data sets normalize; if they are metres, say "
            "metres_per_unit=1 (--metres-per-unit 1)"
        )
    base = points.removesuffix(".xyz")
    beside = {part: f"{base}.{part}" for part in ("rgb", "valid_mask") if f"{base}.{part}" in index.features}
    return CloudColumns(where, points, (shape[0], shape[1]), frame, unit, beside.get("rgb"), beside.get("valid_mask"))


def _numbers(where: str, name: str, row: Mapping[str, Any], shape: tuple[int, ...]) -> np.ndarray:
    values = row[name]
    if not isinstance(values, np.ndarray) or values.size != int(np.prod(shape)):
        found = values.size if isinstance(values, np.ndarray) else type(values).__name__
        raise CaptureError(f"{where}: {name} must hold {shape} numbers, got {found}")
    return values.reshape(shape)
