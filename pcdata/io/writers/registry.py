"""What captures can be written as: writers by their names."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from pcdata.errors import ConfigError, near_matches
from pcdata.io.writers.writer import KEPT, Writer
from pcdata.registry import Registry

WRITERS: Registry[type[Writer]] = Registry("writer")


def register_writer(writer: type[Writer]) -> type[Writer]:
    """Make a layout that captures can be written in known by its ``kind``, to ``pcdata convert``; a decorator.

    Raises:
        ConfigError: it is no complete dataclass of :class:`Writer`, or the name exists.
    """
    where = "register_writer"
    if not (isinstance(writer, type) and issubclass(writer, Writer) and dataclasses.is_dataclass(writer)):
        raise ConfigError(f"{where}: must be a dataclass of pcdata.io.Writer, got {writer!r:.100}")
    if missing := ", ".join(sorted(writer.__abstractmethods__)):
        raise ConfigError(f"{where}: {writer.__name__} does not say {missing}; define that")
    for name in ("kind", "layout"):
        if not isinstance(getattr(writer, name, None), str):
            raise ConfigError(f"{where}: {writer.__name__}.{name} must be a text; see pcdata.io.Writer")
    if unknown := sorted(set(writer.keeps) - set(KEPT)):
        raise ConfigError(f"{where}: {writer.__name__}.keeps {unknown}; a capture has {', '.join(KEPT)}")
    WRITERS.add(writer.kind, writer)
    return writer


def writer_named(where: str, kind: str, options: Mapping[str, Any]) -> Writer:
    """Return a writer with its options.

    Raises:
        ConfigError: there is no such writer or option, or an option has no such value.
    """
    writer = WRITERS.named(where, kind)
    known = [field.name for field in dataclasses.fields(writer)]
    for option in options:
        if option not in known:
            hint = near_matches(str(option), known)
            raise ConfigError(
                f"{where}: {kind} has no option {option!r:.100}{hint}; it has {', '.join(known) or 'none'}"
            )
    return writer(**options)
