"""The record: the one form between a cloud and every file format."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import torch

from pcdata import PointCloud
from pcdata.errors import CacheError
from pcdata.io.store.cloud_record import Record, cloud_from_record, parse_info, record_from_cloud


def _cloud(**changes: object) -> PointCloud:
    fields = {"points": torch.arange(12.0).reshape(4, 3), "frame_id": "base"}
    return PointCloud(**(fields | changes))


def _changed(cloud: PointCloud, **info: object) -> Record:
    record = record_from_cloud(cloud)
    return Record(record.arrays, {**record.info, **info})


def test_arrays_follow_the_customs_of_the_field():
    colors, normals = torch.rand(4, 3), torch.nn.functional.normalize(torch.randn(4, 3))
    arrays = record_from_cloud(_cloud(colors=colors, normals=normals, labels=torch.tensor([-1, 0, 7, 2]))).arrays
    assert {name: (array.dtype.name, array.shape) for name, array in arrays.items()} == {
        "points": ("float32", (4, 3)),
        "colors": ("float32", (4, 3)),
        "normals": ("float32", (4, 3)),
        "labels": ("int32", (4, 1)),
        "ptr": ("int64", (2,)),
        "source_from_cloud": ("float64", (1, 4, 4)),
    }
    assert arrays["labels"][:, 0].tolist() == [-1, 0, 7, 2]


def test_intrinsics_and_extrinsics_repeat_the_cameras_of_every_view():
    k = [[500.0, 0.0, 31.5], [0.0, 501.0, 23.5], [0.0, 0.0, 1.0]]
    pose = torch.eye(4, dtype=torch.float64).tolist()
    cameras = [{"intrinsics": [k], "world_from_camera": pose}, {"intrinsics": [k], "world_from_camera": pose}]
    arrays = record_from_cloud(_cloud(meta=[{"cameras": cameras}])).arrays
    assert arrays["intrinsics"].tolist() == [k, k]
    assert arrays["extrinsics"].tolist() == [pose, pose]


def test_a_camera_without_pose_leaves_the_extrinsics_out():
    k = [[500.0, 0.0, 31.5], [0.0, 501.0, 23.5], [0.0, 0.0, 1.0]]
    arrays = record_from_cloud(_cloud(meta=[{"cameras": [{"intrinsics": [k], "world_from_camera": None}]}])).arrays
    assert "intrinsics" in arrays
    assert "extrinsics" not in arrays


def test_the_digest_depends_on_every_byte_name_dtype_shape_and_fact():
    cloud = _cloud(labels=torch.tensor([0, 1, 2, 3]))
    moved = cloud.points.clone()
    moved[3, 2] = torch.nextafter(moved[3, 2], torch.tensor(100.0))
    record = record_from_cloud(cloud)
    others = [
        record_from_cloud(_cloud(points=moved, labels=cloud.labels)),
        record_from_cloud(_cloud()),
        record_from_cloud(_cloud(labels=cloud.labels, frame_id="world")),
        record_from_cloud(_cloud(labels=cloud.labels, meta=[{"sample_id": "a"}])),
        Record({**record.arrays, "labels": record.arrays["labels"].astype(np.int64)}, record.info),
        Record({**record.arrays, "labels": record.arrays["labels"].reshape(2, 2)}, record.info),
    ]
    digests = {record.digest(), *(other.digest() for other in others)}
    assert len(digests) == 7
    assert record_from_cloud(cloud).digest() == record.digest()


def test_the_digest_survives_json_for_keys_and_tuples_that_json_changes():
    cloud = _cloud(meta=[{"counts": {10: 1, 2: 2}, "box": (1, 2)}])
    record = record_from_cloud(cloud)
    assert Record(record.arrays, json.loads(record.info_text())).digest() == record.digest()


def test_a_tensor_in_need_of_gradients_and_a_strided_one_are_stored_by_value():
    wide = torch.rand(3, 4)
    cloud = _cloud(points=wide.T, colors=torch.rand(4, 3, requires_grad=True))
    back = cloud_from_record(record_from_cloud(cloud))
    assert torch.equal(back.points, wide.T)
    assert torch.equal(back.colors, cloud.colors)


@pytest.mark.parametrize("label", [2**31, -(2**31) - 1])
def test_a_label_beyond_int32_is_refused_not_wrapped(label):
    with pytest.raises(CacheError, match="int32"):
        record_from_cloud(_cloud(labels=torch.tensor([0, 0, 0, label])))


@pytest.mark.parametrize(
    ("meta", "word"),
    [({"score": float("nan")}, "NaN"), ({"plane": torch.zeros(4)}, "Tensor"), ({"names": {1, 2}}, "set")],
)
def test_meta_that_json_cannot_hold_is_refused_with_what_to_do(meta, word):
    with pytest.raises(CacheError, match="tolist") as caught:
        record_from_cloud(_cloud(meta=[meta]))
    assert word in str(caught.value)


def test_a_dtype_without_numpy_counterpart_is_refused_by_name():
    cloud = _cloud().with_extra("feature", torch.zeros(4, 2, dtype=torch.bfloat16), "invariant")
    with pytest.raises(CacheError, match=r"extra\.feature|feature.*bfloat16"):
        record_from_cloud(cloud)


@pytest.mark.parametrize("name", ["robot/base_link", "caméra 1", "..", "a%2Fb"])
def test_frames_keep_any_name(name):
    cloud = _cloud(frames={name: torch.eye(4, dtype=torch.float64)[None]})
    record = record_from_cloud(cloud)
    assert not any("/" in array for array in record.arrays)
    assert list(cloud_from_record(record).frames) == [name]


@pytest.mark.parametrize(
    "info",
    [
        {"schema": "other/1"},
        {"schema": None},
        {"frame_id": 5},
        {"source_frame": None},
        {"unit": "feet"},
        {"kinds": []},
        {"kinds": {"a": "invariant"}},
        {"kinds": {"a": "colorful"}},
        {"meta": 3},
        {"meta": [1]},
        {"meta": [{}, {}]},
        {"history": "abc"},
        {"history": [1]},
        {"history": [[], [], []]},
    ],
    ids=str,
)
def test_facts_that_do_not_fit_are_a_cache_error(info):
    with pytest.raises(CacheError):
        cloud_from_record(_changed(_cloud(), **info))


@pytest.mark.parametrize("info", [[], "text", None, 3])
def test_facts_that_are_no_object_are_a_cache_error(info):
    with pytest.raises(CacheError, match="not a cloud record"):
        cloud_from_record(Record({}, info))


@pytest.mark.parametrize(
    ("name", "array"),
    [
        ("points", np.zeros((4, 2), np.float32)),
        ("points", np.zeros((4, 3), np.float64)),
        ("points", np.zeros((4, 3), ">f4")),
        ("points", np.zeros((4, 3), np.longdouble)),
        ("points", np.array(["a"])),
        ("points", np.array([None], dtype=object)),
        ("points", np.zeros(4, dtype=[("x", "f4")])),
        ("points", np.float32(0)),
        ("labels", np.zeros((4, 3), np.int32)),
        ("labels", np.zeros((4, 1), np.float32)),
        ("ptr", np.array([0, 5])),
        ("ptr", np.array([1, 4])),
        ("ptr", np.array([0, 4], np.int32)),
        ("source_from_cloud", np.zeros((2, 4, 4))),
        ("frames.base", np.zeros((1, 4, 4), np.float32)),
        ("frames.base", np.zeros((1, 3, 4))),
        ("extra.weight", np.zeros(4, np.float32)),
        ("extra.not a name", np.zeros(4, np.float32)),
        ("frame_id", np.zeros(4)),
        ("self", np.zeros(4)),
        ("unheard_of", np.zeros(4)),
    ],
)
def test_arrays_that_do_not_fit_are_a_cache_error(name, array):
    record = record_from_cloud(_cloud(labels=torch.zeros(4, dtype=torch.int64)))
    with pytest.raises(CacheError):
        cloud_from_record(Record({**record.arrays, name: array}, record.info))


def test_missing_points_are_a_cache_error():
    record = record_from_cloud(_cloud())
    arrays = {name: array for name, array in record.arrays.items() if name != "points"}
    with pytest.raises(CacheError):
        cloud_from_record(Record(arrays, record.info))


@pytest.mark.parametrize("text", ["", "{", "[1]", "null", "[" * 100_000, b"\xff\xfe\xff", "1" * 5000])
def test_json_that_is_no_object_is_a_cache_error(text):
    with pytest.raises(CacheError):
        parse_info(text)


def test_dropping_a_field_changes_nothing_else():
    cloud = _cloud(colors=torch.rand(4, 3))
    back = cloud_from_record(record_from_cloud(dataclasses.replace(cloud, colors=None)))
    assert back.colors is None
    assert torch.equal(back.points, cloud.points)
