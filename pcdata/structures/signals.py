"""Signals: what belongs to a cloud and not to its points, such as joints, the pose of the gripper, the action, a text.

They are kept as they were recorded, with the frame that they were recorded in. No step moves them: a cloud knows how
its coordinates came about, and gives them in its own when they are read. So no step can forget one, and none rounds.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from pcdata.errors import DeviceError, DTypeError, FrameError, NonFiniteError, PoseError, ShapeError
from pcdata.structures.kinds import CAMERA_FRAME
from pcdata.structures.pose_layouts import motion_by
from pcdata.structures.pose_rows import checked_pose_layout, continued_along, poses_rewritten
from pcdata.structures.signal_kinds import moved_values, parse_kind, pose_faults
from pcdata.structures.structure import Structure, derived

if TYPE_CHECKING:
    from pcdata.structures.cloud_batch import CloudBatch

Values = Tensor | tuple[str, ...]

_LONGEST_NAME = 200
_MOST_AXES = 32  # what every array library takes
_FLOATS = (torch.float32, torch.float64, torch.float16, torch.bfloat16)


@dataclass(frozen=True, eq=False)
class Signal(Structure):
    """A signal of B clouds, as it was recorded.

    Args:
        values: (B, ...) tensor; free axes, such as a horizon, lie between the clouds and the row that the kind acts on.
            B texts for the kind "text".
        kind: what the values are, see docs/signals.md: "invariant", "position", "displacement", "direction",
            "pose LAYOUT", "delta_pose LAYOUT", "text", or columns of several, "position + invariant 1".
        frame: the coordinate frame of its spatial parts; None where it has none.

    Raises:
        ConfigError: there is no such kind, or it leaves open what it must state.
        DTypeError, ShapeError, NonFiniteError, PoseError: the values are not of that kind.
        FrameError: a spatial signal without a frame, or one that is not spatial with one.
    """

    values: Values
    kind: str
    frame: str | None = None

    def __post_init__(self) -> None:
        self._check("Signal")

    def _check(self, where: str) -> Signal:
        kind = parse_kind(self.kind)
        fill = object.__setattr__  # the class is frozen
        fill(self, "kind", kind.text)
        values: Any = self.values  # as the caller left it, whatever the annotations promise
        if kind.is_text and isinstance(values, list):
            fill(self, "values", tuple(values))
        if kind.is_spatial and not (isinstance(self.frame, str) and self.frame):
            raise FrameError(f"{where}: a {kind.text!r} is in a frame; say which, got {self.frame!r:.100}")
        if not kind.is_spatial and self.frame is not None:
            raise FrameError(f"{where}: a {kind.text!r} is in no frame; leave frame out, got {self.frame!r:.100}")
        _check_values(where, self.values, kind.text)
        return self

    @property
    def is_spatial(self) -> bool:
        """Whether a motion of the cloud changes it."""
        return parse_kind(self.kind).is_spatial

    def __len__(self) -> int:
        return len(self.values)

    def rows(self, which: slice | Tensor) -> Signal:
        """Return those of some clouds: a slice, or (M,) int64 indices."""
        if isinstance(self.values, tuple):
            texts = self.values[which] if isinstance(which, slice) else [self.values[i] for i in which.tolist()]
            return derived(self, values=tuple(texts))
        return derived(self, values=self.values[which])

    def repeated(self, count: int) -> Signal:
        """Return the values of one cloud for ``count`` clouds; the memory is shared."""
        if count == 1 or isinstance(self.values, tuple):
            return self if count == 1 else derived(self, values=self.values * count)
        return derived(self, values=self.values.expand(count, *self.values.shape[1:]))

    def moved(self, matrix: Tensor) -> Values:
        """Return the values after a motion by affine (B, 4, 4), to_from: computed in float64, in the dtype they have.

        Where a matrix is the identity they are the recorded ones, bit for bit.

        Raises:
            ShapeError: matrices for another number of clouds; one moves all.
            PoseError: a matrix mirrors a pose, or is singular or not finite.
        """
        if isinstance(self.values, tuple):
            return self.values
        _check_motion("Signal.moved", matrix, len(self))
        return _moved(f"Signal.moved: a {self.kind!r}", self, motion_by(matrix.to(device=self.values.device)))

    def with_poses_as(self, layout: str, *, along: int | None = None) -> Signal:
        """Return the same poses written in another layout of a row, such as ``"xyz_rot6d_rows"``; the dtype stays.

        A rotation alone becomes the rotation part of the layout. What is no pose, and a pose in this layout already,
        keeps its bits. A quaternion comes out with w >= 0.

        Args:
            layout: how a pose is written, see docs/signals.md.
            along: the axis of the values along which poses follow each other in time, 0 of a whole episode, 1 of a
                horizon: then every quaternion has the sign nearest to the one before, so that it does not jump where
                w passes 0. None = they are poses of their own.

        Raises:
            ConfigError: there is no such layout of a row.
            ShapeError: the values have no such axis.
        """
        checked_pose_layout("Signal.with_poses_as", layout)
        if isinstance(self.values, tuple):
            return self
        kind, values = poses_rewritten(self.kind, self.values, layout)
        if along is not None:
            values = continued_along(kind, values, along)
        return replace(self, kind=kind, values=values)

    def same_bits(self, other: Signal) -> bool:
        """Whether the other is of the same kind, frame, dtype and shape, and all its values are the same."""
        if (self.kind, self.frame) != (other.kind, other.frame):
            return False
        if isinstance(self.values, tuple) or isinstance(other.values, tuple):
            return self.values == other.values if type(self.values) is type(other.values) else False
        alike = self.values.dtype == other.values.dtype and self.values.shape == other.values.shape
        return alike and torch.equal(self.values, other.values)

    def __repr__(self) -> str:
        frame = "" if self.frame is None else f" in {self.frame!r}"
        if isinstance(self.values, tuple):
            return f"Signal({len(self)} texts)"
        return f"Signal({self.kind!r}{frame}: {tuple(self.values.shape)} {self.values.dtype})"


Signals = Mapping[str, Signal]


def signals_now(clouds: CloudBatch) -> MovedSignals:
    """Return the signals of clouds by name, in the coordinates that these have now."""
    return MovedSignals(clouds)


class MovedSignals(Mapping[str, Any]):
    """The signals of clouds in the coordinates that these have now, by name; each is computed when it is read."""

    def __init__(self, clouds: CloudBatch) -> None:
        self._recorded = clouds.recorded_signals
        self._clouds = clouds
        self._motions: dict[str, Any] = {}  # by the frame they start from: one inverse for all signals of a frame

    def __getitem__(self, name: str) -> Any:
        if name not in self._recorded:
            raise KeyError(f"the clouds have no signal {name!r}; they have {sorted(self._recorded)}")
        signal = self._recorded[name]
        return signal.values if signal.frame is None else self._moved(name, signal, self._motion(signal.frame))

    def of(self, name: str, which: Tensor) -> Values:
        """Return the values of some clouds alone, by (M,) int64 indices: the others are not computed."""
        signal = self._recorded[name].rows(which)
        if signal.frame is None:
            return signal.values
        return self._moved(name, signal, motion_by(self._motion(signal.frame).matrix[which]))

    def _motion(self, frame: str) -> Any:
        if frame not in self._motions:
            self._motions[frame] = motion_by(cloud_from_frame(self._clouds, frame))
        return self._motions[frame]

    def _moved(self, name: str, signal: Signal, motion: Any) -> Values:
        return _moved(f"{type(self._clouds).__name__}.signals[{name!r}]", signal, motion)

    def __contains__(self, name: object) -> bool:
        return name in self._recorded  # without computing it

    def __iter__(self) -> Iterator[str]:
        return iter(self._recorded)

    def __len__(self) -> int:
        return len(self._recorded)

    def __repr__(self) -> str:
        return f"signals({', '.join(f'{name}: {signal!r}' for name, signal in self._recorded.items())})"


def cloud_from_frame(clouds: CloudBatch, frame: str) -> Tensor:
    """Return (B, 4, 4) float64 from a frame that the clouds know to the coordinates they have now.

    Not by the name of the frame they are in: a cloud that was turned is still in "base", and its coordinates are not.
    """
    return torch.linalg.inv(_frame_from_cloud(clouds, frame))


def is_frame_of_camera(clouds: CloudBatch, frame: str) -> bool:
    """Whether a frame goes where the camera goes: its own, also after views were merged.

    A frame with a name of its own stays where it is, also that of a source: what moves in it, such as a hand, moves.
    """
    return frame == CAMERA_FRAME and CAMERA_FRAME in {clouds.source_frame, *clouds.frames}


def _frame_from_cloud(clouds: CloudBatch, frame: str) -> Tensor:
    if frame == clouds.source_frame:
        return clouds.source_from_cloud
    return clouds.frames[frame] @ clouds.source_from_cloud


def attached(where: str, clouds: CloudBatch, name: str, values: Values, kind: str, frame: str | None) -> Signal:
    """Return a signal of clouds as they keep it; without a frame the values are in the coordinates they have now."""
    where = f"{where}({name!r:.{_LONGEST_NAME}})"
    check_signal_name(where, name)
    parsed = parse_kind(kind)
    in_source = parsed.is_spatial and frame is None
    signal = _checked(where, values, kind, clouds.source_frame if in_source else frame)
    _check_of_clouds(where, clouds, name, signal, {})
    if not in_source:
        return signal
    return derived(signal, values=_moved(where, signal, motion_by(clouds.source_from_cloud)))


def checked_signal(where: str, name: str, values: Values, kind: str, frame: str | None) -> Signal:
    """Return a signal; ``where`` is the place of this one in whatever is wrong with it."""
    check_signal_name(where, name)
    return _checked(where, values, kind, frame)


def _checked(where: str, values: Values, kind: str, frame: str | None) -> Signal:
    signal: Signal = object.__new__(Signal)
    signal.__dict__.update(values=values, kind=kind, frame=frame)
    return signal._check(where)


def check_signal_name(where: str, name: str) -> None:
    """Raise unless it names a signal: any printable text, as other projects call theirs."""
    if not (isinstance(name, str) and 0 < len(name) <= _LONGEST_NAME and name.isprintable()):
        raise DTypeError(f"{where}: a signal's name must be a printable text of 1 to {_LONGEST_NAME} characters")


def check_signals(clouds: CloudBatch) -> None:
    """Raise unless the signals of clouds fit them."""
    ways: dict[str, tuple[bool, bool]] = {}  # of each frame, looked at once for all of its signals
    for name, signal in clouds.recorded_signals.items():
        _check_of_clouds(f"{type(clouds).__name__}: signal {name!r:.{_LONGEST_NAME}}", clouds, name, signal, ways)


def check_signal_form(where: str, name: str, signal: Signal, count: int, device: torch.device) -> None:
    """Raise unless it is a signal with ``count`` values on a device."""
    check_signal_name(where, name)
    given: Any = signal  # whatever the annotations promise
    if not isinstance(given, Signal):
        raise DTypeError(f"{where}: must be a Signal, got {type(given).__name__}; attach it by with_signal")
    if len(signal) != count:
        found = f"{len(signal)} texts" if isinstance(signal.values, tuple) else tuple(signal.values.shape)
        one = "; values[None] is that of one" if count == 1 else ""
        raise ShapeError(f"{where}: must begin with one value per cloud, {count}, got {found}{one}")
    if isinstance(signal.values, Tensor) and signal.values.device != device:
        raise DeviceError(f"{where}: is on {signal.values.device} but the rest is on {device}; move it with .to()")


def _check_of_clouds(
    where: str, clouds: CloudBatch, name: str, signal: Signal, ways: dict[str, tuple[bool, bool]]
) -> None:
    device = clouds.source_from_cloud.device
    check_signal_form(where, name, signal, clouds.num_clouds, device)
    if signal.frame is None:
        return
    if signal.frame != clouds.source_frame and signal.frame not in clouds.frames:
        known = sorted({clouds.source_frame, *clouds.frames})
        raise FrameError(
            f"{where}: is in {signal.frame!r:.100}, but the clouds know the frames {known}; give the captures their "
            "poses, or leave frame out for the coordinates that the clouds have now"
        )
    if device.type == "cpu":  # a GPU would make the host wait; there a mirror is refused where it is done
        is_way, mirrors = ways.get(signal.frame) or ways.setdefault(signal.frame, _way_to(clouds, signal.frame))
        if not is_way:
            raise PoseError(
                f"{where}: no way leads from {signal.frame!r:.100} to the clouds: their matrices are singular"
            )
        if mirrors and parse_kind(signal.kind).has_pose:
            raise PoseError(_mirrored(where))


def _way_to(clouds: CloudBatch, frame: str) -> tuple[bool, bool]:
    """Say whether a frame and the clouds lead to each other, and whether one is the mirror image of the other."""
    determinant = torch.linalg.det(_frame_from_cloud(clouds, frame)[:, :3, :3])
    return bool((torch.isfinite(determinant) & (determinant != 0)).all()), bool((determinant < 0).any())


def refuse_mirror(where: str, signals: Signals, matrix: Tensor) -> None:
    """Raise if any of the affine (B, 4, 4) mirrors clouds that have a pose."""
    poses = [name for name, signal in signals.items() if parse_kind(signal.kind).has_pose]
    if poses and bool((torch.linalg.det(matrix[:, :3, :3].double()) < 0).any()):
        raise PoseError(_mirrored(f"{where}: signal {', '.join(map(repr, poses))}"))


def _mirrored(where: str) -> str:
    return (
        f"{where}: a mirrored pose does not exist, and the clouds are mirrored (determinant < 0); leave the flip out, "
        "or drop the signal before it by without_signal"
    )


def told_signals(signals: Mapping[str, Any]) -> str:
    """Return ``; signals a, b`` for a structure's repr, or nothing."""
    return f"; signals {', '.join(signals)}" if signals else ""


def _moved(where: str, signal: Signal, motion: Any) -> Values:
    values, kind = signal.values, parse_kind(signal.kind)
    if not kind.is_spatial or not isinstance(values, Tensor) or motion.all_rest:
        return values
    if kind.has_pose and bool((motion.handedness < 0).any()):
        raise PoseError(_mirrored(where))
    return moved_values(values, kind.parts, motion)


def _check_motion(where: str, matrix: Tensor, count: int) -> None:
    if matrix.shape not in ((count, 4, 4), (1, 4, 4)):
        raise ShapeError(f"{where}: matrix must be ({count}, 4, 4), one per cloud, got {tuple(matrix.shape)}")
    if matrix.device.type == "cpu":
        determinant = torch.linalg.det(matrix[:, :3, :3].double())
        if not bool(torch.isfinite(matrix).all() and (determinant != 0).all()):
            raise PoseError(f"{where}: matrix must be finite and invertible; is it filled?")


def _check_values(where: str, values: Any, kind_text: str) -> None:
    kind = parse_kind(kind_text)
    if kind.is_text:
        if not isinstance(values, tuple) or not all(isinstance(text, str) for text in values):
            raise DTypeError(f"{where}: a text needs a tuple of texts, one per cloud, got {values!r:.100}")
        return
    if not isinstance(values, Tensor):
        raise DTypeError(
            f"{where}: values must be a torch.Tensor (B, ...), not {type(values).__name__}; torch.from_numpy(array) "
            "makes one of an array"
        )
    narrow = values.is_floating_point() and values.dtype not in _FLOATS
    if values.is_nested or values.dtype.is_complex or values.is_quantized or values.is_sparse or narrow:
        raise DTypeError(f"{where}: must be numbers side by side, got {values.dtype} {values.layout}")
    if kind.is_spatial and not values.is_floating_point():
        raise DTypeError(f"{where}: a {kind.text!r} is moved with its cloud, so it must be floats, got {values.dtype}")
    row = kind.row
    if values.ndim < 1 or (row is not None and (values.ndim <= len(row) or tuple(values.shape[-len(row) :]) != row)):
        wanted = ", ".join(map(str, ("B", "...", *(row or ()))))
        one = "; values[None] is that of one cloud" if row is not None and tuple(values.shape) == row else ""
        raise ShapeError(f"{where}: a {kind.text!r} must be ({wanted}), got {tuple(values.shape)}{one}")
    if values.ndim > _MOST_AXES:
        raise ShapeError(f"{where}: must have {_MOST_AXES} axes at most, got {values.ndim}")
    if values.device.type == "meta":
        return
    if values.is_floating_point() and not bool((finite := torch.isfinite(values)).all()):
        count, first = int((~finite).sum()), (~finite).nonzero()[0].tolist()
        raise NonFiniteError(
            f"{where}: {count} of {values.numel()} values are NaN or infinite, the first at {first}; leave those "
            "samples out, or fill them where they were recorded"
        )
    for bad, what in pose_faults(values, kind.parts):
        if bool(bad.any()):
            place = bad.nonzero()[0].tolist()
            raise PoseError(f"{where}: {int(bad.sum())} of {bad.numel()}, the first at {place}: {what}")
