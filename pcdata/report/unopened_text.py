"""What can be told of captures that cannot be opened yet: their layout, their files, a first depth image, and why."""

from __future__ import annotations

import re
import shlex
import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pcdata.errors import PcdataError
from pcdata.io.images.reading import DEPTH_SUFFIXES, read_raw_depth
from pcdata.io.sources.detect import detect_layout
from pcdata.io.sources.layouts import LAYOUTS
from pcdata.io.sources.listed import ONE_IMAGE
from pcdata.io.sources.listing import absolute, entries, is_folder
from pcdata.report.capture_facts import SCHEMA
from pcdata.report.inspection_text import size_in_words
from pcdata.report.plain_table import text_table

_MOST_FILES = 10_000  # that are counted
_WIDTH = 110  # characters of a line
_TRIED = 20  # images, of which the first that can be depth is told
_FLAG = re.compile(r"\((--[a-z][a-z-]*[^()]*)\)")  # how messages name the option that helps


def unopened_facts(path: str, kind: str | None, error: PcdataError) -> dict[str, Any] | None:
    """Return what can be told of a path without opening its captures, as JSON can hold it; None where nothing can.

    Args:
        path: the file or folder.
        kind: its layout, where that was said.
        error: why it cannot be opened.
    """
    place = absolute(path)
    if not place.exists():
        return None
    try:
        layout = LAYOUTS.get(kind) if kind is not None else detect_layout(place)
    except PcdataError:
        layout = None
    if layout is None:
        return None
    files = _files(place)
    facts: dict[str, Any] = {
        "schema": SCHEMA,
        "name": place.name,
        "layout": [layout.kind],
        "files": dict(Counter(file.suffix.lower() or file.name for file in files).most_common()),
        "bytes": sum(file.stat().st_size for file in files),
        "contents": layout.glance(place),
        "refused": f"{type(error).__name__}: {error}",
        "options": _FLAG.findall(str(error)),
    }
    if depth := _first_depth(files):
        facts["depth"] = depth
        if ONE_IMAGE in str(error):
            facts |= {"path": path, "single": str(Path(path) / str(depth["file"]))}
    return facts


def unopened_text(facts: Mapping[str, Any], words: Sequence[str]) -> str:
    """Tell what :func:`unopened_facts` found, and the command to go on."""
    counted = ", ".join(f"{count} {suffix}" for suffix, count in list(facts["files"].items())[:8])
    rows = [["layout", facts["layout"][0]], ["files", f"{counted}; {size_in_words(facts['bytes'])}"]]
    rows += [["contents" * (not number), line] for number, line in enumerate(facts["contents"])]
    if depth := facts.get("depth"):
        rows.append(["depth", f"{depth['file']}: {depth['width']}x{depth['height']} {depth['dtype']}, {depth['told']}"])
    why = textwrap.wrap(facts["refused"].splitlines()[0], _WIDTH, break_long_words=False, break_on_hyphens=False)
    rows += [["not opened" * (not number), line] for number, line in enumerate(why)]
    needed = needed_options(facts["refused"])
    commands = [f"{shlex.join(words)} {options}" for options in ([needed] if needed else facts["options"])]
    if facts.get("single"):  # what helps one image of the folder does not help the others
        commands = [shlex.join([facts["single"] if word == facts["path"] else word for word in words])]
    rows += [["next" * (not number), f"pcdata inspect {command}"] for number, command in enumerate(commands)]
    return text_table(["capture", facts["name"]], rows)


def needed_options(message: str) -> str:
    """Return the options that an error says are needed, all of them, as they are typed; "" = it names none.

    An image needs intrinsics and a unit; of other options that messages name, one helps.
    """
    found = _FLAG.findall(message)
    return " ".join(option for option in found if option.startswith(("--intrinsics", "--metres-per-unit")))


def _files(place: Path) -> list[Path]:
    if not is_folder(place):
        return [place]
    found: list[Path] = []
    folders = [place]
    while folders and len(found) < _MOST_FILES:
        try:
            inside = entries(folders.pop())
        except PcdataError:
            continue
        found += [entry for entry in inside if entry.is_file()]
        folders += [entry for entry in reversed(inside) if is_folder(entry) and not entry.is_symlink()]
    return found


def _first_depth(files: Sequence[Path]) -> dict[str, Any] | None:
    """Return the size, the type and the range of the numbers of the first image that can be depth."""
    images = [file for file in files if file.suffix.lower() in DEPTH_SUFFIXES]
    likely = sorted(images, key=lambda file: ("depth" not in str(file).lower(), files.index(file)))
    for file in likely[:_TRIED]:
        try:
            raw = read_raw_depth("inspect", file)
        except PcdataError:
            continue
        readings = raw[np.isfinite(raw) & (raw > 0)]
        if not readings.size:
            continue
        low, middle, high = readings.min(), np.median(readings), readings.max()
        told = f"stored numbers from {low:g} to {high:g}, half below {middle:g}; {readings.size / raw.size:.0%} not 0"
        height, width = raw.shape
        return {"file": file.name, "width": width, "height": height, "dtype": str(raw.dtype), "told": told}
    return None
