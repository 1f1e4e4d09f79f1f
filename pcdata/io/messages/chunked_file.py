"""A file of messages, some of them in chunks that are packed: what bags of ROS 1 and MCAP files share."""

from __future__ import annotations

import os
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from typing import BinaryIO, ClassVar

from pcdata.errors import CaptureError
from pcdata.io.messages.byte_fields import Fields
from pcdata.io.messages.log_file import Index, LogFile, Place, Read
from pcdata.io.messages.packing import UNPACKED

IN_FILE = -1  # the second number of a place: the first is from the start of the file, not of a packed chunk


class ChunkedFile(LogFile):
    """A place is (byte, -1), or (byte of a packed chunk, byte within)."""

    magic: ClassVar[bytes]
    begins_as: ClassVar[str]  # in words, what its first bytes say

    @classmethod
    def _begins_so(cls, stream: BinaryIO) -> bool:
        return stream.read(len(cls.magic)) == cls.magic

    def index(self) -> Index:
        """Return what the file holds: by its own index, or read through where that is missing."""
        with self._stream() as (stream, size):
            if not self._begins_so(stream):
                raise CaptureError(f"{self.path}: does not start as {self.begins_as} does")
            return self._indexed(stream, size)

    @contextmanager
    def opened(self) -> Iterator[Read]:
        """Open the file."""
        with self._stream() as (stream, size):

            def read(place: Place, most: int | None = None) -> bytes:
                start, offset = place
                if offset == IN_FILE:
                    length = self._seek_message(stream, start, size)
                    return stream.read(length if most is None else min(most, length))
                key = (str(self.path), os.fstat(stream.fileno()).st_mtime_ns, start)
                chunk = Fields(UNPACKED.get(key, lambda: self._unpacked_chunk(stream, start, size)), offset)
                length = self._skip_to_message(chunk, start)
                return chunk.take(length if most is None else min(most, length))

            yield read

    @abstractmethod
    def _indexed(self, stream: BinaryIO, size: int) -> Index:
        """Return what the file of so many bytes holds; the stream is behind the first bytes."""

    @abstractmethod
    def _seek_message(self, stream: BinaryIO, start: int, size: int) -> int:
        """Go to the data of the message whose record is at a byte of the file; return how many bytes they are."""

    @abstractmethod
    def _unpacked_chunk(self, stream: BinaryIO, start: int, size: int) -> bytes:
        """Return what is packed in the chunk at a byte of the file."""

    @abstractmethod
    def _skip_to_message(self, chunk: Fields, start: int) -> int:
        """Pass over the head of the message where the content of a chunk stands; return how many bytes its data are."""
