"""The GPU's launcher: kernels compiled for it, started on torch's current stream.

Compiled and loaded through cuda-core; started by the driver's own call through cuda-bindings, on which cuda-core rests:
its arguments are the same in all versions, and with a list of addresses made here a launch costs the host least.
"""

from __future__ import annotations

import ctypes
import functools
import importlib
import threading
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from pcdata.kernels.cuda.compiling import compiled, cuda_core, supported_architectures, target_for, why_no_compiler
from pcdata.kernels.cuda.declarations import KINDS, kernels
from pcdata.kernels.cuda.launching import BLOCK, LAUNCHERS, Launcher, T

_THREADS_PER_PROCESSOR = 2048  # at most resident, on every GPU since 2017 but small ones


def unavailable() -> str | None:
    """Return None when kernels can be compiled and started on a GPU, else why not and what to do."""
    if torch.version.cuda is None:
        return f"torch {torch.__version__} was built without CUDA; install one with it, see pytorch.org"
    if not torch.cuda.is_available():
        return "torch finds no CUDA device, or no driver for it; nvidia-smi shows what the driver sees"
    return why_no_compiler()


class GpuLauncher(Launcher):
    """Starts kernels on one GPU."""

    def __init__(self, index: int) -> None:
        self.index = index
        self._loaded: dict[str, Any] = {}  # theme -> what holds its kernels
        self._handles: dict[str, int] = {}
        self._lock = threading.Lock()
        properties = torch.cuda.get_device_properties(index)
        self._processors = properties.multi_processor_count
        self._target = target_for((properties.major, properties.minor), supported_architectures())
        self._driver = importlib.import_module("cuda.bindings.driver")

    def resident_blocks(self, name: str, block: int = BLOCK) -> int:
        """Ask the driver how many blocks fit into a processor."""
        with torch.cuda.device(self.index):
            function = self._driver.CUfunction(self._handle(name))
            each = self._checked(self._driver.cuOccupancyMaxActiveBlocksPerMultiprocessor(function, block, 0))
        return max(1, int(each) * self._processors)

    def busy_threads(self) -> int:
        """Fill every processor once."""
        return self._processors * _THREADS_PER_PROCESSOR

    def captured(self, work: Callable[[], T]) -> tuple[T, Callable[[], None]]:
        """Capture a CUDA graph, after a run that compiles, loads and allocates what is missing."""
        with torch.cuda.device(self.index):
            here, aside = torch.cuda.current_stream(self.index), torch.cuda.Stream(self.index)
            aside.wait_stream(here)
            with torch.cuda.stream(aside):
                work()
            here.wait_stream(aside)
            graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(graph, capture_error_mode="thread_local"):  # other threads may do as they like
                result = work()
        return result, graph.replay

    def _start(self, name: str, blocks: int, block: int, values: list[int | float]) -> None:
        handle = self._handle(name)
        held = [ctypes.c_double(one) if isinstance(one, float) else ctypes.c_int64(one) for one in values]
        addresses = (ctypes.c_void_p * len(held))(*map(ctypes.addressof, held))
        meets = kernels()[name].meets == KINDS["GRID_"]
        start = self._driver.cuLaunchCooperativeKernel if meets else self._driver.cuLaunchKernel
        extra = () if meets else (0,)
        with torch.cuda.device(self.index):
            stream = torch.cuda.current_stream(self.index).cuda_stream
            sizes = blocks, 1, 1, block, 1, 1, 0
            self._checked(start(handle, *sizes, stream, ctypes.addressof(addresses), *extra))

    def _handle(self, name: str) -> int:
        if name not in self._handles:
            with self._lock, torch.cuda.device(self.index):
                theme = kernels()[name].theme
                if theme not in self._loaded:
                    code = cuda_core().ObjectCode
                    load = code.from_cubin if self._target[1] == "cubin" else code.from_ptx
                    self._loaded[theme] = load(compiled(theme, *self._target))
                kernel = self._loaded[theme].get_kernel(name)
                self._handles[name] = int(getattr(kernel, "handle", None) or kernel._handle)
        return self._handles[name]

    def _checked(self, result: tuple[Any, ...]) -> Any:
        if int(result[0]) != 0:
            raise RuntimeError(f"a kernel could not be started on GPU {self.index}: {result[0]}")
        return result[1] if len(result) > 1 else None


@functools.cache
def _launcher(index: int) -> GpuLauncher:
    return GpuLauncher(index)


def _launcher_of(tensor: Tensor) -> Launcher:
    return _launcher(tensor.device.index)


LAUNCHERS["cuda"] = _launcher_of
