"""The laws of signals, for every example of every registered transform: none is dropped, reordered, rounded or left."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import pytest
import torch
from scipy.linalg import polar
from torch import Tensor

from pcdata import transforms as T
from pcdata.errors import CaptureError, FrameError, PoseError
from pcdata.functional.rows import cloud_of_rows, transform_points
from pcdata.geometry import rigid
from pcdata.rng import seeded
from pcdata.structures import DepthFrame, PointCloud, Signal
from pcdata.structures.pose_layouts import LAYOUTS
from tests.factories import assert_same, base_from_camera, cloud_in_base, frame_with_counts
from tests.signals import has_position, read, rotations_of, written
from tests.transforms.examples import ALL, NAMES, Example

COUNTS = (120, 90, 150)
PLACE = torch.tensor([[0.05, -0.1, 0.2]], dtype=torch.float64)  # (1, 3) in the base frame
ARM = torch.tensor([[0.3, 0.1, -0.2]], dtype=torch.float64)
TURN = rotations_of(1)[:, 0]


def marked(num_clouds: int, *, poses: bool) -> dict[str, tuple[Any, str, str | None]]:
    """The same signals for every cloud, in the base frame: name -> values, kind, frame."""
    told: dict[str, tuple[Any, str, str | None]] = {
        "task": (("pick",), "text", None),
        "joints": (torch.arange(7)[None], "invariant", None),
        "place": (PLACE, "position", "base"),
        "arm": (ARM, "displacement", "base"),
        "force": (ARM, "direction", "base"),
    }
    for layout in LAYOUTS:
        told[f"delta {layout}"] = (written(layout, ARM, TURN), f"delta_pose {layout}", "base")
        if poses:
            told[f"pose {layout}"] = (written(layout, PLACE, TURN), f"pose {layout}", "base")
    return {
        name: (
            values * num_clouds if kind == "text" else values.repeat(num_clouds, *[1] * (values.ndim - 1)),
            kind,
            frame,
        )
        for name, (values, kind, frame) in told.items()
    }


@functools.cache
def with_marks(make: Callable[[Sequence[int]], Any], *, poses: bool) -> PointCloud:
    """Attach signals, and markers at the same places as fields of points, which steps are known to move."""
    data = make(COUNTS)
    now_from_base = torch.linalg.inv(data.frames["base"] @ data.source_from_cloud)
    base = torch.cat([PLACE, PLACE + ARM, PLACE + torch.eye(3)]).repeat(data.num_clouds, 1, 1)
    each = torch.arange(data.num_clouds + 1)
    owner = cloud_of_rows(data.ptr)
    for number in range(base.shape[1]):
        place = transform_points(base[:, number], each, now_from_base)
        data = data.with_extra(f"mark{number}", place[owner], "position")
    force = ARM / ARM.norm() @ torch.linalg.inv(now_from_base)[:, :3, :3]
    data = data.with_extra(
        "way", torch.nn.functional.normalize(force[:, 0] if force.ndim == 3 else force, dim=1)[owner], "direction"
    )
    for name, said in marked(data.num_clouds, poses=poses).items():  # last: a new field checks them all
        data = data.with_signal(name, *said)
    return data


def run(example: Example, data: Any, generator: Any = None) -> Any:
    return example.transform(data, generator=(generator or seeded(0)) if example.transform.is_random else None)


def mirrors(example: Example) -> bool:
    result = run(example, example.make(COUNTS))
    return bool((torch.linalg.det(result.source_from_cloud[:, :3, :3]) < 0).any())


def only(wanted) -> Any:
    pairs = [(example, name) for example, name in zip(ALL, NAMES) if example.transform.takes is wanted]
    return pytest.mark.parametrize("example", [pair[0] for pair in pairs], ids=[pair[1] for pair in pairs])


def close(actual: Tensor, expected: Tensor) -> None:
    torch.testing.assert_close(actual.double(), expected.double(), atol=1e-6, rtol=1e-6)


@only(PointCloud)
def test_a_step_moves_every_kind_of_signal_as_what_is_attached_to_the_cloud(example):
    poses = not mirrors(example)
    if not poses:
        with pytest.raises(PoseError, match="a mirrored pose does not exist"):
            run(example, with_marks(example.make, poses=True))
    data = with_marks(example.make, poses=poses)
    result = run(example, data)
    assert list(result.signals) == list(data.signals)
    expected = marked(result.num_clouds, poses=poses)
    for name, signal in result.recorded_signals.items():
        assert signal.same_bits(Signal(*expected[name])), name
    real = torch.nonzero(result.source_index >= 0).squeeze(1)
    first = torch.stack([real[cloud_of_rows(result.ptr)[real] == b][0] for b in range(result.num_clouds)])
    place, tip, *axes = (result.extra[f"mark{number}"][first] for number in range(5))
    now = dict(result.signals)
    close(now["place"], place)
    close(now["arm"], tip - place)
    close(now["force"], result.extra["way"][first] * ARM.norm())
    assert torch.equal(now["joints"], expected["joints"][0])
    assert now["task"] == expected["task"][0]
    linear = torch.stack([axis - place for axis in axes], dim=-1)  # what became of the base's axes
    nearest = torch.stack([torch.from_numpy(polar(one.numpy())[0]) for one in linear])
    for layout in LAYOUTS:
        shift, turned = read(layout, now[f"delta {layout}"])
        if has_position(layout):
            close(shift, tip - place)
        close(turned, nearest @ TURN @ nearest.mT)
        if poses:
            position, rotation = read(layout, now[f"pose {layout}"])
            if has_position(layout):
                close(position, place)
            close(rotation, nearest @ TURN)
    # And back: what was recorded in the base, in the base.
    back = result.in_source_frame().to_frame("base").signals
    for name, (values, *_) in expected.items():
        assert torch.equal(back[name], values) if isinstance(values, Tensor) else back[name] == values
    source = result.in_source_frame()
    to_source = torch.linalg.inv(source.frames["base"]) if "base" in source.frames else torch.eye(4).double()[None]
    close(
        source.signals["place"], transform_points(expected["place"][0], torch.arange(result.num_clouds + 1), to_source)
    )


@only(PointCloud)
def test_a_batch_with_signals_equals_its_clouds(example):
    if not example.transform.keeps_clouds:
        return
    data = with_marks(example.make, poses=not mirrors(example))
    batch = run(example, data, [seeded(b) for b in range(3)])
    singles = [run(example, cloud, [seeded(b)]) for b, cloud in enumerate(data)]
    assert_same(batch, PointCloud.cat(singles))
    signals = dict(batch.signals)  # each is moved when it is asked for
    for b, single in enumerate(singles):
        for name, value in single.signals.items():
            whole = signals[name]
            assert torch.equal(value[0], whole[b]) if isinstance(value, Tensor) else value[0] == whole[b]


@only(DepthFrame)
def test_what_becomes_of_a_capture_keeps_its_signals(example):
    data = example.make(COUNTS[:2])
    for name, (values, kind, frame) in marked(1, poses=True).items():
        data = data.with_signal(name, values, kind, frame and data.frame_id)
    result = run(example, data)
    assert list(result.recorded_signals) == list(data.recorded_signals)
    count = result.num_clouds if isinstance(result, PointCloud) else 1
    for name, signal in data.recorded_signals.items():
        assert result.recorded_signals[name].same_bits(signal.repeated(count)), name


def carrying(values: Tensor, frame: str = "base") -> DepthFrame:
    return frame_with_counts().with_signal("place", values, "position", frame)


def test_a_chain_from_captures_keeps_signals_whether_or_not_its_beginning_is_fused():
    frame = carrying(PLACE.float())
    steps = [T.Deproject(), T.ToFrame(frame="base"), T.CropWorkspace(frame="base", lower=(-9, -9, -9), upper=(9, 9, 9))]
    fused = T.Compose(steps)(frame)
    data = frame
    for step in steps:
        data = step(data)
    assert_same(fused, data)
    assert torch.equal(fused.signals["place"], PLACE.float().repeat(2, 1))
    merged = T.MergeViews()(fused)
    assert torch.equal(merged.signals["place"], PLACE.float())
    assert merged.recorded_signals["place"].frame == "base"


def test_views_whose_signals_disagree_are_not_merged():
    clouds = T.Compose([T.Deproject(), T.ToFrame(frame="base")])(frame_with_counts())
    two = torch.stack([PLACE[0], PLACE[0] + 1e-9])
    with pytest.raises(CaptureError, match=r"MergeViews: signal 'place' of view 1 is not that"):
        T.MergeViews()(clouds.with_signal("place", two, "position", "base"))
    with pytest.raises(CaptureError, match=r"MergeViews: signal 'joints'"):
        T.MergeViews()(clouds.with_signal("joints", two, "invariant"))
    with pytest.raises(FrameError, match=r"'camera'.* lies elsewhere for each view.*attach them in 'base'"):
        T.MergeViews()(clouds.with_signal("place", PLACE.repeat(2, 1), "position", "camera"))


def test_merging_one_view_remembers_where_the_camera_of_a_signal_was():
    frame = frame_with_counts((50,)).with_signal("place", PLACE, "position", "camera")
    cloud = T.Compose([T.Deproject(), T.ToFrame(frame="base"), T.MergeViews()])(frame)
    expected = transform_points(PLACE, torch.tensor([0, 1]), frame.world_from_camera)
    close(cloud.signals["place"], expected)
    assert cloud.recorded_signals["place"].same_bits(frame.recorded_signals["place"])
    assert torch.equal(cloud.to_frame("camera").signals["place"], PLACE)


def test_merging_turned_views_makes_where_they_are_the_frame_of_their_name():
    clouds = T.Compose([T.Deproject(), T.ToFrame(frame="base")])(carrying(PLACE))
    turn = base_from_camera(1, seed=3)
    cloud = T.MergeViews()(clouds.transformed(turn.repeat(2, 1, 1)))
    close(cloud.signals["place"], transform_points(PLACE, torch.tensor([0, 1]), turn))
    close(cloud.in_source_frame().signals["place"], cloud.signals["place"])


def test_a_fused_cloud_has_the_signals_of_its_capture():
    views = carrying(PLACE)
    step = T.FuseTSDF(frame="base", voxel_size=0.05)
    assert torch.equal(step(views).signals["place"], PLACE)
    one = frame_with_counts((150,)).with_signal("place", PLACE, "position", "camera")
    close(step(one).signals["place"], transform_points(PLACE, torch.tensor([0, 1]), one.world_from_camera))


def test_an_action_points_at_its_cube_after_all_that_may_be_done_with_the_cloud():
    """Aimed at a point, it is where that point is, through normalization, turns, scales and shifts."""
    cloud = cloud_in_base((400,), seed=3)
    target = cloud.points[123:124].clone()
    cloud = cloud.with_signal("action", torch.cat([target, torch.zeros(1, 1)], 1), "position + invariant 1", "base")
    chain = T.Compose(
        [
            T.NormalizeWorkspace(frame="base", lower=(-0.5, -0.4, -0.3), upper=(0.5, 0.4, 0.9)),
            T.RandomRotation(axis=None),
            T.RandomScale(per_axis=True),
            T.RandomTranslation(max_offset=0.5),
            T.Center(),
        ]
    )
    result = chain(cloud, generator=seeded(5))
    row = torch.nonzero(result.source_index == cloud.source_index[123]).squeeze(1)
    close(result.signals["action"][:, :3], result.points[row])


def test_a_calibration_given_later_leaves_a_signal_of_the_base_in_the_base():
    frame = frame_with_counts((50,)).with_signal("place", PLACE, "position", "base")
    better = base_from_camera(1, seed=8)[0]
    step = T.ToFrame(frame="base", matrix=tuple(map(tuple, better.tolist())), start="camera")
    cloud = T.Compose([T.Deproject(), step])(frame)
    assert torch.equal(cloud.signals["place"], PLACE)
    close(
        cloud.in_source_frame().signals["place"],
        transform_points(PLACE, torch.tensor([0, 1]), rigid.invert_rigid(better)[None]),
    )
