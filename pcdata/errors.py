"""The exceptions pcdata raises; each is also the builtin a caller would expect to catch.

Every message says where, what must hold, what was given and what to do.
"""

from __future__ import annotations

import difflib
import errno
import functools
import inspect
import os
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import ParamSpec, TypeVar

_P = ParamSpec("_P")
_R = TypeVar("_R")

_LONGEST = 2000  # characters of one fault, which may repeat a name from a file
_LINES = 50  # faults of one file, of which nearly every line is wrong


class PcdataError(Exception):
    """Base of every error that pcdata raises on purpose.

    Beside its words it says where it happened, as far as that is known: programs need not read the message. What is
    raised inside a step by others (torch, a transform of your own) has the same attributes.
    """

    step: str | None = None  # the class name of the innermost transform that failed
    sample_id: str | None = None  # of the capture, as the source that was iterated calls it
    path: str | None = None  # the file or folder that could not be read or written


class ShapeError(PcdataError, ValueError):
    """A tensor has the wrong shape, or tensors that must agree do not."""


class DTypeError(PcdataError, TypeError):
    """A tensor has the wrong dtype, or a value the wrong type."""


class OutOfRangeError(PcdataError, IndexError):
    """There is no cloud of that number in the batch."""


class DeviceError(PcdataError, RuntimeError):
    """Tensors that must be on one device are not."""


class NonFiniteError(PcdataError, ValueError):
    """NaN or infinity where only finite numbers are allowed."""


class FrameError(PcdataError, ValueError):
    """A coordinate frame is unknown, or two frames were about to be mixed."""


class UnitError(PcdataError, ValueError):
    """Lengths are not in the unit that the step needs."""


class PoseError(PcdataError, ValueError):
    """A matrix that must be a rigid pose is not."""


class TooFewPointsError(PcdataError, ValueError):
    """A cloud has fewer points than the step needs, possibly none."""


class NoPlaneError(PcdataError, ValueError):
    """No plane satisfies the constraints."""


class NoShapeError(PcdataError, ValueError):
    """No sphere, cylinder, line or circle satisfies the constraints."""


class ContractError(PcdataError, ValueError):
    """Data are not what a model takes: wrong frame, unit, count, channels or layout."""


class ConfigError(PcdataError, ValueError):
    """A transform's fields or a configuration file are wrong; lists every fault at once.

    Where the caller can point at the place, ``faults`` has each with the path to it from what was given.
    """

    faults: Sequence[tuple[tuple[int | str, ...], str]] = ()


class ReplayError(PcdataError, ValueError):
    """What a history says was decided cannot be repeated on these data, or the history is not of these steps."""


class CaptureError(PcdataError, ValueError):
    """A raw capture (depth, color, intrinsics, pose, cloud file) cannot be trusted."""


class WriteError(CaptureError):
    """A single file cannot be written: its folder or the disk is at fault, not what goes into it."""


class IntrinsicsError(CaptureError):
    """Camera intrinsics cannot belong to the image they are given for."""


class NoReadingError(CaptureError):
    """A depth image has no reading at all."""


class CalibrationError(PcdataError, ValueError):
    """A calibration file is wrong, or what was given cannot determine a calibration."""


class CacheError(PcdataError, RuntimeError):
    """A stored dataset is damaged, hostile, incomplete or made by another pipeline."""


class VolumeTooLargeError(PcdataError, MemoryError):
    """A volume would need more memory than it was allowed."""


def is_out_of_memory(error: BaseException) -> bool:
    """Say whether the memory of the machine did not suffice: Python's error, or what PyTorch raises in its place.

    Its allocator for the CPU raises a plain ``RuntimeError``, which its text alone tells (c10/core/impl/alloc_cpu.cpp).
    """
    if isinstance(error, PcdataError):  # a limit that somebody set, or told in words
        return False
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    return isinstance(error, RuntimeError) and "DefaultCPUAllocator" in str(error)


class BackendError(PcdataError, RuntimeError):
    """A named backend is absent or cannot keep the contract for this call."""


class PcdataWarning(UserWarning):
    """Base of every warning of pcdata."""


class SlowBackendWarning(PcdataWarning):
    """A slow body serves because a fast one is absent; the message says why and what to do."""


class MissingExtraError(PcdataError, ImportError):
    """An optional dependency is not installed, or cannot be loaded."""


_WRITE_FAULTS = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the disk quota is used up",
    errno.EFBIG: "a file may not become so large here (see ulimit -f)",
    errno.EROFS: "the file system is read-only",
    errno.EACCES: "there is no permission to write",
    errno.EPERM: "there is no permission to write",
    errno.ENAMETOOLONG: "the name is too long",
}


def write_fault(error: BaseException) -> str:
    """Return why something cannot be written: in words where the system's number has a common cause."""
    words = _WRITE_FAULTS.get(error.errno or 0) if isinstance(error, OSError) else None
    return f"{words}: {error}" if words else str(error)


def locate(
    error: BaseException,
    *,
    step: str | None = None,
    sample_id: str | None = None,
    path: str | os.PathLike[str] | None = None,
) -> None:
    """Give an exception in flight the attributes of :class:`PcdataError`; what is not given stays.

    The innermost step and file are kept, since they are the cause; the outermost sample id, since that is the caller's.
    """
    inner = {"step": step, "path": None if path is None else os.fspath(path)}
    given = {name: value for name, value in inner.items() if getattr(error, name, None) is None}
    for name, value in {**given, "sample_id": sample_id}.items():
        if value is not None:
            with suppress(AttributeError, TypeError):  # an exception may have slots, or other ideas of a name
                setattr(error, name, value)


def locates_path(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorate what reads or writes the file named by its parameter ``path``: what it raises has that ``path``."""
    position = list(inspect.signature(function).parameters).index("path")

    @functools.wraps(function)
    def located(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        try:
            return function(*args, **kwargs)
        except Exception as error:
            given = kwargs["path"] if "path" in kwargs else args[position] if position < len(args) else None
            locate(error, path=given if isinstance(given, (str, os.PathLike)) else None)
            raise

    return located


def add_note(
    error: BaseException,
    note: str,
    *,
    step: str | None = None,
    sample_id: str | None = None,
    path: str | os.PathLike[str] | None = None,
) -> None:
    """Attach context to an exception in flight, in words and as :func:`locate` does, keeping its type and traceback.

    Python 3.10 has no ``add_note``: there the note joins the message, or is kept where 3.11 keeps it.
    """
    locate(error, step=step, sample_id=sample_id, path=path)
    if hasattr(error, "add_note"):
        error.add_note(note)
    elif error.args and isinstance(error.args[0], str):
        error.args = (f"{error.args[0]}\n{note}", *error.args[1:])
    else:
        error.__notes__ = [*getattr(error, "__notes__", []), note]


def near_matches(word: str, known: Iterable[str]) -> str:
    """Return a ``; did you mean 'x'?`` hint, or an empty string when nothing is close."""
    folded = {name.lower(): name for name in known}
    close = [folded[match] for match in difflib.get_close_matches(word.lower(), folded, n=3, cutoff=0.6)]
    return f"; did you mean {' or '.join(map(repr, close))}?" if close else ""


def first_lines(lines: Sequence[str]) -> str:
    """Return faults one to a line, the first of them where there are very many."""
    more = [f"and {len(lines) - _LINES} more"] if len(lines) > _LINES else []
    shown = [line if len(line) <= _LONGEST else f"{line[:_LONGEST]}..." for line in lines[:_LINES]]
    return "\n".join([*shown, *more])


def told_apart(value: float, limit: float, digits: int = 3) -> tuple[str, str]:
    """Return a measured number and its limit in as many digits as show on which side of it the number lies.

    "0.1 degrees, at most 0.1" helps nobody: 0.1004 and 0.1 do.
    """
    for more in range(digits, 18):
        shown = f"{value:.{more}g}", f"{limit:.{more}g}"
        if value == limit or value != value or float(shown[0]) != float(shown[1]):
            break
    return shown
