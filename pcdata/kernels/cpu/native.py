"""The compiled CPU core: finding it, choosing the instruction set, calling it.

The core is a plain C library reached through ctypes, which releases the GIL during a call. It starts its own threads
per call, as many as torch has (:mod:`pcdata.threads`), so it is safe after fork and serial inside DataLoader workers.
"""

from __future__ import annotations

import ctypes
import functools
import os
import sys
import threading
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pcdata.errors import BackendError
from pcdata.kernels.cpu.signatures import DECLARATIONS, INTERFACE_NUMBER
from pcdata.threads import core_threads

INSTRUCTION_SETS = ("baseline", "avx2", "avx512")

# Names an instruction set to use instead of the best one; for tests and for measuring.
FORCE_VARIABLE = "PCDATA_INSTRUCTION_SET"

_LARGE = 4 << 20  # bytes: holds a huge page (2 MB) wherever it starts
_HUGE_PAGE_BITS = 21

_CPU = torch.device("cpu")

_OK, _OUT_OF_MEMORY, _INTERRUPTED, _TOO_MANY_ROWS = 0, 1, 2, 4

_Poll = ctypes.CFUNCTYPE(ctypes.c_int32)


class _Context(ctypes.Structure):
    _fields_ = [("threads", ctypes.c_int32), ("poll", _Poll)]


_NUMBERS = {"int64": ctypes.c_int64, "double": ctypes.c_double}
# What a pointer of each type may point to: the dtypes of tensors, of which True and False are bytes too, and the type
# of a few numbers of Python's own.
_POINTED = {
    "float*": ((torch.float32,), ctypes.c_float),
    "double*": ((torch.float64,), ctypes.c_double),
    "bool*": ((torch.bool,), None),
    "uint8*": ((torch.uint8, torch.bool), None),
    "int32*": ((torch.int32,), None),
    "int64*": ((torch.int64,), ctypes.c_int64),
}

# A few numbers that the core reads or writes: these cost a fraction of a tensor, to make and to read.
Numbers = ctypes.Array[Any]


class _Pointer(NamedTuple):
    place: int  # among the arguments
    name: str
    dtypes: tuple[torch.dtype, ...]
    numbers: type[Any] | None


class _Function(NamedTuple):
    entry: Any  # of ctypes, with the types of its arguments
    num_arguments: int
    pointers: tuple[_Pointer, ...]  # those of them that are no numbers


Library = dict[str, _Function]  # the functions by their names


def unavailable() -> str | None:
    """Return None when the core can be called, else why not and what to do."""
    try:
        library()
    except OSError as error:
        return str(error)
    return None


@functools.cache
def library() -> Library:
    """Load the best library that this processor runs.

    Raises:
        OSError: there is none, or it belongs to another version of pcdata.
    """
    folder = _folder()
    best = best_instruction_set()
    name = os.environ.get(FORCE_VARIABLE, best)
    if name not in INSTRUCTION_SETS or INSTRUCTION_SETS.index(name) > INSTRUCTION_SETS.index(best):
        raise OSError(f"{FORCE_VARIABLE}={name!r}: this processor runs {', '.join(_runnable(best))}")
    path = folder / f"libpcdata_{name}.so"
    return load(path if path.exists() else folder / "libpcdata_baseline.so")


def best_instruction_set() -> str:
    """Return the most capable of the instruction sets that this processor runs.

    Raises:
        OSError: the core is not installed.
    """
    return INSTRUCTION_SETS[ctypes.CDLL(str(_folder() / "libpcdata_baseline.so")).pc_best_instruction_set()]


def load(path: Path) -> Library:
    """Load one library of the core, with the types of its functions' arguments as this version of pcdata has them.

    Raises:
        OSError: it cannot be loaded, or it was built from other declarations.
    """
    compiled = ctypes.CDLL(str(path))
    number = getattr(compiled, "pc_interface_number", None)
    if number is not None:
        number.restype = ctypes.c_int64
    if number is None or number() != INTERFACE_NUMBER:
        raise OSError(
            f"{path} was built from other declarations than this version of pcdata has; reinstall pcdata "
            f"(in a source tree: pip install -e .)"
        )
    functions = {}
    for line in DECLARATIONS.replace("\n    ", " ").strip().splitlines():
        name, _, declared = line.partition(": ")
        arguments = [argument.split() for argument in declared.split(", ")]
        entry = getattr(compiled, name)
        entry.argtypes = [ctypes.c_void_p, *(_NUMBERS.get(kind, ctypes.c_void_p) for kind, _ in arguments)]
        pointers = [(place, at, *_POINTED[kind]) for place, (kind, at) in enumerate(arguments) if kind in _POINTED]
        functions[name] = _Function(entry, len(arguments), tuple(map(_Pointer._make, pointers)))
    return functions


def call(function: str, *arguments: Any) -> None:
    """Call ``function(context, *arguments)``; tensors and arrays go as pointers, numbers as the core declares them.

    None goes as the null pointer and means "not given". No tensor does, not even an empty one, whose own pointer is
    null: the core may tell the two apart.

    Raises:
        TypeError: an argument is not what the core's header declares.
        ValueError: a tensor is not contiguous or not in the memory of the CPU.
        MemoryError: the core could not get memory.
        BackendError: there are more rows than it can number.
        KeyboardInterrupt: Ctrl-C (or whatever a signal handler raised) while it ran.
    """
    entry, num_arguments, pointers = library()[function]
    if len(arguments) != num_arguments:
        raise TypeError(f"{function} takes {num_arguments} arguments, got {len(arguments)}; please report this")
    values = _values(function, pointers, arguments)
    idle = _idle.callers
    caller = idle.pop() if idle else _Caller()
    caller.context.threads = core_threads()
    try:
        status = entry(caller.pointer, *values)
    except ctypes.ArgumentError as error:
        raise TypeError(f"{function}: {error} (the context is argument 1); please report this") from error
    if caller.raised:
        raise caller.raised[0]
    idle.append(caller)
    if status == _OUT_OF_MEMORY:
        raise MemoryError(f"{function}: out of memory")
    if status == _INTERRUPTED:
        raise KeyboardInterrupt
    if status == _TOO_MANY_ROWS:
        raise BackendError(
            f"{function}: the compiled core numbers up to {2**31 - 1:,} rows; give it fewer at a time, or take "
            "backend='torch'"
        )
    if status != _OK:
        raise RuntimeError(f"{function}: the core failed with status {status}; please report this")


def room_for(*results: tuple[Sequence[int], torch.dtype]) -> list[Tensor]:
    """Return uninitialized memory for results of these shapes; if large, in huge pages where the system has them."""
    rooms = [torch.empty(shape, dtype=dtype, device=_CPU) for shape, dtype in results]
    sizes = [room.nbytes for room in rooms]
    if sum(sizes) >= _LARGE and not _is_advised(rooms, sizes):
        call("pc_advise_huge_pages", len(rooms), addresses(rooms), numbers(sizes))
    return rooms


def remember_advice(below: int) -> None:
    """Ask for huge pages once where the process keeps what it frees: blocks of less bytes than this."""
    global _kept_below
    _kept_below = below


_kept_below = 0  # bytes; larger blocks are given back, and with them what was advised
_advised: set[int] = set()  # the huge pages of the others


def _is_advised(rooms: Sequence[Tensor], sizes: Sequence[int]) -> bool:
    """Tell whether the system was asked about this memory before; it is about to be."""
    pages: set[int] = set()
    for result, size in zip(rooms, sizes):
        if size >= _kept_below:
            return False
        if size >= 1 << _HUGE_PAGE_BITS:  # nothing is asked about smaller ones
            start = result.data_ptr()
            pages.update(range(start >> _HUGE_PAGE_BITS, (start + size - 1 >> _HUGE_PAGE_BITS) + 1))
    known = pages <= _advised
    _advised.update(pages)
    return known


def room(shape: int | Sequence[int], dtype: torch.dtype) -> Tensor:
    """Return uninitialized memory for a result: contiguous and on the CPU, whatever torch's defaults are."""
    return torch.empty(shape, dtype=dtype, device=_CPU)


def numbers(values: Iterable[int]) -> Numbers:
    """Return whole numbers as the core reads them, int64."""
    given = [*values]
    return (ctypes.c_int64 * len(given))(*given)


def answers(count: int = 1, kind: type[Any] = ctypes.c_int64) -> Numbers:
    """Return zeros for the core to write a few numbers over."""
    return (kind * count)()


def addresses(tensors: Iterable[Tensor]) -> Numbers:
    """Return where the tensors lie in memory, for functions that take any number of them; keep them alive meanwhile."""
    return numbers(_pointers(tensors))


# Where an empty tensor "lies": no tensor may look like one that was not given, and nothing is read or written here.
_EMPTY = ctypes.create_string_buffer(64)
_NOWHERE = ctypes.addressof(_EMPTY)


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


class _Caller:
    """What a call hands to the core beside its arguments; to make one takes longer than most of the rest of a call."""

    __slots__ = ("context", "pointer", "raised")

    def __init__(self) -> None:
        self.raised: list[BaseException] = []
        polls = _polls(self.raised)
        next(polls)
        self.context = _Context(1, _Poll(polls.__next__))
        self.pointer = ctypes.byref(self.context)


class _Idle(threading.local):
    """Those of this thread that no call uses: one, but for calls by what a signal handler does during a call."""

    def __init__(self) -> None:
        self.callers: list[_Caller] = []


_idle = _Idle()


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


def _values(function: str, pointers: Sequence[_Pointer], arguments: Sequence[Any]) -> list[Any]:
    """Return arguments as ctypes passes them; what it would not hold to its declaration, pointers, checked."""
    passed = list(arguments)
    for place, name, dtypes, kind in pointers:
        value = passed[place]
        if value is None:
            continue
        if isinstance(value, Tensor) and value.dtype in dtypes:
            if not value.is_contiguous() or not value.is_cpu:
                raise _astray(value)
            passed[place] = value.data_ptr() or _NOWHERE
        elif not isinstance(value, ctypes.Array) or value._type_ is not kind:
            given = value.dtype if isinstance(value, Tensor) else type(value).__name__
            raise TypeError(f"{function}: {name} takes a tensor of {dtypes[0]}, got {given}; please report this")
    return passed


def _folder() -> Path:
    """Find the libraries in this tree, or, for an editable install, beside the other installed packages."""
    beside = Path(__file__).parents[1] / "_core"
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
