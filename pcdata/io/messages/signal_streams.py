"""What a robot recorded besides images: joints, poses, commands and texts, each joined to the depth by a rule."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pcdata.errors import CaptureError, ConfigError
from pcdata.geometry import rigid
from pcdata.io.messages.log_file import Topic
from pcdata.io.messages.transforms import plain_frame
from pcdata.io.sources.synchronized import Rule, mixed, slerp
from pcdata.structures.signal_kinds import parse_kind

JOINTS = "sensor_msgs/msg/JointState"
POSES = {  # by type: where in a message the pose is
    "geometry_msgs/msg/PoseStamped": ("pose",), "geometry_msgs/msg/Pose": (), "nav_msgs/msg/Odometry": ("pose", "pose"),
}  # fmt: skip
VECTORS = {  # by type: where in a message the vectors of three are; their kind is to be stated
    "geometry_msgs/msg/Point": ((),), "geometry_msgs/msg/PointStamped": (("point",),),
    "geometry_msgs/msg/Vector3": ((),), "geometry_msgs/msg/Vector3Stamped": (("vector",),),
    "geometry_msgs/msg/Twist": (("linear",), ("angular",)),
    "geometry_msgs/msg/TwistStamped": (("twist", "linear"), ("twist", "angular")),
    "geometry_msgs/msg/Wrench": (("force",), ("torque",)),
    "geometry_msgs/msg/WrenchStamped": (("wrench", "force"), ("wrench", "torque")),
}  # fmt: skip
NUMBERS = re.compile(r"std_msgs/msg/(Float32|Float64|U?Int(8|16|32|64)|Bool)(MultiArray)?")
TEXT = "std_msgs/msg/String"


@dataclass(frozen=True, eq=False)
class SignalStream:
    """One signal: where its values are, what they are, and how they are joined.

    Args:
        name: of the signal.
        topic: of its messages, or those of a topic that are of it.
        kind: of signals, as :class:`pcdata.Signal` has it.
        frame: of its spatial parts; that of the messages' header must be the same, where they have one.
        rule: how it is joined.
        max_gap: nanoseconds; infinite where the last value holds.
        part: of a JointState: position, velocity or effort.
        joints: the names of the joints, in the order of the values.
        dtype, shape: of the values, where the recording states them.
    """

    name: str
    topic: Topic
    kind: str
    frame: str | None
    rule: Rule
    max_gap: float
    part: str = ""
    joints: tuple[str, ...] = ()
    dtype: str | None = None
    shape: tuple[int, ...] | None = None

    @property
    def is_pose(self) -> bool:
        """Whether messages are poses: they turn at a constant rate in between."""
        return self.topic.type in POSES

    def value(self, message: Any) -> NDArray[Any] | str:
        """Return what a message says: of a pose x y z and the quaternion x y z w.

        Raises:
            CaptureError: it lacks a joint, or has another number of values.
        """
        if self.topic.type == TEXT:
            return str(message.data)
        if self.topic.type == JOINTS:
            return self._of_joints(message)
        if self.is_pose:
            pose = _within(message, POSES[self.topic.type])
            return np.array([*_numbers(pose.position, "xyz"), *_numbers(pose.orientation, "xyzw")])
        if self.topic.type in VECTORS:
            parts = [_within(message, names) for names in VECTORS[self.topic.type]]
            return np.array([number for part in parts for number in _numbers(part, "xyz")])
        values = np.asarray(message.data)
        shape = self.shape if self.shape is not None else _layout(message, values, is_stated=self.dtype is not None)
        if math.prod(shape) != values.size:
            raise CaptureError(f"{self.topic.name}: a message has {values.size} numbers, not those of {shape}")
        return values.reshape(shape)

    def between(self, one: Any, other: Any, share: float) -> NDArray[Any] | str:
        """Return the value between two messages."""
        first = self.value(one)
        if share == 0 or isinstance(first, str):
            return first
        second = self.value(other)
        assert not isinstance(second, str)
        if not self.is_pose:
            return mixed(first, second, share)
        turns = [value[3:] / np.linalg.norm(value[3:]) for value in (first, second)]
        return np.concatenate([mixed(first[:3], second[:3], share), slerp(turns[0], turns[1], share)])

    def tensor(self, value: NDArray[Any]) -> torch.Tensor:
        """Return a value as the signal has it: (1, ...)."""
        if self.is_pose and self.kind == "pose matrix":
            given = torch.from_numpy(value.astype(np.float64))
            return rigid.from_rotation_translation(rigid.rotation_from_quaternion(given[3:]), given[:3])[None]
        given = torch.from_numpy(np.array(value[None]))
        return given if self.dtype is None else given.to(getattr(torch, self.dtype))

    def check_frame(self, message: Any) -> None:
        """Require that a message is in the frame that is stated.

        Raises:
            CaptureError: its header names another one.
        """
        named = plain_frame(message.header.frame_id) if hasattr(message, "header") else ""
        if self.frame is not None and named and named != self.frame:
            raise CaptureError(
                f"{self.topic.name}: its messages are in the frame {named!r:.60}, signals says {self.frame!r:.60}; "
                f"state that of the messages, tf leads to the frame of the poses"
            )

    def _of_joints(self, message: Any) -> NDArray[Any]:
        values = np.asarray(getattr(message, self.part), np.float64)
        place = {name: number for number, name in enumerate(message.name)}
        missing = [name for name in self.joints if place.get(name, len(values)) >= len(values)]
        if missing:
            raise CaptureError(
                f"{self.topic.name}: a message has no {self.part} of the joint {missing[0]!r:.60}; it has "
                f"{', '.join(map(str, message.name))[:200]}"
            )
        return values[[place[name] for name in self.joints]]


def _within(message: Any, names: tuple[str, ...]) -> Any:
    for name in names:
        message = getattr(message, name)
    return message


def _numbers(part: Any, axes: str) -> list[float]:
    return [float(getattr(part, axis)) for axis in axes]


def _layout(message: Any, values: NDArray[Any], *, is_stated: bool) -> tuple[int, ...]:
    """Return the shape that a message states; few recorders fill it in, so without one it is a row."""
    if values.ndim == 0:
        return (1,)
    dims = [int(dim.size) for dim in message.layout.dim]
    if not dims and is_stated and values.size == 1:
        return ()
    return tuple(dims) if dims and math.prod(dims) == values.size else (values.size,)


def check_kind(where: str, stream: SignalStream) -> None:
    """Require a kind that the messages of a topic can be.

    Raises:
        ConfigError: they cannot.
    """
    parsed = parse_kind(stream.kind)
    if stream.is_pose and stream.kind not in ("pose matrix", "pose xyz_quat_xyzw", "invariant"):
        raise ConfigError(
            f"{where}: a {stream.topic.type} is 'pose matrix' or 'pose xyz_quat_xyzw', or 'invariant' for seven "
            f"numbers that no motion of the cloud changes, not {stream.kind!r:.60}"
        )
    if (stream.topic.type == TEXT) != parsed.is_text or (stream.topic.type == JOINTS and parsed.is_spatial):
        raise ConfigError(f"{where}: a {stream.topic.type} is not of the kind {stream.kind!r:.60}")


def check_rule(where: str, stream: SignalStream) -> None:
    """Require a rule that such values can be joined by.

    Raises:
        ConfigError: they cannot.
    """
    if stream.is_pose:
        allowed: tuple[str, ...] = ("slerp", "nearest", "step")
    elif parse_kind(stream.kind).has_pose or stream.kind.startswith("delta_pose") or stream.topic.type == TEXT:
        allowed = ("nearest", "step")  # a straight line between two rotations, or two texts, is none
    else:
        allowed = ("linear", "nearest", "step")
    if stream.rule not in allowed:
        raise ConfigError(
            f"{where}: a {stream.kind!r} of {stream.topic.type} is joined by {', '.join(allowed)}, not by "
            f"{stream.rule!r}"
        )
