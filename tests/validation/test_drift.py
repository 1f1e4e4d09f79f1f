"""Drift: a camera that moved is found, measured and dated; one that did not is left in peace."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from pcdata import DepthFrame, PointCloud
from pcdata.errors import CaptureError, ConfigError, DTypeError
from pcdata.geometry.small_motions import motion_from_twist
from pcdata.report.html.drift_page import drift_page
from pcdata.synthetic import tabletop
from pcdata.validation.drift import measure_drift
from pcdata.verdicts import Verdict
from tests.validation.captures import Frames

SIZE = HEIGHT, WIDTH = 180, 240


def motion(millimetres: float, degrees: float) -> torch.Tensor:
    """(4, 4): along (2, 1, -1), about (1, 2, 0.5)."""
    along, about = (torch.nn.functional.normalize(torch.tensor(one), dim=0) for one in ([2.0, 1, -1], [1, 2, 0.5]))
    twist = torch.cat([math.radians(degrees) * about, millimetres / 1e3 * along]).double()
    return motion_from_twist(twist, torch.zeros(3, dtype=torch.float64))


def session(motions: list[torch.Tensor], *, seed: int = 0, arm: bool = False, poses: bool = False) -> Frames:
    """A camera that is where the motions say, three captures at each; an arm may sweep through its image."""
    pose = tabletop(seed, size=SIZE).frame.world_from_camera
    frames: list[DepthFrame] = []
    for moved in motions:
        scene = tabletop(seed, noise="stereo", size=SIZE, world_from_camera=pose @ moved)
        frames += [scene.render(seed_noise=len(frames) + number) for number in range(3)]
    kept = []
    for place, frame in enumerate(frames):
        depth = frame.depth.clone()
        if arm:
            x = int((0.5 + 0.45 * math.sin(0.9 * place)) * (WIDTH - 60))
            depth[0, 40:120, x : x + 60] = (depth[0, 40:120, x : x + 60] - 0.15).clamp(min=0.2)
        still = {} if poses else {"world_from_camera": None, "frame_id": None}
        kept.append(replace(frame, depth=depth, colors=None, sample_id=f"f{place}", **still))
    return Frames(kept)


HERE = motion(0, 0)


@pytest.mark.parametrize(
    ("millimetres", "degrees", "arm"), [(2, 0, True), (10, 0, False), (0, 0.2, True), (0, 1.0, False)]
)
def test_a_step_is_found_measured_and_dated(millimetres, degrees, arm):
    there = motion(millimetres, degrees)
    (camera,) = measure_drift(session([HERE] * 3 + [there] * 3, arm=arm), window=3).cameras
    assert (camera.kind, camera.verdict) == ("step", Verdict.FAIL)
    assert camera.since in ("f7", "f8", "f9")  # a window that holds the step, or the first after it
    moved = np.median([point.camera_shift for point in camera.points[-3:]], axis=0)
    assert np.linalg.norm(moved - there[:3, 3].numpy()) < 0.2 * 2e-3 + 0.05 * millimetres / 1e3
    assert camera.rotation_degrees == pytest.approx(degrees, rel=0.2, abs=0.05)
    assert "at once" in camera.told


def test_a_slow_ramp_is_found():
    slow = [motion(place, 0) for place in range(7)]
    (camera,) = measure_drift(session(slow), window=3).cameras
    assert (camera.kind, camera.verdict) == ("ramp", Verdict.FAIL)
    assert camera.shift == pytest.approx(0.006, rel=0.2)


@pytest.mark.parametrize("seed", range(3))
def test_a_still_camera_raises_no_alarm(seed):
    (camera,) = measure_drift(session([HERE] * 4, seed=seed, arm=seed == 1), window=3).cameras
    assert camera.kind == "still"
    assert camera.verdict in (Verdict.PASS, Verdict.UNKNOWN)
    assert camera.shift < 5e-4
    assert camera.since == ""


@pytest.mark.parametrize("poses", [True, False], ids=["with poses", "without poses"])
def test_a_camera_in_a_hand_is_moving_and_did_not_drift(poses):
    carried = [motion(120 * place, 6 * place) for place in range(6)]
    result = measure_drift(session(carried, poses=poses), window=3, num_windows=6)
    assert result.cameras[0].kind == "moving"
    assert result.verdict is Verdict.UNKNOWN
    assert result.advice == ""


def test_against_another_recording():
    monday, tuesday = session([HERE] * 2), session([motion(5, 0)] * 2, seed=0)
    (camera,) = measure_drift(tuesday, reference=monday, window=3).cameras
    assert camera.verdict is Verdict.FAIL
    assert camera.since == "f0"
    assert camera.shift == pytest.approx(0.005, rel=0.2)


def test_a_bare_wall_says_that_it_cannot_tell():
    frames = []
    for place in range(8):
        noise = 0.001 * torch.randn(SIZE, generator=torch.Generator().manual_seed(place))
        frame = tabletop(0, size=SIZE).frame
        wall = (0.8 + noise)[None]
        plain = {"world_from_camera": None, "frame_id": None, "colors": None, "labels": None}
        frames.append(replace(frame, depth=wall, sample_id=f"f{place}", **plain))
    (camera,) = measure_drift(Frames(frames), window=3).cameras
    assert camera.verdict is Verdict.UNKNOWN
    assert len(camera.unmeasurable) == 3  # along the wall twice, and about what points to it


def test_the_worst_of_several_cameras_is_named():
    first, second = session([HERE] * 4), session([HERE] * 2 + [motion(6, 0)] * 2)
    both = []
    for one, other in zip(first.frames, second.frames):
        camera = replace(
            one.camera,
            intrinsics=torch.cat([one.camera.intrinsics, other.camera.intrinsics]),
        )
        depth = torch.cat([one.depth, other.depth])
        both.append(replace(one, depth=depth, labels=None, camera=camera, provenance={"cameras": ["left", "right"]}))
    result = measure_drift(Frames(both), window=3)
    assert [camera.verdict.value for camera in result.cameras] == ["pass", "fail"]
    assert "view 1 (right)" in result.advice
    assert result.text().splitlines()[0] == "drift: fail"
    told = json.loads(json.dumps(result.to_json(), allow_nan=False))
    assert told["cameras"][1]["kind"] == "step"
    page = drift_page(result, "monday")
    assert page.index("view 1 (right)") < page.index("view 0 (left)")


def test_what_it_cannot_take_is_refused():
    few = session([HERE])
    with pytest.raises(CaptureError, match="needs 6 captures or more"):
        measure_drift(few, window=3)
    with pytest.raises(ConfigError, match="window"):
        measure_drift(few, window=0)
    clouds = Frames([PointCloud(points=torch.rand(5, 3), frame_id="base")] * 8)  # type: ignore[list-item]
    clouds.load = lambda sample_id: clouds.frames[0]  # type: ignore[method-assign]
    with pytest.raises(DTypeError, match="no depth image"):
        measure_drift(clouds, window=2)
