"""The one door for files that are read: regular files only, of a bounded size, inside the folder they belong to.

Whatever pcdata reads, it opens here: :func:`open_input` where a library takes an open file, :func:`existing_file` where
it takes a path alone, :func:`read_bytes`, :func:`read_text` and :func:`map_npy` where the whole file is wanted. Each
fails with one typed error that names the file; docs/security.md states the rules.
"""

from __future__ import annotations

import errno
import mmap
import os
import shlex
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CacheError, CaptureError, PcdataError, WriteError, locates_path, write_fault
from pcdata.files.inputs import note_input
from pcdata.files.interrupts import shielded
from pcdata.files.npy import PREFIX, header_length, parse_header
from pcdata.files.part_files import part_file
from pcdata.files.urls import url_hint

MAX_TEXT_BYTES = 1 << 20  # a calibration or pose file holds a few hundred bytes
MAX_STREAMED_BYTES = 1 << 42  # 4 TB: a file that is read in parts, whose claims are checked before each part is read

_SPARSE_FROM = 1 << 26  # bytes: below, a file of holes takes no more memory than a small image
_MOST_HOLES = 1000  # a file's size over what is stored of it: above, it is nearly all nothing


@locates_path
def open_input(
    where: str,
    path: str | os.PathLike[str],
    *,
    max_bytes: int,
    inside: Iterable[str | os.PathLike[str]] | None = None,
    error: type[PcdataError] = CaptureError,
) -> BinaryIO:
    """Open a file for reading; what is opened is also what was examined, so nothing can be exchanged in between.

    Args:
        where: who asks, the first words of a message.
        path: the file; its links are followed.
        max_bytes: what a file of this kind holds at most; :data:`MAX_STREAMED_BYTES` where it is read in parts.
        inside: folders, one of which the file must lie in once links have been followed: the folder that lists it and
            the stores that its links may lead to. None = anywhere, for a file that the user named.
        error: what is raised.

    Raises:
        PcdataError: of the type ``error``: missing, no regular file (a folder, FIFO, device or socket), empty, larger
            than ``max_bytes``, nearly all holes, outside, or not readable.
    """
    file = Path(path)
    try:
        # Examined before it is opened too: opening alone can set off a device. O_NONBLOCK: a FIFO would wait for ever.
        _check_kind(where, file, os.stat(file), error)
        descriptor = os.open(file, os.O_RDONLY | _FLAGS)
    except PcdataError:  # some of which are an OSError or a ValueError as well
        raise
    except FileNotFoundError as cause:
        raise error(_missing(where, file)) from cause
    except (OSError, ValueError) as cause:  # ValueError: a NUL in the name
        raise error(f"{told_at(where, file)}: cannot be opened: {cause}") from cause
    stream = os.fdopen(descriptor, "rb")
    try:
        status = os.fstat(descriptor)
        _check_kind(where, file, status, error)
        if inside is not None:
            _check_inside(where, file, status, inside, error)
        if status.st_size == 0:
            raise error(f"{told_at(where, file)}: the file is empty (0 bytes); was the copy or download interrupted?")
        if status.st_size > max_bytes:
            raise error(
                f"{told_at(where, file)}: has {status.st_size} bytes, more than the limit of {max_bytes} for this kind"
            )
        if status.st_size >= _SPARSE_FROM and _stored_bytes(descriptor, status.st_size) * _MOST_HOLES < status.st_size:
            raise error(
                f"{told_at(where, file)}: claims {status.st_size} bytes but is nearly all holes (a sparse file); was "
                "the copy or download interrupted?"
            )
    except BaseException as cause:
        stream.close()
        if isinstance(cause, OSError) and not isinstance(cause, PcdataError):
            raise error(f"{told_at(where, file)}: cannot be examined: {cause}") from cause
        raise
    try:
        note_input(file, stream)
    except OSError as cause:
        stream.close()
        raise error(f"{told_at(where, file)}: cannot be read: {cause}") from cause
    return stream


def existing_file(
    where: str,
    path: str | os.PathLike[str],
    *,
    max_bytes: int,
    inside: Iterable[str | os.PathLike[str]] | None = None,
    error: type[PcdataError] = CaptureError,
) -> Path:
    """Return the path of a file that passes :func:`open_input`, for libraries that open files themselves."""
    open_input(where, path, max_bytes=max_bytes, inside=inside, error=error).close()
    return Path(path)


def read_bytes(
    where: str,
    path: str | os.PathLike[str],
    *,
    max_bytes: int,
    inside: Iterable[str | os.PathLike[str]] | None = None,
    error: type[PcdataError] = CaptureError,
) -> bytes:
    """Return the whole content of a file that passes :func:`open_input`."""
    try:
        with open_input(where, path, max_bytes=max_bytes, inside=inside, error=error) as stream:
            size = os.fstat(stream.fileno()).st_size
            content = stream.read(size + 1)  # Python takes the memory for all that is asked for, before it reads
    except (OSError, MemoryError) as cause:
        if isinstance(cause, PcdataError):
            raise
        raise error(f"{told_at(where, path)}: cannot be read: {str(cause) or type(cause).__name__}") from cause
    if len(content) != size:
        raise error(f"{told_at(where, path)}: changed its size while it was read; is it still being written?")
    return content


@locates_path
def read_text(
    where: str,
    path: str | os.PathLike[str],
    *,
    max_bytes: int = MAX_TEXT_BYTES,
    inside: Iterable[str | os.PathLike[str]] | None = None,
    error: type[PcdataError] = CaptureError,
) -> str:
    """Return the content of a small UTF-8 text file (a byte order mark is dropped)."""
    try:
        return read_bytes(where, path, max_bytes=max_bytes, inside=inside, error=error).decode("utf-8-sig")
    except UnicodeDecodeError as cause:
        raise error(
            f"{told_at(where, path)}: must be UTF-8 text, but byte {cause.start} is none; is it another file, or "
            "damaged?"
        ) from cause


def map_npy(
    where: str,
    path: str | os.PathLike[str],
    *,
    max_bytes: int,
    inside: Iterable[str | os.PathLike[str]] | None = None,
    error: type[PcdataError] = CaptureError,
) -> NDArray[Any]:
    """Return the array of a ``.npy`` file, read-only and still on disk; objects are never unpickled.

    The size that the header claims must be that of the file: less would leave out data without a word, more would
    have to be invented.
    """
    with open_input(where, path, max_bytes=max_bytes, inside=inside, error=error) as stream:
        try:
            start = stream.read(PREFIX)
            start += stream.read(header_length(start) - len(start))
            header = parse_header(start, os.fstat(stream.fileno()).st_size)
            if header.dtype.kind not in "biufc":
                raise CacheError(f"it must hold plain numbers, got {header.dtype}")
        except CacheError as cause:
            raise error(f"{told_at(where, path)}: not a readable .npy file of numbers: {cause}") from cause
        if not header.nbytes:
            return np.empty(header.shape, header.dtype)
        order: Literal["C", "F"] = "F" if header.by_columns else "C"
        try:
            content = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
            return np.ndarray(header.shape, header.dtype, content, header.begin, order=order)
        except (OSError, ValueError, TypeError) as cause:  # it has become shorter, or its file system maps none
            raise error(f"{told_at(where, path)}: cannot be read: {cause}") from cause


def check_inside(
    where: str,
    path: str | os.PathLike[str],
    inside: Iterable[str | os.PathLike[str]],
    error: type[PcdataError] = CaptureError,
) -> None:
    """Require that a file lies in one of the folders once links have been followed; a missing file passes."""
    try:
        _check_inside(where, Path(path), None, inside, error)
    except OSError as cause:
        if isinstance(cause, PcdataError):
            raise
        raise error(f"{told_at(where, path)}: cannot be examined: {cause}") from cause


@contextmanager
def replacing(where: str, path: str | os.PathLike[str], *, error: type[PcdataError] = WriteError) -> Iterator[Path]:
    """Give a temporary name beside ``path`` to write to; on success it becomes ``path`` at once, else it is removed.

    A link is followed: it stays, and its file is replaced. What a killed writer of the same file left is removed.

    Raises:
        PcdataError: of the type ``error``: the folder is missing, ``path`` is no regular file, or it cannot be written.
    """
    target = Path(os.path.realpath(path))
    if not target.parent.is_dir():
        if hint := url_hint(path):
            raise error(f"{where}: {hint}")
        raise error(f"{told_at(where, path)}: the folder {target.parent} does not exist; create it first")
    try:
        with suppress(FileNotFoundError):
            _check_kind(where, Path(path), os.stat(target), error)  # a rename would put a file where a device was
        with part_file(target) as temporary:
            yield temporary
            with shielded():
                os.replace(temporary, target)
    except OSError as cause:
        if isinstance(cause, PcdataError):
            raise
        raise error(f"{told_at(where, path)}: cannot be written: {write_fault(cause)}") from cause


# Absent on Windows, where none of these kinds of files has a name in the file system.
_FLAGS = (
    getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
)

_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a FIFO (named pipe)"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def told_at(where: str, path: str | os.PathLike[str]) -> str:
    """Return how a message about a file begins: who asks, and the path, unless who asks named it."""
    return where if where.endswith(str(path)) else f"{where}: {path}"


def _missing(where: str, file: Path) -> str:
    if file.is_symlink():
        return (
            f"{told_at(where, file)}: is a link to {os.readlink(file)}, which is not there; fetch its content, or "
            "correct the link"
        )
    if ":" in str(file) and (hint := url_hint(file)):
        return f"{where}: {hint}"
    return f"{told_at(where, file)}: no such file; check the path (relative to {Path.cwd()})"


def _check_kind(where: str, file: Path, status: os.stat_result, error: type[PcdataError]) -> None:
    if not stat.S_ISREG(status.st_mode):
        kind = next((words for test, words in _KINDS if test(status.st_mode)), "no regular file")
        raise error(f"{told_at(where, file)}: must be a file, but it is {kind}")


def _check_inside(
    where: str,
    file: Path,
    opened: os.stat_result | None,
    inside: Iterable[str | os.PathLike[str]],
    error: type[PcdataError],
) -> None:
    real = Path(os.path.realpath(file))
    folders = [Path(os.path.realpath(folder)) for folder in inside]
    if not any(real.is_relative_to(folder) for folder in folders):
        raise error(
            f"{told_at(where, file)}: leads out of {folders[0]}, to {real}; files outside are not read unless you "
            f"name the folder that links may lead to: links_to={str(real.parent)!r} "
            f"(--links-to {shlex.quote(str(real.parent))})"
        )
    if opened is not None and not os.path.samestat(os.stat(real), opened):
        raise error(f"{told_at(where, file)}: was exchanged while it was opened")


def _stored_bytes(descriptor: int, size: int) -> int:
    """Return how many bytes of a file are stored; the rest are holes. All, where the system does not tell."""
    if not hasattr(os, "SEEK_DATA"):
        return size
    stored = position = 0
    try:
        while position < size and stored * _MOST_HOLES < size:
            start = os.lseek(descriptor, position, os.SEEK_DATA)
            position = os.lseek(descriptor, start, os.SEEK_HOLE)
            stored += position - start
    except OSError as cause:
        if cause.errno != errno.ENXIO:  # which says that no more data follow; a file system without holes says another
            return size
    finally:
        os.lseek(descriptor, 0, os.SEEK_SET)
    return stored
