"""What a robot recorded besides images: joints, poses, commands and texts, each joined to the depth by a rule."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pcdata.errors import CaptureError, ConfigError, PcdataError
from pcdata.geometry import rigid
from pcdata.io.messages.camera_streams import told
from pcdata.io.messages.decoding import decoded, is_known
from pcdata.io.messages.log_file import Topic
from pcdata.io.messages.message_log import MessageLog
from pcdata.io.messages.statement import SIGNALS, Statement
from pcdata.io.messages.transforms import plain_frame
from pcdata.io.sources.option_checks import check_seconds
from pcdata.io.sources.stated_kinds import check_stated_names, stated_kinds
from pcdata.io.sources.synchronized import RULES, Rule, mixed, slerp
from pcdata.structures.signal_kinds import parse_kind
from pcdata.structures.signals import check_signal_name

JOINTS = "sensor_msgs/msg/JointState"
_JOINT_FIELDS = ("position", "velocity", "effort")
_POSES = {  # by type: where in a message the pose is
    "geometry_msgs/msg/PoseStamped": ("pose",), "geometry_msgs/msg/Pose": (), "nav_msgs/msg/Odometry": ("pose", "pose"),
}  # fmt: skip
_VECTORS = {  # by type: where in a message the vectors of three are; their kind is to be stated
    "geometry_msgs/msg/Point": ((),), "geometry_msgs/msg/PointStamped": (("point",),),
    "geometry_msgs/msg/Vector3": ((),), "geometry_msgs/msg/Vector3Stamped": (("vector",),),
    "geometry_msgs/msg/Twist": (("linear",), ("angular",)),
    "geometry_msgs/msg/TwistStamped": (("twist", "linear"), ("twist", "angular")),
    "geometry_msgs/msg/Wrench": (("force",), ("torque",)),
    "geometry_msgs/msg/WrenchStamped": (("wrench", "force"), ("wrench", "torque")),
}  # fmt: skip
_NUMBERS = re.compile(r"std_msgs/msg/(Float32|Float64|U?Int(8|16|32|64)|Bool)(MultiArray)?")
_DTYPES = (
    "float32", "float64", "float16", "bfloat16", "int64", "int32", "int16", "int8", "uint8", "uint16", "uint32",
    "uint64", "bool",
)  # fmt: skip
_TEXT = "std_msgs/msg/String"
_FIRST = 64  # messages that show whether joints are published together


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
        return self.topic.type in _POSES

    def value(self, message: Any) -> NDArray[Any] | str:
        """Return what a message says: of a pose x y z and the quaternion x y z w.

        Raises:
            CaptureError: it lacks a joint, or has another number of values.
        """
        if self.topic.type == _TEXT:
            return str(message.data)
        if self.topic.type == JOINTS:
            return self._of_joints(message)
        if self.is_pose:
            pose = _within(message, _POSES[self.topic.type])
            return np.array([*_numbers(pose.position, "xyz"), *_numbers(pose.orientation, "xyzw")])
        if self.topic.type in _VECTORS:
            parts = [_within(message, names) for names in _VECTORS[self.topic.type]]
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


def chosen_signals(
    where: str,
    log: MessageLog,
    said: Statement,
    given: Mapping[str, Any] | None,
    max_gap: float,
) -> tuple[list[SignalStream], list[str]]:
    """Return the signals that the recording states and the joints that it holds, and those that are asked for.

    Args:
        where: for messages.
        log: the recording.
        said: what it states.
        given: by the name of a stream, its topic without the first slash: kind, and maybe frame, rule, max_gap (in
            seconds); None = left out.
        max_gap: nanoseconds, where none is stated.

    The second list says in words what of the topics is no signal.

    Raises:
        ConfigError, FrameError, CaptureError: what is said of a signal cannot be so.
    """
    rules, plain = _rules(where, given)
    stated = stated_kinds(where, plain)
    streams: dict[str, SignalStream] = {}
    left: list[str] = []
    for own, told_of in said.signals.items():
        stream = _stated(where, log, own, told_of)
        streams[stream.name] = stream
    for topic in log.topics.values():
        if topic.type == JOINTS and len(topic) and is_known(topic) and topic.name.strip("/") not in _left_out(stated):
            found, without = joint_streams(log, topic, max_gap)
            streams |= {one.name: one for one in found}
            left += without
    others = {topic.name.strip("/"): topic for topic in log.topics.values() if _may_be_signal(topic)}
    check_stated_names(
        where, stated, [*streams, *others, *(name for name in _left_out(stated) if f"/{name}" in log.topics)]
    )
    for name, kind in stated.items():
        at = f"{where}: signals[{name!r:.100}]"
        if kind is None:
            streams.pop(name, None)
            continue
        if name in streams:
            stream = replace(streams[name], kind=kind[0], frame=kind[1])
        else:
            stream = SignalStream(name, others[name], kind[0], kind[1], "step", math.inf)
            stream = replace(stream, rule="slerp", max_gap=max_gap) if stream.is_pose else stream
        check_kind(at, stream)
        rule, gap = rules.get(name, (None, None))
        if rule is not None:
            stream = replace(stream, rule=rule, max_gap=math.inf if rule == "step" else max_gap)
        streams[name] = stream if gap is None else replace(stream, max_gap=gap)
        check_rule(at, streams[name])
    return list(streams.values()), left


def _left_out(stated: Mapping[str, Any]) -> list[str]:
    return [name for name, kind in stated.items() if kind is None]


def _may_be_signal(topic: Topic) -> bool:
    kinds = (*_POSES, *_VECTORS, _TEXT)
    return bool(len(topic)) and is_known(topic) and (topic.type in kinds or bool(_NUMBERS.fullmatch(topic.type)))


def _rules(where: str, given: Any) -> tuple[dict[str, tuple[Rule | None, float | None]], Any]:
    """Return how streams are joined, by name, and the option without that."""
    if not isinstance(given, Mapping):
        return {}, given
    rules: dict[str, tuple[Rule | None, float | None]] = {}
    plain: dict[str, Any] = {}
    for name, said in given.items():
        if isinstance(said, Mapping):
            rule, gap = said.get("rule"), said.get("max_gap")
            if rule is not None and rule not in RULES:
                raise ConfigError(
                    f"{where}: signals[{name!r:.100}]: rule must be one of {', '.join(RULES)}, got {rule!r:.60}"
                )
            rules[name] = (
                rule,
                None if gap is None else check_seconds(where, f"signals[{name!r:.100}]: max_gap", gap) * 1e9,
            )
            said = {word: value for word, value in said.items() if word not in ("rule", "max_gap")}
        plain[name] = said
    return rules, plain


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
    if (stream.topic.type == _TEXT) != parsed.is_text or (stream.topic.type == JOINTS and parsed.is_spatial):
        raise ConfigError(f"{where}: a {stream.topic.type} is not of the kind {stream.kind!r:.60}")


def check_rule(where: str, stream: SignalStream) -> None:
    """Require a rule that such values can be joined by.

    Raises:
        ConfigError: they cannot.
    """
    if stream.is_pose:
        allowed: tuple[str, ...] = ("slerp", "nearest", "step")
    elif parse_kind(stream.kind).has_pose or stream.kind.startswith("delta_pose") or stream.topic.type == _TEXT:
        allowed = ("nearest", "step")  # a straight line between two rotations, or two texts, is none
    else:
        allowed = ("linear", "nearest", "step")
    if stream.rule not in allowed:
        raise ConfigError(
            f"{where}: a {stream.kind!r} of {stream.topic.type} is joined by {', '.join(allowed)}, not by "
            f"{stream.rule!r}"
        )


def _stated(where: str, log: MessageLog, name: str, said: Mapping[str, Any]) -> SignalStream:
    where = f"{where}: topic /pcdata: signal {name!r:.100}"
    topic = log.topics.get(f"{SIGNALS}{name}")
    if topic is None or not len(topic):
        raise CaptureError(f"{where}: there are no messages of {SIGNALS}{name:.200}")
    kind, frame, dtype, shape = (said.get(word) for word in ("kind", "frame", "dtype", "shape"))
    if (topic.type == _TEXT) != (kind == "text") or not (topic.type == _TEXT or _NUMBERS.fullmatch(topic.type)):
        raise CaptureError(f"{where}: is of the kind {kind!r:.60}, but {told(topic)} is none of that")
    try:
        parsed = parse_kind(kind)  # type: ignore[arg-type]
    except (PcdataError, TypeError, ValueError) as error:
        raise CaptureError(f"{where}: {error}") from error
    if dtype not in (None, *_DTYPES):
        raise CaptureError(f"{where}: dtype must be one of {', '.join(_DTYPES)}, got {dtype!r:.60}")
    is_shape = isinstance(shape, list) and len(shape) <= 31 and all(type(n) is int and 0 <= n < 1 << 31 for n in shape)
    if shape is not None and not is_shape:
        raise CaptureError(f"{where}: shape must be a list of whole numbers, got {shape!r:.60}")
    if parsed.is_spatial != isinstance(frame, str):
        raise CaptureError(
            f"{where}: a {kind!r:.60} is in {'a' if parsed.is_spatial else 'no'} frame, got {frame!r:.60}"
        )
    own = said.get("name", name)
    check_signal_name(where, own)
    return SignalStream(
        own,
        topic,
        parsed.text,
        frame,
        "step",
        math.inf,
        dtype=dtype,
        shape=None if shape is None else tuple(shape or ()),
    )


def joint_streams(log: MessageLog, topic: Topic, max_gap: float) -> tuple[list[SignalStream], list[str]]:
    """Return positions, velocities and efforts of the joints of a topic, and in words what is left out.

    Joints that are published by several nodes, in messages of their own, are signals of their own.
    """
    streams: list[SignalStream] = []
    left: list[str] = []
    base = topic.name.strip("/")
    with log.opened() as read:
        groups = _groups(lambda number: decoded(topic, read(topic, number)), len(topic))
        for number, (joints, numbers) in enumerate(groups.items()):
            name = base if len(groups) == 1 else f"{base}/{number}"
            own = (
                topic if len(groups) == 1 else replace(topic, times=topic.times[numbers], places=topic.places[numbers])
            )
            first = decoded(own, read(own, 0))
            if len(set(joints)) < len(joints):
                twice = next(joint for joint in joints if joints.count(joint) > 1)
                left.append(f"{topic.name}: its messages name the joint {twice!r:.60} twice")
                continue
            for part in _JOINT_FIELDS:
                values = np.asarray(getattr(first, part))
                if len(values) < len(joints) or not joints:
                    continue
                if not np.isfinite(values).all():
                    left.append(f"{part} of {topic.name}: the first message has values that are not finite")
                    continue
                stream = SignalStream(f"{name}/{part}", own, "invariant", None, "linear", max_gap, part, tuple(joints))
                streams.append(stream)
    return streams, left


def _groups(message: Callable[[int], Any], count: int) -> dict[tuple[str, ...], list[int]]:
    """Return the messages by the joints they name, in the order of the first that names them so."""
    order: dict[frozenset[str], tuple[str, ...]] = {}
    found: dict[tuple[str, ...], list[int]] = {}
    for number in range(count):
        names = tuple(map(str, message(number).name))
        found.setdefault(order.setdefault(frozenset(names), names), []).append(number)
        if number + 1 == min(count, _FIRST) and len(found) == 1:
            return {names: [] for names in found}  # all together: the rest is held to it where it is read
    return found
