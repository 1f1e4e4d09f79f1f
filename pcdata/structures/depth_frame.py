"""The capture: depth images with their cameras, before they become points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from pcdata.contracts.host import any_negative
from pcdata.contracts.lengths import check_depth
from pcdata.contracts.tensors import check_tensors
from pcdata.errors import CaptureError, ShapeError
from pcdata.functional.depth.deproject import mask_depth
from pcdata.geometry import rigid
from pcdata.structures.camera import Camera, check_view
from pcdata.structures.confidence import Confidence
from pcdata.structures.structure import Structure, derived

CAMERA_FRAME = "camera"
_SAMPLE = 1 << 12  # readings
_MASKED = {"depth": "V H W", "mask": "V H W : bool"}


@dataclass(frozen=True, eq=False, kw_only=True)
class DepthFrame(Structure):
    """V >= 1 views of one image size, taken at one moment.

    Depth is the z coordinate in metres; 0 means "no reading". NaN, infinite and negative depth is refused here: the
    reader cleans or rejects it, so no later step meets it.

    Args:
        depth: (V, H, W) float32 metres, 0 = no reading.
        camera: V cameras of size (H, W).
        colors: (V, H, W, 3) uint8 RGB.
        labels: (V, H, W) int64, -1 = none.
        confidence: (V, H, W) uint8, values of Confidence; None = every reading is RELIABLE.
        mask: (V, H, W) bool, True = inside the region of interest.
        world_from_camera: (V, 4, 4) float64 rigid.
        frame_id: the frame that world_from_camera leads to, e.g. "base".
        capture_index: position in the sequence.
        sample_id: the name of the capture within its source.
        provenance: JSON-able facts: files, unit, sensor.
    """

    depth: Tensor
    camera: Camera
    colors: Tensor | None = None
    labels: Tensor | None = None
    confidence: Tensor | None = None
    mask: Tensor | None = None
    world_from_camera: Tensor | None = None
    frame_id: str | None = None
    capture_index: int = 0
    sample_id: str = ""
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        where = f"DepthFrame {self.sample_id!r}" if self.sample_id else "DepthFrame"
        check_tensors(
            where,
            {
                "depth": self.depth,
                "colors": self.colors,
                "labels": self.labels,
                "confidence": self.confidence,
                "mask": self.mask,
            },
            {
                "depth": "V H W : float32",
                "colors": "V H W 3 : uint8",
                "labels": "V H W : int64",
                "confidence": "V H W : uint8",
                "mask": "V H W : bool",
            },
        )
        # Its shape is tied to the depth, its values have their own check: NaN in a pose means lost tracking.
        check_tensors(
            where,
            {"depth": self.depth, "world_from_camera": self.world_from_camera},
            {"depth": "V H W : float32", "world_from_camera": "V 4 4 : float64"},
            check_values=False,
        )
        if any_negative(self.depth):
            raise CaptureError(f"{where}: depth has negative values; 0 is the only mark for 'no reading'")
        # Some thousand pixels tell the median; on a GPU they are one small copy.
        some = self.depth.flatten()[:: max(1, self.depth.numel() // _SAMPLE)].detach().cpu().numpy()
        check_depth(where, some[some > 0])
        if self.confidence is not None and bool((self.confidence > max(Confidence)).any()):
            raise CaptureError(
                f"{where}: confidence must hold the values of Confidence, 0 .. {max(Confidence)}, got "
                f"{int(self.confidence.max())}; translate a sensor's own confidence where it is read"
            )
        if self.camera.num_views != self.num_views or self.camera.size != self.size:
            raise ShapeError(
                f"{where}: depth has {self.num_views} views of {self.size} but the camera describes "
                f"{self.camera.num_views} views of {self.camera.size}"
            )
        if (self.world_from_camera is None) != (self.frame_id is None):
            raise CaptureError(f"{where}: give world_from_camera and the frame_id it leads to together, or neither")
        if self.world_from_camera is not None:
            if self.frame_id == CAMERA_FRAME:
                raise CaptureError(f"{where}: frame_id names where the poses lead to; {CAMERA_FRAME!r} is the start")
            rigid.check_rigid(f"{where}: world_from_camera", self.world_from_camera)

    @property
    def num_views(self) -> int:
        """The number of views V."""
        return self.depth.shape[0]

    @property
    def size(self) -> tuple[int, int]:
        """Image size as (height, width)."""
        return self.depth.shape[1], self.depth.shape[2]

    @property
    def device(self) -> torch.device:
        """Where the depth lies."""
        return self.depth.device

    def view(self, index: int) -> DepthFrame:
        """Return one view as a frame of its own.

        Raises:
            ShapeError: there is no such view; views count from 0.
        """
        check_view("DepthFrame", index, self.num_views)
        keep = slice(index, index + 1)
        images = {name: None if image is None else image[keep] for name, image in self._tensors().items()}
        return replace(self, camera=self.camera.view(index), **images)  # type: ignore[arg-type]

    def masked(self, *, near: float | None = None, far: float | None = None, mask: Tensor | None = None) -> DepthFrame:
        """Return the frame with "no reading" wherever depth is not in [near, far] or ``mask`` (V, H, W) is False."""
        check_tensors("DepthFrame.masked", {"depth": self.depth, "mask": mask}, _MASKED, check_values=False)
        return derived(self, depth=mask_depth(self.depth, near, far, mask))

    def with_provenance(self, entries: Mapping[str, Any]) -> DepthFrame:
        """Merge JSON-able facts into the provenance."""
        return derived(self, provenance={**self.provenance, **entries})

    def _tensors(self) -> dict[str, Tensor | None]:
        names = ("depth", "colors", "labels", "confidence", "mask", "world_from_camera")
        return {name: getattr(self, name) for name in names}

    def __repr__(self) -> str:
        height, width = self.size
        carried = [name for name, tensor in self._tensors().items() if tensor is not None]
        return f"DepthFrame({self.sample_id!r}, {self.num_views} views of {width}x{height}: {', '.join(carried)})"
