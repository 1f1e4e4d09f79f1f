from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import strategies as st

from pcdata.errors import CaptureError, NonFiniteError, UnitError
from pcdata.io import read_pcd, write_pcd
from pcdata.io.clouds import lzf
from pcdata.structures import Kind, PointCloud
from tests.messages import told
from tests.written_clouds import check_damaged, each_damage

ENCODINGS = ["ascii", "binary", "binary_compressed"]


def header(fields: Sequence[tuple[str, str, int, int]], num_points: int, encoding: str, **changes: str | None) -> bytes:
    lines: dict[str, str | None] = {
        "VERSION": "0.7",
        "FIELDS": " ".join(f[0] for f in fields),
        "SIZE": " ".join(str(f[2]) for f in fields),
        "TYPE": " ".join(f[1] for f in fields),
        "COUNT": " ".join(str(f[3]) for f in fields),
        "WIDTH": str(num_points),
        "HEIGHT": "1",
        "VIEWPOINT": "0 0 0 1 0 0 0",
        "POINTS": str(num_points),
    } | changes
    lines = {**lines, "DATA": lines.pop("DATA", encoding)}
    text = "# .PCD v0.7\n" + "".join(f"{key} {value}\n" for key, value in lines.items() if value is not None)
    return text.encode()


def pcd(
    fields: Sequence[tuple[str, str, int, int]], columns: Sequence[Any], encoding: str, **changes: str | None
) -> bytes:
    """A file written here by hand, independent of the library's writer."""
    codes = {"I": "i", "U": "u", "F": "f"}
    arrays = [
        np.asarray(column, dtype=f"<{codes[kind]}{size}").reshape(-1, count)
        for (_, kind, size, count), column in zip(fields, columns, strict=True)
    ]
    if encoding == "ascii":
        body = "".join(
            " ".join(repr(v) for array in arrays for v in array[row].tolist()) + "\n" for row in range(len(arrays[0]))
        ).encode()
    elif encoding == "binary":
        body = b"".join(array[row].tobytes() for row in range(len(arrays[0])) for array in arrays)
    else:
        raw = b"".join(array.tobytes() for array in arrays)
        packed = lzf.compress(raw)
        body = struct.pack("<II", len(packed), len(raw)) + packed
    return header(fields, len(arrays[0]), encoding, **changes) + body


XYZ = [("x", "F", 4, 1), ("y", "F", 4, 1), ("z", "F", 4, 1)]
COORDINATES = np.array([[0.1, 0.2, 0.3], [-1.0, 2.0, 3.5], [0.0, 0.0, 1.0]], dtype=np.float32)


def write(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_every_field_lands_where_its_name_says(tmp_path: Path, encoding: str) -> None:
    fields = [
        ("label", "U", 4, 1), *XYZ, ("_", "U", 1, 3), ("rgba", "U", 4, 1), ("normal_x", "F", 4, 1),
        ("normal_y", "F", 4, 1), ("normal_z", "F", 4, 1), ("curvature", "F", 8, 1), ("fpfh", "F", 4, 5),
        ("ring", "U", 2, 1), ("big", "U", 4, 1), ("tiny", "I", 1, 2), ("stamp", "I", 8, 1),
    ]  # fmt: skip
    fpfh = np.arange(15, dtype=np.float32).reshape(3, 5)
    columns = [
        [7, 0, 29], *COORDINATES.T, np.zeros((3, 3)), [0xFF102030, 0x00FF0001, 0x80000000], [0, 0, 1], [0, 1, 0],
        [1, 0, 0], [0.1, 0.2, 0.3], fpfh, [1, 2, 65535], [0, 1, 4294967295], [[-1, 1], [-128, 127], [0, 0]],
        [2**62, -(2**62), 2**53 + 1],
    ]  # fmt: skip
    cloud = read_pcd(write(tmp_path / "c.pcd", pcd(fields, columns, encoding)), frame_id="base")
    assert cloud.frame_id == "base"
    assert np.array_equal(cloud.points.numpy(), COORDINATES)
    assert cloud.labels is not None
    assert cloud.labels.tolist() == [7, 0, 29]
    assert cloud.colors is not None
    expected = torch.tensor([[0x10, 0x20, 0x30], [0xFF, 0, 1], [0, 0, 0]]) / 255
    assert torch.equal(cloud.colors, expected)
    assert cloud.normals is not None
    assert cloud.normals.tolist() == [[0, 0, 1], [0, 1, 0], [1, 0, 0]]
    assert cloud.extra["curvature"].tolist() == [0.1, 0.2, 0.3]
    assert cloud.extra["fpfh"].tolist() == fpfh.tolist()
    assert cloud.extra["ring"].tolist() == [1, 2, 65535]
    assert cloud.extra["big"].tolist() == [0, 1, 4294967295]
    assert cloud.extra["tiny"].tolist() == [[-1, 1], [-128, 127], [0, 0]]
    assert cloud.extra["stamp"].tolist() == [2**62, -(2**62), 2**53 + 1]
    assert set(cloud.kinds.values()) == {Kind.INVARIANT}
    assert "_" not in cloud.extra


@pytest.mark.parametrize("encoding", ["binary", "binary_compressed"])
def test_rgb_as_float_bits_gives_the_same_colors_as_rgba_integers(tmp_path: Path, encoding: str) -> None:
    bits = np.array([0x00102030, 0x7FC00001, 0xFFFFFFFF], dtype=np.uint32)  # the last two are NaN patterns
    as_float = pcd([*XYZ, ("rgb", "F", 4, 1)], [*COORDINATES.T, bits.view(np.float32)], encoding)
    as_int = pcd([*XYZ, ("rgba", "U", 4, 1)], [*COORDINATES.T, bits], encoding)
    floats, ints = (read_pcd(write(tmp_path / "c.pcd", data)).colors for data in (as_float, as_int))
    assert floats is not None
    assert ints is not None
    assert torch.equal(floats, ints)
    assert (ints * 255).round().int().tolist() == [[16, 32, 48], [192, 0, 1], [255, 255, 255]]


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_rows_without_a_reading_are_dropped_and_source_index_keeps_the_pixel(tmp_path: Path, encoding: str) -> None:
    nan, inf = np.nan, np.inf
    x, y, z = [0.0, nan, 1.0, 2.0, 3.0, 4.0], [0.0, nan, 1.0, inf, 3.0, 4.0], [1.0, nan, nan, 1.0, 1.0, 1.0]
    data = pcd([*XYZ, ("label", "I", 4, 1)], [x, y, z, range(6)], encoding, WIDTH="3", HEIGHT="2")
    cloud = read_pcd(write(tmp_path / "c.pcd", data))
    assert cloud.source_index is not None
    assert cloud.source_index.tolist() == [0, 4, 5]
    assert cloud.labels is not None
    assert cloud.labels.tolist() == [0, 4, 5]
    assert cloud.points[:, 0].tolist() == [0, 3, 4]
    assert cloud.meta[0]["organized_size"] == [2, 3]


@pytest.mark.parametrize("seen", ["plainly", "moved", "bent", "behind", "in one row"])
def test_an_organized_file_lies_on_the_image_that_its_points_prove(tmp_path: Path, seen: str) -> None:
    height, width = (10, 24) if seen != "in one row" else (240, 1)
    row, column = np.divmod(np.arange(height * width), width)
    depth = 1 + 0.2 * np.sin(column) + 0.01 * row
    x, y = (column - 11.3) / 30 * depth, (row - 4.2) / 40 * depth
    depth[7] = np.nan
    if seen == "moved":
        x = x + 0.05
    elif seen == "bent":
        x = x * (1 + 0.5 * (x / depth) ** 2)
    elif seen == "behind":
        x, y, depth = -x, -y, -depth
    file = write(tmp_path / "c.pcd", pcd(XYZ, [x, y, depth], "binary", WIDTH=str(width), HEIGHT=str(height)))
    cloud = read_pcd(file)
    assert (cloud.layout is not None) == (seen == "plainly")
    if cloud.layout is not None:
        assert cloud.layout.size == (10, 24)
        expected = torch.tensor([[[30, 0, 11.3], [0, 40, 4.2], [0, 0, 1]]], dtype=torch.float64)
        torch.testing.assert_close(cloud.layout.intrinsics, expected, atol=1e-4, rtol=0)


def test_the_sensor_position_and_orientation_are_kept(tmp_path: Path) -> None:
    data = pcd(XYZ, COORDINATES.T, "binary", VIEWPOINT="0.5 -1 2 0 1 0 0")
    cloud = read_pcd(write(tmp_path / "c.pcd", data))
    assert cloud.viewpoint is not None
    assert cloud.viewpoint.tolist() == [[0.5, -1, 2]]
    assert cloud.meta[0]["viewpoint"] == [0.5, -1, 2, 0, 1, 0, 0]
    write_pcd(tmp_path / "again.pcd", cloud)
    assert read_pcd(tmp_path / "again.pcd").meta[0]["viewpoint"] == [0.5, -1, 2, 0, 1, 0, 0]


def test_optional_header_lines_may_be_absent_and_lines_may_end_in_crlf(tmp_path: Path) -> None:
    data = pcd(XYZ, COORDINATES.T, "ascii", COUNT=None, HEIGHT=None, VIEWPOINT=None, POINTS=None, VERSION=".7")
    cloud = read_pcd(write(tmp_path / "c.pcd", data.replace(b"\n", b"\r\n")))
    assert np.array_equal(cloud.points.numpy(), COORDINATES)


def test_clouds_in_millimetres_are_noticed_and_converted_on_request(tmp_path: Path) -> None:
    path = write(tmp_path / "c.pcd", pcd(XYZ, (COORDINATES * 1000).T, "binary", VIEWPOINT="0 0 500 1 0 0 0"))
    with pytest.raises(UnitError, match=r"metres_per_unit=0\.001 if these are millimetres"):
        read_pcd(path)
    cloud = read_pcd(path, metres_per_unit=0.001)
    assert np.allclose(cloud.points.numpy(), COORDINATES, atol=1e-6)
    assert cloud.viewpoint is not None
    assert cloud.viewpoint.tolist() == [[0, 0, 0.5]]
    assert read_pcd(path, metres_per_unit=1.0).points[1, 1] == 2000


def test_coordinates_that_float32_would_blur_are_refused(tmp_path: Path) -> None:
    fields = [(name, "F", 8, 1) for name in "xyz"]
    far = COORDINATES.astype(np.float64) + np.array([500_000.123, 0, 0])
    with pytest.raises(CaptureError, match="subtract a common offset"):
        read_pcd(write(tmp_path / "c.pcd", pcd(fields, far.T, "binary")), metres_per_unit=1.0)
    near = read_pcd(write(tmp_path / "c.pcd", pcd(fields, COORDINATES.astype(np.float64).T, "binary")))
    assert np.array_equal(near.points.numpy(), COORDINATES)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"POINTS": "1000000000000"}, "must equal POINTS"),
        ({"POINTS": "100000000", "WIDTH": "100000000"}, "truncated|must follow|unpack to"),
        ({"WIDTH": "2"}, "WIDTH 2 x HEIGHT 1 must equal POINTS"),
        ({"POINTS": "2", "WIDTH": "2"}, "header or data are wrong|must follow|unpack to"),
        ({"WIDTH": "-3"}, "WIDTH must be one whole number"),
        ({"WIDTH": "9" * 5000}, "WIDTH must be one whole number"),
        ({"FIELDS": "x y"}, "must be equally long"),
        ({"FIELDS": "x y y"}, "listed twice"),
        ({"FIELDS": "a b c"}, "x, y and z are needed"),
        ({"FIELDS": None}, "FIELDS is missing"),
        ({"SIZE": None}, "SIZE is missing"),
        ({"TYPE": "F F Q"}, "TYPE Q SIZE 4"),
        ({"SIZE": "4 4 2"}, "TYPE F SIZE 2"),
        ({"COUNT": "1 1 0"}, "COUNT of field 'z' must be"),
        ({"COUNT": "1 1 2"}, "."),
        ({"COUNT": "1 1 99999999"}, "COUNT of field"),
        ({"VERSION": "0.5"}, "version"),
        ({"VIEWPOINT": "0 0 0"}, "VIEWPOINT must be seven"),
        ({"VIEWPOINT": "0 0 nan 1 0 0 0"}, "VIEWPOINT must be seven"),
        ({"DATA": "binary_zip"}, "DATA must be one of"),
        ({"FEILDS": "x"}, "unknown header line.*did you mean 'FIELDS'"),
    ],
)
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_header_that_contradicts_itself_or_the_data_is_refused(
    tmp_path: Path, encoding: str, changes: dict[str, str | None], message: str
) -> None:
    path = write(tmp_path / "c.pcd", pcd(XYZ, COORDINATES.T, encoding, **changes))
    with pytest.raises(CaptureError, match=message) as caught:
        read_pcd(path)
    assert "c.pcd" in told(caught.value)


def test_compressed_lengths_are_checked_before_anything_is_allocated(tmp_path: Path) -> None:
    n = 1 << 28
    body = struct.pack("<II", 10, (n * 12) & 0xFFFFFFFF) + b"\0" * 10
    with pytest.raises(CaptureError, match=r"can yield at most|unpack to"):
        read_pcd(write(tmp_path / "c.pcd", header(XYZ, n, "binary_compressed") + body))
    body = struct.pack("<II", 1000, 36) + b"\0" * 10
    with pytest.raises(CaptureError, match="truncated"):
        read_pcd(write(tmp_path / "c.pcd", header(XYZ, 3, "binary_compressed") + body))
    with pytest.raises(CaptureError, match="two lengths"):
        read_pcd(write(tmp_path / "c.pcd", header(XYZ, 3, "binary_compressed") + b"\0"))


@pytest.mark.parametrize(
    ("line", "message"),
    [("1 2 x", "must be numbers"), ("1 2", "must follow"), ("1 2 3 4", "must follow"), ("", "must follow")],
)
def test_damaged_ascii_rows_are_refused(tmp_path: Path, line: str, message: str) -> None:
    data = header(XYZ, 2, "ascii") + f"0 0 1\n{line}\n".encode()
    with pytest.raises(CaptureError, match=message):
        read_pcd(write(tmp_path / "c.pcd", data))


@pytest.mark.parametrize("word", ["-1", "256", "1.5", "nan"])
def test_ascii_values_that_their_type_cannot_hold_are_refused(tmp_path: Path, word: str) -> None:
    data = header([*XYZ, ("ring", "U", 1, 1)], 1, "ascii") + f"0 0 1 {word}\n".encode()
    with pytest.raises(CaptureError, match="ring: values must be numbers of type uint8"):
        read_pcd(write(tmp_path / "c.pcd", data))


def test_a_file_without_any_finite_point_is_refused_but_an_empty_file_is_empty(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="none of the 3 points"):
        read_pcd(write(tmp_path / "c.pcd", pcd(XYZ, np.full((3, 3), np.nan), "binary")))
    for encoding in ENCODINGS:
        assert read_pcd(write(tmp_path / "c.pcd", pcd(XYZ, np.zeros((3, 0)), encoding))).num_points == 0


@each_damage(ENCODINGS)
def test_damaged_files_never_raise_an_untyped_error(
    tmp_path_factory: pytest.TempPathFactory, encoding: str, data: st.DataObject
) -> None:
    fields = [*XYZ, ("rgb", "U", 4, 1), ("label", "U", 4, 1)]
    whole = pcd(fields, [*COORDINATES.T, [1, 2, 3], [1, 2, 3]], encoding)
    check_damaged(data, whole, tmp_path_factory.mktemp("damaged") / "c.pcd", read_pcd)


# -- writing -----------------------------------------------------------------------------------------------------------


def test_what_the_format_cannot_hold_is_not_written(tmp_path: Path) -> None:
    points = torch.ones(2, 3)
    single = PointCloud(points=points, frame_id="camera")
    path = tmp_path / "c.pcd"
    with pytest.raises(CaptureError, match="something else"):
        write_pcd(path, single.with_extra("rgb", points, Kind.INVARIANT))
    with pytest.raises(CaptureError, match="colors must lie in"):
        write_pcd(path, PointCloud(points=points, frame_id="camera", colors=points * 255))
    with pytest.raises(NonFiniteError):
        write_pcd(path, PointCloud(points=points * torch.nan, frame_id="camera"))
    with pytest.raises(CaptureError, match="did you mean 'binary"):
        write_pcd(path, single, encoding="binari")
    assert list(tmp_path.iterdir()) == []


# -- Open3D as the oracle ----------------------------------------------------------------------------------------------


@pytest.mark.open3d
@pytest.mark.parametrize(("ascii_", "compressed"), [(True, False), (False, False), (False, True)])
def test_what_open3d_writes_is_read_here(tmp_path: Path, ascii_: bool, compressed: bool) -> None:
    o3d = pytest.importorskip("open3d")
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 3)).astype(np.float32)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    colors = rng.integers(0, 256, (500, 3)) / 255
    cloud.colors = o3d.utility.Vector3dVector(colors)
    cloud.normals = o3d.utility.Vector3dVector(points / np.linalg.norm(points, axis=1, keepdims=True))
    assert o3d.io.write_point_cloud(str(tmp_path / "c.pcd"), cloud, write_ascii=ascii_, compressed=compressed)
    found = read_pcd(tmp_path / "c.pcd")
    tolerance = 1e-9 if not ascii_ else 1e-4  # Open3D writes few digits
    assert np.allclose(found.points.numpy(), points, atol=tolerance)
    assert found.normals is not None
    assert np.allclose(found.normals.numpy(), np.asarray(cloud.normals), atol=max(tolerance, 1e-7))
    assert found.colors is not None
    assert np.allclose(found.colors.numpy(), colors, atol=1.01 / 255)


@pytest.mark.open3d
def test_real_clouds_equal_what_open3d_reads(test_data: Path) -> None:
    o3d = pytest.importorskip("open3d")
    learning_scenes = [f"osd/learn{number}.pcd" for number in (0, 8, 16, 17, 24, 25, 32, 33, 44)]
    for name in (*learning_scenes, "pcd/milk_cartoon_all_small_clorox.pcd", "pcd/table_scene_mug_stereo_textured.pcd"):
        file = test_data / name
        expected = o3d.io.read_point_cloud(str(file), remove_nan_points=True, remove_infinite_points=True)
        found = read_pcd(file)
        assert np.array_equal(found.points.numpy(), np.asarray(expected.points)), file
        assert found.colors is not None
        assert np.array_equal((found.colors * 255).round().numpy(), np.rint(np.asarray(expected.colors) * 255)), file
        assert found.meta[0]["organized_size"] == [480, 640]


def test_real_labels_are_those_of_the_readme(test_data: Path) -> None:
    cloud = read_pcd(test_data / "osd" / "learn0.pcd")
    assert cloud.labels is not None
    labels = set(cloud.labels.unique().tolist())
    assert labels & set(range(1, 10))  # the table
    assert labels & set(range(20, 30))  # the first object
    assert cloud.source_index is not None
    assert int(cloud.source_index.max()) < 480 * 640
    assert cloud.layout is not None  # of a Kinect
    assert abs(float(cloud.layout.intrinsics[0, 0, 0]) - 525) < 0.01
    # A pixel's column and row agree with its direction: right of the center x > 0, below it y > 0.
    column, row = cloud.source_index % 640, cloud.source_index // 640
    assert bool((cloud.points[column > 400, 0] > 0).all())
    assert bool((cloud.points[row > 320, 1] > 0).all())
