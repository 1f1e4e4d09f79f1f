"""Files mapped into memory without keeping them open: a thousand shards need no thousand open files.

Before Python 3.13 its own ``mmap`` keeps a descriptor for as long as the mapping lives, and a process may have 1,024 of
them on a usual Linux. The system itself needs none (POSIX, mmap: closing the file does not remove the mapping).
"""

from __future__ import annotations

import ctypes
import mmap
import os
import sys
import weakref
from typing import BinaryIO

_FAILED = ctypes.c_void_p(-1).value


def map_file(file: BinaryIO) -> memoryview:
    """Return the bytes of an open file that is not empty, read-only and still on disk; the file may be closed.

    Raises:
        OSError: its file system maps none, or there is no address space.
    """
    size = os.fstat(file.fileno()).st_size
    if sys.version_info >= (3, 13) or os.name == "nt":
        more = {"trackfd": False} if os.name != "nt" else {}
        return memoryview(mmap.mmap(file.fileno(), size, access=mmap.ACCESS_READ, **more))
    return _mapped(file.fileno(), size)


def identity_of(file: BinaryIO) -> tuple[int, ...]:
    """Return what tells an open file, so long as nobody writes into it, from others of its name."""
    status = os.fstat(file.fileno())
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


def _mapped(descriptor: int, size: int) -> memoryview:
    library = ctypes.CDLL(None, use_errno=True)
    library.mmap.restype = ctypes.c_void_p
    library.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 3, ctypes.c_long]
    library.munmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t]
    address = library.mmap(None, size, mmap.PROT_READ, mmap.MAP_SHARED, descriptor, 0)
    if address == _FAILED:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    whole = (ctypes.c_ubyte * size).from_address(address)
    # Nothing is unmapped at exit: other objects may still read it then.
    weakref.finalize(whole, library.munmap, address, size).atexit = False
    return memoryview(whole).cast("B").toreadonly()
