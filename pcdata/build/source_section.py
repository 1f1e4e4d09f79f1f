"""The section ``source`` of a configuration: where the captures are, how they are read, and which are left out."""

from __future__ import annotations

import inspect
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pcdata.errors import ConfigError, near_matches
from pcdata.io.sources.averaged import AveragedSource
from pcdata.io.sources.combine import Selectable
from pcdata.io.sources.opening import open_source, read_skip_file
from pcdata.io.sources.registry import LAYOUTS
from pcdata.io.sources.temporal import TemporallyFilteredSource
from pcdata.yaml_nodes import YamlDocument

_OWN = ("path", "kind", "limit", "skip", "skip_file", "skip_refused", "average", "temporal")
_FILES = ("path", "calibration", "skip_file")  # relative to the folder of the configuration


@dataclass(frozen=True)
class SourceSettings:
    """What the section says; the command line may add to it, but not contradict it."""

    path: str | None = None
    kind: str | None = None  # the layout
    limit: int | None = None
    skip: tuple[str, ...] = ()
    skip_refused: bool = False
    average: int | None = None  # captures of a still scene that become one; see AveragedSource
    temporal: int | None = None  # captures that the temporal filter looks at; see TemporallyFilteredSource
    options: Mapping[str, Any] = field(default_factory=dict)  # those of the layout's class

    def open(
        self,
        path: str | os.PathLike[str] | None = None,
        *,
        kind: str | None = None,
        limit: int | None = None,
        skip: Sequence[str] = (),
        skip_refused: bool = False,
        **options: Any,
    ) -> Selectable[Any]:
        """Open the captures.

        Args:
            path: instead of the path of the section.
            kind: the layout, where the section does not say it.
            limit: keep the first so many samples; the smaller of this and the section's counts.
            skip: ids to leave out besides those of the section.
            skip_refused: load every capture once, and leave out those that are refused.
            **options: those of the layout's class, besides those of the section.

        Raises:
            ConfigError: there is no path, or an option has one value here and another in the section.
            CaptureError: the captures cannot be opened.
        """
        given = {name: value for name, value in {"kind": kind, **options}.items() if value is not None}
        stated = {name: value for name, value in {"kind": self.kind, **self.options}.items() if value is not None}
        for name in given.keys() & stated.keys():
            if given[name] != stated[name]:
                raise ConfigError(
                    f"source: the configuration says {name} {stated[name]!r}, the argument {given[name]!r}; drop one"
                )
        where = path if path is not None else self.path
        if where is None:
            raise ConfigError("source: nothing says where the captures are; give --source PATH, or source: {path: ...}")
        limits = [number for number in (limit, self.limit) if number is not None]
        source = open_source(
            where,
            limit=min(limits, default=None),
            skip=[*dict.fromkeys([*self.skip, *skip])],
            # An average or a filtered frame would be lost for one bad capture of many.
            skip_refused=skip_refused or (self.skip_refused and bool(self.average or self.temporal)),
            **{"kind": None, **stated, **given},
        )
        if self.average is not None:
            return AveragedSource(source=source, num_frames=self.average)
        if self.temporal is not None:
            return TemporallyFilteredSource(source=source, num_frames=self.temporal)
        return source


def source_settings(document: YamlDocument, node: Any, folder: Path | None) -> SourceSettings:
    """Read the section; faults go to the document.

    Args:
        document: the configuration.
        node: the section; None = there is none.
        folder: what relative paths in it start from; None = the working folder.
    """
    entries = document.mapping(node, "source")
    values = {key: document.plain(value) for key, (_, value) in entries.items()}
    options = {name for layout in LAYOUTS.values() for name in inspect.signature(layout).parameters} - {"path"}
    known = [*_OWN, *sorted(options)]
    for key in values:
        if key not in known:
            hint = near_matches(key, known) or f"; known: {', '.join(known)}"
            document.fault(entries[key][0], f"source.{key}: no such setting{hint}")
        elif key in _OWN and (wrong := _wrong(key, values[key])):
            document.fault(entries[key][1], f"source.{key}: {wrong}, got {values[key]!r:.100}")
    if {"average", "temporal"} <= values.keys():
        document.fault(entries["temporal"][0], "source: average and temporal both smooth over time; choose one")
    if document.faults:
        return SourceSettings()
    for key in _FILES:
        if isinstance(values.get(key), str) and folder is not None:
            values[key] = str(folder / Path(values[key]).expanduser())
    skip = list(values.pop("skip", None) or ())
    skip_file = values.pop("skip_file", None)
    skip += read_skip_file(skip_file) if skip_file else []
    own = {key: value for key in _OWN if (value := values.pop(key, None)) is not None}
    return SourceSettings(**own, skip=tuple(skip), options=values)


def _wrong(key: str, value: Any) -> str:
    """Say what a setting must be, where it is not."""
    if value is None:
        return ""
    if key == "kind" and value not in LAYOUTS:
        return f"must be one of {', '.join(LAYOUTS)}{near_matches(str(value), LAYOUTS)}"
    if key in ("path", "skip_file") and (not isinstance(value, str) or not value):
        return "must be a path"
    if key in ("limit", "average", "temporal") and (type(value) is not int or value < 1):
        return "must be a whole number of at least 1"
    if key == "skip" and (not isinstance(value, list) or not all(isinstance(one, str) for one in value)):
        return 'must be a list of ids, texts in quotes such as ["0005"]'
    if key == "skip_refused" and not isinstance(value, bool):
        return "must be true or false"
    return ""
