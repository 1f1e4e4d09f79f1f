"""The capture: depth images with their cameras, before they become points."""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from pcdata.contracts.host import any_above, any_negative
from pcdata.contracts.known import FINITE, METRES, NOT_NEGATIVE, is_known, note, pass_on
from pcdata.contracts.lengths import FARTHEST, check_depth
from pcdata.contracts.on_host import look
from pcdata.contracts.tensors import check_tensors
from pcdata.errors import CaptureError, FrameError, ShapeError
from pcdata.functional.depth.confidence import Confidence
from pcdata.functional.depth.deproject import mask_depth
from pcdata.functional.depth.stored_depth import depth_in_metres
from pcdata.geometry import rigid
from pcdata.structures.camera import Camera, check_view
from pcdata.structures.image_arrays import camera_of, image_tensor, pose_tensor
from pcdata.structures.kinds import CAMERA_FRAME
from pcdata.structures.point_arrays import signals_of_arrays
from pcdata.structures.showing import shown_page
from pcdata.structures.signal_joining import check_same_signals, joined_signals, remaining_signals
from pcdata.structures.signals import Signal, Values, check_signal_form, checked_signal, told_signals
from pcdata.structures.structure import Structure, derived

_SAMPLE = 1 << 12  # readings
_INTEGERS = ("int64", "int32", "int16", "int8", "uint8", "uint16", "uint32")
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
        recorded_signals: name -> what belongs to the moment and not to a pixel (joints, action, text), one row each;
            attached by :meth:`with_signal`.
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
    recorded_signals: Mapping[str, Signal] = field(default_factory=dict)

    def __post_init__(self) -> None:
        where = f"DepthFrame {self.sample_id!r}" if self.sample_id else "DepthFrame"
        if isinstance(self.depth, Tensor) and self.depth.dtype is torch.float32:
            _look_once(self.depth)
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
        if not is_known(METRES, self.depth):
            some = _sample_of(self.depth).cpu().numpy()
            check_depth(where, some[some > 0])
            note(METRES, self.depth)
        if self.confidence is not None and any_above(self.confidence, int(max(Confidence))):
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
        for name, signal in self.recorded_signals.items():
            self._check_signal(f"{where}: signal {name!r:.200}", name, signal)

    @classmethod
    def from_numpy(
        cls,
        depth: ArrayLike,  # (H, W) or (V, H, W): whole numbers of 16 bits or more, or floats
        intrinsics: ArrayLike | Camera,  # (3, 3) or (V, 3, 3) pixels of this very image size; or the cameras
        *,
        metres_per_unit: float | None = None,  # of depth, e.g. 0.001 for millimetres; None = floats are metres
        colors: ArrayLike | None = None,  # (H, W, 3) or (V, H, W, 3) uint8 RGB at the depth's pixels
        world_from_camera: ArrayLike | None = None,  # (4, 4) or (V, 4, 4) rigid
        frame_id: str | None = None,  # the frame that world_from_camera leads to, e.g. "base"
        distortion: ArrayLike | None = None,  # (D,) or (V, D), in OpenCV's order
        labels: ArrayLike | None = None,  # (H, W) or (V, H, W) whole numbers, -1 = none
        confidence: ArrayLike | None = None,  # (H, W) or (V, H, W) uint8, values of Confidence
        mask: ArrayLike | None = None,  # (H, W) or (V, H, W) bool, True = inside the region of interest
        invalid_values: Collection[int] = (),  # stored depths besides 0 that mean "no reading", e.g. (65535,)
        capture_index: int = 0,
        sample_id: str = "",
        signals: Mapping[str, Sequence[Any]] | None = None,  # name -> (values of this moment, kind[, frame])
    ) -> DepthFrame:
        """Make a capture of arrays in memory, as a camera's driver or a simulator gives them.

        All arrays are copied: the driver may use its buffers again. Depth becomes the metres that reading it from a
        file would give; NaN and infinite depth means "no reading". What arrays cannot show must be right: depth is z
        along the optical axis, not the length of the ray; colors are RGB (OpenCV's are BGR: ``colors[..., ::-1]``);
        camera axes are OpenCV's, x right, y down, z forward (of OpenGL's poses, ``pose @ np.diag([1, -1, -1, 1])``).

        Signals are what belongs to the moment: ``{"joints": (q, "invariant"), "eef": (pose, "pose xyz_quat_xyzw",
        "base"), "task": ("pick the cube", "text")}``, q (7,) or with a horizon (H, 7); see docs/signals.md.

        Raises:
            UnitError: whole numbers without a unit, or depth where no camera sees.
            ShapeError: an image of another size than depth, or with its channels first.
            DTypeError: an array of another dtype.
            IntrinsicsError: intrinsics of another image size.
            PoseError: a pose that is not rigid, is a mirror or is transposed.
            CaptureError: negative depth; a pose without its frame.
            ConfigError, FrameError, NonFiniteError: signals, as :meth:`with_signal`.
        """
        where = "DepthFrame.from_numpy"
        stored = np.asarray(depth)
        if stored.ndim not in (2, 3) or 0 in stored.shape:
            raise ShapeError(f"{where}: depth must be (H, W) or (V, H, W), got {stored.shape}")
        if stored.ndim == 3 and stored.shape[2] <= 4 < min(stored.shape[:2]):
            raise ShapeError(
                f"{where}: depth must be (H, W) or (V, H, W), got {stored.shape}, which ends in channels: give "
                "depth[..., 0] if that is the depth; a picture of the depth in colors holds no lengths"
            )
        stored = stored[None] if stored.ndim == 2 else stored
        views, *size = stored.shape
        frame = cls(
            depth=torch.from_numpy(depth_in_metres(where, stored, metres_per_unit, invalid_values)),
            camera=camera_of(where, intrinsics, distortion, views, (size[0], size[1])),
            colors=image_tensor(where, "colors", colors, stored.shape, dtypes=("uint8",), channels=(3,)),
            labels=image_tensor(where, "labels", labels, stored.shape, dtypes=_INTEGERS),
            confidence=image_tensor(where, "confidence", confidence, stored.shape, dtypes=("uint8",)),
            mask=image_tensor(where, "mask", mask, stored.shape, dtypes=("bool",)),
            world_from_camera=pose_tensor(where, world_from_camera, views),
            frame_id=frame_id,
            capture_index=capture_index,
            sample_id=sample_id,
            provenance={} if metres_per_unit is None else {"metres_per_unit": float(metres_per_unit)},
        )
        if not signals:
            return frame
        for name, (values, *said) in signals_of_arrays(where, signals).items():
            frame = frame.with_signal(name, values, *said)
        return frame

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

    def _mapped(self, move: Callable[[Tensor], Tensor]) -> DepthFrame:
        moved = super()._mapped(move)
        if moved.device != self.device:
            for fact in (FINITE, NOT_NEGATIVE, METRES):  # the constructor has looked
                note(fact, moved.depth)
        return moved

    def view(self, index: int) -> DepthFrame:
        """Return one view as a frame of its own.

        Raises:
            ShapeError: there is no such view; views count from 0.
        """
        check_view("DepthFrame", index, self.num_views)
        keep = slice(index, index + 1)
        images = {name: None if image is None else image[keep] for name, image in self._tensors().items()}
        return derived(self, camera=self.camera.view(index), **images)

    def masked(self, *, near: float | None = None, far: float | None = None, mask: Tensor | None = None) -> DepthFrame:
        """Return the frame with "no reading" wherever depth is not in [near, far] or ``mask`` (V, H, W) is False."""
        check_tensors("DepthFrame.masked", {"depth": self.depth, "mask": mask}, _MASKED, check_values=False)
        depth = mask_depth(self.depth, near, far, mask)
        pass_on(self.depth, depth)
        note(NOT_NEGATIVE, depth)  # what is NaN or below 0 is no reading
        if far is not None:
            note(FINITE, depth)
        return derived(self, depth=depth)

    def with_provenance(self, entries: Mapping[str, Any]) -> DepthFrame:
        """Merge JSON-able facts into the provenance."""
        return derived(self, provenance={**self.provenance, **entries})

    @property
    def signals(self) -> Mapping[str, Any]:
        """Name -> (1, ...) tensor, or one text, as it was recorded; ``recorded_signals[name]`` says kind and frame."""
        return {name: signal.values for name, signal in self.recorded_signals.items()}

    def with_signal(self, name: str, values: Values, kind: str, frame: str | None = None) -> DepthFrame:
        """Attach or replace one signal of the moment, which all views share and their clouds keep.

        Args:
            name: any printable text.
            values: (1, ...) tensor, with free axes such as a horizon after the first; or one text in a tuple.
            kind: "invariant", "position", "displacement", "direction", "pose LAYOUT", "delta_pose LAYOUT", "text", or
                columns of several, "pose xyz_quat_xyzw + invariant 1"; see docs/signals.md.
            frame: of its spatial parts: where the poses lead to (``frame_id``), or "camera" for one view.

        Raises:
            ConfigError: there is no such kind, or it leaves open what it must state.
            FrameError: the capture does not know the frame, or the kind has none.
            ShapeError, DTypeError, DeviceError, NonFiniteError, PoseError: the values are not of that kind.
        """
        where = f"DepthFrame.with_signal({name!r:.200})"
        signal = checked_signal(where, name, values, kind, frame)
        self._check_signal(where, name, signal)
        return derived(self, recorded_signals={**self.recorded_signals, name: signal})

    def without_signal(self, *names: str) -> DepthFrame:
        """Drop signals.

        Raises:
            DTypeError: there is none of that name.
        """
        kept = remaining_signals("DepthFrame.without_signal", self.recorded_signals, names)
        return derived(self, recorded_signals=kept)

    def _check_signal(self, where: str, name: str, signal: Signal) -> None:
        check_signal_form(where, name, signal, 1, self.depth.device)
        if signal.frame is None or signal.frame == self.frame_id:
            return
        if signal.frame == CAMERA_FRAME and self.num_views > 1:
            raise FrameError(
                f"{where}: is in {CAMERA_FRAME!r}, but {self.num_views} views have a camera each; give it in "
                f"{self.frame_id or 'the frame that their poses lead to'!r}"
            )
        if signal.frame != CAMERA_FRAME:
            known = [CAMERA_FRAME] if self.frame_id is None else [CAMERA_FRAME, self.frame_id]
            raise FrameError(
                f"{where}: is in {signal.frame!r:.100}, but the capture knows the frames {known}; give it its poses "
                "(world_from_camera) and the name of the frame that they lead to (frame_id; --frame, or frame_id in "
                "intrinsics.json), or the signal in one of these"
            )

    def _tensors(self) -> dict[str, Tensor | None]:
        names = ("depth", "colors", "labels", "confidence", "mask", "world_from_camera")
        return {name: getattr(self, name) for name in names}

    def show(self, *, max_points: int = 200_000) -> Any:
        """Return a :class:`pcdata.report.Page` with the points that the images show; see :meth:`PointCloud.show`."""
        return shown_page([("capture", self)], repr(self), max_points=max_points)

    def __repr__(self) -> str:
        height, width = self.size
        carried = [name for name, tensor in self._tensors().items() if tensor is not None]
        told = told_signals(self.recorded_signals)
        views = f"{self.num_views} view{'s' * (self.num_views != 1)}"
        return f"DepthFrame({self.sample_id!r}, {views} of {width}x{height}: {', '.join(carried)}{told})"


def _sample_of(depth: Tensor) -> Tensor:
    """Return some thousand pixels: they tell the median."""
    return depth.detach().flatten()[:: max(1, depth.numel() // _SAMPLE)]


def _look_once(depth: Tensor) -> None:
    """Wait once for all that is to be known of depth on another device."""

    def looks_like_metres() -> Tensor:
        some = _sample_of(depth)
        return (some > FARTHEST).sum() * 2 < (some > 0).sum()

    answers: dict[Hashable, Callable[[], Tensor]] = {
        FINITE: lambda: torch.isfinite(depth).all(),
        NOT_NEGATIVE: lambda: ~(depth < 0).any(),
        METRES: looks_like_metres,
    }
    look(depth, answers)


def signals_of_views(frames: Sequence[DepthFrame]) -> dict[str, Any]:
    """Return the signals of captures for each of their views, each in its camera's frame: name -> values.

    Raises:
        ShapeError, FrameError, DTypeError: the captures carry different signals.
    """
    if not any(frame.recorded_signals for frame in frames):
        return {}
    for position, frame in enumerate(frames):
        check_same_signals("signals_of_views", frames[0].recorded_signals, frame.recorded_signals, position)
    return {name: signal.values for name, signal in joined_signals([_in_cameras(frame) for frame in frames]).items()}


def _in_cameras(frame: DepthFrame) -> dict[str, Signal]:
    seen = {}
    for name, signal in frame.recorded_signals.items():
        signal = signal.repeated(frame.num_views)
        if signal.frame == frame.frame_id and frame.world_from_camera is not None:
            signal = Signal(signal.moved(rigid.invert_rigid(frame.world_from_camera)), signal.kind, CAMERA_FRAME)
        seen[name] = signal
    return seen
