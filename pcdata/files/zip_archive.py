"""The members of a zip archive of arrays: their list is checked as a whole, and none unpacks to more than it claims.

Only what NumPy and PyTorch write is taken: members that are stored or deflated, not encrypted, one after another, with
one name each. ``zipfile`` takes more, such as bzip2, which it unpacks without a bound.

Source: PKWARE APPNOTE.TXT 6.3.10, sections 4.3 to 4.5.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import IO

from pcdata.errors import CacheError

_LOCAL = struct.Struct("<4s5H3I2H")
_CENTRAL = struct.Struct("<4s6H3I5H2I")
_END = struct.Struct("<4s4H2IH")
_LOCATOR64 = struct.Struct("<4sIQI")
_END64 = struct.Struct("<4sQ2H2I4Q")
_STORED, _DEFLATED = 0, 8
_MAX_LIST = 1 << 24  # bytes of the list of members: about 200,000 arrays
_IN_64_BITS = 0xFFFFFFFF
# Sizes behind the data, a UTF-8 name, the effort of the compressor: the others mean encryption and patches.
_FLAGS = 0x0008 | 0x0800 | 0x0006
_MAX_DEFLATE = 1032  # to one: the most that deflate can do
_PIECE = 1 << 20  # bytes


@dataclass(frozen=True)
class Member:
    """What the list says of one member; its data begin after a header at ``start`` and end before ``stop``."""

    name: str
    raw_name: bytes
    deflated: bool
    crc: int
    packed: int
    size: int
    start: int
    stop: int


class ZipArchive:
    """The members of an open file of ``size`` bytes, by name.

    Raises:
        CacheError: no zip archive, cut short, with something appended, or one that claims what cannot be.
    """

    def __init__(self, file: IO[bytes], size: int) -> None:
        self._file = file
        self.size = size
        self.members = {member.name: member for member in _listed(file, size)}

    def read(self, member: Member) -> bytearray:
        """Return the content of a member.

        Raises:
            CacheError: damaged: another length or checksum than the list says.
        """
        content = bytearray(member.size)
        with memoryview(content) as view:
            filled = 0
            for piece in self.pieces(member, _PIECE, _PIECE):
                view[filled : filled + len(piece)] = piece
                filled += len(piece)
        return content

    def pieces(self, member: Member, first: int, length: int) -> Iterator[bytes]:
        """Yield the content of a member: ``first`` bytes, then ``length`` at a time, of which the last may be fewer.

        A packed member yields pieces of at most that many bytes.

        Raises:
            CacheError: as for :meth:`read`; a wrong checksum is told at the end.
        """
        self._file.seek(self._begin_of(member))
        crc, left = 0, member.size
        for piece in self._inflated(member, length) if member.deflated else self._stored(member, first, length):
            left -= len(piece)
            if left < 0:
                raise CacheError(f"member {member.name!r:.100} unpacks to more than the {member.size} bytes it claims")
            crc = zlib.crc32(piece, crc)
            yield piece
        if left or crc != member.crc:
            raise CacheError(f"member {member.name!r:.100} is damaged: its checksum or its length is wrong")

    def start_of(self, member: Member, most: int) -> bytes:
        """Return the first bytes of a stored member, or fewer where it has fewer; its checksum is not compared."""
        self._file.seek(self._begin_of(member))
        return _exactly(self._file, min(most, member.size))

    def _begin_of(self, member: Member) -> int:
        self._file.seek(member.start)
        fields = _LOCAL.unpack(_exactly(self._file, _LOCAL.size))
        signature, _, flags, method, *_, name_length, extra_length = fields
        name = _exactly(self._file, name_length)
        begin = member.start + _LOCAL.size + name_length + extra_length
        same = (signature, method, name) == (b"PK\3\4", _DEFLATED if member.deflated else _STORED, member.raw_name)
        if not same or flags & ~_FLAGS or begin + member.packed > member.stop:
            raise CacheError(f"member {member.name!r:.100} is not what the list of members says")
        return begin

    def _stored(self, member: Member, first: int, length: int) -> Iterator[bytes]:
        left, wanted = member.size, first
        while left:
            piece = _exactly(self._file, min(wanted, left))
            yield piece
            left, wanted = left - len(piece), length

    def _inflated(self, member: Member, length: int) -> Iterator[bytes]:
        unpack = zlib.decompressobj(-zlib.MAX_WBITS)
        left, given = member.packed, b""
        while not unpack.eof:
            if not given:
                given = _exactly(self._file, min(_PIECE, left))
                left -= len(given)
            ended = not given
            try:
                piece = unpack.decompress(given, length)
            except zlib.error as error:
                raise CacheError(f"member {member.name!r:.100} is damaged: {error}") from error
            given = unpack.unconsumed_tail
            if piece:
                yield piece
            elif ended and not unpack.eof:
                raise CacheError(f"member {member.name!r:.100} ends early")
        if left or unpack.unused_data:
            raise CacheError(f"member {member.name!r:.100} has bytes after its end")


def _listed(file: IO[bytes], size: int) -> list[Member]:
    """Return the members in the order of the file; they do not overlap, so that none can be counted twice."""
    count, length, begin = _end_of(file, size)
    if length > _MAX_LIST or count * _CENTRAL.size > length or begin + length > size:
        raise CacheError(f"its list of {count} members in {length} bytes cannot be in a file of {size} bytes")
    file.seek(begin)
    text = _exactly(file, length)
    found, place = [], 0
    for _ in range(count):
        entry, place = _entry(text, place)
        found.append(entry)
    if place != length:
        raise CacheError("its list of members has another length than its end says")
    # torch and some file systems find names without regard to case: a second one would be read unchecked.
    if len({entry[0].casefold() for entry in found}) != count:
        raise CacheError("two members have one name")
    found.sort(key=lambda entry: entry[-1])
    stops = [entry[-1] for entry in found[1:]] + [begin]
    members = [Member(*entry, stop) for entry, stop in zip(found, stops)]
    for member in members:
        _check_sizes(member)
    return members


def _check_sizes(member: Member) -> None:
    if member.start + _LOCAL.size + len(member.raw_name) + member.packed > member.stop:
        raise CacheError(f"member {member.name!r:.100} claims {member.packed} packed bytes, which overlap others")
    most = _MAX_DEFLATE * (member.packed + 1) if member.deflated else member.packed
    if member.size > most or (not member.deflated and member.size != member.packed):
        raise CacheError(f"member {member.name!r:.100} claims {member.size} bytes from {member.packed}")


def _end_of(file: IO[bytes], size: int) -> tuple[int, int, int]:
    """Return count, length and place of the entries in the list of members."""
    if size < _END.size:
        raise CacheError(f"its {size} bytes are no zip archive")
    file.seek(size - _END.size)
    signature, disk, disk_of_list, here, count, length, begin, comment = _END.unpack(_exactly(file, _END.size))
    if signature != b"PK\5\6" or comment:
        raise CacheError("it does not end as a zip archive does: cut short, or something was appended")
    stop = size - _END.size
    if 0xFFFF in (here, count) or _IN_64_BITS in (length, begin):
        stop = size - _END.size - _LOCATOR64.size
        file.seek(max(stop, 0))
        signature, _, place, _ = _LOCATOR64.unpack(_exactly(file, _LOCATOR64.size))
        if signature != b"PK\6\7" or place + _END64.size > stop:
            raise CacheError("the end of its list of members is damaged")
        file.seek(place)
        fields = _END64.unpack(_exactly(file, _END64.size))
        signature, _, _, _, disk, disk_of_list, here, count, length, begin = fields
        if signature != b"PK\6\6":
            raise CacheError("the end of its list of members is damaged")
        stop = place
    if disk or disk_of_list or here != count or begin + length > stop:
        raise CacheError("the end of its list of members is damaged")
    return count, length, begin


def _entry(text: bytes, place: int) -> tuple[tuple[str, bytes, bool, int, int, int, int], int]:
    """Return name, raw name, whether deflated, checksum, packed size, size, place of an entry; and the next one's."""
    stop = place + _CENTRAL.size
    if stop > len(text):
        raise CacheError("its list of members ends early")
    fields = _CENTRAL.unpack_from(text, place)
    signature, _, _, flags, method, _, _, crc, packed, size, name_length, extra_length, comment, disk, _, _, begin = (
        fields
    )
    if signature != b"PK\1\2" or disk or stop + name_length + extra_length + comment > len(text):
        raise CacheError("its list of members is damaged")
    raw = text[stop : stop + name_length]
    try:
        name = raw.decode("utf-8" if flags & 0x0800 else "cp437")
    except UnicodeDecodeError as error:
        raise CacheError(f"its list of members has a name that is no text: {raw!r:.100}") from error
    if flags & ~_FLAGS:
        raise CacheError(f"member {name!r:.100} is encrypted or a patch (flags {flags:#x})")
    if method not in (_STORED, _DEFLATED):
        raise CacheError(
            f"member {name!r:.100} is packed by method {method}; only stored and deflated members are read, as "
            "numpy.savez and numpy.savez_compressed write them"
        )
    stop += name_length
    extra = text[stop : stop + extra_length]
    size, packed, begin = _in_64_bits(extra, size, packed, begin)
    return (name, raw, method == _DEFLATED, crc, packed, size, begin), stop + extra_length + comment


def _in_64_bits(extra: bytes, *values: int) -> list[int]:
    """Replace values that did not fit into 32 bits by those of the extra field, where they stand in this order."""
    wide = b""
    while len(extra) >= 4:
        kind, length = struct.unpack_from("<2H", extra)
        if kind == 1:
            wide = extra[4 : 4 + length]
        extra = extra[4 + length :]
    result = []
    for value in values:
        if value == _IN_64_BITS and len(wide) >= 8:
            value, wide = struct.unpack_from("<Q", wide)[0], wide[8:]
        result.append(value)
    return result


def _exactly(file: IO[bytes], length: int) -> bytes:
    content = file.read(length)
    if len(content) != length:
        raise CacheError("it ends early")
    return content
