"""How batches travel from a DataLoader's workers to its process: in memory that both map, and use again.

torch makes a new piece of shared memory for every tensor of every batch. The system has to clear its pages, one fault
for each 4 KB, and the two processes hand a file descriptor over: for a batch of some megabytes both cost more than
reading it. Here a worker keeps a few blocks. A batch is laid into one block, what is sent says where its tensors are,
and the block is free again when neither process holds a tensor of it. The tensors are ordinary ones: whoever keeps a
batch keeps its block, and the worker takes another.

A block is a file in memory without a name (``memfd_create``), which the receiver opens through ``/proc`` once; nothing
remains when the processes end, however they do. Where the system has none of this, and for tensors that are not plain
ones on the CPU, torch's own way is taken.
"""

from __future__ import annotations

import math
import mmap
import os
import secrets
import threading
import weakref
from collections.abc import Mapping, Sequence
from multiprocessing.reduction import ForkingPickler
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import get_worker_info

from pcdata.errors import CacheError
from pcdata.structures import PaddedClouds, PointCloud
from pcdata.structures.read_later import StoredTexts, texts_from_bytes
from pcdata.structures.structure import Structure, derived

S = TypeVar("S", bound=Structure)

_ALIGNED = 64  # bytes: a line of the processor's cache
_HEAD = 4096  # bytes before the tensors: who holds the block, and its name
_NAME = slice(16, 32)
_WORKER, _RECEIVER = 0, 1  # bytes of the head, 1 = holds it
_MOST_BLOCKS = 32  # of one worker; a receiver that keeps more batches gets the others as torch sends them
_MOST_FREE = 8  # that wait to be used again
_SPARE = 1 << 16  # bytes
_NUMPY = {
    **{torch.bool: "?", torch.uint8: "u1", torch.int8: "i1", torch.int16: "i2", torch.int32: "i4"},
    **{torch.int64: "i8", torch.float16: "f2", torch.float32: "f4", torch.float64: "f8"},
}


class _Place(NamedTuple):
    """Where a tensor lies in its block, and in its batch."""

    begin: int
    dtype: str | torch.dtype  # NumPy's word for it, where it has one
    shape: tuple[int, ...]
    path: tuple[str, ...]  # of attributes and of keys


class _Sent(NamedTuple):
    """Which block it is."""

    process: int
    file: int
    size: int
    name: bytes


class _Block:
    """Memory of this worker that its receiver maps too."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.name = secrets.token_bytes(16)
        self.file = os.memfd_create("pcdata batch", os.MFD_CLOEXEC)
        try:
            os.ftruncate(self.file, _HEAD + size)
            self.content = mmap.mmap(self.file, _HEAD + size)
        except OSError:
            os.close(self.file)
            raise
        self.content[_NAME] = self.name
        self.begin = self.used = 0  # its address, while a tensor of it lives, and how many bytes were taken

    @property
    def is_free(self) -> bool:
        return self.content[_WORKER] == self.content[_RECEIVER] == 0

    def take(self, size: int) -> Tensor:
        """Return so many bytes of the memory, which is held until nothing uses it."""
        self.content[_WORKER] = 1
        memory = torch.from_numpy(_memory(self.content, _WORKER))
        self.begin, self.used = memory.data_ptr(), size
        return memory[:size]

    def holds(self, tensor: Tensor) -> bool:
        return self.holds_bytes(tensor.data_ptr(), tensor.nbytes) and tensor.is_contiguous()

    def holds_bytes(self, address: int, size: int) -> bool:
        begin = address - self.begin
        return begin >= 0 and begin + size <= self.used

    def rest(self) -> Tensor:
        """Return the memory behind what was taken, while that is held."""
        return torch.from_numpy(np.frombuffer(self.content, np.uint8, offset=_HEAD))[
            self.used + -self.used % _ALIGNED :
        ]

    def drop(self) -> None:
        """Forget the memory; the receiver may still have it."""
        os.close(self.file)
        self.content = None  # type: ignore[assignment]  # an array may still look at it


class _Blocks:
    """The blocks of this worker."""

    def __init__(self) -> None:
        self._blocks: list[_Block] = []
        self._lock = threading.Lock()  # the thread that sends takes blocks too
        self._process = os.getpid()

    def take(self, size: int) -> Tensor | None:
        """Return memory of so many bytes, or more; None where there is none."""
        with self._lock:
            if self._process != os.getpid():  # what this process was forked from has them
                self._blocks, self._process = [], os.getpid()
            free = [block for block in self._blocks if block.is_free]
            fitting = [block for block in free if size <= block.size]
            if fitting:
                return min(fitting, key=lambda block: block.size).take(size)
            for block in free if len(free) >= _MOST_FREE else free[:1]:  # too small: make room for a larger one
                self._blocks.remove(block)
                block.drop()
            if len(self._blocks) >= _MOST_BLOCKS:
                return None
            try:
                block = _Block(size + (size >> 3) + _SPARE)  # batches differ a little, and masks are added
            except OSError:  # no memory, or no files: torch says so, if it has none either
                return None
            self._blocks.append(block)
            return block.take(size)

    def holding(self, tensor: Tensor) -> _Block | None:
        """Return the block that a tensor lies in, unless it was sent already."""
        with self._lock:
            for block in self._blocks:
                is_own = block.begin and block.content[_WORKER] and not block.content[_RECEIVER]
                if is_own and block.holds(tensor):
                    return block
        return None


_BLOCKS = _Blocks()


def batch_memory(size: int) -> Tensor | None:
    """Return memory for a batch that this worker makes, (bytes,) uint8; None where there is none, or no worker.

    A batch whose tensors all lie in it is sent without being copied.
    """
    return _BLOCKS.take(size) if _is_worker() else None


def _is_worker() -> bool:
    return get_worker_info() is not None and _can_be_opened()


def _can_be_opened() -> bool:
    """Whether processes of this system may open each other's files in memory, as the receiver will."""
    global _OPENS
    if _OPENS is None:
        parent = f"/proc/{os.getppid()}/fd"
        _OPENS = hasattr(os, "memfd_create") and os.access(parent, os.R_OK | os.X_OK)
    return _OPENS


_OPENS: bool | None = None


def _memory(content: mmap.mmap, holder: int) -> NDArray[np.uint8]:
    """Return what lies behind the head; when its last view is gone, the holder's mark is taken away."""
    array = np.frombuffer(content, np.uint8, offset=_HEAD)
    # Not in a process that was forked since: it has copies of these objects, and holds nothing.
    weakref.finalize(array, _let_go, content, holder, os.getpid()).atexit = False
    return array


def _let_go(content: mmap.mmap, holder: int, process: int) -> None:
    if os.getpid() == process:
        content[holder] = 0
        if holder == _RECEIVER:
            _forget_the_dead()


def sent_together(kind: type[S]) -> type[S]:
    """Let the tensors of a kind of batch travel in one block; a decorator."""
    ForkingPickler.register(kind, _reduced)
    return kind


# -- sending ----------------------------------------------------------------------------------------------------------


def _reduced(structure: Structure) -> Any:
    """Return how a batch is pickled for another process."""
    _SENDING.block = None, None
    if _is_worker():
        found: list[tuple[tuple[str, ...], Tensor]] = []
        state = {name: _taken_apart(value, (name,), found) for name, value in vars(structure).items()}
        if found and all(_is_plain(tensor) for _, tensor in found):
            sent = _sent(found)
            if sent is not None:
                return _received, (type(structure), state, *sent)
    return structure.__reduce_ex__(4)


def _taken_apart(value: Any, path: tuple[str, ...], found: list[tuple[tuple[str, ...], Tensor]]) -> Any:
    """Return a value of structures without its tensors, which are listed with their paths."""
    if isinstance(value, Tensor):
        found.append((path, value))
        return None
    if isinstance(value, Structure):
        return derived(value, **{name: _taken_apart(one, (*path, name), found) for name, one in vars(value).items()})
    if isinstance(value, Mapping) and any(isinstance(one, (Tensor, Structure)) for one in value.values()):
        return {name: _taken_apart(one, (*path, name), found) for name, one in value.items()}
    return value


def _is_plain(tensor: Tensor) -> bool:
    return (
        type(tensor) is Tensor
        and tensor.is_cpu
        and tensor.layout is torch.strided
        and not tensor.requires_grad
        and not tensor.is_conj()
        and not tensor.is_neg()
    )


def _sent(found: Sequence[tuple[tuple[str, ...], Tensor]]) -> tuple[list[_Place], _Sent] | None:
    """Lay tensors into a block, but for those that are in it; return where each is, or None where there is no block."""
    tensors = [tensor for _, tensor in found]
    block = _BLOCKS.holding(max(tensors, key=lambda tensor: tensor.nbytes))
    rest = None
    if block is not None:  # what else there is goes behind it, such as a mask
        others = [tensor for tensor in tensors if not block.holds(tensor)]
        rest = block.rest()
    if block is None or rest is None or _size(others) > len(rest):
        memory = _BLOCKS.take(_size(tensors))
        block = None if memory is None else _BLOCKS.holding(memory)
        if memory is None or block is None:
            return None
        others, rest = tensors, memory
    begin, free = block.begin, rest.data_ptr() - block.begin
    laid = {id(tensor) for tensor in others}
    places = []
    for path, tensor in found:
        is_laid = id(tensor) in laid
        place = free if is_laid else tensor.data_ptr() - begin
        places.append(_Place(place, _NUMPY.get(tensor.dtype, tensor.dtype), tuple(tensor.shape), path))
        if is_laid:
            _at(rest.numpy(), places[-1]._replace(begin=free + begin - rest.data_ptr())).copy_(tensor)
            free += _aligned(tensor.nbytes)
    block.content[_RECEIVER] = 1
    sent = _Sent(os.getpid(), block.file, block.size, block.name)
    _SENDING.block = block, sent
    return places, sent


_SENDING = threading.local()  # the block of the batch that is pickled, and what is sent of it


def _reduced_texts(texts: StoredTexts) -> Any:
    """Return how the meta or the history of a batch is pickled: where its block has them, they stay."""
    address, size = texts.letters.__array_interface__["data"][0], texts.letters.nbytes
    block, sent = getattr(_SENDING, "block", (None, None))
    if block is not None and size and block.holds_bytes(address, size):
        return _received_texts, (sent, address - block.begin, size, texts.ends.tobytes())
    return texts.__reduce__()


def _size(tensors: list[Tensor]) -> int:
    return sum(_aligned(tensor.nbytes) for tensor in tensors)


def _aligned(size: int) -> int:
    return size + -size % _ALIGNED


def _at(memory: NDArray[np.uint8], place: _Place) -> Tensor:
    if isinstance(place.dtype, str):
        return torch.from_numpy(np.ndarray(place.shape, place.dtype, memory, place.begin))
    size = math.prod(place.shape) * place.dtype.itemsize
    return torch.from_numpy(memory[place.begin : place.begin + size]).view(place.dtype).view(place.shape)


# -- receiving --------------------------------------------------------------------------------------------------------

_MAPPED: dict[bytes, tuple[int, mmap.mmap]] = {}  # name -> worker, block
_MAPPED_BY = os.getpid()


def _received(cls: type[Structure], state: dict[str, Any], places: Sequence[_Place], sent: _Sent) -> Structure:
    """Put a batch together from where the worker laid it."""
    memory = _memory(_mapped(sent), _RECEIVER)
    for place in places:
        holder: Any = state
        for name in place.path[:-1]:
            holder = holder[name]
            holder = vars(holder) if isinstance(holder, Structure) else holder
        holder[place.path[-1]] = _at(memory, place)
    return derived(object.__new__(cls), **state)


def _received_texts(sent: _Sent, begin: int, size: int, ends: bytes) -> StoredTexts:
    """Copy texts out of a block, which is free again when the tensors are gone."""
    begin += _HEAD
    return texts_from_bytes(_mapped(sent)[begin : begin + size], ends)


def _mapped(sent: _Sent) -> mmap.mmap:
    global _MAPPED_BY
    if os.getpid() != _MAPPED_BY:  # those of the process this one was forked from
        _MAPPED.clear()
        _MAPPED_BY = os.getpid()
    known = _MAPPED.get(sent.name)
    if known is not None:
        return known[1]
    _forget_the_dead()
    fault: Exception | None = None
    try:
        file = os.open(f"/proc/{sent.process}/fd/{sent.file}", os.O_RDWR | os.O_CLOEXEC)
        try:
            content = mmap.mmap(file, _HEAD + sent.size)
        finally:
            os.close(file)
        if content[_NAME] == sent.name:
            _MAPPED[sent.name] = sent.process, content
            return content
    except (OSError, ValueError) as error:
        fault = error
    raise CacheError(
        f"a batch of the worker {sent.process} cannot be opened ({fault or 'another file is in its place'}); it must "
        "be received while its worker runs, by a process of the same user"
    ) from fault


def _forget_the_dead() -> None:
    """Give back the memory of workers that have ended; batches that are still held keep theirs."""
    for worker in {process for process, _ in _MAPPED.values()}:
        try:
            os.kill(worker, 0)
        except ProcessLookupError:
            for name in [name for name, (process, _) in _MAPPED.items() if process == worker]:
                _MAPPED.pop(name, None)
        except OSError:
            continue


for _kind in (PointCloud, PaddedClouds):
    sent_together(_kind)
ForkingPickler.register(StoredTexts, _reduced_texts)
