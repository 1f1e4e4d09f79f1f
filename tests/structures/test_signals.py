"""Signals are kept as they were recorded, read in the coordinates of their cloud, and refused where they lie."""

from __future__ import annotations

import pickle
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from pcdata import DepthFrame, PointCloud, Signal, errors
from pcdata.geometry import rigid
from pcdata.io.arrays import signal_files
from pcdata.io.store.cloud_record import (
    Record,
    cloud_from_record,
    record_from_cloud,
    record_from_signals,
    signals_from_record,
)
from pcdata.io.store.shards import SIGNALS_KEY
from pcdata.io.store.stores import STORES
from pcdata.structures.pose_layouts import LAYOUTS
from pcdata.structures.pose_rows import continued
from pcdata.structures.signal_kinds import SIGNAL_KINDS, parse_kind, poses_of_signal, signal_kinds_table
from pcdata.transforms import RandomRotation
from tests.factories import assert_same, base_from_camera, cloud_in_base, cloud_in_camera
from tests.signals import EULER, has_position, markers, read, with_signals

COUNTS = (3, 0, 5)


def same_signals(one: PointCloud, two: PointCloud) -> bool:
    assert list(one.recorded_signals) == list(two.recorded_signals)
    return all(signal.same_bits(two.recorded_signals[name]) for name, signal in one.recorded_signals.items())


def test_every_kind_and_layout_has_a_marker():
    kinds = {part.name for _, kind in markers(1).values() for part in parse_kind(kind).parts}
    assert kinds == set(SIGNAL_KINDS)
    assert {kind.split()[1] for _, kind in markers(1).values() if kind.startswith(("pose", "delta_pose"))} == set(
        LAYOUTS
    )


@pytest.mark.parametrize("frame", ["camera", "base", None])
def test_signals_survive_all_that_is_done_with_batches_bit_for_bit(frame):
    cloud = with_signals(cloud_in_base(COUNTS), frame)
    assert_same(PointCloud.cat(list(cloud)), cloud)
    assert_same(PointCloud.cat([cloud[0], cloud[1:]]), cloud)
    assert_same(PointCloud.from_padded(cloud.padded()), cloud)
    assert_same(PointCloud.cat_padded(list(cloud)), cloud.padded())
    assert_same(cloud_from_record(record_from_cloud(cloud)), cloud)
    assert_same(pickle.loads(pickle.dumps(cloud)), cloud)
    assert_same(cloud.cpu(), cloud)
    others = [
        cloud.select(torch.arange(2), torch.tensor([0, 1, 1, 2])),
        cloud.with_fields(colors=None),
        cloud.with_extra("other", cloud.points, "position"),
        cloud.averaged(torch.arange(8), cloud.ptr, points=cloud.points),
        cloud.in_source_frame(),
        cloud.to_frame("camera"),
        cloud.with_meta([{}] * 3).with_steps([{}] * 3),
    ]
    assert all(same_signals(cloud, other) for other in others)
    assert all(
        signal.values.device.type == "meta"
        for signal in cloud.to("meta").recorded_signals.values()
        if signal.kind != "text"
    )
    assert cloud.signals["language"][1] == "pick cube 1"


def test_signals_are_read_in_the_coordinates_of_now():
    """Against SciPy: positions as points, displacements as their differences, poses and motions turned."""
    cloud = with_signals(cloud_in_camera(COUNTS), "base", poses=True)
    pose = rigid.invert_rigid(cloud.frames["base"])
    turn, shift = pose[:, None, :3, :3], pose[:, None, :3, 3]
    for name, (values, kind) in markers(3).items():
        now = cloud.signals[name]
        if kind in ("invariant", "text"):
            assert now is cloud.recorded_signals[name].values
            continue
        assert now.dtype == values.dtype
        layout = kind.split()[1] if "pose" in kind else None
        if layout is None or has_position(layout):
            was = values.double()
            rows = was[..., :3] if was.ndim == 3 else was[..., :3, 3]
            place = (turn @ rows[..., None]).squeeze(-1)
            if kind.startswith(("pose", "position")):
                place = place + shift
            found = now[..., :3] if now.ndim == 3 else now[..., :3, 3]
            torch.testing.assert_close(found.double(), place, atol=2e-3 if now.dtype is torch.half else 1e-6, rtol=0)
        if "+ invariant" in kind:
            width = parse_kind(kind).parts[-1].columns
            assert torch.equal(now[..., -width:], values[..., -width:])
        if layout and "+" not in kind:
            expected = turn @ read(layout, values)[1]
            expected = expected if kind.startswith("pose") else expected @ turn.mT
            torch.testing.assert_close(read(layout, now)[1], expected, atol=1e-6, rtol=0)
    back = cloud.to_frame("base")
    assert all(torch.equal(back.signals[name], values) for name, (values, kind) in markers(3).items() if kind != "text")


@pytest.mark.parametrize("layout", EULER)
def test_euler_angles_of_a_turned_gripper_are_those_of_scipy_also_where_they_are_not_unique(layout):
    """A quarter turn of the middle axis leaves the other two open: the rotation counts."""
    middles = np.pi / 2 * np.array([-1.0, -1.0 + 1e-9, 0.0, 0.8, 1.0 - 1e-7, 1.0])
    angles = np.array([[0.3, middle, -2.0] for middle in middles])
    values = torch.from_numpy(angles)[None]
    cloud = cloud_in_base((3,)).with_signal("eef", values, f"pose {layout}", "base")
    pose = base_from_camera(1, seed=4)
    pose[:, :3, :3] = torch.eye(3)  # a shift, and nothing turns
    shifted = cloud.transformed(pose).signals["eef"]
    torch.testing.assert_close(read(layout, shifted)[1], read(layout, values)[1], atol=1e-12, rtol=0)
    turn = base_from_camera(1, seed=4)
    now = cloud.transformed(turn).signals["eef"]
    expected = turn[:, None, :3, :3] @ read(layout, values)[1]
    torch.testing.assert_close(read(layout, now)[1], expected, atol=1e-12, rtol=0)
    same = Rotation.from_matrix(expected[0].numpy()).as_euler(EULER[layout])
    assert np.allclose(now[0].numpy(), same, atol=1e-6)
    assert torch.equal(cloud.transformed(turn).in_source_frame().to_frame("base").signals["eef"], values)


def test_values_given_without_a_frame_are_those_of_the_coordinates_of_now():
    turned = cloud_in_base(COUNTS).transformed(base_from_camera(3, seed=9))
    cloud = with_signals(turned, None)
    for name, (values, kind) in markers(3).items():
        if kind != "text":
            torch.testing.assert_close(
                cloud.signals[name].double(), values.double(), atol=2e-3 if values.dtype is torch.half else 1e-6, rtol=0
            )
    assert {signal.frame for signal in cloud.recorded_signals.values()} == {"camera", None}


def test_a_turned_quaternion_stays_near_the_recorded_one():
    values = torch.tensor([[0.0, 0, 0, 1, 0, 0, 0], [0.0, 0, 0, -1, 0, 0, 0]])[None]
    cloud = cloud_in_camera((4,)).with_signal("pose", values, "pose xyz_quat_wxyz", "camera")
    for seed in range(20):
        now = cloud.transformed(base_from_camera(1, seed=seed)).signals["pose"]
        assert bool(((now * values)[..., 3:].sum(-1) >= 0).all())


def test_reading_all_signals_of_a_batch_takes_one_inverse(monkeypatch):
    cloud = with_signals(cloud_in_base(COUNTS), "camera")
    real, calls = torch.linalg.inv, []
    monkeypatch.setattr(torch.linalg, "inv", lambda matrix: calls.append(matrix.shape) or real(matrix))
    assert len(dict(cloud.signals)) == len(markers(3))
    assert calls.count((3, 4, 4)) == 1


def test_mirrors_refuse_poses_and_nothing_else():
    mirror = torch.diag(torch.tensor([-1.0, 1.0, 1.0, 1.0])).repeat(3, 1, 1)
    with pytest.raises(errors.PoseError, match=r"'pose/matrix'.*a mirrored pose does not exist.*without_signal"):
        with_signals(cloud_in_base(COUNTS), "base").transformed(mirror)
    cloud = with_signals(cloud_in_base(COUNTS), "base", poses=False).transformed(mirror)
    place, shift, turned = (cloud.signals[name] for name in ("place", "shift", "delta/xyz_quat_xyzw"))
    values = markers(3)
    flip = torch.tensor([-1.0, 1.0, 1.0])
    torch.testing.assert_close(place, values["place"][0] * flip)
    torch.testing.assert_close(shift, values["shift"][0] * flip)
    matrix = flip.diag().double()
    was = read("xyz_quat_xyzw", values["delta/xyz_quat_xyzw"][0])[1]
    torch.testing.assert_close(read("xyz_quat_xyzw", turned)[1], matrix @ was @ matrix, atol=1e-6, rtol=0)
    for layout in LAYOUTS:
        torch.testing.assert_close(
            read(layout, cloud.signals[f"delta/{layout}"])[1], matrix @ was @ matrix, atol=1e-6, rtol=0
        )
    with pytest.raises(errors.PoseError, match="mirrored"):
        cloud.with_signal("pose", values["pose/matrix"][0], "pose matrix", "base")
    with pytest.raises(errors.PoseError, match="mirrored"):
        cloud.with_signal("pose", values["pose/matrix"][0], "pose matrix")


def test_kinds_are_read_whatever_their_spaces_and_told_apart_by_one_text():
    assert Signal(torch.zeros(1, 5), " position+invariant   2 ", "base").kind == "position + invariant 2"
    assert Signal(torch.zeros(1, 2, 5), "invariant").kind == "invariant"
    assert not Signal(torch.zeros(1, 5), "invariant 5").is_spatial


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("pose", "pose LAYOUT.*xyz_quat_wxyz"),
        ("pose xyz_quat", "does not state the order; say xyz_quat_wxyz or xyz_quat_xyzw"),
        ("pose xyz_rot6d", "does not state the order; say xyz_rot6d_rows or xyz_rot6d_columns"),
        ("pose xyz_quat_wxzy", "did you mean"),
        ("pose matrix + invariant 1", "no columns beside"),
        ("positon", "did you mean.*position"),
        ("position 2", "nothing stands after position"),
        ("position + invariant", "how many columns"),
        ("invariant 0", "1 or more"),
        ("invariant ¹", "1 or more"),
        ("text + invariant 1", "texts have no columns"),
        ("position +", "there is no ''"),
        ("", "there is no ''"),
    ],
)
def test_a_kind_that_leaves_something_open_is_refused_with_the_words_that_are_known(kind, said):
    with pytest.raises(errors.ConfigError, match=said):
        cloud_in_camera((4,)).with_signal("a", torch.zeros(1, 7), kind, "camera")


QUATERNION = "pose xyz_quat_xyzw"


@pytest.mark.parametrize(
    ("values", "kind", "frame", "error", "said"),
    [
        (
            torch.tensor([[0.0, float("nan")]]),
            "invariant",
            None,
            errors.NonFiniteError,
            r"1 of 2 values are NaN.*\[0, 1\]",
        ),
        (torch.zeros(1, 7), QUATERNION, "base", errors.PoseError, r"at \[0\]: the quaternion has length 0.*x y z w"),
        (
            torch.tensor([[0, 0, 0, 0, 0, 0, 2.0]]),
            QUATERNION,
            "base",
            errors.PoseError,
            "length 1.*divide it by its length",
        ),
        (torch.eye(4)[None] * 2, "pose matrix", "base", errors.PoseError, "last row"),
        (torch.diag(torch.tensor([2.0, 2, 2, 1]))[None], "pose matrix", "base", errors.PoseError, "rigid"),
        (torch.diag(torch.tensor([-1.0, 1, 1, 1]))[None], "delta_pose matrix", "base", errors.PoseError, "mirror"),
        (torch.ones(1, 9), "pose xyz_rot6d_rows", "base", errors.PoseError, "not be 0 nor parallel"),
        (torch.zeros(1, 9), "pose xyz_rot6d_columns", "base", errors.PoseError, "not be 0 nor parallel"),
        (torch.zeros(1, 4), "position", "base", errors.ShapeError, r"must be \(B, ..., 3\), got \(1, 4\)"),
        (torch.zeros(3), "position", "base", errors.ShapeError, r"must be \(B, ..., 3\), got \(3,\); values\[None\]"),
        (torch.zeros(()), "invariant", None, errors.ShapeError, "must be"),
        (torch.zeros(2, 3), "position", "base", errors.ShapeError, r"one value per cloud, 1, got \(2, 3\)"),
        (torch.zeros(1, 3, dtype=torch.int64), "position", "base", errors.DTypeError, "must be floats"),
        (torch.zeros(1, 3, dtype=torch.complex64), "invariant", None, errors.DTypeError, "complex"),
        ([[0.0]], "invariant", None, errors.DTypeError, "must be a torch.Tensor"),
        ("pick", "text", None, errors.DTypeError, "tuple of texts"),
        (("a", "b"), "text", None, errors.ShapeError, "one value per cloud, 1, got 2 texts"),
        ((3,), "text", None, errors.DTypeError, "tuple of texts"),
        (torch.zeros(1, 3), "position", "elsewhere", errors.FrameError, r"know the frames \['base', 'camera'\].*poses"),
        (torch.zeros(1, 3), "invariant", "base", errors.FrameError, "leave frame out"),
        (torch.zeros(1, 3), 7, None, errors.DTypeError, "must be a text"),
        (torch.zeros(1, 3, device="meta"), "invariant", None, errors.DeviceError, "is on meta"),
    ],
)
def test_what_is_no_signal_of_the_cloud_is_refused(values, kind, frame, error, said):
    with pytest.raises(error, match=said) as caught:
        cloud_in_base((4,)).with_signal("a", values, kind, frame)
    assert "with_signal('a')" in str(caught.value) or isinstance(caught.value, errors.DTypeError | errors.ConfigError)


def test_a_spatial_signal_without_a_frame_is_none():
    with pytest.raises(errors.FrameError, match="say which"):
        Signal(torch.zeros(1, 3), "position")
    for name in ("", 3, "a\n", "x" * 300):
        with pytest.raises(errors.DTypeError, match="name"):
            cloud_in_base((4,)).with_signal(name, torch.zeros(1, 3), "invariant")
    with pytest.raises(errors.DTypeError, match="no signal 'b'"):
        cloud_in_base((4,)).without_signal("b")
    with pytest.raises(KeyError, match="no signal 'b'"):
        cloud_in_base((4,)).signals["b"]


def test_clouds_with_other_signals_are_not_joined():
    one = cloud_in_base((4,)).with_signal("a", torch.zeros(1, 3), "position", "base")
    others = [
        (one.without_signal("a"), errors.ShapeError, "different signals.*'a'"),
        (one.with_signal("a", torch.zeros(1, 3), "displacement", "base"), errors.ShapeError, "two kinds"),
        (one.with_signal("a", torch.zeros(1, 3), "position", "camera"), errors.FrameError, "two frames"),
        (one.with_signal("a", torch.zeros(1, 2, 3), "position", "base"), errors.ShapeError, "rows of"),
        (one.with_signal("a", torch.zeros(1, 3).double(), "position", "base"), errors.DTypeError, "convert"),
    ]
    for other, error, said in others:
        for join in (PointCloud.cat, PointCloud.cat_padded):
            with pytest.raises(error, match=said):
                join([one, other])
            with pytest.raises(error):
                join([other, one])


def test_a_cloud_loses_no_frame_that_a_signal_is_in():
    cloud = cloud_in_base((4,)).with_signal("a", torch.zeros(1, 3), "position", "base")
    with pytest.raises(errors.FrameError, match="signal 'a': is in 'base'"):
        replace(cloud, frames={})


def test_stored_signals_that_are_forged_are_refused():
    record = record_from_cloud(with_signals(cloud_in_base((4,)), "base"))
    first = record.info["signals"][0]
    wrong_facts = [
        {"signals": "joints"},
        {"signals": [3]},
        {"signals": []},
        {"signals": [first, first]},
        {"signals": [*record.info["signals"], {"name": "other", "kind": "invariant", "frame": None}]},
        *[
            {"signals": [{**first, **change}, *record.info["signals"][1:]]}
            for change in (
                {"kind": "pose matrix", "frame": "base"},
                {"kind": "joint angles"},
                {"kind": None},
                {"kind": "position", "frame": "base"},
                {"frame": "base"},
                {"frame": ["base"]},
                {"name": ["joints"]},
                {"texts": "abc"},
                {"texts": ["a"]},
                {"kind": "text", "texts": ["a", "b"]},
            )
        ],
    ]
    for change in wrong_facts:
        with pytest.raises(errors.CacheError):
            cloud_from_record(Record(record.arrays, {**record.info, **change}))
    quaternion = "signals.pose%2Fxyz_quat_xyzw"
    wrong_arrays = [
        {quaternion: 0 * record.arrays[quaternion]},
        {quaternion: record.arrays[quaternion][..., :6]},
        {quaternion: record.arrays[quaternion].astype("int64")},
        {"signals.joints": record.arrays["signals.joints"][0]},
        {"signals.joints": record.arrays["signals.joints"] * np.nan},
        {"signals.more": record.arrays["signals.joints"]},
        {"frames.base": -record.arrays["frames.base"]},
        {"source_from_cloud": 0 * record.arrays["source_from_cloud"]},
    ]
    for change in wrong_arrays:
        with pytest.raises(errors.CacheError):
            cloud_from_record(Record({**record.arrays, **change}, record.info))


def test_a_batch_is_read_as_its_clouds_are():
    cloud = with_signals(cloud_in_base(COUNTS), "base").transformed(base_from_camera(3, seed=4))
    for b, one in enumerate(cloud):
        for name, value in cloud.signals.items():
            single = one.signals[name]
            assert torch.equal(single[0], value[b]) if isinstance(value, torch.Tensor) else single[0] == value[b]


def test_the_closest_rotation_is_taken_where_axes_scale_differently():
    cloud = with_signals(cloud_in_base(COUNTS), "base")
    stretched = cloud.transformed(rigid.scaling(torch.tensor([2.0, 3.0, 5.0])).repeat(3, 1, 1))
    pose, was = stretched.signals["pose/matrix"], markers(3)["pose/matrix"][0]
    torch.testing.assert_close(pose[..., :3, :3], was[..., :3, :3], atol=1e-6, rtol=0)
    torch.testing.assert_close(pose[..., :3, 3], was[..., :3, 3] * torch.tensor([2.0, 3.0, 5.0]))
    force, own = stretched.signals["force"], markers(3)["force"][0]
    torch.testing.assert_close(force.norm(dim=-1), own.norm(dim=-1), atol=2e-3, rtol=0)


DOCS = Path(__file__).parents[2] / "docs" / "signals.md"


def test_the_page_tells_every_kind_and_layout():
    assert signal_kinds_table() in DOCS.read_text(encoding="utf-8")


def test_the_code_of_the_page_runs():
    for block in re.findall(
        r"^```python\n(.*?)^```$", DOCS.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL
    ):
        exec(compile(block, str(DOCS), "exec"), {})


def test_a_prediction_goes_back_by_the_rule_that_brought_the_action():
    cloud = with_signals(cloud_in_base(COUNTS), "base").transformed(base_from_camera(3, seed=2), frame_id="turned")
    predicted = Signal(cloud.signals["action"], "pose xyz_quat_xyzw + invariant 1", "turned")
    torch.testing.assert_close(
        predicted.moved(cloud.frame_from_cloud("base")), markers(3)["action"][0], atol=1e-6, rtol=0
    )


def test_a_capture_of_arrays_takes_signals_without_an_axis_of_clouds():
    pose = np.array([0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0])
    joints = np.arange(14, dtype=np.float32).reshape(2, 7)
    frame = DepthFrame.from_numpy(
        np.full((4, 5), 0.5, np.float32),
        [[5.0, 0, 2], [0, 5.0, 1.5], [0, 0, 1]],
        world_from_camera=np.eye(4),
        frame_id="base",
        signals={
            "eef": (pose, "pose xyz_quat_xyzw", "base"),
            "joints": (joints, "invariant"),
            "task": ("pick", "text"),
        },
    )
    joints += 1  # the driver may use its buffers again
    assert torch.equal(frame.signals["joints"][0], torch.arange(14.0).reshape(2, 7))
    assert (frame.signals["eef"].shape, frame.signals["eef"].dtype) == ((1, 7), torch.float64)
    assert frame.signals["task"] == ("pick",)
    bad = [
        (pose, errors.DTypeError, "must be"),
        ((pose,), errors.DTypeError, "must be"),
        ((pose, "invariant", "base"), errors.FrameError, "leave frame"),
    ]
    for said, error, match in [
        *bad,
        ((["a"], "invariant"), errors.DTypeError, "numbers"),
        ((np.nan, "invariant"), errors.NonFiniteError, "NaN"),
    ]:
        with pytest.raises(error, match=match):
            DepthFrame.from_numpy(np.full((4, 5), 0.5), [[5.0, 0, 2], [0, 5.0, 1.5], [0, 0, 1]], signals={"eef": said})


def test_a_direction_of_length_0_lets_a_gradient_through():
    force = torch.zeros(1, 3, requires_grad=True)
    cloud = PointCloud(points=torch.rand(4, 3), frame_id="base").with_signal("force", force, "direction")
    turned = RandomRotation()(cloud, generator=torch.Generator().manual_seed(0))
    turned.signals["force"].sum().backward()
    assert torch.isfinite(force.grad).all()


def test_names_that_differ_by_case_alone_are_stored(tmp_path):
    cloud = PointCloud(points=torch.rand(4, 3), frame_id="base")
    for place, name in enumerate(("q", "Q", "%51", "qq", "qQ", "QQ")):
        cloud = cloud.with_signal(name, torch.full((1,), float(place)), "invariant")
    eye = torch.eye(4, dtype=torch.float64)[None]
    cloud = replace(cloud, frames={"Tool": eye, "tool": eye * torch.tensor([2.0, 2.0, 2.0, 1.0])})
    for form in ("npz", "hdf5", "packed", "pt"):
        store = STORES[form](tmp_path)
        store.write("k", record_from_cloud(cloud))
        store.close()
        back = cloud_from_record(store.read("k"))
        assert same_signals(back, cloud)
        assert all(torch.equal(back.frames[name], cloud.frames[name]) for name in cloud.frames)


def test_signals_of_every_dtype_come_back_bit_for_bit_from_every_store_and_file(tmp_path):
    """Of bfloat16 too, which NumPy and HDF5 do not know."""
    cloud = cloud_in_base((3,))
    dtypes = [*signal_files._DTYPES.values()]
    assert torch.bfloat16 in dtypes
    for number, dtype in enumerate(dtypes):
        values = torch.linspace(0, 7.3, 6).to(dtype)[None]
        cloud = cloud.with_signal(f"s{number}", values, "invariant")
        if dtype.is_floating_point:
            cloud = cloud.with_signal(f"p{number}", values.reshape(1, 2, 3), "position", "base")
    for form in STORES:
        store = STORES[form](tmp_path / form)
        (tmp_path / form).mkdir()
        store.write("k", record_from_cloud(cloud))
        store.write(SIGNALS_KEY, record_from_signals(cloud.recorded_signals))
        store.close()
        assert same_signals(cloud_from_record(store.read("k")), cloud), form
        table = signals_from_record(store.read(SIGNALS_KEY), 1)
        assert all(table[name].same_bits(signal) for name, signal in cloud.recorded_signals.items())
    signal_files.write_signals(tmp_path / "s.json", cloud.recorded_signals)
    back = signal_files.read_signals(tmp_path / "s.json")
    assert all(back[name].same_bits(signal) for name, signal in cloud.recorded_signals.items())
    one = PointCloud(points=torch.rand(2, 3), frame_id="base").with_signal("a", torch.ones(1).bfloat16(), "invariant")
    half = record_from_cloud(one)
    for dtype in ("float8", 3):
        told = [{**half.info["signals"][0], "dtype": dtype}]
        with pytest.raises(errors.CacheError, match="signal 'a': dtype must be 'bfloat16'"):
            cloud_from_record(Record(half.arrays, {**half.info, "signals": told}))


def test_what_is_wrong_with_a_signal_of_a_file_names_it_once(tmp_path):
    path = tmp_path / "0.json"
    for said, message in [
        ('{"eef": {"kind": "position", "values": [1, 2, 3]}}', "'eef': a 'position' is in a frame"),
        ('{"eef": {"kind": "pose xyz_quat_xyzw", "frame": "base", "values": [1, 2, 3]}}', "'eef': a 'pose"),
        ('{"eef": {"kind": "nothing", "values": [1, 2, 3]}}', "there is no 'nothing'"),
    ]:
        path.write_text(said)
        with pytest.raises(errors.CaptureError, match=re.escape(f"read_signals: {path}: ")) as caught:
            signal_files.read_signals(path)
        assert message in str(caught.value)
        assert str(caught.value).count("eef") == 1


def test_clouds_that_were_turned_in_a_frame_lead_back_to_it():
    """A random rotation leaves the frame's name; what a policy predicts there must come back to the robot."""
    cloud = cloud_in_base((4, 6))
    turned = RandomRotation(degrees=90)(cloud, generator=torch.Generator().manual_seed(3))
    assert turned.frame_id == "base"
    assert not torch.allclose(turned.points, cloud.points, atol=1e-2)
    torch.testing.assert_close(turned.to_frame("base").points, cloud.points, atol=1e-6, rtol=0)
    torch.testing.assert_close(turned.padded().to_frame("base").points, cloud.padded().points, atol=1e-6, rtol=0)
    place = torch.tensor([[0.1, 0.2, 0.3], [0.3, 0.1, 0.0]])
    seen = turned.with_signal("action", place, "position", "base").signals["action"]  # as the policy sees it
    back = Signal(seen, "position", "cloud").moved(turned.frame_from_cloud("base"))
    torch.testing.assert_close(back, place, atol=1e-6, rtol=0)
    assert torch.equal(cloud.to_frame("base").points, cloud.points)  # where nothing was turned, nothing is rounded
    scaled = cloud.transformed(torch.diag(torch.tensor([2.0, 2.0, 2.0, 1.0])).double().repeat(2, 1, 1))
    torch.testing.assert_close(scaled.to_frame("base").points, cloud.points, atol=1e-6, rtol=0)


def test_a_tensor_of_eight_bit_floats_is_refused():
    with pytest.raises(errors.DTypeError, match="numbers side by side"):
        Signal(torch.ones(1, 2).to(torch.float8_e4m3fn), "invariant")


def test_two_arrays_of_one_signal_are_refused():
    cloud = PointCloud(points=torch.rand(4, 3), frame_id="base").with_signal("q", torch.zeros(1), "invariant")
    record = record_from_cloud(cloud)
    with pytest.raises(errors.CacheError, match="two arrays are of one"):
        cloud_from_record(Record({**record.arrays, "signals.%71": np.ones(1, np.float32)}, record.info))


@pytest.mark.parametrize(
    ("signals", "told"),
    [
        ([1], "must be a mapping"),
        ({"q": ([[1], [1, 2]], "invariant")}, "'q'.*no array of numbers"),
        ({"q": (np.array([{}]), "invariant")}, "'q'.*must be an array of numbers"),
        ({"q": (torch.zeros(2).bfloat16(), "invariant")}, "'q'.*no array of numbers"),
    ],
)
def test_arrays_that_are_no_signals_are_refused_by_name(signals, told):
    with pytest.raises(errors.DTypeError, match=told):
        DepthFrame.from_numpy(
            np.full((12, 16), 700, np.uint16),
            metres_per_unit=0.001,
            intrinsics=np.array([[15.0, 0, 7.5], [0, 15, 5.5], [0, 0, 1]]),
            signals=signals,
        )


def test_a_matrix_that_moves_nothing_is_refused():
    force = Signal(torch.ones(2, 3), "direction", "base")
    for shape in ((3, 3), (4, 4), (3, 4, 4)):
        with pytest.raises(errors.ShapeError, match=r"\(2, 4, 4\)"):
            force.moved(torch.ones(shape))
    for matrix in (torch.diag(torch.tensor([0.0, 1, 1, 1])), torch.full((4, 4), torch.nan)):
        with pytest.raises(errors.PoseError, match="invertible"):
            force.moved(matrix[None])


@pytest.mark.parametrize("name", [name for name, layout in LAYOUTS.items() if layout.has_position])
@pytest.mark.parametrize("other", ["xyz_rot6d_rows", "xyz_quat_xyzw", "xyz_axis_angle", "xyz_euler_xyz_fixed"])
def test_poses_written_in_another_layout_are_the_same_poses(name, other):
    angles = torch.tensor([[0.3, -0.2, 2.9], [-1.0, 0.4, 0.1], [0.0, 0.0, 0.0]], dtype=torch.float64)
    matrix = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    matrix[:, :3, :3] = torch.from_numpy(Rotation.from_euler("xyz", angles.numpy()).as_matrix())
    matrix[:, :3, 3] = angles * 0.1
    six = torch.cat([matrix[:, :3, 3], matrix[:, 0, :3], matrix[:, 1, :3]], dim=1)
    given = Signal(six, "pose xyz_rot6d_rows", "base")
    given = Signal(matrix, "pose matrix", "base") if name == "matrix" else given.with_poses_as(name)
    found = given.with_poses_as(other)
    assert (found.kind, found.frame, found.values.dtype) == (f"pose {other}", "base", torch.float64)
    torch.testing.assert_close(poses_of_signal(found.kind, found.values), matrix, rtol=0, atol=1e-12)
    assert found.with_poses_as(other).same_bits(found)


def turning(count):  # (count, 4, 4), a whole turn and a half about an axis: w passes 0 three times
    matrix = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    vectors = torch.linspace(0, 3 * torch.pi, count, dtype=torch.float64)[:, None] * torch.tensor([0.6, 0.0, 0.8])
    matrix[:, :3, :3] = torch.from_numpy(Rotation.from_rotvec(vectors.numpy()).as_matrix())
    matrix[:, :3, 3] = torch.rand(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return matrix


def largest_step(rows):
    return float((rows[1:] - rows[:-1])[..., 3:7].norm(dim=-1).max())


@pytest.mark.parametrize("layout", ["xyz_quat_xyzw", "xyz_quat_wxyz"])
def test_quaternions_of_a_trajectory_do_not_jump_and_those_of_single_poses_have_w_above_0(layout):
    matrix = turning(101)
    w = 6 if layout.endswith("xyzw") else 3
    one_by_one = Signal(matrix, "pose matrix", "base").with_poses_as(layout).values
    assert bool((one_by_one[:, w] >= 0).all())
    assert largest_step(one_by_one) > 1.9
    episode = Signal(matrix, "pose matrix", "base").with_poses_as(layout, along=0)
    assert largest_step(episode.values) < 0.05  # half the angle of a step
    torch.testing.assert_close(poses_of_signal(episode.kind, episode.values), matrix, rtol=0, atol=1e-12)
    assert torch.equal(episode.values[0], one_by_one[0])
    one_after_another = [one_by_one[:1]]
    for number in range(1, len(matrix)):
        row = one_by_one[number : number + 1]
        one_after_another.append(continued(episode.kind, row, one_after_another[-1]))
    assert torch.equal(torch.cat(one_after_another), episode.values)
    # Of a horizon every cloud has a trajectory of its own; what jumped before goes on, what did not keeps its bits.
    horizons = torch.stack([matrix, matrix.flip(0)])
    written = Signal(horizons, "pose matrix", "base").with_poses_as(layout, along=1).values
    assert torch.equal(written[0], episode.values)
    assert largest_step(written[1]) < 0.05
    jumping = Signal(one_by_one, f"pose {layout}", "base").with_poses_as(layout, along=0)
    assert torch.equal(jumping.values, episode.values)
    assert episode.with_poses_as(layout, along=0).same_bits(episode)


def test_only_quaternions_of_poses_are_continued_and_along_an_axis_that_there_is():
    matrix = turning(31)
    for kind in ("delta_pose matrix", "pose rotation"):
        values = matrix[:, :3, :3] if kind.endswith("rotation") else matrix
        given = Signal(values, kind, "base")
        same = given.with_poses_as("xyz_quat_xyzw").same_bits(given.with_poses_as("xyz_quat_xyzw", along=0))
        assert same == kind.startswith("delta")  # a motion goes on from none
    quaternion = Signal(matrix, "pose matrix", "base").with_poses_as("xyz_quat_xyzw").values
    beside = Signal(torch.cat([quaternion, -quaternion[:, :1]], dim=1), "pose xyz_quat_xyzw + invariant 1", "base")
    found = beside.with_poses_as("xyz_quat_xyzw", along=0).values
    assert torch.equal(found[:, 7], -quaternion[:, 0])
    assert largest_step(found) < 0.2
    assert beside.rows(slice(0, 0)).with_poses_as("xyz_quat_xyzw", along=0).values.shape == (0, 8)
    joints = Signal(torch.rand(3), "invariant")
    assert joints.with_poses_as("xyz_quat_xyzw", along=0).same_bits(joints)
    for wrong in (1, -1, True, 0.0):
        with pytest.raises(errors.ShapeError, match="along must be an axis on which poses follow each other, 0 to 0"):
            beside.with_poses_as("xyz_quat_xyzw", along=wrong)


def test_rewritten_poses_leave_the_columns_beside_them_and_rotations_stay_alone():
    pose = torch.tensor([[0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0, 0.7]])
    both = Signal(pose, "pose xyz_quat_xyzw + invariant 1", "base").with_poses_as("xyz_rot6d_rows")
    assert both.kind == "pose xyz_rot6d_rows + invariant 1"
    assert both.values.tolist() == [pytest.approx([0.1, 0.2, 0.3, 1, 0, 0, 0, 1, 0, 0.7])]
    turned = Signal(torch.eye(3)[None], "pose rotation", "base").with_poses_as("xyz_quat_wxyz")
    assert (turned.kind, turned.values.tolist()) == ("pose quat_wxyz", [[1, 0, 0, 0]])
    joints = Signal(torch.rand(1, 7), "invariant")
    assert joints.with_poses_as("xyz_rot6d_rows").same_bits(joints)
    for wrong in ("matrix", "quat_xyzw", "xyz_rot6d"):
        with pytest.raises(errors.ConfigError, match="written in a row as one of xyz_quat_wxyz"):
            joints.with_poses_as(wrong)
