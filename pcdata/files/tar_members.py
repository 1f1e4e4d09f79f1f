"""Members of tar archives as pcdata writes them: plain files with a name in one folder, and nothing else.

The library's own ``tarfile`` reads whatever a tar may hold: links, devices, names that lead elsewhere, sizes that no
archive has, later members that replace earlier ones. Here every header must be, byte for byte, what is written for the
name and the size that it tells: owner, time and rights are fixed, so nothing else can be said.

Source: POSIX.1-2017, pax, sections ustar interchange format and pax header block.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from pcdata.errors import CacheError

BLOCK = 512
END = bytes(2 * BLOCK)  # of an archive

_FILE, _PAX = b"0", b"x"
_LONGEST = 100  # bytes of a name in a header; longer ones stand in a pax header before it
_MOST_BYTES = 8**11 - 1  # of a member, in 11 octal digits
_MOST_PAX = 4096
_NAME = re.compile(rb"[!-.0-~]+")  # in one folder: no slash, no space, no control character
_SIZE = re.compile(rb"[0-7]{11}\0")
_RECORD = re.compile(rb"([0-9]{1,4}) path=([!-~]+)\n")
_KINDS = {
    b"1": "a link", b"2": "a link", b"3": "a device", b"4": "a device", b"5": "a folder", b"6": "a FIFO",
    b"g": "a header for other members", b"L": "a name as GNU tar writes it", b"K": "a name as GNU tar writes it",
    b"S": "a sparse file",
}  # fmt: skip
_PAX_NAME = b"@PaxHeader"
_BEFORE_SIZE = b"0000644\0" + 2 * b"0000000\0"  # mode, user, group
_TIME = b"00000000000\0"
_TAIL = bytes(100) + b"ustar\x0000" + bytes(64) + 2 * b"0000000\0" + bytes(167)  # from the name of a link on
_FIXED_SUM = sum(_BEFORE_SIZE) + sum(_TIME) + 8 * ord(" ") + sum(_TAIL)


def padded(size: int) -> int:
    """Return how many bytes a content takes in an archive."""
    return size + -size % BLOCK


def member_head(name: str, size: int) -> bytes:
    """Return what stands before the content of a member.

    Raises:
        CacheError: no name in one folder, or more bytes than a member can have.
    """
    raw = name.encode("utf-8", "surrogatepass")
    if _NAME.fullmatch(raw) is None or raw.startswith(b"."):
        raise CacheError(f"{name!r:.200} is no name of a member: letters, digits and signs without a slash are")
    if not 0 <= size <= _MOST_BYTES:
        raise CacheError(f"member {name!r:.200} has {size} bytes; in a tar archive it has at most {_MOST_BYTES}")
    if len(raw) <= _LONGEST:
        return _header(raw, size, _FILE)
    record = _pax_record(raw)
    if len(record) > _MOST_PAX:
        raise CacheError(f"{name!r:.200}... is too long for the name of a member")
    long = _header(_PAX_NAME, len(record), _PAX) + record + bytes(-len(record) % BLOCK)
    return long + _header(raw[:_LONGEST], size, _FILE)


def read_members(content: memoryview) -> Iterator[tuple[str, memoryview]]:
    """Give name and content of every member in a piece of an archive that begins and ends between members.

    Raises:
        CacheError: something else is in it, or it is not what pcdata writes.
    """
    place, long = 0, b""
    while place < len(content):
        head = bytes(content[place : place + BLOCK])
        name, size, kind = _parsed(head)
        begin = place + BLOCK
        place = begin + padded(size)
        if place > len(content):
            raise CacheError(f"member {name!r:.200} claims {size} bytes, but the archive ends before them")
        if bytes(content[begin + size : place]).strip(b"\0"):
            raise CacheError(f"member {name!r:.200} has something behind its end")
        if kind == _PAX:
            if long or size > _MOST_PAX:
                raise CacheError("a header for a long name belongs to no member, or is too long itself")
            long = _long_name(bytes(content[begin : begin + size]))
            continue
        if long:
            if name != long[:_LONGEST]:
                raise CacheError(f"member {name!r:.200} has the long name of another")
            name, long = long, b""
        if _NAME.fullmatch(name) is None or name.startswith(b"."):
            raise CacheError(f"member {name!r:.200} has a name that leads elsewhere, or is none")
        yield name.decode("ascii"), content[begin : begin + size]
    if long:
        raise CacheError("a header for a long name belongs to no member")


def _header(name: bytes, size: int, kind: bytes) -> bytes:
    told = b"%011o\0" % size
    total = sum(name) + sum(told) + kind[0] + _FIXED_SUM
    return b"".join((name, bytes(_LONGEST - len(name)), _BEFORE_SIZE, told, _TIME, b"%06o\0 " % total, kind, _TAIL))


def _parsed(head: bytes) -> tuple[bytes, int, bytes]:
    """Return name, size and kind of a member."""
    if len(head) != BLOCK:
        raise CacheError("the archive ends early")
    name, told, kind = head[:_LONGEST].rstrip(b"\0"), head[124:136], head[156:157]
    # As a comparison with _header(name, size, kind), which takes longer.
    if (
        head[100:124] == _BEFORE_SIZE
        and head[136:148] == _TIME
        and head[157:] == _TAIL
        and kind in (_FILE, _PAX)
        and _SIZE.fullmatch(told) is not None
        and head[148:156] == b"%06o\0 " % (sum(head[:_LONGEST]) + sum(told) + kind[0] + _FIXED_SUM)
    ):
        return name, int(told[:-1], 8), kind
    if kind in _KINDS and head[257:262] == b"ustar":
        raise CacheError(f"member {name!r:.200} is {_KINDS[kind]}, which no dataset holds")
    raise CacheError(f"{name!r:.200} does not begin a member as pcdata writes it: damaged, or written by other means")


def _pax_record(name: bytes) -> bytes:
    rest = b" path=%s\n" % name
    length = len(rest) + 1
    while len(rest) + len(str(length)) != length:
        length = len(rest) + len(str(length))
    return b"%d%s" % (length, rest)


def _long_name(record: bytes) -> bytes:
    found = _RECORD.fullmatch(record)
    if found is None or len(found[2]) <= _LONGEST or record != _pax_record(found[2]):
        raise CacheError(f"a header for a long name says something else: {record!r:.200}")
    return found[2]
