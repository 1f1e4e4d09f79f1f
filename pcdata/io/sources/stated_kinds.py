"""What is said of recorded streams by their names: of what kind each is, and in which frame; or that it is left out.

``signals={"eef": {"kind": "pose xyz_quat_xyzw", "frame": "base"}, "debug": None}`` is the option
of every reader whose files name numbers without saying what they are.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from pcdata.errors import CaptureError, ConfigError, FrameError, PcdataError, near_matches
from pcdata.structures import Signal
from pcdata.structures.signal_kinds import parse_kind
from pcdata.structures.signals import Values, checked_signal

KindAndFrame = tuple[str, str | None]

_KEYS = ("kind", "frame")


def stated_kinds(where: str, signals: Mapping[str, Any] | None) -> dict[str, KindAndFrame | None]:
    """Return the kind and the frame that are stated, by the names of the streams; None = left out.

    Raises:
        ConfigError: the option is no mapping of names to objects with ``kind`` and maybe ``frame``, or to None, or
            there is no such kind.
        FrameError: a spatial kind without a frame, or another with one.
    """
    if signals is None:
        return {}
    if not isinstance(signals, Mapping):
        raise ConfigError(
            f'{where}: signals must be a mapping of names, such as {{"eef": {{"kind": "pose xyz_quat_xyzw", "frame": '
            f'"base"}}}}, got {signals!r:.100}'
        )
    return {name: _stated(f"{where}: signals[{name!r:.100}]", name, said) for name, said in signals.items()}


def kind_of(name: str, stated: Mapping[str, KindAndFrame | None], known: KindAndFrame | None) -> KindAndFrame | None:
    """Return what a stream is: as stated, else as its format says, else numbers that nothing moves; None = left out."""
    return stated.get(name, known or ("invariant", None))


def check_stated_names(where: str, stated: Iterable[str], names: Iterable[str]) -> None:
    """Require that what is stated is of streams that are there.

    Raises:
        ConfigError: names the first that is not, and those that are.
    """
    known = sorted(names)
    for name in stated:
        if name not in known:
            hint = near_matches(name, known) or f"; there are {', '.join(known) or 'none'}"
            raise ConfigError(f"{where}: signals: there is no stream {name!r:.100}{hint}")


def signal_of(where: str, name: str, values: Values, kind: KindAndFrame) -> Signal:
    """Return values of one moment, B = 1, as a signal.

    Raises:
        CaptureError: the values are not of that kind.
    """
    try:
        return checked_signal(f"{where}({name!r:.200})", name, values, *kind)
    except PcdataError as error:
        told = str(error)
        raise CaptureError(
            f"{told if told.startswith(where) else f'{where}: {told}'}; leave it out by signals={{{name!r}: None}}, or "
            "state another kind there"
        ) from error


def _stated(where: str, name: Any, said: Any) -> KindAndFrame | None:
    if not isinstance(name, str):
        raise ConfigError(f"{where}: the name of a stream must be a text")
    if said is None:
        return None
    if not isinstance(said, Mapping) or "kind" not in said or (unknown := [key for key in said if key not in _KEYS]):
        hint = f", and no {unknown[0]!r:.60}" if isinstance(said, Mapping) and "kind" in said else ""
        raise ConfigError(
            f"{where}: must be None to leave it out, or an object with kind and maybe frame{hint}, got {said!r:.100}"
        )
    kind, frame = said["kind"], said.get("frame")
    try:
        parsed = parse_kind(kind)
    except PcdataError as error:
        raise ConfigError(f"{where}: {error}") from error
    if parsed.is_spatial != (isinstance(frame, str) and bool(frame)) or (not parsed.is_spatial and frame is not None):
        needs = "is in a frame; say frame" if parsed.is_spatial else "is in no frame; leave frame out"
        raise FrameError(f"{where}: a {parsed.text!r} {needs}, got {frame!r:.60}")
    return parsed.text, frame
