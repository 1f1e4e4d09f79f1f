"""What is written as PLY and PCD is read by other programs' readers, by the names and types that they expect."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from pcdata.errors import CaptureError
from pcdata.io import read_pcd, read_ply, write_pcd, write_ply
from pcdata.structures import PointCloud, SurfaceMesh
from tests.io.libraries.clouds import full_cloud

PLY_ENCODINGS = ("binary", "binary_big_endian", "ascii")
PCD_ENCODINGS = ("ascii", "binary", "binary_compressed")
KEPT = (
    "points",
    "colors",
    "normals",
    "labels",
    "confidence",
    "view",
    "score",
    "feature",
    "column",
    "approach",
    "inside",
)


def check_comes_back(found: PointCloud, cloud: PointCloud) -> None:
    for name in KEPT:
        assert torch.equal(found.fields()[name], cloud.fields()[name]), name
    assert {*found.fields()} == {*KEPT, "source_index"}
    assert found.frame_id == cloud.frame_id


@pytest.mark.parametrize("encoding", PLY_ENCODINGS)
@pytest.mark.parametrize("num_points", [30, 1, 0])
def test_names_of_scalars_and_a_quality_change_nothing_of_what_is_read_back(tmp_path, encoding, num_points):
    cloud = full_cloud(num_points)
    path = tmp_path / "cloud.ply"
    write_ply(path, cloud, encoding=encoding, scalar_names=True, quality="labels")
    check_comes_back(read_ply(path), cloud)
    write_ply(path, cloud, encoding=encoding, quality="confidence")
    check_comes_back(read_ply(path), cloud)


def test_a_mesh_has_them_too(tmp_path):
    surface = SurfaceMesh(vertices=full_cloud(4), triangles=torch.tensor([[0, 1, 2], [0, 2, 3]]))
    write_ply(tmp_path / "mesh.ply", surface, scalar_names=True, quality="labels")
    check_comes_back(read_ply(tmp_path / "mesh.ply"), surface.vertices)


def test_a_quality_that_cannot_be_one_is_refused(tmp_path):
    cloud = full_cloud()
    for name in ("points", "feature", "label", ""):
        with pytest.raises(CaptureError, match=r"one value a point.*labels, confidence, view, score, inside"):
            write_ply(tmp_path / "cloud.ply", cloud, quality=name)
    own = cloud.with_extra("quality", torch.zeros(40), "invariant")
    with pytest.raises(CaptureError, match="'quality' already"):
        write_ply(tmp_path / "cloud.ply", own, quality="labels")
    assert list(tmp_path.iterdir()) == []
    write_ply(tmp_path / "cloud.ply", own)
    assert torch.equal(read_ply(tmp_path / "cloud.ply").extra["quality"], torch.zeros(40))


def test_names_that_a_program_put_a_prefix_before_are_those_of_the_file(tmp_path):
    # CloudCompare writes every scalar field as scalar_NAME.
    cloud = full_cloud()
    write_ply(tmp_path / "plain.ply", cloud, encoding="ascii")
    text = (tmp_path / "plain.ply").read_text()
    for name in ("label", "confidence", "view", "feature_0", "feature_1", "feature_2", "feature_3"):
        text = text.replace(f" {name}\n", f" scalar_{name}\n")
    (tmp_path / "renamed.ply").write_text(text)
    check_comes_back(read_ply(tmp_path / "renamed.ply"), cloud)


@pytest.mark.parametrize("encoding", PLY_ENCODINGS)
@pytest.mark.parametrize("scalar_names", [False, True])
def test_plyfile_reads_every_column(tmp_path, encoding, scalar_names):
    plyfile = pytest.importorskip("plyfile")
    cloud = full_cloud()
    surface = SurfaceMesh(vertices=cloud, triangles=torch.tensor([[0, 1, 2], [5, 8, 39]]))
    path = tmp_path / "cloud.ply"
    write_ply(path, surface, encoding=encoding, scalar_names=scalar_names, quality="score")
    data = plyfile.PlyData.read(str(path))
    vertex, prefix = data["vertex"], "scalar_" if scalar_names else ""
    for name, values in zip(("x", "y", "z"), cloud.points.T.numpy(), strict=True):
        assert vertex[name].dtype.newbyteorder("=") == np.float32
        assert np.array_equal(vertex[name], values)
    for name, values in zip(("red", "green", "blue"), (cloud.colors.T * 255).round().numpy(), strict=True):
        assert vertex[name].dtype == np.uint8
        assert np.array_equal(vertex[name], values)
    for name, values in zip(("nx", "ny", "nz"), cloud.normals.T.numpy(), strict=True):
        assert np.array_equal(vertex[name], values)
    assert np.array_equal(vertex[f"{prefix}label"], cloud.labels.numpy())
    assert np.array_equal(vertex[f"{prefix}confidence"], cloud.extra["confidence"].numpy())
    assert np.array_equal(vertex[f"{prefix}view"], cloud.extra["view"].numpy())
    assert np.array_equal(vertex[f"{prefix}score"], cloud.extra["score"].numpy())
    assert np.array_equal(vertex[f"{prefix}feature_3"], cloud.extra["feature"][:, 3].numpy())
    assert vertex["quality"].dtype.newbyteorder("=") == np.float32
    assert np.array_equal(vertex["quality"], cloud.extra["score"].float().numpy())
    assert [row.tolist() for row in data["face"]["vertex_indices"]] == [[0, 1, 2], [5, 8, 39]]


@pytest.mark.parametrize("encoding", PLY_ENCODINGS)
def test_what_plyfile_writes_is_read(tmp_path, encoding):
    plyfile = pytest.importorskip("plyfile")
    rows = np.zeros(5, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1"),
                        ("scalar_label", "f4"), ("confidence", "u1")])  # fmt: skip
    rows["x"], rows["red"], rows["scalar_label"], rows["confidence"] = np.arange(5), 255, [0, 1, 2, 1, 0], 3
    element = plyfile.PlyElement.describe(rows, "vertex")
    order = ">" if encoding == "binary_big_endian" else "<"
    plyfile.PlyData([element], text=encoding == "ascii", byte_order=order).write(str(tmp_path / "theirs.ply"))
    cloud = read_ply(tmp_path / "theirs.ply", frame_id="base")
    assert cloud.points[:, 0].tolist() == [0, 1, 2, 3, 4]
    assert cloud.colors.tolist() == [[1, 0, 0]] * 5
    assert cloud.labels.tolist() == [0, 1, 2, 1, 0]
    assert cloud.extra["confidence"].tolist() == [3] * 5


@pytest.mark.parametrize("encoding", PCD_ENCODINGS)
def test_pypcd4_reads_every_field(tmp_path, encoding):
    pypcd4 = pytest.importorskip("pypcd4")
    cloud = full_cloud().with_fields(labels=torch.arange(40) % 5)
    path = tmp_path / "cloud.pcd"
    write_pcd(path, cloud, encoding=encoding)
    found = pypcd4.PointCloud.from_path(path)
    columns = {name: found.pc_data[name] for name in found.fields}
    for name, values in zip(("x", "y", "z"), cloud.points.T.numpy(), strict=True):
        assert np.array_equal(columns[name], values)
    for name, values in zip(("normal_x", "normal_y", "normal_z"), cloud.normals.T.numpy(), strict=True):
        assert np.array_equal(columns[name], values)
    assert columns["label"].dtype == np.uint32  # as PCL has it
    assert np.array_equal(columns["label"], cloud.labels.numpy())
    assert np.array_equal(columns["confidence"], cloud.extra["confidence"].numpy())
    packed = columns["rgb"].astype("<u4") if encoding == "ascii" else columns["rgb"].view("<u4")
    theirs = np.stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255], axis=1)
    assert np.array_equal(theirs, (cloud.colors * 255).round().numpy())
    if encoding != "ascii":
        assert np.array_equal(pypcd4.PointCloud.decode_rgb(columns["rgb"]), theirs)


@pytest.mark.parametrize("encoding", PCD_ENCODINGS)
def test_what_pypcd4_writes_is_read(tmp_path, encoding):
    pypcd4 = pytest.importorskip("pypcd4")
    points = np.arange(15, dtype=np.float32).reshape(5, 3) / 10
    labels = np.array([7, 0, 7, 1, 0], np.uint32)
    rgb = pypcd4.PointCloud.encode_rgb(np.full((5, 3), (10, 200, 30), np.uint8))
    made = pypcd4.PointCloud.from_points(
        [points[:, 0], points[:, 1], points[:, 2], rgb, labels],
        ("x", "y", "z", "rgb", "label"),
        (np.float32, np.float32, np.float32, np.float32, np.uint32),
    )
    made.save(tmp_path / "theirs.pcd", encoding=getattr(pypcd4.Encoding, encoding.upper()))
    cloud = read_pcd(tmp_path / "theirs.pcd", frame_id="base")
    assert np.allclose(cloud.points.numpy(), points)
    assert cloud.labels.tolist() == labels.tolist()
    if encoding != "ascii":  # there it writes the packed floats, some 1e-39, with ten decimals: nothing of them is left
        assert torch.equal((cloud.colors * 255).round(), torch.tensor([[10.0, 200, 30]]).repeat(5, 1))


@pytest.mark.open3d
@pytest.mark.parametrize("scalar_names", [False, True])
def test_open3d_reads_labels_and_confidence(tmp_path: Path, scalar_names):
    o3d = pytest.importorskip("open3d")
    cloud = full_cloud()
    write_ply(tmp_path / "cloud.ply", cloud, scalar_names=scalar_names, quality="labels")
    found = o3d.t.io.read_point_cloud(str(tmp_path / "cloud.ply"))
    prefix = "scalar_" if scalar_names else ""
    assert found.point[f"{prefix}label"].numpy()[:, 0].tolist() == cloud.labels.tolist()
    assert found.point[f"{prefix}confidence"].numpy()[:, 0].tolist() == cloud.extra["confidence"].tolist()
    assert np.array_equal(found.point["positions"].numpy(), cloud.points.numpy())
    for encoding in PCD_ENCODINGS:
        write_pcd(tmp_path / "cloud.pcd", cloud, encoding=encoding)
        found = o3d.t.io.read_point_cloud(str(tmp_path / "cloud.pcd"))
        assert np.array_equal(found.point["positions"].numpy(), cloud.points.numpy())
        assert found.point["label"].numpy()[:, 0].tolist() == cloud.labels.tolist()
        assert found.point["confidence"].numpy()[:, 0].tolist() == cloud.extra["confidence"].tolist()


@pytest.mark.open3d
def test_what_open3d_writes_with_labels_is_read(tmp_path: Path):
    import pcdata

    o3d = pytest.importorskip("open3d")
    cloud = full_cloud()
    geometry = pcdata.to_open3d(cloud, fields=("colors", "normals", "labels", "confidence", "score"))
    geometry.point["labels"] = geometry.point["labels"].to(o3d.core.int32)  # it writes no wider ones
    assert o3d.t.io.write_point_cloud(str(tmp_path / "theirs.ply"), geometry)
    found = read_ply(tmp_path / "theirs.ply", frame_id="table")
    for name in ("points", "normals", "labels", "confidence", "score"):
        assert torch.equal(found.fields()[name].double(), cloud.fields()[name].double()), name
    assert torch.allclose(found.colors, cloud.colors, atol=1 / 255)
