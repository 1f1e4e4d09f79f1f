"""Where kernels run: what an operation's body asks of it, the same on a GPU and in the harness of the tests.

A body takes ``launcher = launcher_of(points)``, makes its scratch as torch tensors on the device of the points, and
launches kernels one after another; nothing here waits for the device.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, TypeVar

from torch import Tensor

from pcdata.kernels.cuda.declarations import kernels, values_of

BLOCK = 256  # threads

T = TypeVar("T")


class Launcher(ABC):
    """Starts kernels on one device, in the order in which they are asked for."""

    device_type = "cuda"

    def launch(self, name: str, threads: int, *arguments: Any, block: int = BLOCK) -> None:
        """Start a kernel with at least so many threads; none at all for 0."""
        if threads > 0:
            self._start(name, -(-threads // block), block, values_of(kernels()[name], arguments, self.device_type))

    def launch_blocks(self, name: str, blocks: int, *arguments: Any, block: int = BLOCK) -> None:
        """Start a kernel with so many blocks; those that all meet must be :meth:`resident_blocks` at most."""
        if blocks > 0:
            self._start(name, blocks, block, values_of(kernels()[name], arguments, self.device_type))

    def address(self, tensor: Tensor) -> int:
        """Return where a tensor begins on the device: for kernels that take addresses of many."""
        return tensor.data_ptr()

    @abstractmethod
    def resident_blocks(self, name: str, block: int = BLOCK) -> int:
        """Return how many blocks of a kernel the device holds at once."""

    @abstractmethod
    def busy_threads(self) -> int:
        """Return how many threads keep the device busy: for kernels that walk a list whose length it alone knows."""

    @abstractmethod
    def captured(self, work: Callable[[], T]) -> tuple[T, Callable[[], None]]:
        """Take down work that waits for nothing and sends nothing; return its tensors, and what does it, into these.

        Each time what was started is started with the same arguments: what work reads is to lie where it lay.
        """

    @abstractmethod
    def _start(self, name: str, blocks: int, block: int, values: list[int | float]) -> None:
        """Start a kernel with arguments that are checked."""


# Device type -> what gives the launcher of a tensor on it.
LAUNCHERS: dict[str, Callable[[Tensor], Launcher]] = {}


def launcher_of(tensor: Tensor) -> Launcher:
    """Return the launcher for the device that a tensor is on."""
    return LAUNCHERS[tensor.device.type](tensor)
