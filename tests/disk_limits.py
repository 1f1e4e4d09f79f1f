"""Files that cannot grow beyond a size, as on a full disk."""

from __future__ import annotations

import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager


def limit_files(size: int) -> None:
    """Let every file that this process writes end at a size; Python ignores the signal, so writing fails.

    Python itself writes what it compiles, and before 3.12.8 does not look whether all of it was written: half a `.pyc`
    would stay and spoil every later import. So it writes none of them.
    """
    sys.dont_write_bytecode = True
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """Limit files for a while; see `limit_files`."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    bytecode = sys.dont_write_bytecode
    limit_files(size)
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        sys.dont_write_bytecode = bytecode
