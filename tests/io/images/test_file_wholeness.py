"""Damaged images: whatever chunks, checksums and sizes can tell is told, at every door."""

from __future__ import annotations

import io
import struct
import zlib

import numpy as np
import pytest
import torch
from PIL import Image

from pcdata.errors import CaptureError
from pcdata.io import read_color, read_confidence, read_depth, read_labels, read_mask

NUMBER = np.random.default_rng(0)
DEPTH = NUMBER.integers(500, 1500, (24, 32)).astype(np.uint16)
COLOR = NUMBER.integers(0, 256, (24, 32, 3)).astype(np.uint8)
LEVELS = NUMBER.integers(0, 4, (24, 32)).astype(np.uint8)

ADAM7 = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))

DOORS = {
    "depth": (DEPTH, lambda path: read_depth(path, metres_per_unit=0.001)),
    "color": (COLOR, read_color),
    "labels": (LEVELS, read_labels),
    "mask": (LEVELS, read_mask),
    "confidence": (LEVELS, read_confidence),
}


@pytest.fixture(params=DOORS)
def door(request):
    return DOORS[request.param]


def png(image: np.ndarray, **options) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "PNG", **options)
    return stream.getvalue()


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    found, start = [], 8
    while start < len(data):
        (size,) = struct.unpack_from(">I", data, start)
        found.append((data[start + 4 : start + 8], data[start + 8 : start + 8 + size]))
        start += 12 + size
    return found


def joined(parts: list[tuple[bytes, bytes]]) -> bytes:
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts)


def repacked(data: bytes, change) -> bytes:
    """The picture with other packed rows, in chunks whose checksums are right."""
    packed = b"".join(content for kind, content in chunks(data) if kind == b"IDAT")
    head, *_ = chunks(data)
    return joined([head, (b"IDAT", change(packed)), (b"IEND", b"")])


def refused(tmp_path, door, data: bytes, match: str) -> None:
    (tmp_path / "a.png").write_bytes(data)
    with pytest.raises(CaptureError, match=match):
        door[1](tmp_path / "a.png")


def test_every_flipped_bit_of_a_png_is_refused(tmp_path, door):
    whole = png(door[0])
    for position in sorted({*NUMBER.integers(8 * 8, 8 * len(whole), 60).tolist()}):
        data = bytearray(whole)
        data[position // 8] ^= 1 << (position % 8)
        refused(tmp_path, door, bytes(data), "a.png")


def test_a_png_that_ends_anywhere_is_refused(tmp_path, door):
    whole = png(door[0])
    for length in (9, 20, 33, 60, len(whole) // 2, len(whole) - 13, len(whole) - 12, len(whole) - 1):
        refused(tmp_path, door, whole[:length], "a.png")


def test_a_png_whose_rows_end_early_or_go_on_is_refused(tmp_path, door):
    whole = png(door[0])
    rows = zlib.decompress(b"".join(content for kind, content in chunks(whole) if kind == b"IDAT"))
    refused(tmp_path, door, repacked(whole, lambda _: zlib.compress(rows[: len(rows) // 2])), "unpack to")
    refused(tmp_path, door, repacked(whole, lambda _: zlib.compress(rows + bytes(10))), "unpack to more than")
    refused(tmp_path, door, repacked(whole, lambda packed: packed[:-6]), "no end|unpack to")
    refused(tmp_path, door, repacked(whole, lambda packed: packed[:-1] + bytes([packed[-1] ^ 1])), "damaged")
    refused(tmp_path, door, repacked(whole, lambda packed: packed + b"more"), "follow its packed")


def test_png_chunks_must_make_one_picture(tmp_path, door):
    whole = png(door[0])
    parts = chunks(whole)
    refused(tmp_path, door, whole + b"more", "follow its end")
    refused(tmp_path, door, joined(parts[:-1]), "end chunk is missing")
    refused(tmp_path, door, joined([parts[0], *parts]), "one header")
    refused(tmp_path, door, joined([parts[0], parts[-1]]), "image data are missing")
    refused(tmp_path, door, joined([parts[0], (b"acTL", bytes(8)), *parts[1:]]), "animation")
    refused(tmp_path, door, joined([parts[0], (b"NOPE", b""), *parts[1:]]), "not known")
    refused(tmp_path, door, joined([*parts[:-1], (b"tEXt", b"a\0b"), parts[-2], parts[-1]]), "not in one row")


def test_a_png_of_huge_size_is_refused_before_it_is_unpacked(tmp_path, door):
    parts = chunks(png(door[0]))
    for width, height in ((1 << 30, 1 << 30), (1, (1 << 26) + 1), (0, 10)):
        head = struct.pack(">II", width, height) + parts[0][1][8:]
        refused(tmp_path, door, joined([(b"IHDR", head), *parts[1:]]), "pixels")


def test_text_chunks_that_unpack_without_bound_are_never_unpacked(tmp_path):
    parts = chunks(png(DEPTH))
    bomb = b"Comment\0\0" + zlib.compress(bytes(1 << 28))
    (tmp_path / "a.png").write_bytes(joined([parts[0], (b"zTXt", bomb), (b"iCCP", bomb), *parts[1:]]))
    assert read_depth(tmp_path / "a.png", metres_per_unit=0.001).shape == DEPTH.shape


@pytest.mark.parametrize("interlaced", [False, True])
@pytest.mark.parametrize("size", [(1, 1), (1, 5), (5, 1), (3, 3), (8, 8), (9, 17)])
def test_whole_pngs_are_read_as_before(tmp_path, size, interlaced):
    image = NUMBER.integers(500, 1500, size).astype(np.uint16)
    if interlaced:  # written by hand: Pillow does not write Adam7
        rows = b""
        for x, y, dx, dy in ADAM7:
            part = image[y::dy, x::dx]
            rows += b"".join(b"\0" + row.astype(">u2").tobytes() for row in part) if part.size else b""
        head = struct.pack(">IIBBBBB", size[1], size[0], 16, 0, 0, 0, 1)
        data = joined([(b"IHDR", head), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")])
    else:
        data = png(image)
    (tmp_path / "a.png").write_bytes(data)
    read = read_depth(tmp_path / "a.png", metres_per_unit=0.001)
    assert torch.equal((read * 1000).round().int(), torch.from_numpy(image.astype(np.int32)))


def test_palettes_bits_and_alpha_are_read_as_before(tmp_path):
    indexed = Image.fromarray(LEVELS).convert("P")
    indexed.putpalette([value for level in range(4) for value in (level, 9 * level, 250)])
    indexed.save(tmp_path / "p.png", transparency=0)
    assert read_labels(tmp_path / "p.png").tolist() == np.asarray(indexed).tolist()
    Image.fromarray(LEVELS > 1).save(tmp_path / "b.png")
    assert read_mask(tmp_path / "b.png").tolist() == (LEVELS > 1).tolist()
    Image.fromarray(np.dstack([COLOR, COLOR[..., :1]])).save(tmp_path / "a.png")
    assert read_color(tmp_path / "a.png").tolist() == COLOR.tolist()


@pytest.mark.parametrize("options", [{}, {"progressive": True}, {"restart_marker_blocks": 2}, {"subsampling": 2}])
def test_a_jpeg_cut_anywhere_is_refused_and_the_whole_one_is_read(tmp_path, options):
    Image.fromarray(COLOR).save(tmp_path / "a.jpg", **options)
    whole = (tmp_path / "a.jpg").read_bytes()
    assert read_color(tmp_path / "a.jpg").tolist() == np.asarray(Image.open(tmp_path / "a.jpg")).tolist()
    for padding in (b"\0\0\0", b"\xff"):  # cameras pad their frames
        (tmp_path / "a.jpg").write_bytes(whole + padding)
        assert read_color(tmp_path / "a.jpg").shape == COLOR.shape
    for data in (*(whole[:n] for n in (1, 2, 30, len(whole) // 2, len(whole) - 2, len(whole) - 1)), whole + whole):
        (tmp_path / "a.jpg").write_bytes(data)
        with pytest.raises(CaptureError, match=r"a\.jpg"):
            read_color(tmp_path / "a.jpg")


def test_a_jpeg_that_lost_a_span_between_restart_markers_is_refused(tmp_path):
    Image.fromarray(COLOR).save(tmp_path / "a.jpg", restart_marker_blocks=1)
    whole = (tmp_path / "a.jpg").read_bytes()
    lost = whole[: whole.index(b"\xff\xd1")] + whole[whole.index(b"\xff\xd2") :]
    (tmp_path / "a.jpg").write_bytes(lost)
    with pytest.raises(CaptureError, match="out of turn"):
        read_color(tmp_path / "a.jpg")


def test_a_small_jpeg_cannot_claim_millions_of_pixels(tmp_path):
    Image.fromarray(COLOR).save(tmp_path / "a.jpg")
    data = bytearray((tmp_path / "a.jpg").read_bytes())
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = struct.pack(">HH", 8000, 8000)
    (tmp_path / "a.jpg").write_bytes(data)
    with pytest.raises(CaptureError, match="cannot hold"):
        read_color(tmp_path / "a.jpg")


@pytest.mark.parametrize("compression", [None, "tiff_adobe_deflate", "tiff_lzw", "packbits"])
@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_tiffs_are_read_as_before_and_refused_when_their_strips_do_not_fit(tmp_path, compression, dtype):
    image = DEPTH if dtype == np.uint16 else (DEPTH / 1000).astype(np.float32)
    unit = 0.001 if dtype == np.uint16 else 1.0
    path = tmp_path / "a.tiff"
    Image.fromarray(image).save(path, compression=compression)
    whole = path.read_bytes()
    assert np.allclose(read_depth(path, metres_per_unit=unit).numpy(), DEPTH / 1000)
    with Image.open(path) as opened:
        counts, height = opened.tag_v2[279], opened.tag_v2[257]
    shorter = [] if compression in ("tiff_lzw", "packbits") else [(height, 1)]  # which do not say how much they hold
    for old, new in ((counts[0], counts[0] * 2), (height, height * 2), *shorter):
        for kind, size in ((b"\x04\0", 4), (b"\x03\0", 2)):
            before = old.to_bytes(size, "little")
            for tag in (279, 257):
                entry = tag.to_bytes(2, "little") + kind + (1).to_bytes(4, "little") + before
                if entry in whole:
                    path.write_bytes(whole.replace(entry, entry[: -len(before)] + new.to_bytes(size, "little")))
                    with pytest.raises(CaptureError, match=r"a\.tiff"):
                        read_depth(path, metres_per_unit=unit)
    path.write_bytes(whole[: len(whole) - 3])
    with pytest.raises(CaptureError, match=r"a\.tiff"):
        read_depth(path, metres_per_unit=unit)


def test_a_tiff_of_several_pages_is_refused(tmp_path):
    first = Image.fromarray(DEPTH)
    first.save(tmp_path / "a.tiff", save_all=True, append_images=[Image.fromarray(DEPTH)])
    with pytest.raises(CaptureError, match="one image"):
        read_depth(tmp_path / "a.tiff", metres_per_unit=0.001)
