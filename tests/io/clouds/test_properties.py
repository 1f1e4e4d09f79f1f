"""What the columns of other programs' files mean, by name and value."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pcdata.errors import CaptureError
from pcdata.io import open_source, read_pcd, read_ply
from pcdata.structures import Kind, PointCloud
from pcdata.transforms import VoxelDownsample

N = 60
PLY_TYPES = {"f4": "float", "f8": "double", "i4": "int", "u4": "uint", "u1": "uchar", "i2": "short", "u2": "ushort"}
READERS: dict[str, Any] = {"ply": read_ply, "pcd": read_pcd}
each_reader = pytest.mark.parametrize("suffix", READERS)


def write(folder: Path, suffix: str, **columns: np.ndarray) -> Path:
    """A binary file as somebody else's program writes it; points lie in a box 0.3 m wide."""
    xyz = np.random.default_rng(0).uniform(0, 0.3, (N, 3)).astype("f4")
    given = {"x": xyz[:, 0], "y": xyz[:, 1], "z": xyz[:, 2], **columns}
    rows = np.empty(N, [(name, values.dtype.newbyteorder("<")) for name, values in given.items()])
    for name, values in given.items():
        rows[name] = values
    path = folder / f"c.{suffix}"
    if suffix == "ply":
        lines = [f"property {PLY_TYPES[values.dtype.str[1:]]} {name}" for name, values in given.items()]
        head = ["ply", "format binary_little_endian 1.0", f"element vertex {N}", *lines, "end_header"]
    else:
        kinds = " ".join(values.dtype.kind.upper() for values in given.values())
        sizes = " ".join(str(values.dtype.itemsize) for values in given.values())
        head = ["VERSION 0.7", f"FIELDS {' '.join(given)}", f"SIZE {sizes}", f"TYPE {kinds}", f"WIDTH {N}", "HEIGHT 1"]
        head += [f"POINTS {N}", "DATA binary"]
    path.write_bytes("\n".join([*head, ""]).encode() + rows.tobytes())
    return path


def classes(dtype: str = "f4") -> np.ndarray:
    return (np.arange(N) % 2 * 3 + 1).astype(dtype)


LABEL_NAMES = [
    "label", "Label", "LABEL", "labels", "scalar_Label", "scalar_label", "scalar_Classification", "Classification",
    "scalar_Class", "class", "class_id", "classId", "semantic", "semantic_label", "sem_label", "segment", "segment_id",
    "segmentID", "instance", "instance_id", "object", "object_id", "objectId", "vertex_label", "scalar_Instance",
    "category", "cluster", "part_id", "gt_label", "prediction",
]  # fmt: skip


@each_reader
@pytest.mark.parametrize("dtype", ["f4", "f8", "i4", "u4", "u1", "i2"])
@pytest.mark.parametrize("name", LABEL_NAMES)
def test_labels_are_found_under_the_names_that_programs_give_them(
    tmp_path: Path, suffix: str, name: str, dtype: str
) -> None:
    cloud = READERS[suffix](write(tmp_path, suffix, **{name: classes(dtype)}))
    assert cloud.labels is not None
    assert cloud.labels.tolist() == classes("i8").tolist()
    assert not cloud.extra
    assert set(VoxelDownsample(voxel_size=0.1)(cloud).labels.tolist()) <= {1, 4}


@each_reader
def test_two_columns_that_may_be_the_labels_are_both_named(tmp_path: Path, suffix: str) -> None:
    path = write(tmp_path, suffix, semantic=classes(), instance=classes("i4") + 7)
    with pytest.raises(CaptureError, match=r"'semantic' and 'instance' may all be the labels.*labels_from='semantic'"):
        READERS[suffix](path)
    for chosen, other in (("semantic", "instance"), ("instance", "semantic"), ("INSTANCE", "semantic")):
        cloud = READERS[suffix](path, labels_from=chosen)
        assert cloud.labels.min() == (1 if chosen == "semantic" else 8)
        assert not cloud.extra[other].is_floating_point()
        assert set(VoxelDownsample(voxel_size=0.1)(cloud).extra[other].tolist()) <= {1, 4, 8, 11}
    none = READERS[suffix](path, labels_from="")
    assert none.labels is None
    assert set(none.extra) == {"semantic", "instance"}
    assert open_source(path, labels_from="semantic").load("c").labels.max() == 4


@each_reader
def test_any_column_may_be_named_as_the_labels(tmp_path: Path, suffix: str) -> None:
    path = write(tmp_path, suffix, scalar_Tree=classes())
    assert READERS[suffix](path).labels is None
    for name in ("scalar_Tree", "scalar_tree", "Tree"):
        assert READERS[suffix](path, labels_from=name).labels.tolist() == classes("i8").tolist()
    with pytest.raises(CaptureError, match=r"names no column.*did you mean 'scalar_Tree'"):
        READERS[suffix](path, labels_from="scalar_Treee")


@each_reader
@pytest.mark.parametrize("value", [0.5, np.nan, np.inf])
def test_labels_that_are_not_whole_are_refused_with_a_way_out(tmp_path: Path, suffix: str, value: float) -> None:
    odd = classes()
    odd[7] = value
    path = write(tmp_path, suffix, scalar_Label=odd)
    with pytest.raises(CaptureError, match="labels_from=''"):
        READERS[suffix](path)
    assert READERS[suffix](path, labels_from="").extra["scalar_Label"].is_floating_point()


@each_reader
@pytest.mark.parametrize("value", [-1, -100, 255])
def test_marks_of_unlabeled_points_are_kept_as_they_are(tmp_path: Path, suffix: str, value: int) -> None:
    odd = classes()
    odd[::5] = value
    assert value in READERS[suffix](write(tmp_path, suffix, scalar_Label=odd)).labels.tolist()


@each_reader
def test_whole_numbers_are_voted_and_measured_quantities_averaged(tmp_path: Path, suffix: str) -> None:
    columns = {
        "scalar_Strip": classes(),
        "scalar_Intensity": classes(),
        "score": classes() / 3,
        "confidence": classes(),
    }
    cloud = READERS[suffix](write(tmp_path, suffix, **columns))
    assert cloud.extra["scalar_Strip"].dtype == torch.int64
    assert all(cloud.extra[name].dtype == torch.float32 for name in ("scalar_Intensity", "score", "confidence"))
    voxels = VoxelDownsample(voxel_size=0.2)(cloud)
    assert set(voxels.extra["scalar_Strip"].tolist()) <= {1, 4}
    assert not set(voxels.extra["scalar_Intensity"].tolist()) <= {1, 4}


def test_clouds_whose_extra_fields_differ_in_type_are_not_joined() -> None:
    points = torch.zeros(3, 3)
    clouds = [
        PointCloud(points=points, frame_id="camera").with_extra("strip", torch.ones(3, dtype=dtype), Kind.INVARIANT)
        for dtype in (torch.int64, torch.float32)
    ]
    with pytest.raises(Exception, match="strip") as caught:
        PointCloud.cat(clouds)
    assert type(caught.value).__name__ == "DTypeError"


NORMALS = {"ply": ("nx", "ny", "nz"), "pcd": ("normal_x", "normal_y", "normal_z")}


@each_reader
@pytest.mark.parametrize("names", [*NORMALS.values(), ("NX", "NY", "NZ"), ("Normal_X", "Normal_Y", "Normal_Z")])
def test_normals_are_found_under_every_known_name(tmp_path: Path, suffix: str, names: tuple[str, ...]) -> None:
    values = [np.full(N, value, "f4") for value in (0.0, 0.6, 0.8)]
    cloud = READERS[suffix](write(tmp_path, suffix, **dict(zip(names, values))))
    assert torch.allclose(cloud.normals, torch.tensor([0, 0.6, 0.8]))


@each_reader
@pytest.mark.parametrize(
    "names",
    [("nx", "ny", "nq"), ("nx", "oy", "nz"), ("normal_x", "normal_y", "normaL-z"), ("red", "green", "blve"),
     ("vp_x", "vp_y", "vp_w")],
)  # fmt: skip
def test_a_vector_of_which_one_column_is_misnamed_is_refused(
    tmp_path: Path, suffix: str, names: tuple[str, ...]
) -> None:
    path = write(tmp_path, suffix, **{name: np.full(N, 0.5, "f4") for name in names})
    with pytest.raises(CaptureError, match=f"{names[0]}.*is missing"):
        READERS[suffix](path)


@each_reader
def test_two_sets_of_normals_or_colors_are_refused(tmp_path: Path, suffix: str) -> None:
    both = {name: np.full(N, 0.5, "f4") for names in NORMALS.values() for name in names}
    with pytest.raises(CaptureError, match="may both be the normals"):
        READERS[suffix](write(tmp_path, suffix, **both))


@each_reader
@pytest.mark.parametrize("dtype", ["u4", "f4", "i4"])
@pytest.mark.parametrize("name", ["rgb", "rgba"])
def test_packed_colors_are_unpacked(tmp_path: Path, suffix: str, name: str, dtype: str) -> None:
    packed = np.full(N, 0x00336699, "u4").view(dtype)
    cloud = READERS[suffix](write(tmp_path, suffix, **{name: packed}))
    assert torch.allclose(cloud.colors, torch.tensor([0.2, 0.4, 0.6]))


@each_reader
def test_the_viewpoint_of_each_point_moves_with_the_cloud(tmp_path: Path, suffix: str) -> None:
    names = {name: np.full(N, value, "f4") for name, value in (("vp_x", 1000), ("vp_y", 0), ("vp_z", 500))}
    cloud = READERS[suffix](write(tmp_path, suffix, **names), metres_per_unit=0.01)
    assert cloud.kinds["viewpoint"] is Kind.POSITION
    assert cloud.extra["viewpoint"][0].tolist() == pytest.approx([10, 0, 5])
