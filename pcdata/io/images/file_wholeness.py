"""What the structure of a PNG or JPEG file tells of its own wholeness, checked before Pillow decodes it.

Pillow shows what it can of a damaged picture: rows that are missing become 0, a wrong checksum is passed over. For a
photograph that is kind; for depth it invents "no reading". So chunks, checksums and sizes are checked here.

Source: W3C, Portable Network Graphics (Third Edition), sections 5 and 11; ITU-T T.81, annex B.
"""

from __future__ import annotations

import struct
import zlib

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"

_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # of a PNG's color types
_DEPTHS = {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8), 4: (8, 16), 6: (8, 16)}
_PASSES = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))
_MAX_SCANS = 64  # of a progressive JPEG, which has about ten; each is decoded over the whole picture
_JPEG_PIXELS_PER_BYTE = 512  # 16x16 pixels in two colors of half size take six codes of at least one bit


class StructureError(ValueError):
    """What does not fit together in an image file."""


def checked_png(data: bytes, max_pixels: int) -> tuple[bytes, int, int]:
    """Check every chunk and checksum, and that the rows unpack to what the header says, no further.

    Returns:
        The same picture as a PNG of its critical chunks alone, so that no other chunk is parsed; the bits per channel;
        the color type.

    Raises:
        StructureError: damaged, cut short, more than one picture, or with bytes that belong to nothing.
    """
    chunks = _png_chunks(data)
    kinds = [kind for kind, _ in chunks]
    if kinds[0] != b"IHDR" or len(chunks[0][1]) != 13 or kinds.count(b"IHDR") > 1:
        raise StructureError("it does not start with one header")
    width, height, bits, color, packing, filtering, interlaced = struct.unpack(">IIBBBBB", chunks[0][1])
    if bits not in _DEPTHS.get(color, ()) or packing or filtering or interlaced > 1:
        raise StructureError(f"no PNG has {bits} bits of color type {color}")
    if not 0 < width * height <= max_pixels:
        raise StructureError(f"an image must have 1 .. {max_pixels} pixels, this one claims {width}x{height}")
    if b"acTL" in kinds:
        raise StructureError("must hold one image, but is an animation; save one file each")
    unknown = [kind for kind in kinds if not kind[0] & 0x20 and kind not in (b"IHDR", b"PLTE", b"IDAT", b"IEND")]
    palettes = [content for kind, content in chunks if kind == b"PLTE"]
    if unknown or len(palettes) > 1 or (color == 3 and not palettes):
        raise StructureError(f"chunk {unknown[0]!r} is not known" if unknown else "it must have one palette")
    first = kinds.index(b"IDAT") if b"IDAT" in kinds else len(kinds)
    count = kinds.count(b"IDAT")
    if kinds[first : first + count] != [b"IDAT"] * count or not count:
        raise StructureError("its image data are missing or not in one row")
    size = _png_bytes(width, height, bits * _CHANNELS[color], bool(interlaced))
    packed = b"".join(content for kind, content in chunks if kind == b"IDAT")
    check_inflated(packed, size)
    parts: list[tuple[bytes, bytes | memoryview]] = [(b"IHDR", chunks[0][1])]
    parts += [(b"PLTE", palette) for palette in palettes]
    parts += [(b"IDAT", packed), (b"IEND", b"")]
    return PNG_SIGNATURE + b"".join(_png_chunk(kind, content) for kind, content in parts), bits, color


def _png_chunks(data: bytes) -> list[tuple[bytes, memoryview]]:
    if data[:8] != PNG_SIGNATURE:
        raise StructureError("it does not start as a PNG does")
    view, chunks, start = memoryview(data), list[tuple[bytes, memoryview]](), 8
    while not chunks or chunks[-1][0] != b"IEND":
        if start + 12 > len(data):
            raise StructureError("it is cut short: its end chunk is missing")
        (size,) = struct.unpack_from(">I", data, start)
        end = start + 12 + size
        if end > len(data):
            raise StructureError(f"it is cut short: a chunk claims {size} bytes where {len(data) - start - 12} follow")
        kind = data[start + 4 : start + 8]
        if zlib.crc32(view[start + 4 : end - 4]) != struct.unpack_from(">I", data, end - 4)[0]:
            raise StructureError(f"the checksum of chunk {kind!r} at byte {start} is wrong: the file is damaged")
        chunks.append((kind, view[start + 8 : end - 4]))
        start = end
    if start != len(data):
        raise StructureError(f"{len(data) - start} bytes follow its end")
    return chunks


def _png_chunk(kind: bytes, content: bytes | memoryview) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(content, zlib.crc32(kind)))


def _png_bytes(width: int, height: int, bits: int, interlaced: bool) -> int:
    """Return the size of all rows with their filter bytes."""
    if not interlaced:
        return height * (1 + (width * bits + 7) // 8)
    total = 0
    for x, y, dx, dy in _PASSES:
        columns, rows = -((x - width) // dx), -((y - height) // dy)
        if columns > 0 and rows > 0:
            total += rows * (1 + (columns * bits + 7) // 8)
    return total


def check_inflated(packed: bytes | memoryview, size: int) -> None:
    """Require that a zlib stream unpacks to exactly so many bytes and ends with the right checksum."""
    stream = zlib.decompressobj()
    try:
        content = stream.decompress(packed, size + 1)
        if len(content) == size and not stream.eof:  # the checksum may still wait in what was not consumed
            content += stream.decompress(stream.unconsumed_tail, 1)
    except zlib.error as error:
        raise StructureError(f"its packed image data are damaged: {error}") from error
    if len(content) != size:
        more = "more than" if len(content) > size else len(content)
        raise StructureError(f"its image data unpack to {more} {'the ' * (len(content) > size)}{size} bytes it claims")
    if not stream.eof:
        raise StructureError("its packed image data have no end and no checksum")
    if stream.unused_data.strip(b"\0"):
        raise StructureError(f"{len(stream.unused_data)} bytes follow its packed image data")


def check_jpeg(data: bytes, max_pixels: int) -> None:
    """Check the segments of a JPEG up to the marker of its end, and that its size can come from so few bytes.

    The entropy-coded data have no checksum: a wrong bit in them cannot be told.

    Raises:
        StructureError: cut short, segments that lead nowhere, restart markers out of turn, sizes that cannot be.
    """
    if data[:2] != b"\xff\xd8":
        raise StructureError("it does not start as a JPEG does")
    start, scans, frames, interval = 2, 0, 0, 0
    while True:
        start, marker = _jpeg_marker(data, start)
        if marker == 0xD9:
            break
        if marker in (0x00, 0x01, 0xD8) or 0xD0 <= marker <= 0xD7:
            raise StructureError(f"marker {marker:#04x} stands where no such marker may")
        size = struct.unpack_from(">H", data, start)[0] if start + 2 <= len(data) else 0
        if size < 2 or start + size > len(data):
            raise StructureError(f"it is cut short: segment {marker:#04x} claims {size} bytes")
        body = data[start + 2 : start + size]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            frames += 1
            _check_jpeg_frame(marker, body, len(data), max_pixels)
        if marker == 0xDD:
            interval = struct.unpack(">H", body[:2].rjust(2, b"\0"))[0]
        start += size
        if marker == 0xDA:
            scans += 1
            start = _skip_jpeg_scan(data, start, interval)
    if frames != 1 or not 1 <= scans <= _MAX_SCANS:
        raise StructureError(f"it has {frames} pictures in {scans} scans")
    if data[start:].strip(b"\0\xff"):  # cameras pad what they send with zeros
        raise StructureError(f"{len(data) - start} bytes follow its end; does it hold several images?")


def _jpeg_marker(data: bytes, start: int) -> tuple[int, int]:
    if start >= len(data) or data[start] != 0xFF:
        raise StructureError(f"it is cut short or damaged: no marker at byte {start}")
    while start < len(data) and data[start] == 0xFF:
        start += 1
    if start >= len(data):
        raise StructureError("it is cut short: the marker of its end is missing")
    return start + 1, data[start]


def _check_jpeg_frame(marker: int, body: bytes, size: int, max_pixels: int) -> None:
    if marker not in (0xC0, 0xC1, 0xC2) or len(body) < 6 or len(body) != 6 + 3 * body[5]:
        raise StructureError(f"its frame header {marker:#04x} is not one of a baseline or progressive JPEG")
    height, width = struct.unpack_from(">HH", body, 1)
    if not 0 < width * height <= min(max_pixels, _JPEG_PIXELS_PER_BYTE * size):
        raise StructureError(f"{size} bytes cannot hold the {width}x{height} pixels that it claims")


def _skip_jpeg_scan(data: bytes, start: int, interval: int) -> int:
    """Return where the marker after a scan starts; restart markers must count 0 to 7 round, and only where stated."""
    expected = 0
    while True:
        start = data.find(b"\xff", start)
        if start < 0 or start + 1 >= len(data):
            raise StructureError("it is cut short: the marker of its end is missing")
        following = data[start + 1]
        if 0xD0 <= following <= 0xD7:
            if not interval or following - 0xD0 != expected % 8:
                raise StructureError(f"restart marker {following - 0xD0} comes out of turn: data are missing")
            expected += 1
        elif following not in (0x00, 0xFF):
            return start
        start += 1 if following == 0xFF else 2
