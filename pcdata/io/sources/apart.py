"""Nothing is written among the captures that are read: the next reader would take it for one, or for their camera."""

from __future__ import annotations

import glob
import os
from pathlib import Path
from typing import Any

from pcdata.errors import ConfigError
from pcdata.io.sources.capture_source import all_within


def check_apart(where: str, target: str | os.PathLike[str], source: Any) -> None:
    """Require that what is to be written, and all that it may replace, lies apart from what is read.

    Args:
        where: who asks, for the message.
        target: the file or folder that is to be written.
        source: captures, a dataset, or a path.

    Raises:
        ConfigError: the target is among the captures, would be joined to them by the pattern that they were opened
            with, or holds them.
    """
    place = Path(os.path.realpath(Path(target).expanduser()))
    paths, pattern = _read(source)
    for path in paths:
        real = Path(os.path.realpath(Path(path).expanduser()))
        if place == real and real.is_file():
            raise ConfigError(f"{where}: {place} is what is read; choose another file")
        if place.is_relative_to(real):
            raise ConfigError(
                f"{where}: {place} is inside the captures {real}, and would become part of them; choose a place outside"
            )
        if real.is_relative_to(place):
            raise ConfigError(f"{where}: {place} holds the captures {real}, so nothing may be put in its place")
        if glob.has_magic(pattern) and real.match(pattern):
            whole = str(Path(*real.parts[: -len(Path(pattern).parts)], pattern))
            if any(part.match(whole) for part in (place, *place.parents)):
                raise ConfigError(
                    f"{where}: {place} fits the pattern {whole}, so it would be read as captures too, the next time; "
                    "choose another place"
                )


def _read(source: Any) -> tuple[list[str | os.PathLike[str]], str]:
    """Return where captures, or a dataset, lie, and the pattern of several that were joined."""
    if isinstance(source, (str, os.PathLike)):
        path = Path(source).expanduser()
        matches = glob.glob(str(path)) if glob.has_magic(str(path)) and not path.exists() else []
        return [*matches] or [source], Path(os.path.abspath(path)).as_posix() if matches else ""
    source = getattr(source, "source", source)  # of a dataset that processes captures as they are read
    places = [getattr(one, name, None) for one in all_within(source) for name in ("path", "folder")]
    pattern = getattr(source, "opened", {}).get("path", "")
    return [place for place in places if isinstance(place, (str, os.PathLike))], str(pattern)
