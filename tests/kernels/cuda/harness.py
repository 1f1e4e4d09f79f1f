"""Kernels of the GPU on the processor: the launcher of the harness, and the backend ``cuda_harness`` that it carries.

The library is built once for a state of the sources, by the compiler that there is, and kept among temporary files.
Tensors of the processor and of the pretended device (tests/pretend_device.py) are taken.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import itertools
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pcdata.contracts import dispatch
from pcdata.kernels.cuda import launching
from pcdata.kernels.cuda.declarations import SOURCES, kernels, sources_digest
from tests import pretend_device
from tests.sanitized import UNDER_SANITIZERS

BACKEND = "cuda_harness"
COMPILER = shutil.which("g++")
FLAGS = ["-std=c++17", "-O1", "-shared", "-fPIC", "-ffp-contract=off", "-fvisibility=hidden", "-Wall", "-Wextra"]
if UNDER_SANITIZERS:
    FLAGS += ["-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g1"]


def unavailable() -> str | None:
    if COMPILER is None:
        return "there is no C++ compiler to build the harness with; install one"
    return None if (SOURCES / "harness").exists() else "the sources of the kernels are not installed"


@functools.cache
def library(flags: tuple[str, ...] = ()) -> ctypes.CDLL:
    own = b"".join(path.read_bytes() for path in sorted((SOURCES / "harness").iterdir()))
    state = hashlib.sha256(sources_digest().encode() + own + repr((FLAGS, flags)).encode()).hexdigest()[:20]
    built = Path(tempfile.gettempdir()) / f"pcdata-harness-{os.getuid()}" / f"{state}.so"
    if not built.exists():
        built.parent.mkdir(mode=0o700, exist_ok=True)
        part = built.with_suffix(f".{os.getpid()}")
        sources = [f"-I{SOURCES}", str(SOURCES / "harness" / "run.cpp")]
        subprocess.run([str(COMPILER), *FLAGS, *flags, *sources, "-o", str(part)], check=True)
        part.rename(built)
    return ctypes.CDLL(str(built))


class Harness(launching.Launcher):
    """Runs every thread at once, on the processor; ``seed`` 0: in order, else in orders drawn from it."""

    def __init__(self, seed: int = 0) -> None:
        self.seeds = itertools.repeat(0) if seed == 0 else itertools.count(seed)
        self.started: list[str] = []
        self.recordings: list[pretend_device.Recording] = []

    def resident_blocks(self, name: str, block: int = launching.BLOCK) -> int:
        return 3

    def busy_threads(self) -> int:
        return 300  # not a whole number of blocks, and far fewer than rows

    def _start(self, name: str, blocks: int, block: int, values: list[int | float]) -> None:
        self.started.append(name)
        for watched in pretend_device._watching:
            watched.launches += 1
        for recording in pretend_device._recordings:
            told = f"{name} {blocks} x {block} {values}"
            recording.add(told, lambda: self._run(name, blocks, block, values))
        self._run(name, blocks, block, values)

    def _run(self, name: str, blocks: int, block: int, values: list[int | float]) -> None:
        held = [ctypes.c_double(one) if isinstance(one, float) else ctypes.c_int64(one) for one in values]
        words = (ctypes.c_uint64 * len(held))(*(int.from_bytes(bytes(one), "little") for one in held))
        told = ctypes.create_string_buffer(400)
        numbers = (ctypes.c_int64(value) for value in (blocks, block))
        seed = ctypes.c_uint64(next(self.seeds))
        count, room = ctypes.c_int64(len(words)), ctypes.c_int64(len(told))
        if library().pc_run_kernel(name.encode(), *numbers, words, count, seed, told, room):
            raise RuntimeError(told.value.decode())

    def captured(self, work: Callable[[], Any]) -> tuple[Any, Callable[[], None]]:
        """Take down what the pretended device is asked, with its memory."""
        with pretend_device.recording() as recording:
            result = work()
        self.recordings.append(recording)
        return result, recording.replay

    def address(self, tensor: Tensor) -> int:
        return super().address(on_host(tensor))

    def launch(self, name: str, threads: int, *arguments: Any, block: int = launching.BLOCK) -> None:
        super().launch(name, threads, *map(on_host, arguments), block=block)

    def launch_blocks(self, name: str, blocks: int, *arguments: Any, block: int = launching.BLOCK) -> None:
        super().launch_blocks(name, blocks, *map(on_host, arguments), block=block)

    device_type = "cpu"


def on_host(value: Any) -> Any:
    return pretend_device.host(value) if isinstance(value, Tensor) else value


harness = Harness()


def use(seed: int) -> Harness:
    """Give a launcher that draws the order of threads, to all kernels from here on; 0: in order."""
    global harness
    harness = Harness(seed)
    return harness


def register() -> None:
    """Let ``backend="cuda_harness"`` run every kernel of the cuda backend."""
    if BACKEND in dispatch.BACKEND_MODULES:
        return
    import pcdata.kernels.cuda  # noqa: F401 - registers the kernels

    for operation in [*dispatch.OPERATIONS.values(), *dispatch.INNER.values()]:
        if "cuda" in operation.kernels:
            operation.kernels[BACKEND] = operation.kernels["cuda"]
        if "cuda" in operation.roomy:
            operation.roomy.add(BACKEND)
    for device_type in ("cpu", pretend_device.NAME):
        launching.LAUNCHERS[device_type] = lambda tensor: harness
    dispatch.BACKEND_MODULES[BACKEND] = __name__


def kernel_names() -> list[str]:
    return sorted(kernels())


def as_on_a_gpu(monkeypatch: Any) -> torch.device:
    """Let ``auto`` take the harness on the pretended device; return that."""
    register()
    monkeypatch.setitem(dispatch.AUTO_ORDER, pretend_device.NAME, (BACKEND, "torch_tree", "torch"))
    return pretend_device.device()
