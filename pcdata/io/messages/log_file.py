"""A file of messages that were recorded from topics, whatever container it is; its index alone is kept in memory.

A container says how its file begins, which messages it has and where, and how the bytes of one are read. It holds a
path and no open file, so it can be sent to workers.
"""

from __future__ import annotations

import os
import struct
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, ClassVar

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CaptureError, PcdataError
from pcdata.files.library_errors import name_file, told_by_library
from pcdata.files.opening import MAX_STREAMED_BYTES, open_input

MAX_MESSAGE = 1 << 28  # bytes: four times an image of 67 megapixels
LATEST = (1 << 63) - 1  # nanoseconds

# Two numbers that say where in its file a message is; what they mean is the container's own business.
Place = tuple[int, int]
Read = Callable[[Place, int | None], bytes]


@dataclass(frozen=True, eq=False)
class Topic:
    """The messages of one topic, in the order of time.

    Args:
        name: of the topic.
        type: of its messages, as ROS 2 writes it: "sensor_msgs/msg/Image"; or "foxglove.CompressedImage".
        encoding: of their bytes: "cdr", "ros1", "json" or "protobuf".
        times: (N,) int64 nanoseconds, when each was recorded; those of one time stay in the order of the file.
        places: (N, 3) int64, the number of the file and the place in it.
    """

    name: str
    type: str
    encoding: str
    times: NDArray[np.int64]
    places: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.times)

    def rate(self) -> float:
        """Return messages per second over the whole recording; 0 where there is one or none."""
        span = int(self.times[-1] - self.times[0]) if len(self) > 1 else 0
        return (len(self) - 1) * 1e9 / span if span else 0.0


@dataclass(eq=False)
class Index:
    """What a file holds: of each topic by name its type and encoding, and the times and places of its messages.

    ``damage`` says what of the file cannot be read; None = all can.
    """

    topics: dict[str, tuple[str, str]] = field(default_factory=dict)
    times: dict[str, list[NDArray[np.int64]]] = field(default_factory=dict)
    places: dict[str, list[NDArray[np.int64]]] = field(default_factory=dict)
    damage: str | None = None

    def add_topic(self, name: str, kind: str, encoding: str) -> None:
        """Note a topic.

        Raises:
            CaptureError: it has messages of another type or encoding already.
        """
        told = (kind, encoding)
        if self.topics.setdefault(name, told) != told:
            raise CaptureError(f"topic {name!r:.200} holds messages of two types, {self.topics[name]} and {told}")

    def add(self, name: str, times: NDArray[np.int64], places: NDArray[np.int64]) -> None:
        """Note messages of a topic: (N,) times and (N, 2) places."""
        self.times.setdefault(name, []).append(times)
        self.places.setdefault(name, []).append(places)


class LogFile(ABC):
    """One file of messages; subclasses are containers."""

    suffix: ClassVar[str]
    container: ClassVar[str]  # in words

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def begins_so(cls, path: Path) -> bool:
        """Say whether a file begins as this container does; never raises."""
        try:
            with open_input("begins_so", path, max_bytes=MAX_STREAMED_BYTES) as stream:
                return cls._begins_so(stream)
        except (CaptureError, OSError):
            return False

    @classmethod
    @abstractmethod
    def _begins_so(cls, stream: BinaryIO) -> bool: ...

    @abstractmethod
    def index(self) -> Index:
        """Return what the file holds, without reading a message where the file has an index of its own.

        Raises:
            CaptureError: it is no such file, or nothing of it can be read.
        """

    @abstractmethod
    def opened(self) -> AbstractContextManager[Read]:
        """Open the file; gives what reads the bytes of a message by its place, or the first so many of them.

        Raises:
            CaptureError: the file or the message is damaged.
        """

    @contextmanager
    def _stream(self) -> Iterator[tuple[BinaryIO, int]]:
        """Open the file, with its size; whatever its bytes make fail is a CaptureError that names it."""
        with said_of(self.path), open_input(self.container, self.path, max_bytes=MAX_STREAMED_BYTES) as stream:
            yield stream, os.fstat(stream.fileno()).st_size


@contextmanager
def said_of(path: Path) -> Iterator[None]:
    """Turn what parsing raises on damaged bytes into a CaptureError that names the file."""
    try:
        yield
    except PcdataError as error:
        name_file(error, path, str(path))
        raise
    except (OSError, ValueError, struct.error, IndexError, KeyError, OverflowError, MemoryError, EOFError) as error:
        raise CaptureError(f"{path}: is damaged: {told_by_library(error)}; copy it again") from error


def by_topic(messages: dict[str, list[tuple[int, int, int]]], index: Index) -> None:
    """Add messages that were found one by one: time and place."""
    for name, rows in messages.items():
        table = np.array(rows, np.int64).reshape(-1, 3)
        index.add(name, table[:, 0], table[:, 1:])


def type_name(name: str) -> str:
    """Return a type as ROS 2 writes it: ROS 1 leaves out the middle."""
    package, slash, message = name.partition("/")
    return f"{package}/msg/{message}" if slash and "/" not in message else name
