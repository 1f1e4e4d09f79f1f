"""Swap two names of one file system at once, where the system has a call for it."""

from __future__ import annotations

import ctypes
import errno
import os
import sys
from pathlib import Path

_LINUX_EXCHANGE = 2  # RENAME_EXCHANGE of renameat2(2)
_MACOS_SWAP = 2  # RENAME_SWAP of renamex_np(2)
_HERE = -100  # AT_FDCWD: relative paths start at the working folder
_CANNOT = {errno.EINVAL, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EPERM}  # the file system or a sandbox


def exchange(one: Path, other: Path) -> bool:
    """Swap what two names mean; False where that cannot be done at once, and nothing was changed.

    Raises:
        OSError: it can be done, and failed.
    """
    if sys.platform not in ("linux", "darwin"):
        return False
    library = ctypes.CDLL(None, use_errno=True)
    a, b = os.fsencode(one), os.fsencode(other)
    try:
        if sys.platform == "linux":
            failed = library.renameat2(_HERE, a, _HERE, b, ctypes.c_uint(_LINUX_EXCHANGE))
        else:
            failed = library.renamex_np(a, b, ctypes.c_uint(_MACOS_SWAP))
    except AttributeError:  # an old C library
        return False
    if not failed:
        return True
    number = ctypes.get_errno()
    if number in _CANNOT:
        return False
    raise OSError(number, os.strerror(number), str(one), None, str(other))
