"""Which capture layout a path has, by exact signs: nothing is guessed."""

from __future__ import annotations

import inspect
import os
from pathlib import Path
from typing import Any

from pcdata.errors import CaptureError, ConfigError, near_matches
from pcdata.files.sample_names import name_some
from pcdata.io.sources.cloud_files import CloudFilesSource
from pcdata.io.sources.folder import FolderSource
from pcdata.io.sources.graspnet import GraspNetSource
from pcdata.io.sources.listing import check_links, entries, is_folder
from pcdata.io.sources.realsense_bag import RealSenseBagSource
from pcdata.io.sources.rig import RigSource
from pcdata.io.sources.seven_scenes import SevenScenesSource
from pcdata.io.sources.source import Source

LAYOUTS: dict[str, type[Source]] = {
    layout.kind: layout
    for layout in (FolderSource, RigSource, GraspNetSource, SevenScenesSource, RealSenseBagSource, CloudFilesSource)
}


def register_layout(layout: type[Source]) -> type[Source]:
    """Make a layout of your own known by its ``kind``, to :func:`open_source` and to every command; a decorator.

    Raises:
        ConfigError: it is no complete :class:`Source`, or the kind exists.
    """
    if not (isinstance(layout, type) and issubclass(layout, Source)):
        raise ConfigError(f"register_layout: must be a subclass of pcdata.io.Source, got {layout!r:.100}")
    if inspect.isabstract(layout):
        missing = ", ".join(sorted(layout.__abstractmethods__))
        raise ConfigError(f"register_layout: {layout.__name__} does not say {missing}; define that")
    for name in ("kind", "needs"):
        if not isinstance(getattr(layout, name, None), str) or not getattr(layout, name):
            raise ConfigError(f"register_layout: {layout.__name__}.{name} must be a text; see pcdata.io.Source")
    known = LAYOUTS.get(layout.kind)
    if known is not None and (known.__module__, known.__qualname__) != (layout.__module__, layout.__qualname__):
        raise ConfigError(f"a layout called {layout.kind} is registered already; choose another name")
    LAYOUTS[layout.kind] = layout
    return layout


def open_source(
    path: str | os.PathLike[str],
    *,
    kind: str | None = None,
    limit: int | None = None,
    **options: Any,
) -> Source:
    """Open a capture; nothing but names and calibration is read until ``load``.

    Args:
        path: a folder, or a single ``.pcd``, ``.ply`` or ``.bag`` file.
        kind: the layout, one of :data:`LAYOUTS`; None = found by its signs.
        limit: keep the first so many samples only.
        **options: those of the layout's class, e.g. ``metres_per_unit``.

    Raises:
        CaptureError: nothing is there, no layout or more than one fits, or the capture is incomplete.
        ConfigError: the kind, the limit or an option is not known.
    """
    given = Path(path).expanduser()
    check_links([given])
    if not given.exists():
        raise CaptureError(f"open_source: {given}: no such file or folder; check the path (relative to {Path.cwd()})")
    if limit is not None and (isinstance(limit, bool) or not isinstance(limit, int) or limit < 1):
        raise ConfigError(f"open_source: limit must be a whole number of at least 1, or None, got {limit!r}")
    layout = _detect(given) if kind is None else _named(kind)
    known = [name for name in inspect.signature(layout).parameters if name != "path"]
    for option in options:
        if option not in known:
            raise ConfigError(
                f"open_source: the layout {layout.kind!r} has no option {option!r}{near_matches(option, known)}; "
                f"it has {', '.join(known) or 'none'}"
            )
    source = layout(given, **options)
    return source if limit is None else source.subset(source.ids[:limit])


def _named(kind: str) -> type[Source]:
    if kind not in LAYOUTS:
        raise ConfigError(
            f"open_source: no layout {kind!r}{near_matches(kind, LAYOUTS)}; known: {', '.join(LAYOUTS)}; "
            "one of your own needs --import FILE.py"
        )
    return LAYOUTS[kind]


def _detect(path: Path) -> type[Source]:
    fitting = [layout for layout in LAYOUTS.values() if layout.recognises(path)]
    if len(fitting) > 1 and is_folder(path):  # a recording that lies beside a capture is not the capture
        fitting = [layout for layout in fitting if layout is not RealSenseBagSource]
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        kinds = " and ".join(layout.kind for layout in fitting)
        raise CaptureError(f"open_source: {path}: looks like {kinds}; say which with kind= (--kind)")
    known = "\n".join(f"  {layout.kind}: {layout.needs}" for layout in LAYOUTS.values())
    raise CaptureError(
        f"open_source: {path}: no known layout; found {_contents(path)}.{_captures_inside(path)} The layouts and what "
        f"each needs:\n{known}"
    )


def _captures_inside(path: Path) -> str:
    """Say which entries of a folder are captures themselves, such as the folder that an archive was packed with."""
    try:
        inside = entries(path) if is_folder(path) else []
    except CaptureError:
        return ""
    found = [entry.name for entry in inside[:100] if any(layout.recognises(entry) for layout in LAYOUTS.values())]
    return f" A capture by itself: {name_some(found)}; give its path." if found else ""


def _contents(path: Path) -> str:
    if path.is_file():
        return f"a {path.suffix or 'nameless'} file"
    try:
        found = entries(path)
    except CaptureError as error:
        return f"a folder that cannot be listed ({error})"
    return name_some(entry.name + "/" * is_folder(entry) for entry in found) or "an empty folder"
