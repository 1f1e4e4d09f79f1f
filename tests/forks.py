"""Children of a test: whatever happens in one, it ends there, and never goes on with the tests of its parent."""

from __future__ import annotations

import os
import traceback
from collections.abc import Callable


def forked(run: Callable[[], int | None]) -> int:
    """Fork a process that runs a function and exits with what it returns (None = 0), with 99 after an error."""
    pid = os.fork()
    if pid:
        return pid
    code = 99
    try:  # pragma: no cover
        code = run() or 0
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)


def ended(pid: int) -> int:
    """Wait for a child; return its exit code, below 0 where a signal ended it."""
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
