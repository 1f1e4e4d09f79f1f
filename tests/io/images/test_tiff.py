"""Depth TIFFs of every kind that programs write are read as their numbers say, and those that cannot be are refused."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pcdata import open_source
from pcdata.errors import CaptureError
from pcdata.io import read_depth

SIZE = (37, 53)  # no whole number of tiles
MILLIMETRES = np.random.default_rng(0).integers(300, 3000, SIZE).astype(np.uint16)
MILLIMETRES[0, :5] = 0
METRES = np.where(MILLIMETRES > 0, MILLIMETRES / 1000, np.nan)
METRES[3, 4] = np.inf
WANTED = np.where(np.isfinite(METRES), METRES, 0.0)
FORMATS = {"u": 1, "i": 2, "f": 3}


def lzw(content: bytes) -> bytes:
    """Pack as literals alone, with a clear code before the codes grow to ten bits."""
    codes = [code for start in range(0, len(content), 200) for code in (256, *content[start : start + 200])]
    bits = "".join(f"{code:09b}" for code in (*codes, 257))
    return int(bits.ljust(-(-len(bits) // 8) * 8, "0"), 2).to_bytes(-(-len(bits) // 8), "big")


PACKINGS = {1: bytes, 5: lzw, 8: zlib.compress}


def tiff(image: np.ndarray, *, order: str = "<", packing: int = 1, tile: int = 0, **changed: tuple[int, ...]) -> bytes:
    """Write a TIFF by the specification: one strip, or tiles; ``t256=(1,)`` puts other values into an entry."""
    height, width = image.shape
    stored = image.astype(image.dtype.newbyteorder(order))
    if tile:
        padded = np.pad(stored, ((0, -height % tile), (0, -width % tile)))
        starts = [(row, at) for row in range(0, height, tile) for at in range(0, width, tile)]
        parts = [padded[row : row + tile, at : at + tile].tobytes() for row, at in starts]
    else:
        parts = [stored.tobytes()]
    packed = [PACKINGS[packing](part) for part in parts]
    places = [8 + sum(map(len, packed[:number])) for number in range(len(packed))]
    entries = {256: (width,), 257: (height,), 258: (image.itemsize * 8,), 259: (packing,), 262: (1,), 277: (1,)}
    entries |= {339: (FORMATS[image.dtype.kind],)}
    entries |= {322: (tile,), 323: (tile,), 324: tuple(places), 325: tuple(map(len, packed))} if tile else {}
    entries |= {} if tile else {273: tuple(places), 278: (height,), 279: tuple(map(len, packed))}
    entries |= {int(tag[1:]): values for tag, values in changed.items() if tag.startswith("t")}
    directory = 8 + sum(map(len, packed))
    longs = directory + 6 + 12 * len(entries)
    rows, apart = b"", b""
    for tag in sorted(entries):
        values = entries[tag]
        short = tag in (258, 259, 262, 277, 339, 317)
        kind, code = (3, "H") if short else (4, "I")
        content = struct.pack(f"{order}{len(values)}{code}", *values)
        if len(content) > 4:
            content, apart = struct.pack(order + "I", longs + len(apart)), apart + content
        rows += struct.pack(order + "HHI", tag, kind, len(values)) + content.ljust(4, b"\0")
    following = struct.pack(order + "I", changed.get("following", (0,))[0])
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", directory)
    return head + b"".join(packed) + struct.pack(order + "H", len(entries)) + rows + following + apart


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("packing", PACKINGS)
@pytest.mark.parametrize("tile", [0, 16])
def test_numbers_of_every_kind_order_and_packing_are_read(tmp_path: Path, order: str, packing: int, tile: int) -> None:
    for image, unit in ((MILLIMETRES, 0.001), (METRES.astype(np.float32), 1.0), (METRES, 1.0)):
        path = tmp_path / f"{image.dtype}.tiff"
        path.write_bytes(tiff(image, order=order, packing=packing, tile=tile))
        wanted = np.where(np.isposinf(METRES), MILLIMETRES / 1000, WANTED) if unit == 0.001 else WANTED
        assert np.array_equal(read_depth(path, metres_per_unit=unit).numpy(), wanted.astype(np.float32))


@pytest.mark.parametrize("predictor", [1, 2, 3])
@pytest.mark.parametrize("packing", [1, 5, 8])
def test_what_opencv_writes_is_read(tmp_path: Path, packing: int, predictor: int) -> None:
    cv2 = pytest.importorskip("cv2")
    options = [cv2.IMWRITE_TIFF_COMPRESSION, packing, cv2.IMWRITE_TIFF_PREDICTOR, predictor]
    for image in (METRES, METRES.astype(np.float32)):
        path = str(tmp_path / f"{image.dtype}.tiff")
        assert cv2.imwrite(path, image, options)
        assert np.array_equal(read_depth(path, metres_per_unit=1.0).numpy(), WANTED.astype(np.float32))
    if predictor != 3:  # of floating point alone
        path = str(tmp_path / "whole.tiff")
        assert cv2.imwrite(path, MILLIMETRES, options)
        assert np.allclose(read_depth(path, metres_per_unit=0.001), MILLIMETRES / 1000)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (tiff(MILLIMETRES.astype(np.int16)), "it holds int16; save depth as uint16, float32 or float64"),
        (tiff(MILLIMETRES.astype(np.uint32)), "it holds uint32"),
        (tiff(METRES.astype(np.float16)), "it holds float16"),
        (b"II+\0\x08\0\0\0" + bytes(40), "a BigTIFF, which is not read; save it as a TIFF"),
        (tiff(MILLIMETRES, following=(8 + MILLIMETRES.nbytes,)), "must hold one image, but holds several"),
        (tiff(MILLIMETRES, t330=(8 + MILLIMETRES.nbytes,)), "holds others inside it"),
        (tiff(MILLIMETRES, t256=(1 << 30,)), "must have 1 .. 67108864 pixels"),
        (tiff(METRES, t257=(0,)), "must have 1 .. 67108864 pixels"),
        (tiff(METRES, t256=(54,)), "a strip has 15688 bytes where the image size asks for 15984"),
        (tiff(METRES, tile=16, t322=(1 << 31,)), "its tiles claim"),
        (tiff(METRES, t274=(6,)), "is turned"),
        (tiff(METRES, tile=16, t317=(2,)), "save it without a predictor"),
        (tiff(METRES.astype(np.float32), order=">", tile=16, t317=(3,)), "save it without a predictor"),
        (tiff(METRES)[:-40], "cut short"),
        (tiff(METRES, t273=(1 << 31,)), "lies outside"),
    ],
)
def test_tiffs_that_are_no_depth_or_cannot_be_are_refused(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "a.tiff"
    path.write_bytes(content)
    with pytest.raises(CaptureError, match=r"a\.tiff") as caught:
        read_depth(path, metres_per_unit=0.001)
    assert words in str(caught.value)


def test_entries_that_share_their_bytes_are_refused_before_they_are_read(tmp_path: Path) -> None:
    number = 20_000
    rows = b"".join(struct.pack("<HHII", 1000 + at, 7, 240_000, 8) for at in range(number))
    path = tmp_path / "a.tiff"
    path.write_bytes(b"II*\0" + struct.pack("<IH", 8, number) + rows + bytes(4))
    with pytest.raises(CaptureError, match="lies outside the file"):
        read_depth(path, metres_per_unit=0.001)


@pytest.mark.parametrize(
    "image", [MILLIMETRES, METRES.astype(np.float32), METRES], ids=["uint16", "float32", "float64"]
)
def test_plain_folders_pairs_and_single_files_take_tiffs(tmp_path: Path, image: np.ndarray) -> None:
    unit = {"metres_per_unit": 0.001} if image.dtype == np.uint16 else {"metres_per_unit": 1.0}
    lens = (60.0, 60.0, 26.0, 18.0)
    content = tiff(image, order=">", packing=8, tile=16)
    colors = np.full((*SIZE, 3), 90, np.uint8)
    (tmp_path / "pairs").mkdir()
    (tmp_path / "pairs" / "depth_0.tiff").write_bytes(content)
    Image.fromarray(colors).save(tmp_path / "pairs" / "color_0.png")
    (tmp_path / "folder" / "depth").mkdir(parents=True)
    (tmp_path / "folder" / "depth" / "0.tif").write_bytes(content)
    stated = {"fx": 60.0, "fy": 60.0, "cx": 26.0, "cy": 18.0, "width": SIZE[1], "height": SIZE[0]}
    (tmp_path / "folder" / "intrinsics.json").write_text(json.dumps(stated))
    wanted = read_depth(tmp_path / "pairs" / "depth_0.tiff", **unit)
    for path, options in (
        ("pairs", {"intrinsics": lens}),
        ("pairs/depth_0.tiff", {"intrinsics": lens}),
        ("folder", {}),
    ):
        source = open_source(tmp_path / path, **options, **unit)
        frame = source.load(source.ids[0])
        assert np.array_equal(frame.depth[0], wanted)
    assert open_source(tmp_path / "pairs", intrinsics=lens, **unit).load("0").colors is not None
