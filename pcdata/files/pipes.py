"""A named pipe for libraries that write to a path alone and do not tell what failed."""

from __future__ import annotations

import os
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from pcdata.errors import WriteError

_AT_ONCE = 1 << 20  # bytes


@contextmanager
def piped(where: str, file: BinaryIO) -> Iterator[Path]:
    """Give a named pipe, whose bytes go to ``file``; it must be opened inside, once, and be closed again.

    All that is written to the pipe is taken, whether the file can be written or not, so no writer waits.

    Raises:
        WriteError: the system (Windows) has no named pipes.
        OSError: of the file, at the end.
    """
    if not hasattr(os, "mkfifo"):
        raise WriteError(f"{where}: needs named pipes, which this system lacks; write on Linux or macOS")
    failed: list[OSError] = []

    def copy() -> None:
        while data := os.read(pipe, _AT_ONCE):
            try:
                if not failed:
                    file.write(data)
            except OSError as error:
                failed.append(error)

    with tempfile.TemporaryDirectory(prefix="pcdata-") as folder:
        name = Path(folder, "pipe")
        os.mkfifo(name, 0o600)
        # Without waiting for a writer; a second end of ours keeps it from ending before the writer has come.
        pipe = os.open(name, os.O_RDONLY | os.O_NONBLOCK)
        own = os.open(name, os.O_WRONLY)
        os.set_blocking(pipe, True)
        copying = threading.Thread(target=copy, daemon=True)
        copying.start()
        try:
            yield name
        finally:
            os.close(own)
            copying.join()
            os.close(pipe)
    if failed:
        raise failed[0]
