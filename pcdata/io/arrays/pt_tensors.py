"""``.pt`` files of tensors and one text, read without PyTorch's unpickler.

What ``torch.save`` makes of ``{name: tensor, ..., name: text}`` is a zip archive with one pickle, and a member for the
bytes of each tensor. The pickle is a short program; the machine here knows the few operations that such a dictionary
needs, and can neither import nor call anything. ``weights_only=True`` can more: ``bytearray(10**10)``, or a tensor of
more elements than its bytes hold.

Source: Python's ``pickletools`` (operations of protocol 2); PyTorch, ``torch/serialization.py``.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CacheError
from pcdata.files.zip_archive import ZipArchive

_STORAGES = {
    "FloatStorage": "<f4", "DoubleStorage": "<f8", "HalfStorage": "<f2", "LongStorage": "<i8", "IntStorage": "<i4",
    "ShortStorage": "<i2", "CharStorage": "|i1", "ByteStorage": "|u1", "BoolStorage": "|b1",
}  # fmt: skip
_DTYPES = {"uint16": "<u2", "uint32": "<u4", "uint64": "<u8"}
_SIDE_MEMBERS = {"version", "byteorder", ".data/serialization_id", ".format_version", ".storage_alignment"}
_MAX_OPERATIONS = 500_000  # of about 45 per tensor
_MARK = object()


@dataclass(frozen=True)
class _Name:
    """Something that the pickle names; what it may do is decided here, by name."""

    text: str


@dataclass(frozen=True)
class _Storage:
    key: str
    dtype: np.dtype | None  # None: bytes, whose dtype the tensor tells
    count: int


@dataclass(frozen=True)
class _Tensor:
    storage: _Storage
    dtype: np.dtype
    offset: int  # in elements
    shape: tuple[int, ...]


def read_pt(archive: ZipArchive) -> dict[str, NDArray[Any] | str]:
    """Return the arrays and texts by name.

    Raises:
        CacheError: damaged; or anything but a dictionary of contiguous tensors and texts; nothing is run.
    """
    contents = _by_role(archive)
    described = _described(bytes(archive.read(archive.members[contents["data.pkl"]])))
    stored = {
        name.removeprefix("data/"): archive.members[member] for name, member in contents.items() if name[:5] == "data/"
    }
    buffers: dict[str, bytearray] = {}
    result: dict[str, NDArray[Any] | str] = {}
    for name, value in described.items():
        if isinstance(value, str):
            result[name] = value
            continue
        key, size = value.storage.key, value.dtype.itemsize
        nbytes = value.storage.count * (value.storage.dtype.itemsize if value.storage.dtype else 1)
        if key not in stored or stored[key].size != nbytes:
            raise CacheError(f"the tensor {name!r:.100} needs {nbytes} bytes, which its member data/{key:.100} has not")
        if (value.offset + math.prod(value.shape)) * size > nbytes:
            raise CacheError(f"the tensor {name!r:.100} claims {value.shape} of {value.dtype} in {nbytes} bytes")
        if key not in buffers:
            buffers[key] = archive.read(stored[key])
        result[name] = np.ndarray(value.shape, value.dtype, buffer=buffers[key], offset=value.offset * size)
    if len(buffers) != len(stored):
        raise CacheError(f"it stores {len(stored)} tensors, but names {len(buffers)}")
    return result


def _by_role(archive: ZipArchive) -> dict[str, str]:
    """Return the members' names by what follows their one folder; all are known, and none is packed."""
    folders = {name.partition("/")[0] for name in archive.members}
    if len(folders) != 1:
        raise CacheError(f"its members must lie in one folder, but lie in {len(folders)}")
    roles = {}
    for name, member in archive.members.items():
        role = name.partition("/")[2]
        kind, _, number = role.partition("/")
        if role != "data.pkl" and role not in _SIDE_MEMBERS and not (kind == "data" and number.isdecimal()):
            raise CacheError(f"its member {name!r:.100} is none that tensors need")
        if member.deflated:
            raise CacheError(f"its members must not be compressed, but {name!r:.100} is")
        roles[role] = name
    if "data.pkl" not in roles:
        raise CacheError("must hold one pickle of tensors, data.pkl, but has none")
    order = archive.read(archive.members[roles["byteorder"]]) if "byteorder" in roles else b"little"
    if order != b"little":
        raise CacheError(f"its byte order must be little, got {bytes(order)!r:.20}")
    return roles


def _described(program: bytes) -> dict[str, _Tensor | str]:
    try:
        value = _Machine(program).run()
    except (struct.error, IndexError, KeyError, TypeError, ValueError, OverflowError) as error:
        if isinstance(error, CacheError):
            raise
        raise CacheError(f"its pickle is damaged ({type(error).__name__}: {error})") from error
    if not isinstance(value, dict):
        raise CacheError(f"must hold a dict of tensors, got a {type(value).__name__}")
    for name, entry in value.items():
        if not isinstance(entry, (_Tensor, str)):
            raise CacheError(f"entry {name!r:.100} must be a contiguous tensor, or a text")
    return value


class _Machine:
    """Runs the operations of a pickle that build a dictionary of tensors and texts; any other is refused."""

    def __init__(self, program: bytes) -> None:
        self._program = program
        self._place = 0
        self._stack: list[Any] = []
        self._memo: dict[int, Any] = {}

    def run(self) -> Any:
        for _ in range(_MAX_OPERATIONS):
            code = self._program[self._place]
            self._place += 1
            if code == 0x2E:  # STOP
                if self._place != len(self._program) or len(self._stack) != 1:
                    raise CacheError("its pickle does not end where it stops")
                return self._stack[0]
            operation = _OPERATIONS.get(code)
            if operation is None:
                raise CacheError(f"its pickle asks for operation {code:#x}, which no tensor needs; it was not run")
            operation(self)
        raise CacheError(f"its pickle has more than {_MAX_OPERATIONS} operations")

    def _number(self, form: str) -> int:
        number: int = struct.unpack_from(form, self._program, self._place)[0]
        self._place += struct.calcsize(form)
        return number

    def _bytes(self, length: int) -> bytes:
        part = self._program[self._place : self._place + length]
        if len(part) != length:
            raise CacheError("its pickle ends early")
        self._place += length
        return part

    def _line(self) -> str:
        stop = self._program.index(b"\n", self._place)
        part = self._program[self._place : stop]
        self._place = stop + 1
        return part.decode("ascii")

    def _marked(self) -> list[Any]:
        """Take what lies above the last mark."""
        start = len(self._stack) - 1
        while self._stack[start] is not _MARK:
            start -= 1
            if start < 0:
                raise CacheError("its pickle is damaged: a mark is missing")
        taken = self._stack[start + 1 :]
        del self._stack[start:]
        return taken

    def protocol(self) -> None:
        if self._number("<B") != 2:
            raise CacheError("its pickle must have protocol 2")

    def dictionary(self) -> None:
        self._stack.append({})

    def mark(self) -> None:
        self._stack.append(_MARK)

    def tuple_of_marked(self) -> None:
        self._stack.append(tuple(self._marked()))

    def text(self) -> None:
        self._stack.append(self._bytes(self._number("<I")).decode("utf-8", "surrogatepass"))

    def long_number(self) -> None:
        self._stack.append(int.from_bytes(self._bytes(min(self._number("<B"), 16)), "little", signed=True))

    def name(self) -> None:
        self._stack.append(_Name(f"{self._line()} {self._line()}"))

    def keep(self, form: str) -> None:
        self._memo[self._number(form)] = self._stack[-1]

    def recall(self, form: str) -> None:
        self._stack.append(self._memo[self._number(form)])

    def set_item(self) -> None:
        value, key = self._stack.pop(), self._stack.pop()
        self._set([key, value])

    def set_items(self) -> None:
        self._set(self._marked())

    def _set(self, pairs: list[Any]) -> None:
        target = self._stack[-1]
        if not isinstance(target, dict) or len(pairs) % 2:
            raise CacheError("its pickle is damaged: entries without a dictionary")
        for key, value in zip(pairs[::2], pairs[1::2]):
            if not isinstance(key, str) or key in target:
                # Never shown whole: a few bytes of nested tuples print as gigabytes.
                shown = f"{key!r:.100}" if isinstance(key, str) else f"named by a {type(key).__name__}"
                raise CacheError(f"entry {shown} must have a name, a text that is there once")
            target[key] = value

    def storage(self) -> None:
        kind, named, key, place, count = self._stack.pop()
        module, _, name = named.text.rpartition(" ") if isinstance(named, _Name) else ("", "", "")
        if kind != "storage" or place != "cpu" or not isinstance(key, str) or not _is_size(count):
            raise CacheError("its pickle describes a tensor's bytes wrongly")
        if module == "torch" and name in _STORAGES:
            self._stack.append(_Storage(key, np.dtype(_STORAGES[name]), count))
        elif (module, name) == ("torch.storage", "UntypedStorage"):
            self._stack.append(_Storage(key, None, count))
        else:
            raise CacheError(f"its pickle asks for {module:.100} {name:.100}, which no tensor needs; it was not run")

    def call(self) -> None:
        arguments, called = self._stack.pop(), self._stack.pop()
        name = called.text if isinstance(called, _Name) else f"a {type(called).__name__}"
        if name == "collections OrderedDict" and arguments == ():
            self._stack.append(_NO_HOOKS)
        elif name == "torch._utils _rebuild_tensor_v2":
            storage, offset, shape, stride, _, hooks, *others = arguments
            self._stack.append(_tensor(storage, None, offset, shape, stride, hooks, others))
        elif name == "torch._utils _rebuild_tensor_v3":
            storage, offset, shape, stride, _, hooks, dtype, *others = arguments
            self._stack.append(_tensor(storage, dtype, offset, shape, stride, hooks, others))
        else:
            raise CacheError(f"its pickle asks for {name:.200}, which no tensor needs; it was not run")


_NO_HOOKS: dict[str, Any] = {}


def _tensor(storage: Any, named: Any, offset: Any, shape: Any, stride: Any, hooks: Any, others: list[Any]) -> _Tensor:
    if not isinstance(storage, _Storage) or others or hooks is not _NO_HOOKS or not _is_size(offset):
        raise CacheError("its pickle describes a tensor wrongly")
    if not all(isinstance(sizes, tuple) and all(map(_is_size, sizes)) for sizes in (shape, stride)):
        raise CacheError("its pickle gives a tensor sizes that are no whole numbers")
    dtype = storage.dtype
    if named is not None:
        name = named.text.removeprefix("torch ") if isinstance(named, _Name) else ""
        if dtype is not None or name not in _DTYPES:
            raise CacheError(f"its pickle asks for a tensor of {name!r:.100}, which no cloud has")
        dtype = np.dtype(_DTYPES[name])
    if dtype is None or len(shape) != len(stride) or len(shape) > 32:
        raise CacheError("its pickle describes a tensor wrongly")
    # A stride of 0 makes gigabytes of one stored number.
    step = 1
    for length, given in zip(reversed(shape), reversed(stride)):
        if length > 1 and given != step and math.prod(shape):
            raise CacheError("a tensor must be a contiguous tensor")
        step *= length
    return _Tensor(storage, dtype, offset, shape)


def _is_size(value: Any) -> bool:
    return type(value) is int and 0 <= value < 1 << 60


def _take(count: int) -> Any:
    def operation(machine: _Machine) -> None:
        stack = machine._stack
        if len(stack) < count:
            raise CacheError("its pickle is damaged: a value is missing")
        taken = tuple(stack[len(stack) - count :])
        del stack[len(stack) - count :]
        stack.append(taken)

    return operation


_OPERATIONS: dict[int, Any] = {
    0x80: _Machine.protocol,
    ord("}"): _Machine.dictionary,
    ord("("): _Machine.mark,
    ord("t"): _Machine.tuple_of_marked,
    ord(")"): _take(0),
    0x85: _take(1),
    0x86: _take(2),
    0x87: _take(3),
    ord("X"): _Machine.text,
    ord("J"): lambda machine: machine._stack.append(machine._number("<i")),
    ord("K"): lambda machine: machine._stack.append(machine._number("<B")),
    ord("M"): lambda machine: machine._stack.append(machine._number("<H")),
    0x8A: _Machine.long_number,
    0x88: lambda machine: machine._stack.append(True),
    0x89: lambda machine: machine._stack.append(False),
    ord("c"): _Machine.name,
    ord("q"): lambda machine: machine.keep("<B"),
    ord("r"): lambda machine: machine.keep("<I"),
    ord("h"): lambda machine: machine.recall("<B"),
    ord("j"): lambda machine: machine.recall("<I"),
    ord("s"): _Machine.set_item,
    ord("u"): _Machine.set_items,
    ord("Q"): _Machine.storage,
    ord("R"): _Machine.call,
}
