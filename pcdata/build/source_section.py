"""The section ``source`` of a configuration: where the captures are, how they are read, and what is made of them."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pcdata.errors import ConfigError, near_matches
from pcdata.io.sources.combine import Selectable
from pcdata.io.sources.open_source import open_source, read_skip_file
from pcdata.io.sources.registry import COMBINATORS, LAYOUTS, OPENING, checked_fields, options_of
from pcdata.yaml_nodes import Document

_FILES = ("path", "calibration", "skip_file")  # relative to the folder of the configuration


@dataclass(frozen=True)
class SourceSettings:
    """What the section says; the command line may add to it, but not contradict it.

    Args:
        path: of the captures, or a pattern; None = the command line says it.
        kind: the layout; None = found by its signs.
        only: patterns of the ids that are kept.
        limit: how many samples are kept.
        skip: ids that are left out.
        options: those of the layout's class, and combinators with their fields, in their order.
        by_name: whether files are known by their names alone, as a dataset remembers them: an argument says the place.
    """

    path: str | None = None
    kind: str | None = None
    only: tuple[str, ...] = ()
    limit: int | None = None
    skip: tuple[str, ...] = ()
    options: Mapping[str, Any] = field(default_factory=dict)
    by_name: bool = False

    def open(
        self,
        path: str | os.PathLike[str] | None = None,
        *,
        kind: str | None = None,
        only: Sequence[str] = (),
        limit: int | None = None,
        skip: Sequence[str] = (),
        **options: Any,
    ) -> Selectable[Any]:
        """Open the captures; of what is said twice see :meth:`with_arguments`.

        Raises:
            ConfigError: there is no path, or an option has one value here and another in the section.
            CaptureError: the captures cannot be opened.
        """
        said = self.with_arguments(path, kind=kind, only=only, limit=limit, skip=skip, **options)
        if said.path is None:
            raise ConfigError("source: nothing says where the captures are; give --source PATH, or source: {path: ...}")
        return open_source(
            said.path, kind=said.kind, only=said.only, limit=said.limit, skip=said.skip, **dict(said.options)
        )

    def with_arguments(
        self,
        path: str | os.PathLike[str] | None = None,
        *,
        kind: str | None = None,
        only: Sequence[str] = (),
        limit: int | None = None,
        skip: Sequence[str] = (),
        **options: Any,
    ) -> SourceSettings:
        """Return what the section and arguments say together.

        Args:
            path: instead of the path of the section.
            kind: the layout, where the section does not say it.
            only: patterns of ids to keep, where the section does not say them.
            limit: keep the first so many samples; the smaller of this and the section's counts.
            skip: ids to leave out besides those of the section.
            **options: those of the layout's class and combinators, besides those of the section.

        Raises:
            ConfigError: an option has one value here and another in the section.
        """
        limits = [number for number in (limit, self.limit) if number is not None]
        merged = self._merged({"kind": kind, "only": list(only) or None, **options})
        where = self.path if path is None else os.fspath(path)
        return replace(
            self,
            path=where,
            kind=merged.pop("kind", None),
            only=tuple(merged.pop("only")),
            limit=min(limits, default=None),
            skip=tuple(dict.fromkeys([*self.skip, *skip])),
            options=merged,
        )

    def to_config(self) -> dict[str, Any]:
        """Return the section, as :func:`source_settings` reads it."""
        own = {"path": self.path, "kind": self.kind, "limit": self.limit, "only": list(self.only)}
        said = {**own, "skip": list(self.skip), **self.options}
        for name in _FILES:
            if isinstance(said.get(name), str):
                said[name] = os.path.join(os.getcwd(), os.path.expanduser(said[name]))
        return {name: value for name, value in said.items() if value not in (None, [])}

    def _merged(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """Return what the section and the arguments say together."""
        merged = {"kind": self.kind, "only": list(self.only) or None, **self.options}
        merged = {name: value for name, value in merged.items() if value is not None}
        for name, value in given.items():
            if value is None:
                continue
            stated = merged.get(name, value)
            if name in COMBINATORS and name in merged:
                stated, value = checked_fields("source", name, stated), checked_fields("source", name, value)
                for key in stated.keys() & value.keys():
                    self._check_agree(f"{name}.{key}", stated[key], value[key])
                value = {**stated, **value}
            else:
                self._check_agree(name, stated, value)
            merged[name] = value
        return {"only": (), **merged}

    def _check_agree(self, name: str, stated: Any, given: Any) -> None:
        if stated == given or (self.by_name and name in ("calibration", "links_to", "posed.file")):
            return
        raise ConfigError(f"source: the configuration says {name} {stated!r}, the argument {given!r}; drop one")


def source_settings(document: Document, node: Any, folder: Path | None) -> SourceSettings:
    """Read the section; faults go to the document.

    Args:
        document: the configuration.
        node: the section; None = there is none.
        folder: what relative paths in it start from; None = the working folder.
    """
    entries = document.mapping(node, "source")
    values = {key: document.plain(value) for key, (_, value) in entries.items()}
    layouts = [LAYOUTS[values["kind"]]] if values.get("kind") in [*LAYOUTS] else [*LAYOUTS.values()]
    opening = [name for name in OPENING if name != "skip_refused"]  # a build quarantines what fails
    known = list(dict.fromkeys([*opening, *COMBINATORS, *(name for layout in layouts for name in options_of(layout))]))
    for key in values:
        if key not in known:
            hint = near_matches(key, known) or f"; known: {', '.join(known)}; those of your own need --import FILE.py"
            document.fault(entries[key][0], f"source.{key}: no such setting{hint}")
        elif key in opening and (wrong := _wrong(key, values[key])):
            document.fault(entries[key][1], f"source.{key}: {wrong}, got {values[key]!r:.100}")
        elif key in COMBINATORS and values[key] not in (None, False):
            try:
                checked_fields("source", key, values[key])
            except ConfigError as error:
                document.fault(entries[key][1], str(error))
    twice = [key for key in values if key in COMBINATORS and COMBINATORS[key].over_time and values[key]]
    if len(twice) > 1:
        document.fault(entries[twice[1]][0], f"source: {' and '.join(twice)} both smooth over time; choose one")
    if document.faults:
        return SourceSettings()
    for key in _FILES:
        if isinstance(values.get(key), str) and folder is not None:
            values[key] = os.path.join(folder, os.path.expanduser(values[key]))  # a Path drops a pattern's last slash
    posed = values.get("posed")
    if isinstance(posed, dict) and isinstance(posed.get("file"), str) and folder is not None:
        posed["file"] = os.path.join(folder, os.path.expanduser(posed["file"]))
    skip = list(values.pop("skip", None) or ())
    skip_file = values.pop("skip_file", None)
    skip += read_skip_file(skip_file) if skip_file else []
    only = values.pop("only", None) or ()
    only = (only,) if isinstance(only, str) else tuple(only)
    own = {key: value for key in opening if (value := values.pop(key, None)) is not None}
    return SourceSettings(**own, only=only, skip=tuple(skip), options=values)


def _wrong(key: str, value: Any) -> str:
    """Say what a setting must be, where it is not."""
    if value is None:
        return ""
    if key == "kind" and value not in [*LAYOUTS]:
        hint = near_matches(str(value), LAYOUTS) or "; one of your own needs --import FILE.py"
        return f"must be one of {', '.join(LAYOUTS)}{hint}"
    if key in ("path", "skip_file") and (not isinstance(value, str) or not value):
        return "must be a path"
    if key == "limit" and (type(value) is not int or value < 1):
        return "must be a whole number of at least 1"
    if key == "only" and not (isinstance(value, str) and value) and not _is_texts(value):
        return 'must be a pattern of ids such as "left_*", or a list of them'
    if key == "skip" and not _is_texts(value):
        return 'must be a list of ids, texts in quotes such as ["0005"]'
    return ""


def _is_texts(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(one, str) for one in value)
