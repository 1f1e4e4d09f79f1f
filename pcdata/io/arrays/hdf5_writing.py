"""The file under an HDF5 file that is being written: a full disk ends in an error, not in a crash of the C library.

HDF5 keeps what it could not write in its caches, tries again when objects are dropped and the file is closed, and is
left with freed memory where that fails once more. So it is never told of a fault: what the disk does not take is kept
in memory, where the library can still read it, and the caller asks :meth:`FaultKeepingFile.check` after every record.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pcdata.files.interrupts import shielded


@contextmanager
def new_hdf5(path: Path) -> Iterator[tuple[Any, FaultKeepingFile]]:
    """Make a file and close it; with it comes what to ask for faults after every write, which is to be shielded.

    HDF5 calls back into Python, where a signal must not raise.

    Raises:
        OSError: it cannot be made, or something that HDF5 wrote is not in it.
    """
    import h5py

    disk = FaultKeepingFile(path)
    try:
        with shielded():
            file = h5py.File(disk, "w")
        try:
            yield file, disk
        finally:
            with shielded():
                file.close()
    except BaseException:
        disk.abandon()
        raise
    disk.close()


class FaultKeepingFile:
    """A file object for ``h5py.File`` whose writes never fail toward HDF5."""

    def __init__(self, path: Path) -> None:
        """Open a file for reading and writing; it is made where there is none.

        Raises:
            OSError: it cannot be opened.
        """
        self.is_new = not path.exists()
        self._file = io.FileIO(path, "x+" if self.is_new else "r+")
        self._position = 0
        self._fault: OSError | None = None
        self._kept: list[tuple[int, bytes]] = []  # offset and bytes that the disk did not take, in order

    @property
    def has_failed(self) -> bool:
        """Whether something that HDF5 wrote is not in the file."""
        return self._fault is not None

    def check(self) -> None:
        """Raise the first fault, if there was one.

        Raises:
            OSError: something that HDF5 wrote is not in the file.
        """
        if self._fault is not None:
            raise self._fault

    def close(self) -> None:
        """Force everything to disk and close the file, after HDF5 has closed its own.

        Raises:
            OSError: something is not in the file.
        """
        try:
            self.check()
            os.fsync(self._file.fileno())
        finally:
            self._file.close()

    def abandon(self) -> None:
        """Close the file, whatever is in it."""
        self._file.close()

    # -- what h5py calls; positions are absolute since HDF5 seeks before every access ------------------------------

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to an offset; HDF5 also asks for the end."""
        if whence == os.SEEK_END:
            offset += self._end()
        elif whence == os.SEEK_CUR:
            offset += self._position
        self._position = offset
        return self._position

    def tell(self) -> int:
        """Return the offset."""
        return self._position

    def write(self, data: Any) -> int:
        """Write all bytes, or keep them."""
        view = memoryview(data).cast("B")
        start, self._position = self._position, self._position + len(view)
        if self._fault is None:
            try:
                self._file.seek(start)
                done = 0
                while done < len(view):  # a disk that fills up takes a part
                    done += self._file.write(view[done:])
                return len(view)
            except OSError as error:
                self._fault = error
        self._kept.append((start, bytes(view)))
        return len(view)

    def read(self, size: int) -> bytes:
        """Return bytes from here on; h5py knows a file object by this name and calls the next."""
        data = bytearray(max(0, min(size, self._end() - self._position)))
        self.readinto(data)
        return bytes(data)

    def readinto(self, buffer: Any) -> int:
        """Fill a buffer from the file and from what was kept."""
        view = memoryview(buffer).cast("B")
        start, self._position = self._position, self._position + len(view)
        done = 0
        try:
            self._file.seek(start)
            while done < len(view) and (count := self._file.readinto(view[done:])):
                done += count
        except OSError as error:
            self._fault = self._fault or error
        view[done:] = bytes(len(view) - done)
        for offset, kept in self._kept:
            low, high = max(offset, start), min(offset + len(kept), start + len(view))
            if low < high:
                view[low - start : high - start] = kept[low - offset : high - offset]
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        """Set the length, where the disk allows it."""
        size = self._position if size is None else size
        try:
            self._file.truncate(size)
        except OSError as error:
            self._fault = self._fault or error
        return size

    def flush(self) -> None:
        """Nothing waits here."""

    def _end(self) -> int:
        try:
            end = self._file.seek(0, os.SEEK_END)
        except OSError as error:
            self._fault = self._fault or error
            end = 0
        return max([end, *(offset + len(kept) for offset, kept in self._kept)])
