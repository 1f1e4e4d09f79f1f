"""Sources that join captures: averages of a still scene, and streams filtered in time."""

from __future__ import annotations

import json
import pickle
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pcdata.errors import CaptureError, ConfigError, DTypeError
from pcdata.functional import average_depth, depth_to_disparity, temporal_filter
from pcdata.io import AveragedSource, TemporalFilterDepth, TemporallyFilteredSource
from pcdata.structures import Camera, Confidence, DepthFrame, PointCloud
from pcdata.synthetic import SensorNoise, tabletop
from tests.factories import cloud_in_camera
from tests.messages import told

# Of images so small; that of a real camera, on its ten times longer focal length, has the same effect in millimetres.
NOISE = SensorNoise(disparity_sigma=0.01, disparity_step=1 / 256)


@dataclass
class Captures:
    """Frames by name, as a source."""

    frames: dict[str, DepthFrame | PointCloud]
    name: str = "captures"

    @property
    def ids(self) -> list[str]:
        return list(self.frames)

    def load(self, sample_id: str) -> DepthFrame | PointCloud:
        return self.frames[sample_id]


def recording(count: int = 10, *, seed: int = 0) -> Captures:
    scene = tabletop(seed, num_objects=3, noise=NOISE, size=(60, 80), floor=False)
    frames = [replace(frame, sample_id=f"{seed}-{i}") for i, frame in enumerate(scene.noisy_frames(count))]
    return Captures({frame.sample_id: frame for frame in frames})


def with_frame(captures: Captures, place: int, **changes) -> Captures:
    name = captures.ids[place]
    return Captures({**captures.frames, name: replace(captures.frames[name], **changes)})


def test_every_group_becomes_one_capture_called_after_its_first():
    first, second = recording(5, seed=0), recording(5, seed=1)
    source = AveragedSource(source=Captures({**first.frames, **second.frames}), num_frames=5)
    assert (source.ids, len(source), source.name) == (["0-0", "1-0"], 2, "captures")
    assert source.group("1-0") == [f"1-{i}" for i in range(5)]
    for sample_id, captures in (("0-0", first), ("1-0", second)):
        frame = source.load(sample_id)
        expected = average_depth(torch.stack([one.depth for one in captures.frames.values()]), min_count=3)
        assert torch.equal(frame.depth, expected.depth)
        original = captures.load(sample_id)
        assert torch.equal(frame.colors, original.colors)
        assert torch.equal(frame.world_from_camera, original.world_from_camera)
        assert (frame.sample_id, frame.capture_index) == (sample_id, 0)


def test_the_provenance_tells_what_was_dropped():
    captures = recording(10)
    depth = captures.load("0-4").depth.clone()
    there = (depth > 0).nonzero()[100]
    depth[tuple(there)] += 0.5
    captures = with_frame(captures, 4, depth=depth)
    source = AveragedSource(source=captures)
    facts = source.load("0-0").provenance["averaged"]
    json.dumps(facts, allow_nan=False)
    depths = torch.stack([one.depth for one in captures.frames.values()])
    average = average_depth(depths, min_count=3)
    assert facts["frames"] == captures.ids
    assert facts["readings"] == int((depths > 0).sum())
    assert facts["jumps"] == int(average.num_jumps.sum()) >= 1
    assert facts["jitter"] == int(average.num_jitter.sum())
    assert facts["too_few"] == int(((average.num_readings > 0) & (average.num_readings < 3)).sum()) > 0
    assert 0.0005 < facts["noise"] < 0.05


def test_a_moving_camera_is_refused_with_how_far_it_moved():
    captures = recording(4)
    pose = captures.load("0-2").world_from_camera.clone()
    pose[:, 0, 3] += 0.0005
    AveragedSource(source=with_frame(captures, 2, world_from_camera=pose), num_frames=4).load("0-0")
    pose[:, 0, 3] += 0.01
    moving = AveragedSource(source=with_frame(captures, 2, world_from_camera=pose), num_frames=4)
    with pytest.raises(CaptureError, match=r"'0-2' and '0-0' are 10\.5 mm and 0\.0000 rad apart"):
        moving.load("0-0")


def test_a_turning_camera_is_refused():
    captures = recording(4)
    pose = captures.load("0-1").world_from_camera.clone()
    turn = torch.tensor([[np.cos(0.01), -np.sin(0.01)], [np.sin(0.01), np.cos(0.01)]])
    pose[:, :3, :2] = pose[:, :3, :2] @ turn
    with pytest.raises(CaptureError, match=r"0\.0 mm and 0\.0100 rad apart"):
        AveragedSource(source=with_frame(captures, 1, world_from_camera=pose), num_frames=4).load("0-0")


def test_other_cameras_and_frames_are_refused():
    captures = recording(4)
    frame = captures.load("0-3")
    shifted = replace(frame.camera, intrinsics=frame.camera.intrinsics * torch.tensor([[1.01], [1.0], [1.0]]))
    lens = replace(frame.camera, distortion=torch.zeros(1, 5, dtype=torch.float64))
    for camera in (shifted, lens):
        with pytest.raises(CaptureError, match="other intrinsics or distortion"):
            AveragedSource(source=with_frame(captures, 3, camera=camera), num_frames=4).load("0-0")
    with pytest.raises(CaptureError, match="poses in 'elsewhere' and 'base'"):
        AveragedSource(source=with_frame(captures, 3, frame_id="elsewhere"), num_frames=4).load("0-0")
    small = tabletop(0, size=(30, 40)).frame
    with pytest.raises(CaptureError, match="must come from the same cameras"):
        AveragedSource(source=Captures({**captures.frames, "0-3": small}), num_frames=4).load("0-0")


def test_a_moving_scene_is_refused_where_no_pose_tells():
    captures = recording(4)
    still = Captures({k: replace(f, world_from_camera=None, frame_id=None) for k, f in captures.frames.items()})
    AveragedSource(source=still, num_frames=4).load("0-0")
    moved = with_frame(still, 3, depth=still.load("0-3").depth.roll(15, dims=2))
    with pytest.raises(CaptureError, match="the camera or the scene moved") as caught:
        AveragedSource(source=moved, num_frames=4).load("0-0")
    assert "while averaging '0-0' .. '0-3'" in told(caught.value)


def test_an_average_is_as_reliable_as_its_worst_reading():
    captures = recording(4)
    doubtful = torch.full(captures.load("0-1").depth.shape, int(Confidence.COMPLETED), dtype=torch.uint8)
    frame = AveragedSource(source=with_frame(captures, 1, confidence=doubtful), num_frames=4).load("0-0")
    seen = (captures.load("0-1").depth > 0) & (frame.depth > 0)
    assert bool((frame.confidence[seen] == Confidence.COMPLETED).all())
    assert bool((frame.confidence[(frame.depth > 0) & ~seen] == Confidence.RELIABLE).all())
    assert bool((frame.confidence[frame.depth == 0] == Confidence.NO_READING).all())


def test_readings_that_are_not_trusted_count_for_nothing():
    captures = recording(4)
    depth = captures.load("0-2").depth
    untrusted = torch.zeros(depth.shape, dtype=torch.uint8)
    with_wrong = with_frame(captures, 2, depth=depth + 1.0, confidence=untrusted)
    without = with_frame(captures, 2, depth=torch.zeros_like(depth))
    found, expected = (AveragedSource(source=one, num_frames=4).load("0-0") for one in (with_wrong, without))
    assert torch.equal(found.depth, expected.depth)
    assert torch.equal(found.confidence > 0, found.depth > 0)


def test_groups_must_come_out_even_and_samples_must_exist():
    with pytest.raises(CaptureError, match="10 captures are no whole number of groups of 4"):
        AveragedSource(source=recording(10), num_frames=4)
    with pytest.raises(CaptureError, match="no sample '0-1'; a group is called after its first capture"):
        AveragedSource(source=recording(10)).load("0-1")
    for wrong in ({"num_frames": 1}, {"min_count": 0}, {"min_count": 11}, {"max_moving": -0.1}):
        with pytest.raises(ConfigError, match="AveragedSource: needs"):
            AveragedSource(source=recording(10), **wrong)
    clouds = Captures({str(i): cloud_in_camera() for i in range(2)})
    with pytest.raises(DTypeError, match="averages depth frames"):
        AveragedSource(source=clouds, num_frames=2, min_count=1).load("0")


def test_a_stream_filtered_step_by_step_is_the_temporal_filter_in_disparity():
    frames = list(recording(6).frames.values())
    step = TemporalFilterDepth(alpha=0.3, delta=10.0, persistence=5, baseline=0.06)
    state = None
    for frame, filtered in zip(frames, step.frames(frames), strict=True):
        focal = frame.camera.intrinsics[:, 0, 0]
        expected, state = temporal_filter(
            depth_to_disparity(frame.depth, focal, 0.06), state, alpha=0.3, delta=10.0, persistence=5
        )
        torch.testing.assert_close(depth_to_disparity(filtered.depth, focal, 0.06), expected, rtol=1e-6, atol=0)
        repeated = (filtered.depth > 0) & (frame.depth == 0)
        if bool(repeated.any()):
            assert bool((filtered.confidence[repeated] == Confidence.COMPLETED).all())
    assert bool(repeated.any())


def test_a_filtered_capture_depends_on_its_window_alone():
    captures = recording(9)
    source = TemporallyFilteredSource(source=captures, num_frames=4)
    assert (source.ids, len(source), source.name) == (captures.ids, 9, "captures")
    for place in (0, 2, 8):
        window = list(captures.frames.values())[max(0, place - 3) : place + 1]
        *_, expected = TemporalFilterDepth().frames(window)
        frame = source.load(captures.ids[place])
        assert torch.equal(frame.depth, expected.depth)
        assert frame.provenance["temporal_filter"]["frames"] == [one.sample_id for one in window]
    assert torch.equal(pickle.loads(pickle.dumps(source)).load("0-8").depth, source.load("0-8").depth)


def test_a_filtered_stream_is_less_noisy_than_its_frames():
    scene = tabletop(0, num_objects=0, noise=NOISE, size=(60, 80), floor=False)
    captures = Captures({str(i): frame for i, frame in enumerate(scene.noisy_frames(12))})
    filtered = TemporallyFilteredSource(source=captures).load("11").depth
    last, truth = captures.load("11").depth, scene.truth.depth.float()
    both = (filtered > 0) & (last > 0)
    before, after = ((depth - truth)[both].square().mean().sqrt() for depth in (last, filtered))
    assert float(after) < 0.6 * float(before)  # 0.5 is what the weights of alpha = 0.4 give


def test_a_stream_of_a_moving_camera_is_refused():
    captures = recording(3)
    pose = captures.load("0-2").world_from_camera.clone()
    pose[:, 2, 3] += 0.1
    source = TemporallyFilteredSource(source=with_frame(captures, 2, world_from_camera=pose))
    source.load("0-1")
    with pytest.raises(CaptureError, match=r"TemporalFilterDepth: .* are 100\.0 mm"):
        source.load("0-2")
    with pytest.raises(CaptureError, match="no sample '0-7'"):
        source.load("0-7")
    for wrong in ({"alpha": 0.0}, {"delta": 0.0}, {"persistence": 9}, {"baseline": 0.0}):
        with pytest.raises(ConfigError, match="TemporalFilterDepth: needs"):
            TemporalFilterDepth(**wrong)


@pytest.fixture(scope="module")
def stream(test_data: Path) -> Captures:
    """Ten frames of a tabletop on which something moves, from a camera that moves too."""
    camera = Camera.pinhole(fx=927.17, fy=927.37, cx=651.32, cy=349.62, size=(720, 1280))
    files = [test_data / "tabletop_stream" / f"depth_{number:03d}.npy" for number in range(10)]
    depths = [torch.from_numpy(np.load(file).astype(np.float32))[None] / 1000 for file in files]
    return Captures({f.stem: DepthFrame(depth=d, camera=camera, sample_id=f.stem) for f, d in zip(files, depths)})


def test_a_real_stream_that_moves_is_not_averaged(stream):
    with pytest.raises(CaptureError, match="of the readings lie on another surface"):
        AveragedSource(source=stream).load("depth_000")


def test_the_temporal_filter_follows_a_real_stream_that_moves(stream):
    *_, (frame, filtered) = zip(stream.frames.values(), TemporalFilterDepth().frames(stream.frames.values()))
    both = (frame.depth > 0) & (filtered.depth > 0)
    disparity, smoothed = (
        depth_to_disparity(one.depth, one.camera.intrinsics[:, 0, 0], 0.05)[both] for one in (frame, filtered)
    )
    # It averages with what lies within delta and takes the rest as it is, so it never strays further than delta.
    assert float((disparity - smoothed).abs().max()) < 20.0
    assert torch.equal(filtered.depth > 0, (frame.depth > 0) | (filtered.confidence == Confidence.COMPLETED))


class _Signalled:
    """Captures of a still wall whose joints change, one after another."""

    def __init__(self, count: int) -> None:
        self.ids = [f"{number:02d}" for number in range(count)]

    def load(self, sample_id: str) -> DepthFrame:
        number = int(sample_id)
        return DepthFrame.from_numpy(
            np.full((6, 8), 1000 + number % 3, np.uint16),
            [[8.0, 0, 3.5], [0, 8.0, 2.5], [0, 0, 1]],
            metres_per_unit=0.001,
            sample_id=sample_id,
            signals={"q": (np.array([number, 1.0], np.float32), "invariant"), "task": ("look", "text")},
        )


def test_an_average_has_the_signals_of_its_first_capture_and_names_those_that_changed():
    averaged = AveragedSource(source=_Signalled(6), num_frames=3)
    frame = averaged.load("03")
    assert frame.signals["q"].tolist() == [[3.0, 1.0]]
    assert frame.signals["task"] == ("look",)
    assert frame.provenance["averaged"]["changing_signals"] == ["q"]


def test_what_does_not_make_a_group_is_named_so_that_it_can_be_left_out():
    with pytest.raises(CaptureError, match="5 captures are no whole number") as caught:
        AveragedSource(source=_Signalled(5), num_frames=3)
    assert "skip=['03', '04']" in str(caught.value)
    with pytest.raises(ConfigError, match=r"min_count 3.*say min_count=2 too"):
        AveragedSource(source=_Signalled(4), num_frames=2)
