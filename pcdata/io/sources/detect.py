"""Which capture layout a path has, by exact signs: nothing is guessed."""

from __future__ import annotations

from pathlib import Path

from pcdata.errors import CaptureError
from pcdata.files.sample_names import name_some
from pcdata.io.sources.listing import entries, is_folder
from pcdata.io.sources.registry import LAYOUTS
from pcdata.io.sources.source import Source

# Signs that other layouts may have too, where they have more: a recording that lies beside a capture is not the
# capture, and any folder may have an image with the word depth in its name.
_LESS_EXACT = ("realsense_bag", "azure_kinect", "ros", "pairs")


def detect_layout(path: Path) -> type[Source]:
    """Return the one layout whose signs are there.

    Raises:
        CaptureError: none is, or more than one.
    """
    fitting = [layout for layout in LAYOUTS.values() if layout.recognizes(path)]
    for less_exact in _LESS_EXACT:
        if len(fitting) > 1 and is_folder(path):
            fitting = [layout for layout in fitting if layout.kind != less_exact]
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
    found = [entry.name for entry in inside[:100] if any(layout.recognizes(entry) for layout in LAYOUTS.values())]
    return f" A capture by itself: {name_some(found)}; give its path." if found else ""


def _contents(path: Path) -> str:
    if path.is_file():
        return f"a {path.suffix or 'nameless'} file"
    try:
        found = entries(path)
    except CaptureError as error:
        return f"a folder that cannot be listed ({error})"
    return name_some(entry.name + "/" * is_folder(entry) for entry in found) or "an empty folder"
