"""What B clouds know about themselves, however their points are laid out."""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import torch
from torch import Tensor

from pcdata.contracts.on_host import on_host, taken, uploaded
from pcdata.errors import DTypeError, FrameError, OutOfRangeError, UnitError
from pcdata.functional.motions import led_back
from pcdata.geometry import rigid
from pcdata.structures.image_layout import ImageLayout, joined_layout
from pcdata.structures.kinds import KINDS, METRE, NORMALIZED, Kind, kind_of
from pcdata.structures.pose_layouts import motion_by
from pcdata.structures.read_later import Histories, Metas, ReadLater, Step
from pcdata.structures.signal_joining import joined_signals, remaining_signals
from pcdata.structures.signals import Signal, Values, attached, refuse_mirror, signals_now
from pcdata.structures.structure import Structure, derived

Clouds = TypeVar("Clouds", bound="CloudBatch")


@dataclass(frozen=True, eq=False, kw_only=True)
class CloudBatch(Structure):
    """B >= 1 clouds that know their frame, their unit, where they came from and what was done to them.

    Args:
        frame_id: the coordinate frame, e.g. "camera", "base".
        unit: "m", or "normalized" after a normalization.
        kinds: the kind of every extra field.
        viewpoint: (B, 3) float32 where the sensor stood; per point: extra["viewpoint"].
        source_from_cloud: (B, 4, 4) float64, back to source_frame in metres.
        source_frame: the frame that source_from_cloud leads to; "" = frame_id at construction.
        frames: frame name -> (B, 4, 4) float64 frame_from_source.
        layout: set by Deproject and by readers of organized clouds, kept while rows are only dropped and moved rigidly.
        meta: per cloud, JSON-able: what was found (planes, counts, sample id).
        history: per cloud, JSON-able: what was done, in order.
        recorded_signals: name -> what belongs to the clouds and not to their points, as it was recorded; see
            :attr:`signals`.
    """

    frame_id: str
    unit: str = METRE
    kinds: Mapping[str, Kind] = field(default_factory=dict)
    viewpoint: Tensor | None = None
    source_from_cloud: Tensor = None  # type: ignore[assignment]
    source_frame: str = ""
    frames: Mapping[str, Tensor] = field(default_factory=dict)
    layout: ImageLayout | None = None
    meta: Sequence[Mapping[str, Any]] = ReadLater(Metas)  # type: ignore[assignment]
    history: Sequence[Sequence[Step]] = ReadLater(Histories)  # type: ignore[assignment]
    recorded_signals: Mapping[str, Signal] = field(default_factory=dict)

    def kind(self, name: str) -> Kind:
        """Return the kind of a per-point field."""
        return kind_of(name, self.kinds)

    def frame_from_cloud(self, frame: str) -> Tensor:
        """Return (B, 4, 4) float64 from the present coordinates to a frame that the clouds know, in metres.

        Not by the name of the frame they are in: clouds that were turned, scaled or shifted in "base" still bear its
        name, and this leads back to where they lay. It is the identity where they lie there.

        Raises:
            FrameError: the clouds do not know the frame.
        """
        here = torch.eye(4, dtype=torch.float64, device=self.source_from_cloud.device).expand(self.num_clouds, 4, 4)
        if frame == self.source_frame:
            matrix = self.source_from_cloud
        elif frame in self.frames:
            matrix = self.frames[frame] @ self.source_from_cloud
        elif frame == self.frame_id and self.unit == METRE:  # of no other frame is it known where it lies
            return here.clone()
        else:
            known = sorted({self.source_frame, *self.frames})
            raise FrameError(f"the clouds know the frames {known}, not {frame!r}; give the captures their poses")
        if frame != self.frame_id:
            return matrix
        # What float64 leaves of going there and back would round every point.
        return torch.where(motion_by(matrix).rests[:, None, None], here, matrix)

    @property
    def signals(self) -> Mapping[str, Any]:
        """Name -> (B, ...) tensor, or B texts, in the coordinates that the clouds have now; computed when it is read.

        An action that was recorded in "base" follows its cloud through every step: what it points at stays what it
        points at. Where the clouds are in the frame of the record, the bits are the recorded ones. Read-only: a signal
        is attached by :meth:`with_signal`, and ``recorded_signals[name]`` says its kind and frame.
        """
        return signals_now(self)

    def with_signal(self: Clouds, name: str, values: Values, kind: str, frame: str | None = None) -> Clouds:
        """Attach or replace one signal: values of the clouds and not of their points, which are moved with them.

        Args:
            name: any printable text.
            values: (B, ...) tensor, one row per cloud, with free axes such as a horizon between; or B texts.
            kind: "invariant", "position", "displacement", "direction", "pose LAYOUT", "delta_pose LAYOUT", "text", or
                columns of several, "pose xyz_quat_xyzw + invariant 1"; see docs/signals.md.
            frame: the frame of its spatial parts, one that the clouds know; None = the coordinates they have now.

        Raises:
            ConfigError: there is no such kind, or it leaves open what it must state.
            FrameError: the clouds do not know the frame, or the kind has none.
            ShapeError, DTypeError, DeviceError, NonFiniteError, PoseError: the values are not of that kind.
        """
        signal = attached(f"{type(self).__name__}.with_signal", self, name, values, kind, frame)
        return derived(self, recorded_signals={**self.recorded_signals, name: signal})

    def without_signal(self: Clouds, *names: str) -> Clouds:
        """Drop signals.

        Raises:
            DTypeError: there is none of that name.
        """
        kept = remaining_signals(f"{type(self).__name__}.without_signal", self.recorded_signals, names)
        return derived(self, recorded_signals=kept)

    @property
    def num_clouds(self) -> int:
        """The number of clouds B."""
        return self.source_from_cloud.shape[0]

    def __len__(self) -> int:
        return self.num_clouds

    def _which(self, clouds: int | slice) -> slice:
        """Return the clouds that an index or a slice names, as a slice of at least one."""
        name = type(self).__name__
        if isinstance(clouds, slice):
            start, stop, step = clouds.indices(self.num_clouds)
            if step != 1 or stop <= start:
                raise OutOfRangeError(
                    f"{name}[...]: a slice must name at least one cloud of {self.num_clouds}, and neighbors, got "
                    f"{clouds.start}:{clouds.stop}:{clouds.step}"
                )
            return slice(start, stop)
        try:
            number = operator.index(clouds)
        except TypeError:
            number = None
        if number is None or isinstance(clouds, bool):
            raise DTypeError(
                f"{name}[...]: takes the number of a cloud or a slice of clouds, got {type(clouds).__name__}; points "
                "are picked by PointCloud.select(index, ptr)"
            )
        if not -self.num_clouds <= number < self.num_clouds:
            raise OutOfRangeError(f"{name}[{number}]: there are {self.num_clouds} clouds, numbered from 0")
        number %= self.num_clouds
        return slice(number, number + 1)

    def __array__(self, *args: Any, **kwargs: Any) -> Any:
        # NumPy would take it for a sequence and descend into clouds of clouds.
        raise DTypeError(f"{type(self).__name__}: is several arrays, not one; take .points.numpy(), or another field's")

    # -- what becomes of it ----------------------------------------------------------------------------------------

    def _facts_of(self, clouds: slice) -> dict[str, Any]:
        """Return what some of the clouds know."""
        if clouds.indices(self.num_clouds) == (0, self.num_clouds, 1):
            return {name: vars(self)[name] for name in _FACTS}
        signals = self.recorded_signals
        if signals:
            signals = {name: signal.rows(clouds) for name, signal in signals.items()}
        return {
            "layout": joined_layout([self.layout], clouds),
            "viewpoint": None if self.viewpoint is None else self.viewpoint[clouds],
            "source_from_cloud": self.source_from_cloud[clouds],
            "frames": {name: matrix[clouds] for name, matrix in self.frames.items()},
            "meta": vars(self)["meta"][clouds],
            "history": vars(self)["history"][clouds],
            "recorded_signals": signals,
        }

    def _facts_repeated(self, clouds: Tensor) -> dict[str, Any]:
        """Return what the clouds with these numbers (M,) know, for rows that are picked in another order."""
        meta, history, there = vars(self)["meta"], vars(self)["history"], on_host(clouds).tolist()
        return {
            "layout": None,
            "viewpoint": None if self.viewpoint is None else self.viewpoint[clouds],
            "source_from_cloud": self.source_from_cloud[clouds],
            "frames": {name: matrix[clouds] for name, matrix in self.frames.items()},
            "meta": Metas(meta[b : b + 1] for b in there),
            "history": Histories(history[b : b + 1] for b in there),
            "recorded_signals": {name: signal.rows(clouds) for name, signal in self.recorded_signals.items()},
        }

    def _facts_moved(self, matrices: Tensor, frame_id: str | None, unit: str | None) -> dict[str, Any]:
        """Return what the clouds know after motions (S, B, 4, 4): the way back to the source absorbs their inverses."""
        viewpoint, layout, source_from_cloud = self.viewpoint, self.layout, self.source_from_cloud
        part_of = operator.getitem if matrices.is_cpu else taken
        for step in range(len(matrices)):
            matrix = part_of(matrices, step)
            if self.recorded_signals:  # they stay as recorded: how the clouds moved is in source_from_cloud
                refuse_mirror(type(self).__name__, self.recorded_signals, matrix)
            if viewpoint is not None:
                one_row_each = torch.arange(self.num_clouds + 1, dtype=torch.int64, device="cpu")
                if not viewpoint.is_cpu:
                    one_row_each = uploaded(one_row_each, viewpoint.device)
                viewpoint = KINDS[Kind.POSITION].move(viewpoint, one_row_each, matrix)
        if layout is None:
            source_from_cloud = led_back(source_from_cloud, matrices)
        else:
            for step in range(len(matrices)):
                source_from_cloud = led_back(source_from_cloud, part_of(matrices, slice(step, step + 1)))
                layout = layout if rigid.is_rigid(source_from_cloud) else None
        known = {"frame_id": frame_id if frame_id is not None else self.frame_id, "unit": unit or self.unit}
        check_names(type(self).__name__, **known)
        return {
            **known,
            "layout": layout,
            "viewpoint": viewpoint,
            "source_from_cloud": source_from_cloud,
        }


_FACTS = ("layout", "viewpoint", "source_from_cloud", "frames", "meta", "history", "recorded_signals")


def check_names(where: str, frame_id: str, unit: str) -> None:
    """Raise unless the frame has a name and the unit is a known one."""
    if not frame_id:
        raise FrameError(f"{where}: frame_id must name the coordinate frame, it is empty")
    if unit not in (METRE, NORMALIZED):
        raise UnitError(f"{where}: unit must be {METRE!r} or {NORMALIZED!r}, got {unit!r}")


def joined_facts(clouds: Sequence[CloudBatch]) -> dict[str, Any]:
    """Return what batches know together, for clouds that may be joined."""
    viewpoints = [cloud.viewpoint for cloud in clouds]
    shared = [name for name in clouds[0].frames if all(name in cloud.frames for cloud in clouds)]
    return {
        "layout": joined_layout([cloud.layout for cloud in clouds]),
        "viewpoint": torch.cat([v for v in viewpoints if v is not None]) if None not in viewpoints else None,
        "source_from_cloud": torch.cat([cloud.source_from_cloud for cloud in clouds]),
        "frames": {name: torch.cat([cloud.frames[name] for cloud in clouds]) for name in shared},
        "meta": Metas(vars(cloud)["meta"] for cloud in clouds),
        "history": Histories(vars(cloud)["history"] for cloud in clouds),
        "recorded_signals": joined_signals([cloud.recorded_signals for cloud in clouds])
        if clouds[0].recorded_signals
        else {},
    }
