"""The one door to captures: a path, how it is read, what is left out, and what is made of it."""

from __future__ import annotations

import glob
import math
import os
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from pcdata.errors import CaptureError, ConfigError, PcdataError, add_note, locates_path, near_matches
from pcdata.files.opening import read_text
from pcdata.files.sample_names import in_order, name_some
from pcdata.files.urls import url_hint
from pcdata.io.sources.capture_source import kinds_of, refused_captures
from pcdata.io.sources.combine import Selectable
from pcdata.io.sources.detect import detect_layout
from pcdata.io.sources.joined_source import JoinedSource
from pcdata.io.sources.layouts import COMBINATORS, LAYOUTS
from pcdata.io.sources.listing import absolute, check_links, is_litter, link_targets
from pcdata.io.sources.registry import checked_fields, combined, layout_named, options_of
from pcdata.io.sources.source import Source

_WHERE = "open_source"


@locates_path
def open_source(
    path: str | os.PathLike[str],
    *,
    kind: str | None = None,
    only: str | Sequence[str] = (),
    limit: int | None = None,
    skip: Sequence[str] = (),
    skip_refused: bool = False,
    **options: Any,
) -> Selectable[Any]:
    """Open captures; nothing but names and calibration is read until ``load``.

    Args:
        path: a folder, or a single ``.pcd``, ``.ply`` or ``.bag`` file; or a pattern such as ``scenes/*``, of which
            every match is opened by itself and all are joined: the sample ``NAME/ID`` is ``ID`` of the match ``NAME``;
            ``scenes/*/`` fits folders alone.
        kind: the layout, one of :data:`LAYOUTS`; None = found by its signs.
        only: keep the samples whose ids match this pattern, or one of these, such as ``frame_00*``.
        limit: keep the first so many of the samples that are not left out by ``only`` and ``skip``.
        skip: ids to leave out; ``skipped`` of what is returned tells which, and why.
        skip_refused: load every capture once, and leave out those that are refused.
        **options: those of the layout's class, e.g. ``metres_per_unit``; and combinators, one of :data:`COMBINATORS`
            with its fields, such as ``averaged={"num_frames": 10}``: they go around what is left, in the order given.

    Returns:
        A :class:`CaptureSource` of which a part can be taken: where nothing is combined the layout's own class, such as
        ``FolderSource``.

    Raises:
        CaptureError: nothing is there, no layout or more than one fits, the capture is incomplete, or nothing is left.
        ConfigError: the kind, the limit or an option is not known.
    """
    _check_limit(limit)
    around = {name: options.pop(name) for name in list(options) if name in COMBINATORS}
    around = {name: value for name, value in around.items() if value is not None and value is not False}
    if len(twice := [name for name in around if COMBINATORS[name].over_time]) > 1:
        raise ConfigError(f"{_WHERE}: {' and '.join(twice)} both smooth over time; choose one")
    told = _told(path, options, around, only=only, limit=limit, skip=skip, skip_refused=skip_refused)
    source: Selectable[Any] = _open(path, kind, options)
    if only:
        source = _matching(source, [only] if isinstance(only, str) else only)
    if skip:
        source = source.without(skip)
    if limit is not None:
        source = source.subset(source.ids[:limit])
    if skip_refused and (refused := refused_captures(source)):
        source = source.without(refused)
    for name, value in around.items():
        source = combined(_WHERE, source, name, value)
    layouts = [kind for kind in kinds_of(source) if kind in LAYOUTS]
    told = {"path": told.pop("path"), **({"kind": layouts[0]} if len(layouts) == 1 else {}), **told}
    object.__setattr__(source, "opened", told)  # a combinator is frozen
    return source


def read_skip_file(path: str | os.PathLike[str]) -> list[str]:
    """Read a list of sample ids, one on a line; empty lines and those that begin with ``#`` do not count.

    Raises:
        CaptureError: the file is missing or no text, or lists no id, which is more likely a mistake than meant.
    """
    lines = (line.strip() for line in read_text("read_skip_file", path).splitlines())
    listed = [line for line in lines if line and not line.startswith("#")]
    if not listed:
        raise CaptureError(f"read_skip_file: {path}: lists no id; give one on a line, or leave the file out")
    return listed


def _open(path: str | os.PathLike[str], kind: str | None, options: dict[str, Any]) -> Source | JoinedSource:
    if not os.fspath(path):
        raise ConfigError(f"{_WHERE}: the path is empty; give one, or '.' for the folder that this runs in")
    given = Path(path).expanduser()
    check_links([given])
    if given.exists():
        return _open_one(given, kind, options)
    if not glob.has_magic(str(given)):
        if hint := url_hint(given):
            raise CaptureError(f"{_WHERE}: {hint}")
        raise CaptureError(f"{_WHERE}: {given}: no such file or folder; check the path (relative to {Path.cwd()})")
    fixed = Path(*_before_pattern(given.parts))
    found = [Path(match) for match in glob.glob(str(given) + _folders_alone(path))]
    names = {match.relative_to(fixed).as_posix(): match for match in found if not is_litter(match.name)}
    if not names:
        raise CaptureError(f"{_WHERE}: {given}: no file or folder fits this pattern (relative to {Path.cwd()})")
    check_links(names.values())
    return JoinedSource({name: _open_match(given, names[name], kind, options) for name in in_order(names)})


def _folders_alone(path: str | os.PathLike[str]) -> str:
    """Return the slash that a pattern of folders ends with, which a Path drops, or nothing."""
    return "/" if os.fspath(path).endswith(("/", os.sep)) else ""


def _open_match(pattern: Path, path: Path, kind: str | None, options: dict[str, Any]) -> Source:
    try:
        return _open_one(path, kind, options)
    except PcdataError as error:
        fix = "" if path.is_dir() else f"; {pattern.as_posix()}/ fits folders alone"
        add_note(error, f"{path.name} fits the pattern {pattern}, so it must be a capture{fix}")
        raise


def _open_one(path: Path, kind: str | None, options: dict[str, Any]) -> Source:
    layout = detect_layout(path) if kind is None else layout_named(_WHERE, kind)
    known = options_of(layout)
    for option in options:
        if option not in known:
            hint = near_matches(option, [*known, *COMBINATORS])
            if option == "calibration":
                hint = (
                    "; poses of a calibration go around captures of any layout with posed={'file': ...} (--posed FILE)"
                )
            raise ConfigError(
                f"{_WHERE}: the layout {layout.kind!r} has no option {option!r}{hint}; it has "
                f"{', '.join(known) or 'none'}"
            )
    return layout(path, **options)


def _told(
    path: str | os.PathLike[str], options: Mapping[str, Any], around: Mapping[str, Any], **others: Any
) -> dict[str, Any]:
    """Return what was said, as a section ``source`` says it; of files the names alone, the same on every machine."""
    given = Path(path).expanduser()
    fixed = len(_before_pattern(given.parts))
    is_pattern = fixed < len(given.parts) and not given.exists()
    place = given.parts[max(fixed - 1, 0) :] if is_pattern else [absolute(given).name]
    pattern = _folders_alone(path) if is_pattern else ""
    told = {
        "path": Path(*place).as_posix() + pattern,
        **{name: value for name, value in others.items() if value},
        **options,
    }
    if isinstance(told.get("only"), str):
        told["only"] = [told["only"]]
    if "calibration" in told:
        file = told["calibration"]
        told["calibration"] = Path(file).name if isinstance(file, (str, os.PathLike)) else "given as an object"
    if "links_to" in told:
        told["links_to"] = [folder.name for folder in link_targets(told["links_to"])]
    told |= {name: checked_fields(_WHERE, name, value) for name, value in around.items()}
    if isinstance(file := told.get("posed", {}).get("file"), (str, os.PathLike)):
        told["posed"] |= {"file": Path(file).name}
    return {name: _plain(value) for name, value in told.items() if value is not None}


def _plain(value: Any) -> Any:
    """Return what JSON and YAML can hold."""
    if isinstance(value, Mapping):
        return {str(name): _plain(inner) for name, inner in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [_plain(inner) for inner in value]
    if isinstance(value, os.PathLike):
        return Path(value).name
    is_plain = isinstance(value, (str, bool, int, type(None))) or (isinstance(value, float) and math.isfinite(value))
    return value if is_plain else str(value)


def _before_pattern(parts: Sequence[str]) -> list[str]:
    """Return the parts of a path before the first that is a pattern."""
    fixed = []
    for part in parts:
        if glob.has_magic(part):
            break
        fixed.append(part)
    return fixed


def _matching(source: Any, patterns: Sequence[str]) -> Any:
    if not isinstance(patterns, Sequence) or not all(isinstance(one, str) and one for one in patterns):
        raise ConfigError(f"{_WHERE}: only must be a pattern of ids, or a list of them, got {patterns!r:.100}")
    for pattern in patterns:
        if not any(fnmatchcase(sample_id, pattern) for sample_id in source.ids):
            raise CaptureError(
                f"{_WHERE}: no sample of {source} fits only {pattern!r}{near_matches(pattern, source.ids)}; the ids "
                f"are {name_some(source.ids)}"
            )
    return source.subset([name for name in source.ids if any(fnmatchcase(name, one) for one in patterns)])


def _check_limit(limit: int | None) -> None:
    if limit is not None and (isinstance(limit, bool) or not isinstance(limit, int) or limit < 1):
        raise ConfigError(f"{_WHERE}: limit must be a whole number of at least 1, or None, got {limit!r}")
