"""Which topics of a recording become signals: those it states, its joints, and those that are asked for."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from pcdata.errors import CaptureError, ConfigError, PcdataError
from pcdata.io.messages.decoding import is_known
from pcdata.io.messages.image_topics import told
from pcdata.io.messages.joint_streams import joint_streams
from pcdata.io.messages.log_file import Topic
from pcdata.io.messages.message_log import MessageLog
from pcdata.io.messages.signal_streams import (
    JOINTS,
    NUMBERS,
    POSES,
    TEXT,
    VECTORS,
    SignalStream,
    check_kind,
    check_rule,
)
from pcdata.io.messages.statement import SIGNALS, Statement
from pcdata.io.sources.option_checks import check_seconds
from pcdata.io.sources.stated_kinds import check_stated_names, stated_kinds
from pcdata.io.sources.synchronized import RULES, Rule
from pcdata.structures.signal_kinds import parse_kind
from pcdata.structures.signals import check_signal_name

_DTYPES = (
    "float32", "float64", "float16", "bfloat16", "int64", "int32", "int16", "int8", "uint8", "uint16", "uint32",
    "uint64", "bool",
)  # fmt: skip


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
    kinds = (*POSES, *VECTORS, TEXT)
    return bool(len(topic)) and is_known(topic) and (topic.type in kinds or bool(NUMBERS.fullmatch(topic.type)))


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


def _stated(where: str, log: MessageLog, name: str, said: Mapping[str, Any]) -> SignalStream:
    where = f"{where}: topic /pcdata: signal {name!r:.100}"
    topic = log.topics.get(f"{SIGNALS}{name}")
    if topic is None or not len(topic):
        raise CaptureError(f"{where}: there are no messages of {SIGNALS}{name:.200}")
    kind, frame, dtype, shape = (said.get(word) for word in ("kind", "frame", "dtype", "shape"))
    if (topic.type == TEXT) != (kind == "text") or not (topic.type == TEXT or NUMBERS.fullmatch(topic.type)):
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
