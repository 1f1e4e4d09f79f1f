"""Pickles of numpy arrays and plain containers, read without Python's unpickler.

A pickle is a program that may import and call whatever it names. The machine here knows the operations that containers
and arrays are made of. What a pickle names becomes a word, never the thing itself: nothing is imported and nothing is
called, and a word that is not in the table ends the reading. Of classes the table has those that only hold attributes.

Source: Python's ``pickletools`` (operations of protocols 2 to 5); numpy, ``ndarray.__reduce__``, ``dtype.__reduce__``;
RLBench, ``dataset_generator.py`` (low_dim_obs.pkl).
"""

from __future__ import annotations

import math
import pickletools
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CaptureError

_MAX_OPERATIONS = 2_000_000  # an observation of RLBench takes about 500
_MAX_VALUES = 1_000_000  # of the result, besides one a byte: few bytes may name one list or array thousands of times
_MAX_DEPTH = 20
_NUMPY = tuple(f"numpy.{core}.{module}" for core in ("core", "_core") for module in ("multiarray", "numeric"))
_WORDS = {  # that may be called or stand for a type: what is done instead
    "numpy ndarray": "array",
    "numpy dtype": "dtype",
    **{f"{module} {name}": name for module in _NUMPY for name in ("_reconstruct", "scalar", "_frombuffer")},
    "_codecs encode": "encode",
    "__builtin__ bytes": "bytes",
    "builtins bytes": "bytes",
    "collections OrderedDict": "dictionary",
}
_HOLDERS = {"rlbench.demo Demo", "rlbench.backend.observation Observation"}  # classes of attributes and no more
_DTYPE_TEXT = re.compile(r"[<>|=]?([iuf][248]|[iub]1)")
_MARK = object()


@dataclass(frozen=True)
class _Word:
    """Something that the pickle names."""

    text: str


@dataclass
class _Held:
    """An object of one of the classes that hold attributes."""

    state: Any = None


@dataclass
class _Dtype:
    text: str
    order: str = "="


@dataclass
class _Array:
    """An array, before and after its state is known."""

    value: NDArray[Any] | None = None


def read_plain_pickle(where: str, program: bytes) -> Any:
    """Return what a pickle holds: None, numbers, texts, bytes, lists, tuples, dictionaries and arrays of numbers.

    Objects of the classes in the table are dictionaries of their attributes.

    Raises:
        CaptureError: it asks for anything else, is damaged, or unfolds to more than any metadata are; nothing was run.
    """
    try:
        return _unfolded(where, _Machine(where).run(program), _Budget(_MAX_VALUES + len(program)))
    except CaptureError:
        raise
    except (ValueError, IndexError, KeyError, TypeError, OverflowError, RecursionError, MemoryError) as error:
        raise CaptureError(
            f"{where}: is a damaged pickle ({type(error).__name__}: {str(error)[:200]}); copy or write it again"
        ) from error


class _Machine:
    """Runs the operations that make containers and arrays; any other is refused."""

    def __init__(self, where: str) -> None:
        self._where = where
        self._stack: list[Any] = []
        self._memo: list[Any] = []
        self._by_number: dict[int, Any] = {}

    def run(self, program: bytes) -> Any:
        """Return the one value that is left where the program stops."""
        for count, (operation, argument, _) in enumerate(pickletools.genops(program)):
            if count >= _MAX_OPERATIONS:
                raise CaptureError(f"{self._where}: has more than {_MAX_OPERATIONS} operations")
            if operation.name == "STOP":
                if len(self._stack) != 1:
                    raise CaptureError(f"{self._where}: is a damaged pickle: it stops with {len(self._stack)} values")
                return self._stack[0]
            does = _OPERATIONS.get(operation.name)
            if does is None:
                raise self._refused(f"the operation {operation.name}")
            does(self, argument)
        raise CaptureError(f"{self._where}: is a damaged pickle: it does not stop")

    def _refused(self, what: str) -> CaptureError:
        return CaptureError(
            f"{self._where}: asks for {what:.200}, which no array and no container needs; it was not run. If you trust "
            "the file, load it where it was made and write what is needed as JSON"
        )

    def push(self, value: Any) -> None:
        self._stack.append(value)

    def _pop(self) -> Any:
        value = self._stack.pop()
        if value is _MARK:
            raise CaptureError(f"{self._where}: is a damaged pickle: a value is missing")
        return value

    def _marked(self) -> list[Any]:
        """Take what lies above the last mark."""
        start = len(self._stack) - 1
        while start >= 0 and self._stack[start] is not _MARK:
            start -= 1
        if start < 0:
            raise CaptureError(f"{self._where}: is a damaged pickle: a mark is missing")
        taken = self._stack[start + 1 :]
        del self._stack[start:]
        return taken

    def tuple_of(self, count: int) -> None:
        taken = [self._pop() for _ in range(count)]
        self.push(tuple(reversed(taken)))

    def tuple_of_marked(self) -> None:
        self.push(tuple(self._marked()))

    def append(self, values: list[Any]) -> None:
        target = self._stack[-1]
        if type(target) is not list:
            raise CaptureError(f"{self._where}: is a damaged pickle: values for a list that is none")
        target.extend(values)

    def set_items(self, pairs: list[Any]) -> None:
        target = self._stack[-1]
        if type(target) is not dict or len(pairs) % 2:
            raise CaptureError(f"{self._where}: is a damaged pickle: entries without a dictionary")
        for key, value in zip(pairs[::2], pairs[1::2]):
            if type(key) not in (str, int):
                raise self._refused(f"a key that is a {type(key).__name__}")
            target[key] = value

    def keep(self, number: int | None) -> None:
        if number is None:
            self._memo.append(self._stack[-1])
        else:
            self._by_number[number] = self._stack[-1]

    def recall(self, number: int) -> None:
        known = self._by_number[number] if number in self._by_number else self._memo[number]
        self.push(known)

    def name(self, text: str) -> None:
        if text not in _WORDS and text not in _HOLDERS:
            raise self._refused(repr(text))
        self.push(_Word(text))

    def stack_name(self) -> None:
        name, module = self._pop(), self._pop()
        if not (isinstance(name, str) and isinstance(module, str)):
            raise CaptureError(f"{self._where}: is a damaged pickle: a name that is no text")
        self.name(f"{module} {name}")

    def new_object(self) -> None:
        arguments, word = self._pop(), self._pop()
        if not isinstance(word, _Word) or word.text not in _HOLDERS or arguments != ():
            raise self._refused(f"a new {word.text if isinstance(word, _Word) else type(word).__name__}")
        self.push(_Held())

    def call(self) -> None:
        arguments, word = self._pop(), self._pop()
        called = _WORDS.get(word.text) if isinstance(word, _Word) else None
        does = _CALLS.get(called or "")
        if does is None or type(arguments) is not tuple:
            raise self._refused(f"a call of {word.text if isinstance(word, _Word) else type(word).__name__}")
        self.push(does(self._where, *arguments))

    def build(self) -> None:
        state, target = self._pop(), self._stack[-1]
        if isinstance(target, _Held) and type(state) is dict and target.state is None:
            target.state = state
        elif isinstance(target, _Dtype) and type(state) is tuple and len(state) in (8, 9):
            _, order, subtype, names, fields, *_ = state
            if order not in ("<", ">", "|", "=") or (subtype, names, fields) != (None, None, None):
                raise self._refused("a dtype of several fields")
            target.order = order
        elif isinstance(target, _Array) and target.value is None and type(state) is tuple and len(state) == 5:
            _, shape, dtype, by_columns, content = state
            target.value = _array(self._where, content, dtype, shape, "F" if by_columns is True else "C")
        else:
            raise self._refused(f"a state of a {type(target).__name__.strip('_').lower()}")


def _dtype(where: str, text: Any = None, *flags: Any) -> _Dtype:
    # Nothing that is no text is shown, compared deeply or hashed: a few bytes of nested tuples stand for gigabytes.
    if (
        type(text) is not str
        or _DTYPE_TEXT.fullmatch(text) is None
        or not all(type(one) in (bool, int) for one in flags)
    ):
        shown = repr(text)[:60] if type(text) is str else f"a {type(text).__name__}"
        raise CaptureError(f"{where}: holds an array of {shown}; only numbers and switches are read")
    return _Dtype(text.lstrip("<>|="), text[0] if text[0] in "<>|=" else "=")


def _array(where: str, content: Any, dtype: Any, shape: Any, order: Any) -> NDArray[Any]:
    if not isinstance(dtype, _Dtype) or not isinstance(content, (bytes, bytearray)) or order not in ("C", "F"):
        raise CaptureError(f"{where}: holds an array that is not made of the bytes of numbers")
    if type(shape) is not tuple or len(shape) > 32 or not all(type(n) is int and 0 <= n < 1 << 40 for n in shape):
        raise CaptureError(f"{where}: holds an array whose shape is no tuple of whole numbers")
    kind = np.dtype(dtype.text).newbyteorder(dtype.order if dtype.order in "<>" else "=")  # type: ignore[arg-type]
    if math.prod(shape) * kind.itemsize != len(content):
        raise CaptureError(f"{where}: holds an array that claims {shape} of {kind} in {len(content)} bytes")
    return np.frombuffer(content, kind).reshape(shape, order=order)


def _scalar(where: str, dtype: Any = None, content: Any = None) -> Any:
    return _array(where, content, dtype, (), "C").item()


def _reconstructed(where: str, kind: Any = None, shape: Any = None, code: Any = None) -> _Array:
    if kind != _Word("numpy ndarray") or shape != (0,) or code not in (b"b", "b"):
        raise CaptureError(f"{where}: is a damaged pickle: an array that begins as none does")
    return _Array()


def _encoded(where: str, text: Any = None, codec: Any = None) -> bytes:
    if type(text) is not str or codec != "latin1":
        raise CaptureError(f"{where}: is a damaged pickle: bytes that are written as none are")
    return text.encode("latin-1")


def _ordered(where: str, *arguments: Any) -> dict[Any, Any]:
    if arguments:
        raise CaptureError(f"{where}: is a damaged pickle: a dictionary that begins with entries")
    return {}


def _from_buffer(where: str, content: Any = None, dtype: Any = None, shape: Any = None, order: Any = "C") -> _Array:
    return _Array(_array(where, content, dtype, shape, order))


def _no_bytes(where: str, *arguments: Any) -> bytes:
    if arguments:
        raise CaptureError(f"{where}: is a damaged pickle: bytes that are written as none are")
    return b""


_CALLS: dict[str, Callable[..., Any]] = {
    "dtype": _dtype,
    "scalar": _scalar,
    "_reconstruct": _reconstructed,
    "_frombuffer": _from_buffer,
    "encode": _encoded,
    "bytes": _no_bytes,
    "dictionary": _ordered,
}


@dataclass
class _Budget:
    """How many values may still come: what refers to itself has no end."""

    left: int


def _unfolded(where: str, value: Any, budget: _Budget, depth: int = 0) -> Any:
    """Return a result as plain values, each place in it a value of its own; arrays are shared, and count as many."""
    if isinstance(value, _Held):
        value = value.state or {}
    if isinstance(value, _Array):
        if value.value is None:
            raise CaptureError(f"{where}: is a damaged pickle: an array without its content")
        value = value.value
    budget.left -= value.size if isinstance(value, np.ndarray) else 1
    if depth > _MAX_DEPTH or budget.left < 0:
        raise CaptureError(f"{where}: unfolds to more than {_MAX_VALUES} values, or more than {_MAX_DEPTH} deep")
    if isinstance(value, (list, tuple)):
        return [_unfolded(where, one, budget, depth + 1) for one in value]
    if isinstance(value, dict):
        return {key: _unfolded(where, one, budget, depth + 1) for key, one in value.items()}
    if isinstance(value, (_Word, _Dtype)) or value is _MARK:
        raise CaptureError(f"{where}: holds {value!r:.100}, which is no value")
    return value


def _pushes(value: Callable[[], Any]) -> Callable[[_Machine, Any], None]:
    return lambda machine, argument: machine.push(value())


def _push(machine: _Machine, argument: Any) -> None:
    machine.push(argument)


def _nothing(machine: _Machine, argument: Any) -> None:
    return None


_OPERATIONS: dict[str, Callable[[_Machine, Any], None]] = {
    "PROTO": _nothing,
    "FRAME": _nothing,
    "NONE": _pushes(lambda: None),
    "NEWTRUE": _pushes(lambda: True),
    "NEWFALSE": _pushes(lambda: False),
    "EMPTY_LIST": _pushes(list),
    "EMPTY_DICT": _pushes(dict),
    "EMPTY_TUPLE": _pushes(tuple),
    "MARK": _pushes(lambda: _MARK),
    **dict.fromkeys(("BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT"), _push),
    **dict.fromkeys(("SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8"), _push),
    **dict.fromkeys(("SHORT_BINBYTES", "BINBYTES", "BINBYTES8", "BYTEARRAY8"), _push),
    "TUPLE": lambda machine, argument: machine.tuple_of_marked(),
    "TUPLE1": lambda machine, argument: machine.tuple_of(1),
    "TUPLE2": lambda machine, argument: machine.tuple_of(2),
    "TUPLE3": lambda machine, argument: machine.tuple_of(3),
    "APPEND": lambda machine, argument: machine.append([machine._pop()]),
    "APPENDS": lambda machine, argument: machine.append(machine._marked()),
    "SETITEM": lambda machine, argument: machine.set_items(list(reversed([machine._pop(), machine._pop()]))),
    "SETITEMS": lambda machine, argument: machine.set_items(machine._marked()),
    "MEMOIZE": lambda machine, argument: machine.keep(None),
    "BINPUT": lambda machine, argument: machine.keep(argument),
    "LONG_BINPUT": lambda machine, argument: machine.keep(argument),
    "BINGET": lambda machine, argument: machine.recall(argument),
    "LONG_BINGET": lambda machine, argument: machine.recall(argument),
    "GLOBAL": lambda machine, argument: machine.name(argument),
    "STACK_GLOBAL": lambda machine, argument: machine.stack_name(),
    "REDUCE": lambda machine, argument: machine.call(),
    "NEWOBJ": lambda machine, argument: machine.new_object(),
    "BUILD": lambda machine, argument: machine.build(),
}
