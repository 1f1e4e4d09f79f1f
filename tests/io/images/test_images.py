from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from pcdata.errors import CaptureError, DTypeError, NonFiniteError, ShapeError, UnitError
from pcdata.io import read_color, read_depth, read_labels, read_mask, write_color, write_depth

MILLIMETRES = np.array([[0, 500, 1000], [1234, 65534, 65535]], dtype=np.uint16)


def save(path: Path, array: np.ndarray) -> Path:
    np.save(path, array) if path.suffix == ".npy" else Image.fromarray(array).save(path)
    return path


@pytest.mark.parametrize("name", ["d.png", "d.PNG", "d.tiff", "d.npy"])
def test_sixteen_bit_depth_becomes_the_nearest_float_metres(tmp_path: Path, name: str) -> None:
    depth = read_depth(save(tmp_path / name, MILLIMETRES), metres_per_unit=0.001)
    assert depth.dtype == torch.float32
    assert depth.tolist() == (MILLIMETRES / 1000).astype(np.float32).tolist()


def test_big_endian_npy_reads_as_the_same_lengths(tmp_path: Path) -> None:
    big, little = save(tmp_path / "b.npy", MILLIMETRES.astype(">u2")), save(tmp_path / "l.npy", MILLIMETRES)
    assert torch.equal(read_depth(big, metres_per_unit=0.001), read_depth(little, metres_per_unit=0.001))


def test_invalid_values_become_no_reading_and_others_stay(tmp_path: Path) -> None:
    depth = read_depth(save(tmp_path / "d.png", MILLIMETRES), metres_per_unit=0.001, invalid_values=(65535,))
    assert (depth == 0).tolist() == [[True, False, False], [False, False, True]]
    with pytest.raises(CaptureError, match="invalid_values must lie in"):
        read_depth(tmp_path / "d.png", metres_per_unit=0.001, invalid_values=(-1,))


@pytest.mark.parametrize("dtype", [np.float32, np.float64, ">f4"])
def test_nan_and_infinity_in_float_depth_mean_no_reading(tmp_path: Path, dtype: object) -> None:
    raw = np.array([[np.nan, np.inf, -np.inf], [0.5, -0.0, 1.5]]).astype(dtype)  # type: ignore[arg-type]
    depth = read_depth(save(tmp_path / "d.npy", raw), metres_per_unit=1.0)
    assert depth.tolist() == [[0, 0, 0], [0.5, 0, 1.5]]
    assert not torch.signbit(depth).any()


def test_float_tiff_in_metres_is_read(tmp_path: Path) -> None:
    depth = read_depth(save(tmp_path / "d.tif", np.array([[0.5, 2.0]], np.float32)), metres_per_unit=1.0)
    assert depth.tolist() == [[0.5, 2.0]]


def test_float_millimetres_are_named_and_the_named_unit_reads_them(tmp_path: Path) -> None:
    path = save(tmp_path / "d.npy", np.linspace(500.0, 501.3, 600, dtype=np.float32).reshape(20, 30))
    with pytest.raises(UnitError, match=r"beyond 500.* m with metres_per_unit=1; .* fit metres_per_unit=0\.001 "):
        read_depth(path, metres_per_unit=1.0)
    depth = read_depth(path, metres_per_unit=0.001)
    assert depth[0, 0].item() == pytest.approx(0.5)


@pytest.mark.parametrize(("unit", "encoding"), [(0.001, "rotated"), (0.0001, "rotated"), (0.001, "swapped")])
def test_depth_whose_bits_are_out_of_order_is_put_in_order(tmp_path: Path, unit: float, encoding: str) -> None:
    units = np.array([[0, 1, 7, 8], [812, 8191, 8192, 20_001]], np.uint16)
    bits = (units << 3) | (units >> 13) if encoding == "rotated" else (units << 8) | (units >> 8)
    depth = read_depth(save(tmp_path / "d.png", bits), metres_per_unit=unit, depth_encoding=encoding)
    np.testing.assert_array_equal(depth.numpy(), (units * unit).astype(np.float32))


def test_a_mark_that_becomes_points_is_warned_of_and_a_wall_at_that_number_is_not(tmp_path: Path) -> None:
    ramp = np.linspace(700, 900, 4000).reshape(50, 80).astype(np.uint16)
    marked = np.where(ramp > 880, 65535, ramp).astype(np.uint16)
    with pytest.warns(UserWarning, match=r"hold 65535, .* points at 65\.535 m.* invalid_values=\[65535\]"):
        read_depth(save(tmp_path / "m.png", marked), metres_per_unit=0.001)
    read_depth(save(tmp_path / "m.png", marked), metres_per_unit=0.001, invalid_values=(65535,))
    read_depth(save(tmp_path / "w.png", np.clip(ramp + 3215, 0, 4095).astype(np.uint16)), metres_per_unit=0.001)


def test_an_unknown_order_of_bits_is_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "d.png", MILLIMETRES)
    with pytest.raises(UnitError, match="depth_encoding must be one of plain, rotated, swapped"):
        read_depth(path, metres_per_unit=0.001, depth_encoding="shifted")  # type: ignore[arg-type]


def test_negative_float_depth_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="1 pixels have negative depth, down to -1"):
        read_depth(save(tmp_path / "d.npy", np.array([[1.0, -1.0]], np.float32)), metres_per_unit=1.0)


@pytest.mark.parametrize("unit", [0, -0.001, float("nan"), float("inf"), 1000, 5000.0, True, "mm", None])
def test_a_unit_that_is_no_length_is_refused(tmp_path: Path, unit: object) -> None:
    path = save(tmp_path / "d.png", MILLIMETRES)
    with pytest.raises(UnitError, match=r"0\.001 for millimetres"):
        read_depth(path, metres_per_unit=unit)  # type: ignore[arg-type]


@pytest.mark.parametrize(("value", "unit", "word"), [(600, 1.0, "beyond"), (600, 1e-6, "within")])
def test_a_wrong_unit_shows_in_the_median_depth(tmp_path: Path, value: int, unit: float, word: str) -> None:
    path = save(tmp_path / "d.png", np.full((4, 4), value, np.uint16))
    with pytest.raises(
        UnitError, match=rf"{word} .* is metres_per_unit right\? the numbers fit .*metres_per_unit=0\.001 "
    ):
        read_depth(path, metres_per_unit=unit)


@pytest.mark.parametrize("raw", [np.zeros((3, 3), np.uint16), np.full((3, 3), np.nan, np.float32)])
def test_a_frame_without_any_reading_is_refused(tmp_path: Path, raw: np.ndarray) -> None:
    with pytest.raises(CaptureError, match="no pixel of 9 has a reading"):
        read_depth(save(tmp_path / "d.npy", raw), metres_per_unit=1.0)


@pytest.mark.parametrize(
    ("mode", "word"), [("L", "8-bit gray"), ("P", "palette"), ("RGB", "color"), ("RGBA", "alpha"), ("1", "1-bit")]
)
def test_pictures_of_depth_are_refused_as_depth(tmp_path: Path, mode: str, word: str) -> None:
    Image.new(mode, (4, 4)).save(tmp_path / "d.png")
    with pytest.raises(CaptureError, match=f"must be 16-bit gray, but this is an? .*{word}"):
        read_depth(tmp_path / "d.png", metres_per_unit=0.001)


@pytest.mark.parametrize(
    ("array", "word"),
    [
        (np.ones((2, 2, 3), np.uint16), "one image"),
        (np.ones((1, 2, 2), np.uint16), "one image"),
        (np.ones(4, np.uint16), "one image"),
        (np.ones((2, 2), np.int64), "uint16, float32 or float64"),
        (np.ones((2, 2), np.uint8), "uint16, float32 or float64"),
        (np.ones((2, 2), np.float16), "uint16, float32 or float64"),
        (np.ones((2, 2), complex), "uint16, float32 or float64"),
        (np.ones((0, 2), np.uint16), "not a readable|1 .. "),
    ],
)
def test_npy_that_is_not_one_depth_image_is_refused(tmp_path: Path, array: np.ndarray, word: str) -> None:
    with pytest.raises(CaptureError, match=word):
        read_depth(save(tmp_path / "d.npy", array), metres_per_unit=1.0)


def test_npy_with_pickled_objects_is_never_unpickled(tmp_path: Path) -> None:
    np.save(tmp_path / "d.npy", np.array([[{}]], dtype=object), allow_pickle=True)
    with pytest.raises(CaptureError, match=r"not a readable \.npy"):
        read_depth(tmp_path / "d.npy", metres_per_unit=1.0)


def test_npy_header_that_promises_more_than_the_file_holds_allocates_nothing(tmp_path: Path) -> None:
    with (tmp_path / "d.npy").open("wb") as stream:
        header = {"descr": "<f4", "fortran_order": False, "shape": (1 << 20, 1 << 20)}
        np.lib.format.write_array_header_1_0(stream, header)
        stream.write(b"\0" * 64)
    with pytest.raises(CaptureError, match=r"not a readable \.npy"):
        read_depth(tmp_path / "d.npy", metres_per_unit=1.0)


@pytest.mark.parametrize("name", ["d.png", "d.tiff", "d.npy"])
@given(cut=st.floats(0, 1), data=st.data())
@settings(max_examples=30, deadline=None)
def test_truncated_or_corrupted_depth_never_raises_an_untyped_error(
    tmp_path_factory: pytest.TempPathFactory, name: str, cut: float, data: st.DataObject
) -> None:
    folder = tmp_path_factory.mktemp("damaged")
    whole = bytearray(save(folder / name, np.full((32, 32), 800, np.uint16)).read_bytes())
    whole = whole[: int(cut * len(whole))]
    for _ in range(data.draw(st.integers(0, 3))):
        if whole:
            whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    (folder / name).write_bytes(whole)
    try:
        depth = read_depth(folder / name, metres_per_unit=0.001)
    except (CaptureError, UnitError):
        return
    assert bool(torch.isfinite(depth).all())


def png_claiming(width: int, height: int) -> bytes:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\0" * 9)) + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("side", [9000, 10_000, 100_000])
def test_decompression_bombs_are_refused_before_decoding(tmp_path: Path, side: int) -> None:
    (tmp_path / "d.png").write_bytes(png_claiming(side, side))
    with pytest.raises(CaptureError, match=r"pixels|bomb"):
        read_depth(tmp_path / "d.png", metres_per_unit=0.001)


def test_missing_empty_foreign_and_misnamed_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="no such file"):
        read_depth(tmp_path / "d.png", metres_per_unit=0.001)
    (tmp_path / "d.png").touch()
    with pytest.raises(CaptureError, match="is empty"):
        read_depth(tmp_path / "d.png", metres_per_unit=0.001)
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(CaptureError, match="it is a folder"):
        read_depth(tmp_path / "folder.png", metres_per_unit=0.001)
    with pytest.raises(CaptureError, match=r"must be one of \.png.*not '\.jp2'"):
        read_depth(tmp_path / "d.jp2", metres_per_unit=1.0)
    Image.new("L", (2, 2)).save(tmp_path / "j.jpg")
    (tmp_path / "j.jpg").rename(tmp_path / "j.png")
    with pytest.raises(CaptureError, match="not a readable PNG"):
        read_depth(tmp_path / "j.png", metres_per_unit=0.001)


def test_several_pages_in_a_tiff_are_refused(tmp_path: Path) -> None:
    page = Image.fromarray(MILLIMETRES)
    page.save(tmp_path / "d.tiff", save_all=True, append_images=[page])
    with pytest.raises(CaptureError, match="one image, but holds"):
        read_depth(tmp_path / "d.tiff", metres_per_unit=0.001)


@given(st.lists(st.integers(0, 65535), min_size=1, max_size=30), st.sampled_from([0.001, 0.0002, 0.0001, 0.00025]))
@settings(max_examples=50, deadline=None)
def test_written_depth_reads_back_bit_for_bit(
    tmp_path_factory: pytest.TempPathFactory, values: list[int], unit: float
) -> None:
    path = tmp_path_factory.mktemp("depth") / "d.png"
    depth = torch.from_numpy((np.array([[*values, 5000]], dtype=np.float64) * unit).astype(np.float32))
    write_depth(path, depth, metres_per_unit=unit)
    try:
        assert torch.equal(read_depth(path, metres_per_unit=unit), depth)
    except UnitError:
        assert float(depth[depth > 0].median()) < 0.02  # too near to be a frame


def test_depth_computed_in_float32_counts_as_whole_units(tmp_path: Path) -> None:
    depth = torch.arange(1, 65536, dtype=torch.float32).reshape(1, -1) * 0.001
    write_depth(tmp_path / "d.png", depth, metres_per_unit=0.001)
    with Image.open(tmp_path / "d.png") as opened:
        assert np.asarray(opened).ravel().tolist() == list(range(1, 65536))


def test_depth_that_would_not_survive_is_not_written(tmp_path: Path) -> None:
    path = tmp_path / "d.png"
    with pytest.raises(CaptureError, match="2 pixels of 3 are not whole multiples"):
        write_depth(path, torch.tensor([[0.5004, 0.0, 0.50051]]), metres_per_unit=0.001)
    with pytest.raises(CaptureError, match="larger metres_per_unit"):
        write_depth(path, torch.tensor([[66.0]]), metres_per_unit=0.001)
    with pytest.raises(CaptureError, match="must lie in 0"):
        write_depth(path, torch.tensor([[-1.0]]), metres_per_unit=0.001)
    with pytest.raises(CaptureError, match="would become 'no reading'"):
        write_depth(path, torch.tensor([[0.0004, 1.0]]), metres_per_unit=0.001, round_to_unit=True)
    with pytest.raises(NonFiniteError):
        write_depth(path, torch.tensor([[float("nan")]]), metres_per_unit=0.001)
    with pytest.raises(ShapeError):
        write_depth(path, torch.ones(1, 2, 2), metres_per_unit=0.001)
    with pytest.raises(CaptureError, match="does not exist"):
        write_depth(tmp_path / "absent" / "d.png", torch.ones(2, 2), metres_per_unit=0.001)
    assert list(tmp_path.iterdir()) == []


def test_rounding_on_request_errs_by_half_a_unit_at_most(tmp_path: Path) -> None:
    depth = torch.rand(20, 20, generator=torch.Generator().manual_seed(0)) + 0.3
    write_depth(tmp_path / "d.png", depth, metres_per_unit=0.001, round_to_unit=True)
    assert float((read_depth(tmp_path / "d.png", metres_per_unit=0.001) - depth).abs().max()) <= 0.0005 + 1e-6


def test_color_survives_a_round_trip_and_alpha_is_dropped(tmp_path: Path) -> None:
    colors = torch.randint(0, 256, (5, 7, 3), dtype=torch.uint8)
    write_color(tmp_path / "c.png", colors)
    assert torch.equal(read_color(tmp_path / "c.png"), colors)
    with_alpha = np.concatenate([colors.numpy(), np.full((5, 7, 1), 9, np.uint8)], axis=2)
    Image.fromarray(with_alpha, mode=None).save(tmp_path / "a.png")
    assert torch.equal(read_color(tmp_path / "a.png"), colors)
    with pytest.raises(DTypeError, match="uint8"):
        write_color(tmp_path / "f.png", colors.float())


@pytest.mark.parametrize(
    ("mode", "name"), [("L", "c.png"), ("P", "c.png"), ("L", "c.jpg"), ("CMYK", "c.jpg"), ("LA", "c.png")]
)
def test_images_without_three_colors_are_refused_as_color(tmp_path: Path, mode: str, name: str) -> None:
    Image.new(mode, (3, 3)).save(tmp_path / name)
    with pytest.raises(CaptureError, match="must be 8-bit RGB"):
        read_color(tmp_path / name)


def test_sixteen_bit_color_is_refused_though_pillow_would_cut_it_down(tmp_path: Path) -> None:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header, rows = struct.pack(">IIBBBBB", 2, 1, 16, 2, 0, 0, 0), b"\0" + bytes(range(12))
    data = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    (tmp_path / "c.png").write_bytes(b"\x89PNG\r\n\x1a\n" + data)
    with Image.open(tmp_path / "c.png") as opened:
        assert opened.mode == "RGB"  # the trap
    with pytest.raises(CaptureError, match="16-bit RGB"):
        read_color(tmp_path / "c.png")


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_labels_keep_their_ids(tmp_path: Path, dtype: type) -> None:
    ids = np.array([[0, 1, 88], [200, 255, np.iinfo(dtype).max]], dtype=dtype)
    labels = read_labels(save(tmp_path / "l.png", ids))
    assert labels.dtype == torch.int64
    assert labels.tolist() == ids.tolist()


def test_labels_of_a_palette_image_are_its_indices(tmp_path: Path) -> None:
    image = Image.fromarray(np.array([[0, 3], [2, 1]], np.uint8)).convert("P")
    image = Image.frombytes("P", (2, 2), bytes([0, 3, 2, 1]))
    image.putpalette([0, 0, 0, 255, 0, 0, 0, 255, 0, 0, 0, 255])
    image.save(tmp_path / "l.png")
    assert read_labels(tmp_path / "l.png").tolist() == [[0, 3], [2, 1]]


@pytest.mark.parametrize("mode", ["RGB", "1"])
def test_colors_and_masks_are_refused_as_labels(tmp_path: Path, mode: str) -> None:
    Image.new(mode, (3, 3)).save(tmp_path / "l.png")
    with pytest.raises(CaptureError, match="labels must be"):
        read_labels(tmp_path / "l.png")


@pytest.mark.parametrize("array", [np.array([[True, False]]), np.array([[7, 0]], np.uint8)])
def test_masks_are_true_wherever_they_are_not_zero(tmp_path: Path, array: np.ndarray) -> None:
    assert read_mask(save(tmp_path / "m.png", array)).tolist() == [[True, False]]


def test_color_is_refused_as_a_mask(tmp_path: Path) -> None:
    Image.new("RGB", (3, 3)).save(tmp_path / "m.png")
    with pytest.raises(CaptureError, match="1-bit or 8-bit gray"):
        read_mask(tmp_path / "m.png")
