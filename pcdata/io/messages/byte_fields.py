"""Numbers and texts one after another in bytes, little-endian, each checked before it is taken."""

from __future__ import annotations

import struct

from pcdata.errors import CaptureError

_MAX_TEXT = 1 << 20


class Fields:
    """Bytes that are taken from the front."""

    def __init__(self, content: bytes, start: int = 0) -> None:
        if not 0 <= start <= len(content):
            raise CaptureError(f"it should go on at byte {start} of {len(content)}; it is damaged")
        self._content, self.place = content, start

    @property
    def left(self) -> int:
        """The bytes that are left."""
        return len(self._content) - self.place

    def take(self, size: int) -> bytes:
        """Return the next bytes.

        Raises:
            CaptureError: there are fewer.
        """
        if size > self.left:
            raise CaptureError(f"it claims {size} bytes where {self.left} are left; it is damaged")
        self.place += size
        return self._content[self.place - size : self.place]

    def number(self, form: str) -> int:
        """Return the next whole number, "B", "H", "I", "Q" or "i" as :mod:`struct` calls them."""
        return int(struct.unpack(f"<{form}", self.take(struct.calcsize(f"<{form}")))[0])

    def text(self, most: int = _MAX_TEXT) -> str:
        """Return the next text, which begins with its length in four bytes.

        Raises:
            CaptureError: it is longer than ``most``, or no UTF-8.
        """
        size = self.number("I")
        if size > most:
            raise CaptureError(f"a text claims {size} bytes, the limit is {most}; it is damaged")
        try:
            return self.take(size).decode()
        except UnicodeDecodeError as error:
            raise CaptureError("a text is no UTF-8; it is damaged") from error
