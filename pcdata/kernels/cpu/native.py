"""The compiled CPU core: finding it, choosing the instruction set, calling it.

The core is a plain C library reached through ctypes, which releases the GIL during a call. It starts its own threads
per call, as many as torch has (:mod:`pcdata.threads`), so it is safe after fork and serial inside DataLoader workers.
"""

from __future__ import annotations

import ctypes
import functools
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pcdata.threads import core_threads

INTERFACE_VERSION = 6
INSTRUCTION_SETS = ("baseline", "avx2", "avx512")

# Names an instruction set to use instead of the best one; for tests and for measuring.
FORCE_VARIABLE = "PCDATA_INSTRUCTION_SET"

_LARGE = 4 << 20  # bytes: holds a huge page (2 MB) wherever it starts

_OK, _OUT_OF_MEMORY, _INTERRUPTED = 0, 1, 2

_Poll = ctypes.CFUNCTYPE(ctypes.c_int32)


class _Context(ctypes.Structure):
    _fields_ = [("threads", ctypes.c_int32), ("poll", _Poll)]


def unavailable() -> str | None:
    """Return None when the core can be called, else why not and what to do."""
    try:
        library()
    except OSError as error:
        return str(error)
    return None


@functools.cache
def library() -> ctypes.CDLL:
    """Load the best library that this processor runs.

    Raises:
        OSError: there is none, or it belongs to another version of pcdata.
    """
    folder = _folder()
    baseline = ctypes.CDLL(str(folder / "libpcdata_baseline.so"))
    best = INSTRUCTION_SETS[baseline.pc_best_instruction_set()]
    name = os.environ.get(FORCE_VARIABLE, best)
    if name not in INSTRUCTION_SETS or INSTRUCTION_SETS.index(name) > INSTRUCTION_SETS.index(best):
        raise OSError(f"{FORCE_VARIABLE}={name!r}: this processor runs {', '.join(_runnable(best))}")
    path = folder / f"libpcdata_{name}.so"
    chosen = ctypes.CDLL(str(path)) if path.exists() else baseline
    if chosen.pc_interface_version() != INTERFACE_VERSION:
        raise OSError(f"{path} belongs to another version of pcdata; reinstall pcdata")
    return chosen


def call(function: str, *arguments: Any) -> None:
    """Call ``function(context, *arguments)``; tensors go as pointers, ints as int64, floats as double.

    None goes as the null pointer and means "not given". No tensor does, not even an empty one, whose own pointer is
    null: the core may tell the two apart.

    Raises:
        ValueError: a tensor is not contiguous or not in the memory of the CPU.
        MemoryError: the core could not get memory.
        KeyboardInterrupt: Ctrl-C (or whatever a signal handler raised) while it ran.
    """
    raised: list[BaseException] = []
    polls = _polls(raised)
    next(polls)
    context = _Context(core_threads(), _Poll(polls.__next__))
    status = getattr(library(), function)(ctypes.byref(context), *_arguments(arguments))
    if raised:
        raise raised[0]
    if status == _OUT_OF_MEMORY:
        raise MemoryError(f"{function}: out of memory")
    if status == _INTERRUPTED:
        raise KeyboardInterrupt
    if status != _OK:
        raise RuntimeError(f"{function}: the core failed with status {status}; please report this")


def room_for(*results: tuple[Sequence[int], torch.dtype]) -> list[Tensor]:
    """Return uninitialised memory for results of these shapes; if large, in huge pages where the system has them."""
    rooms, sizes = [], []
    for shape, dtype in results:
        rooms.append(torch.empty(tuple(shape), dtype=dtype, device="cpu"))
        sizes.append(rooms[-1].nbytes)
    if sum(sizes) >= _LARGE:
        call("pc_advise_huge_pages", len(rooms), addresses(rooms), numbers(sizes))
    return rooms


def room(shape: int | Sequence[int], dtype: torch.dtype) -> Tensor:
    """Return uninitialised memory for a result: contiguous and on the CPU, whatever torch's defaults are."""
    return torch.empty((shape,) if isinstance(shape, int) else tuple(shape), dtype=dtype, device="cpu")


def numbers(values: Iterable[int]) -> Tensor:
    """Return whole numbers as the core reads them, int64."""
    return torch.tensor(list(values), dtype=torch.int64, device="cpu")


def addresses(tensors: Iterable[Tensor]) -> Tensor:
    """Return where the tensors lie in memory, for functions that take any number of them; keep them alive meanwhile."""
    return torch.tensor(_pointers(tensors), dtype=torch.int64, device="cpu")


# Where an empty tensor "lies": no tensor may look like one that was not given, and nothing is read or written here.
_EMPTY = ctypes.create_string_buffer(64)
_NOWHERE = ctypes.addressof(_EMPTY)


def address(tensor: Tensor) -> int:
    """Return where a tensor lies in memory, never 0; keep it alive meanwhile."""
    return _pointers([tensor])[0]


def _pointers(tensors: Iterable[Tensor]) -> list[int]:
    """Return where tensors lie in memory, never 0."""
    found = []
    for tensor in tensors:
        if not tensor.is_contiguous() or not tensor.is_cpu:
            raise _astray(tensor)
        found.append(tensor.data_ptr() or _NOWHERE)
    return found


def _astray(tensor: Tensor) -> ValueError:
    """Say why a tensor has no place in memory that the core could read or write."""
    return ValueError(
        f"the compiled core takes contiguous tensors in the memory of the CPU, not one of shape "
        f"{tuple(tensor.shape)} with strides {tensor.stride()} on {tensor.device}; please report this"
    )


def _polls(raised: list[BaseException]) -> Iterator[int]:
    """Yield 0 while the core may go on and 1 once a signal handler raised; its exception is kept in ``raised``.

    Python runs pending handlers where a frame is entered or resumed. A generator is resumed inside its ``try``; the
    entry of a function would lie before it, and ctypes drops what a callback raises.
    """
    stop = 0
    while True:
        try:
            yield stop
        except GeneratorExit:
            return
        except BaseException as error:
            raised.append(error)
            stop = 1


def _arguments(values: Sequence[Any]) -> list[Any]:
    """Return values as ctypes passes them; in one loop, as a kernel has up to twenty."""
    passed: list[Any] = []
    for value in values:
        if isinstance(value, Tensor):
            if not value.is_contiguous() or not value.is_cpu:
                raise _astray(value)
            passed.append(ctypes.c_void_p(value.data_ptr() or _NOWHERE))
        elif isinstance(value, float):
            passed.append(ctypes.c_double(value))
        elif value is None:
            passed.append(ctypes.c_void_p(None))
        else:
            passed.append(ctypes.c_int64(int(value)))
    return passed


def _folder() -> Path:
    """Find the libraries beside this file, or, for an editable install, beside the other installed packages."""
    beside = Path(__file__).parent / "_core"
    candidates = [beside, *(Path(entry) / "pcdata" / "kernels" / "_core" for entry in sys.path if entry)]
    for folder in candidates:
        if (folder / "libpcdata_baseline.so").exists():
            return folder
    raise OSError(
        "the compiled core is not installed (building it failed, or there was no C++ compiler); install a compiler "
        "(on Debian or Ubuntu: apt-get install g++) and reinstall pcdata"
    )


def _runnable(best: str) -> tuple[str, ...]:
    return INSTRUCTION_SETS[: INSTRUCTION_SETS.index(best) + 1]
