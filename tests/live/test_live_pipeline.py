"""A live pipeline answers as offline, names what is wrong with a frame, and goes on."""

from __future__ import annotations

import gc
import threading
import time
import tracemalloc
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

import pcdata
from pcdata.errors import ConfigError, DTypeError, TooFewPointsError
from pcdata.live import Fault, LiveAverage, LivePipeline, LiveTemporalFilter
from pcdata.synthetic import tabletop
from tests.live_stream import SIZE, arrays, assert_equal, chain, moved, of_arrays


def test_clouds_are_those_of_the_offline_pipeline(scene):
    live, offline = LivePipeline(chain(), like=scene), chain()
    for number in range(4):
        answer = live(moved(scene, number), stamp=float(number))
        assert answer.fault is None
        assert (answer.number, answer.stamp) == (number, float(number))
        assert_equal(answer.cloud, offline(moved(scene, number)))


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_arrays_give_what_from_numpy_gives_offline(scene, dtype):
    live, offline = LivePipeline(chain(), like=of_arrays(scene)), chain()
    for number in range(4):
        frame = moved(scene, number)
        depth, colors, pose = arrays(frame)
        answer = live(depth.astype(dtype), colors=colors[..., ::-1][..., ::-1], pose=pose)
        assert answer.fault is None, answer.reason
        assert_equal(answer.cloud, offline(of_arrays(frame)))


def test_a_yaml_file_is_the_same_chain(scene, tmp_path):
    path = tmp_path / "policy.yaml"
    path.write_text(chain().to_yaml())
    live = LivePipeline(path, like=scene)
    assert live.chain.fingerprint() == pcdata.load_config(path).pipeline.fingerprint() == chain().fingerprint()
    assert_equal(live(moved(scene, 1)).cloud, chain()(moved(scene, 1)))


def test_a_cloud_is_its_callers_whatever_comes_after(scene):
    live = LivePipeline(pcdata.Compose([pcdata.Deproject()]), like=of_arrays(scene))
    kept, copies = [], []
    for number in range(4):
        depth, colors, pose = arrays(moved(scene, number))
        cloud = live(depth, colors=colors, pose=pose).cloud
        depth[:], colors[:] = 0, 0
        kept.append(cloud)
        copies.append({name: value.clone() for name, value in cloud.fields().items()})
    for cloud, copy in zip(kept, copies):
        assert all(torch.equal(value, copy[name]) for name, value in cloud.fields().items())
        cloud.points.zero_()  # and what they do with it disturbs nobody
    assert live(arrays(scene)[0], colors=arrays(scene)[1], pose=arrays(scene)[2]).cloud.points.abs().sum() > 0


FAULTS = {
    "size": (lambda f: replace(f, **_half(f)), Fault.OTHER_FORM, "80x60"),
    "colors": (lambda f: replace(f, colors=None), Fault.OTHER_FORM, "colors"),
    "camera": (lambda f: replace(f, camera=_other(f.camera)), Fault.OTHER_CAMERA, "intrinsics"),
    "frame": (lambda f: replace(f, frame_id="elsewhere"), Fault.OTHER_CAMERA, "elsewhere"),
    "empty": (lambda f: replace(f, depth=f.depth * 0), Fault.EMPTY, "reading"),
    "far": (lambda f: replace(f, depth=f.depth + 30), Fault.FAILED_STEP, "Deproject"),
    "array size": (lambda f: np.ones((3, 4), np.uint16), Fault.OTHER_FORM, "(3, 4)"),
    "dtype": (lambda f: np.ones(SIZE, np.uint8), Fault.OTHER_FORM, "colors"),
    "nothing": (lambda f: None, Fault.OTHER_FORM, ""),
    "text": (lambda f: "frame", Fault.OTHER_FORM, ""),
    "ragged": (lambda f: [[1], [2, 3]], Fault.OTHER_FORM, ""),
}


def _other(camera):
    intrinsics = camera.intrinsics.clone()
    intrinsics[:, 0, 2] += 0.5
    return replace(camera, intrinsics=intrinsics)


def _half(frame):
    return {
        "depth": frame.depth[:, ::2],
        "colors": frame.colors[:, ::2],
        "labels": None if frame.labels is None else frame.labels[:, ::2],
        "mask": None if frame.mask is None else frame.mask[:, ::2],
        "confidence": None if frame.confidence is None else frame.confidence[:, ::2],
        "camera": frame.camera.resized((30, 80)),
    }


@pytest.mark.parametrize("name", FAULTS)
def test_a_bad_frame_is_named_counted_and_does_not_stop_the_stream(scene, name):
    spoil, fault, told = FAULTS[name]
    live = LivePipeline(chain(), like=scene)
    assert live(moved(scene, 0)).cloud is not None
    answer = live(spoil(moved(scene, 1)))
    assert (answer.cloud, answer.fault) == (None, fault)
    assert told in answer.reason
    after = live(moved(scene, 2))
    assert_equal(after.cloud, chain()(moved(scene, 2)))
    stats = live.stats()
    assert (stats.frames, stats.clouds, stats.faults) == (3, 2, {str(fault): 1})


def test_nan_in_depth_that_was_changed_in_place_is_told(scene):
    live, frame = LivePipeline(chain(), like=scene), moved(scene, 1)
    frame.depth[0, 3, 3] = torch.nan
    assert live(frame).fault is Fault.BAD_VALUES
    frame.depth[0, 3, 3] = -1.0
    assert live(frame).fault is Fault.BAD_VALUES


def test_bad_values_of_arrays_are_told(scene):
    live = LivePipeline(chain(), like=of_arrays(scene))
    depth, colors, pose = arrays(scene)
    lost = pose.copy()
    lost[0, 0] = np.nan
    assert live(depth, colors=colors, pose=lost).fault is Fault.BAD_VALUES
    assert live(depth, colors=colors).fault is Fault.OTHER_FORM
    assert live(depth, colors=colors.astype(np.float32), pose=pose).fault is Fault.OTHER_FORM
    assert live(depth, colors=colors, pose=pose).fault is None
    answer = live(depth.astype(np.float64) + 1, colors=colors, pose=pose)
    assert answer.fault is Fault.OTHER_FORM
    assert "float64" in answer.reason


def test_a_frozen_camera_is_told_by_its_stamps_and_by_its_pixels(scene):
    live = LivePipeline(chain(), like=scene)
    assert live(moved(scene, 1), stamp=1.0).fault is None
    assert live(moved(scene, 2), stamp=1.0).fault is Fault.FROZEN
    for stamp in (2.0, 3.0):
        assert live(moved(scene, 1), stamp=stamp).fault is Fault.FROZEN
    assert live(moved(scene, 2), stamp=4.0).fault is None
    frame = moved(scene, 3)
    assert live(frame).fault is None
    frame.depth.add_(0.001)  # a driver that fills one buffer again and again
    assert live(frame).fault is None
    assert LivePipeline(chain(), like=scene, same_pixels=False)(scene).fault is None


def test_a_frozen_camera_of_arrays_thaws(scene):
    live = LivePipeline(chain(), like=of_arrays(scene))
    for number, expected in ((1, None), (1, "frozen"), (1, "frozen"), (2, None), (2, "frozen"), (1, None)):
        depth, colors, pose = arrays(moved(scene, number))
        assert live(depth, colors=colors, pose=pose).fault == expected


def test_late_frames_old_ones_and_other_clocks_are_told(scene):
    now = [100.0]
    live = LivePipeline(chain(), like=scene, max_age=0.1, clock=lambda: now[0])

    def fault(number, stamp):
        return live(moved(scene, number), stamp=stamp).fault

    assert fault(1, 99.95) is None
    assert fault(2, 99.8) is Fault.LATE
    assert fault(3, 99.93) is Fault.OUT_OF_ORDER
    assert fault(4, 100.05) is None  # clocks differ a little
    assert fault(5, 1000.0) is Fault.WRONG_CLOCK
    assert fault(6, float("nan")) is Fault.WRONG_CLOCK
    assert fault(7, "now") is Fault.WRONG_CLOCK
    assert fault(8, np.float32(100.0625)) is None
    assert live.stats().faults == {"late": 1, "out_of_order": 1, "wrong_clock": 3}


def test_stamps_that_begin_anew_are_followed_after_some_frames(scene):
    live = LivePipeline(chain(), like=scene)
    faults = [live(moved(scene, n), stamp=s).fault for n, s in enumerate((1000.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0))]
    assert faults == [None, *["out_of_order"] * 4, None, None]
    assert live.stats().restarts == 1
    live.reset()
    assert live(moved(scene, 9), stamp=0.5).fault is None


def test_what_is_wrong_with_the_chain_is_raised_at_the_start(scene):
    with pytest.raises(ConfigError, match="from captures to clouds"):
        LivePipeline(pcdata.Compose([pcdata.FarthestPointSample(num_points=4)]), like=scene)
    with pytest.raises(ConfigError, match="random"):
        LivePipeline(pcdata.Compose([pcdata.Deproject(), pcdata.RandomJitter(sigma=0.01)]), like=scene)
    with pytest.raises(TooFewPointsError):
        LivePipeline(chain(), like=replace(scene, depth=scene.depth * 0))
    with pytest.raises(DTypeError, match="from_numpy"):
        LivePipeline(chain(), like=scene.depth.numpy())
    with pytest.raises(DTypeError, match="Compose"):
        LivePipeline([pcdata.Deproject()], like=scene)
    with pytest.raises(DTypeError, match="LiveTemporalFilter"):
        LivePipeline(chain(), like=scene, before=pcdata.TemporalFilterDepth())
    with pytest.raises(ConfigError, match="max_age"):
        LivePipeline(chain(), like=scene, max_age=0)


def test_random_steps_are_drawn_for_anew_with_the_seed(scene):
    steps = pcdata.Compose([pcdata.Deproject(), pcdata.RandomSample(num_points=50)])
    live = LivePipeline(steps, like=scene, seed=7)
    for number in range(2):
        expected = steps(moved(scene, number), generator=torch.Generator().manual_seed(7))
        assert_equal(live(moved(scene, number)).cloud, expected)


def test_the_temporal_filter_remembers_and_forgets(scene):
    live, offline = LivePipeline(chain(), like=scene, before=LiveTemporalFilter(max_gap=0.2)), chain()
    frames = [moved(scene, number) for number in range(6)]
    stamps = [0.0, 0.1, 0.2, 1.0, 1.1, 1.2]
    turned = scene.world_from_camera.clone()
    turned[:, 0, 3] += 0.01
    frames[5] = replace(frames[5], world_from_camera=turned)
    found = [live(frame, stamp=stamp).cloud for frame, stamp in zip(frames, stamps)]
    parts = (frames[:3], frames[3:5], frames[5:])  # a gap, and a camera that moved
    expected = [frame for part in parts for frame in pcdata.TemporalFilterDepth().frames(part)]
    for cloud, frame in zip(found, expected, strict=True):
        assert_equal(cloud, offline(frame))
    assert live.stats().resets == 2
    assert "LiveTemporalFilter" in live.stats().latency


def test_the_average_is_that_of_the_last_frames_and_forgets_a_scene_that_moved(scene):
    average = LiveAverage(num_frames=3)
    frames = [moved(scene, number) for number in range(4)]
    for frame in frames:
        result = average(frame)
    from pcdata.functional.depth.average import average_depth

    window = torch.stack([frame.depth for frame in (frames[3], frames[2], frames[1])])
    assert torch.equal(result.depth, average_depth(window, min_count=3).depth)
    other = replace(scene, depth=torch.where(scene.depth > 0, scene.depth + 0.3, 0.0))
    assert torch.allclose(average(other).depth, other.depth)
    assert average.resets == 1


def test_a_warm_start_is_checked_and_not_trusted(scene):
    live, cold = LivePipeline(chain(), like=scene, warm_planes=True), chain()
    for number in range(3):
        plane, expected = (
            one.meta[0]["planes"][0] for one in (live(moved(scene, number)).cloud, cold(moved(scene, number)))
        )
        assert np.dot(plane["normal"], expected["normal"]) > 0.999
        assert plane["num_inliers"] > 0.98 * expected["num_inliers"]
    for wrong in (([0.0, 0.0, 1.0], -9.0), ([1.0, 0.0, 0.0], 0.0), ([0.0, 0.0, 0.0], 0.0)):
        live._runs._planes = [{"normal": wrong[0], "offset": wrong[1], "frame": "camera"}]
        assert_equal(live(moved(scene, 5)).cloud, cold(moved(scene, 5)))
        live.reset()


def test_memory_does_not_grow(scene):
    """With faults among the frames; benchmarks/live.py looks at 10,000 of the whole chain."""
    small = tabletop(3, num_views=1, size=(12, 16)).frame
    steps = pcdata.Compose([pcdata.MaskDepth(near=0.1, far=5.0), pcdata.Deproject()])
    like = of_arrays(small)
    live = LivePipeline(steps, like=like, max_age=1.0)
    depth, colors, pose = arrays(small)

    def run(count):
        for number in range(count):
            depth[number % 12, 3] = 500 + number % 7
            live(depth, colors=colors, pose=pose, stamp=time.monotonic() - (2.0 if number % 50 == 7 else 0.0))
            if number % 50 == 3:
                live(depth[:5], colors=colors, pose=pose)

    run(200)
    gc.collect()
    tracemalloc.start()
    try:
        run(50)
        gc.collect()
        before, _ = tracemalloc.get_traced_memory()
        run(1_000)
        gc.collect()
        after, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert after - before < 16_384  # an object a frame would be three times as much
    resident = _resident()
    run(2_000)
    assert _resident() - resident < 1 << 20
    assert live.stats().faults == {"late": 65, "other_form": 65}


def _resident():
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * 4096


def test_percentiles_are_those_of_the_latencies():
    from pcdata.live.latency import Histogram

    seconds = np.random.default_rng(0).lognormal(-4.5, 0.5, 5000)
    histogram = Histogram()
    for one in seconds:
        histogram.add(float(one))
    told = histogram.summary()
    for share, found in ((50, told.median), (90, told.p90), (99, told.p99), (99.9, told.p999)):
        true = float(np.percentile(seconds, share, method="inverted_cdf"))
        assert true <= found * (1 + 1e-9)
        assert found <= true * 1.021
    assert told.worst == seconds.max()
    assert told.mean == pytest.approx(seconds.mean())
    assert sum(histogram.bins()["count"]) == told.count == 5000
    histogram.add(1e9)
    histogram.add(0.0)
    assert histogram.summary().worst == 1e9
    assert Histogram().summary().p99 == 0.0


def test_every_pass_has_its_latency(scene):
    live = LivePipeline(chain(), like=scene)
    live(moved(scene, 0))
    latency = live.stats().latency
    names = [type(step).__name__ for step in chain().steps]
    assert " + ".join(list(latency)[1:]) == " + ".join(names)
    assert all(one.count == 1 for one in latency.values())
    assert "RemovePlane" in str(live.stats())
    live.reset_stats()
    assert live.stats().frames == live.stats().clouds == 0


def test_a_warning_is_no_fault(scene):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        live = LivePipeline(pcdata.Compose([pcdata.Deproject()]), like=scene)
        assert live(moved(scene, 0)).fault is None


def test_other_defaults_of_torch_change_nothing(scene):
    frame, like = moved(scene, 1), of_arrays(scene)
    expected = chain()(frame)
    depth, colors, pose = arrays(frame)
    torch.set_default_dtype(torch.float64)
    try:
        assert_equal(LivePipeline(chain(), like=scene)(frame).cloud, expected)
        live = LivePipeline(chain(), like=like, warm_planes=True, before=LiveTemporalFilter())
        for _ in range(2):
            assert live(depth, colors=colors, pose=pose).cloud.points.dtype is torch.float32
            depth[5, 5] += 1
    finally:
        torch.set_default_dtype(torch.float32)


def test_threads_take_turns(scene):
    live, found = LivePipeline(chain(), like=scene, same_pixels=False), {}
    expected = [chain()(moved(scene, number)) for number in range(4)]
    frames = [moved(scene, number) for number in range(4)]
    threads = [threading.Thread(target=lambda n=n: found.update({n: live(frames[n])})) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for number in range(4):
        assert_equal(found[number].cloud, expected[number])
    assert sorted(answer.number for answer in found.values()) == [0, 1, 2, 3]


def test_interrupts_pass(scene, monkeypatch):
    live = LivePipeline(chain(), like=scene)

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(pcdata.RemovePlane, "transform", interrupted)
    with pytest.raises(KeyboardInterrupt):
        live(moved(scene, 0))
    monkeypatch.undo()
    assert live(moved(scene, 1)).fault is None  # nothing is held
