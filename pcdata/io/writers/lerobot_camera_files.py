"""One camera of captures as a LeRobot dataset keeps it: depth, color and what else has its pixels, its columns."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pcdata.errors import CaptureError, ConfigError
from pcdata.functional.depth.stored_depth import metres_of_value
from pcdata.io.sources.lerobot_facts import IMAGES, CameraFacts
from pcdata.io.writers.lerobot_columns import number_feature
from pcdata.io.writers.lerobot_stats import ColorStats
from pcdata.io.writers.lerobot_videos import VideoWriter
from pcdata.io.writers.writer import Captures
from pcdata.structures import DepthFrame

DepthStorage = Literal["auto", "ffv1", "image", "array"]
ColorStorage = Literal["video", "image", "none"]

_UNITS = (0.001, 0.0001, 0.00025, 0.0002, 0.000125)  # of sensors: tried where captures do not state theirs
_HIGHEST = 65535
_COMPRESSION = 3  # of PNG: half the time of the default, and as small


class CameraWriter:
    """The files and columns of one view, which grow a step at a time.

    Args:
        captures: told what is lost.
        folder: of the dataset.
        fps: steps in a second.
        first: the first capture, which the others must be like.
        view: its place in them.
        name: of the camera.
        depth: how depth is stored.
        metres_per_unit: what it is rounded to; None = the unit that the first capture is whole in.
        color: how color is stored.
        registered_to: whose pixels depth has; None = those of color.

    Raises:
        ConfigError: depth is to be whole numbers, and that of the first capture is not.
    """

    def __init__(
        self,
        captures: Captures,
        folder: Path,
        fps: int,
        first: DepthFrame,
        view: int,
        name: str,
        *,
        depth: DepthStorage,
        metres_per_unit: float | None,
        color: ColorStorage,
        registered_to: str | None,
    ) -> None:
        self._captures, self._view, self._asked = captures, view, metres_per_unit
        self._first_id = captures.ids[0]
        self.features: dict[str, dict[str, Any]] = {}
        height, width = first.size
        storage, self.unit = self._storage(first, depth)
        depth_key = f"depth.{name}" if storage != "image" else f"observation.images.{name}_depth"
        self._depth: VideoWriter | None = None
        if storage == "ffv1":
            self._depth = VideoWriter(folder, depth_key, fps, is_depth=True)
        elif storage == "image":
            about = {"is_depth_map": True, **({"depth_unit": "mm"} if self.unit == 0.001 else {})}
            names = ["height", "width", "channels"]
            self.features[depth_key] = {**number_feature("image", [height, width, 1], names), "info": about}
        else:
            self.features[depth_key] = number_feature("float32", [height, width], ["height", "width"])
        color_key: str | None = None
        self._color: VideoWriter | None = None
        if first.colors is not None and color == "none":
            captures.lose("color", "left out, as color=none says", captures=len(captures) if not view else 0)
        elif first.colors is not None:
            color_key = f"observation.images.{name}"
            self.features[color_key] = number_feature(color, [height, width, 3], ["height", "width", "channels"])
            if color == "video":
                self._color = VideoWriter(folder, color_key, fps, is_depth=False)
        images = {role: f"{role}.{name}" for role in IMAGES if getattr(first, role) is not None}
        self._images = {role: VideoWriter(folder, key, fps, is_depth=True) for role, key in images.items()}
        base = f"camera.{name}"
        self.features[f"{base}.intrinsics"] = number_feature("float64", [3, 3])
        lens, model, pose = None, None, None
        if first.camera.distortion is not None:
            lens = f"{base}.distortion"
            model, coefficients = first.camera.lenses[self._view]
            self.features[lens] = number_feature("float64", [len(coefficients)])
        if first.world_from_camera is not None:
            pose = f"{base}.{str(first.frame_id).replace('/', '_')}_from_camera"
            self.features[pose] = number_feature("float64", [4, 4])
        self.facts = CameraFacts(
            name=name,
            depth=depth_key,
            storage="video" if storage == "ffv1" else "image" if storage == "image" else "array",
            size=(height, width),
            intrinsics=f"{base}.intrinsics",
            metres_per_unit=self.unit,
            registered_to=registered_to or color_key,
            color=color_key,
            distortion=lens,
            world_from_camera=pose,
            is_window=first.camera.is_window,
            lens=None if model == "opencv" else model,
            images=images,
        )

    def _storage(self, first: DepthFrame, depth: DepthStorage) -> tuple[str, float | None]:
        """Return how depth is stored, and its unit."""
        if depth == "array":
            return "array", None
        unit = self._asked
        if unit is None:
            stated = first.provenance.get("metres_per_unit")
            known = [float(stated)] if isinstance(stated, (int, float)) and 0 < stated < 1 else []
            metres = first.depth[self._view].numpy()
            unit = next((one for one in [*known, *_UNITS] if _is_whole(metres, one)), None)
        if unit is not None:
            if depth == "auto" and self._asked is None:
                self._captures.note(f"depth of the first capture is whole units of {unit:g} m: FFV1 (depth=ffv1)")
            return ("ffv1" if depth == "auto" else depth), unit
        if depth == "auto":
            self._captures.note("depth is no whole units of any sensor: float32 metres in the rows (depth=array)")
            return "array", None
        raise ConfigError(
            f"lerobot: depth={depth} stores whole numbers, and the depth of {self._first_id} is no whole units "
            "of any sensor; say metres_per_unit=0.0001 to round to a tenth of a millimetre (it reaches 6.5 m), or "
            "depth=array to keep it as it is"
        )

    def begin(self) -> None:
        """Start an episode."""
        self.color_stats = ColorStats()

    def add(self, row: dict[str, Any], frame: DepthFrame) -> tuple[float, int]:
        """Add a step; return by how many metres its depth is rounded, and how many readings are left out.

        Raises:
            CaptureError: labels that 16 bits do not hold, or depth that is not in the unit of the first capture.
        """
        facts, view = self.facts, self._view
        metres = frame.depth[view].numpy()
        off, beyond = 0.0, 0
        if self.unit is None:
            row[facts.depth] = metres
        else:
            units, off, beyond = self._units(frame.sample_id, metres, self.unit)
            if self._depth is not None:
                self._depth.add(units)
            else:
                row[facts.depth] = _png(units)
        if facts.color is not None and frame.colors is not None:
            color = frame.colors[view].numpy()
            if self._color is not None:
                self._color.add(color)
                if not view:
                    self._captures.lose("color", "coded as H.264; color=image keeps it as it is", captures=1)
            else:
                row[facts.color] = _png(color)
            self.color_stats.add(color)
        for role, video in self._images.items():
            values = getattr(frame, role)[view].numpy().astype(np.int64) + (role == "labels")
            if values.min() < 0 or values.max() > _HIGHEST:
                raise CaptureError(
                    f"{frame.sample_id}: labels must lie in -1 .. {_HIGHEST - 1} to be written in 16 bits, got "
                    f"{values.min() - 1} .. {values.max() - 1}; give them other ids"
                )
            video.add(values.astype(np.uint16))
        row[facts.intrinsics] = frame.camera.intrinsics[view].numpy()
        if facts.distortion is not None and frame.camera.distortion is not None:
            row[facts.distortion] = np.array(frame.camera.lenses[view][1], dtype=np.float64)
        if facts.world_from_camera is not None and frame.world_from_camera is not None:
            row[facts.world_from_camera] = frame.world_from_camera[view].numpy()
        return off, beyond

    def _units(self, sample_id: str, metres: NDArray[np.float32], unit: float) -> tuple[NDArray[np.uint16], float, int]:
        """Return depth in whole units, by how many metres that differs, and how many readings it has not."""
        units = np.rint(metres.astype(np.float64) / unit)
        beyond = (units > _HIGHEST) | ((units == 0) & (metres > 0))
        units[beyond] = 0
        stored: NDArray[np.uint16] = units.astype(np.uint16)
        off = np.abs(metres_of_value(unit)[stored].astype(np.float64) - metres)[~beyond]
        lost = float(off.max(initial=0.0)), int(beyond.sum())
        if self._asked is None and any(lost):
            finer = next((one for one in _UNITS if _is_whole(metres, one)), unit)
            raise CaptureError(
                f"{sample_id}: its depth is no whole units of {unit:g} m, unlike that of {self._first_id}, by which "
                f"the dataset stores it; say metres_per_unit={finer:g} (--set metres_per_unit={finer:g}) to round all "
                "to that, or depth=array to keep it as it is"
            )
        return stored, *lost

    def videos(self) -> list[tuple[str, str, VideoWriter]]:
        """Return what it writes into videos: the role, the key and the video of each."""
        found = []
        if self._depth is not None:
            found.append(("depth", self.facts.depth, self._depth))
        if self._color is not None and self.facts.color is not None:
            found.append(("color", self.facts.color, self._color))
        return [*found, *((role, self.facts.images[role], video) for role, video in self._images.items())]


def _is_whole(metres: NDArray[np.float32], unit: float) -> bool:
    """Whether depth is whole units, bit for bit as the reader gives it back."""
    units = np.rint(metres.astype(np.float64) / unit)
    return bool(units.max() <= _HIGHEST and (metres_of_value(unit)[units.astype(np.uint16)] == metres).all())


def _png(pixels: NDArray[Any]) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG", compress_level=_COMPRESSION)
    return buffer.getvalue()
