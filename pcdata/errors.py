"""The exceptions pcdata raises; each is also the builtin a caller would expect to catch.

Every message says where, what must hold, what was given and what to do.
"""

from __future__ import annotations

import difflib
import errno
from collections.abc import Iterable, Sequence

_LONGEST = 2000  # characters of one fault, which may repeat a name from a file
_LINES = 50  # faults of one file, of which nearly every line is wrong


class PcdataError(Exception):
    """Base of every error that pcdata raises on purpose."""


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


class ContractError(PcdataError, ValueError):
    """Data are not what a model takes: wrong frame, unit, count, channels or layout."""


class ConfigError(PcdataError, ValueError):
    """A transform's fields or a configuration file are wrong; lists every fault at once."""


class CaptureError(PcdataError, ValueError):
    """A raw capture (depth, colour, intrinsics, pose, cloud file) cannot be trusted."""


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


def add_note(error: BaseException, note: str) -> None:
    """Attach context to an exception in flight, keeping its type and traceback.

    Python 3.10 has no ``add_note``: there the note joins the message, or is kept where 3.11 keeps it.
    """
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
