"""Files that a command writes at its end: refused at its begin, where they cannot be written."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path


class _Stopped(Exception):
    """An error of the work, on its way past the files that it is not about."""


@contextmanager
def text_files(command: str, **paths: str | None) -> Iterator[Callable[[str, str], None]]:
    """Give what writes the text of an option, such as ``write("json", text)``; all become files once the block is done.

    A text for an option that was not given is dropped.

    Args:
        command: who writes, for messages.
        paths: option -> where.

    Raises:
        ConfigError: two options name one file.
        WriteError: a file cannot be written; before the block where that is known then.
    """
    from pcdata.errors import ConfigError, PcdataError, WriteError, write_fault
    from pcdata.files.opening import replacing

    given = {name: path for name, path in paths.items() if path}
    places: dict[str, str] = {}
    for name, path in given.items():
        place = os.path.realpath(path)
        if place in places:
            raise ConfigError(f"{command}: --{places[place]} and --{name} are one file, {path}; give two")
        places[place] = name
    failed: OSError | None = None
    try:
        with ExitStack() as opened:
            parts = {name: opened.enter_context(replacing(f"{command} --{name}", path)) for name, path in given.items()}

            def write(name: str, text: str) -> None:
                if name not in parts:
                    return
                try:
                    Path(parts[name]).write_text(text, encoding="utf-8")
                except OSError as cause:
                    where = f"{command} --{name}: {given[name]}"
                    raise WriteError(f"{where}: cannot be written: {write_fault(cause)}") from cause

            try:
                yield write
            except OSError as error:
                if isinstance(error, PcdataError):
                    raise
                failed = error
                raise _Stopped from error
    except _Stopped:
        pass
    if failed is not None:
        raise failed
