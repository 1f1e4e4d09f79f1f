"""The sensor model: each effect has the size it states, alone and measured on surfaces that are known."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from pcdata.errors import ConfigError
from pcdata.functional.depth.sensor_noise import facing_depth
from pcdata.rng import seeded
from pcdata.structures import Camera
from pcdata.synthetic import SensorNoise, Tabletop, look_at, tabletop

OFF = {
    "disparity_sigma": 0.0, "disparity_step": 0.0, "depth_step": 0.0, "min_range": 0.0, "max_range": math.inf,
    "edge_dropout": 0.0, "dropout": 0.0, "flying_pixels": 0.0,
}  # fmt: skip
FOCAL = 600.0


def _only(**fields: float) -> SensorNoise:
    return SensorNoise(**{**OFF, **fields})


def _flat(noise: SensorNoise, depth: float, size: int = 200) -> Tensor:
    return noise.apply(torch.full((1, size, size), depth).double(), torch.tensor([FOCAL]), [seeded(1)])


def _step_edge() -> Tensor:
    """Left half at 1 m, right half at 1.5 m: columns 199 and 200 are the edge."""
    depth = torch.ones(1, 400, 400).double()
    depth[..., 200:] = 1.5
    return depth


def test_a_sensor_without_faults_reports_the_truth() -> None:
    depth = _step_edge()
    assert torch.equal(_only().apply(depth, torch.tensor([FOCAL]), [seeded(0)]), depth.float())


@pytest.mark.parametrize("distance", [0.4, 0.8, 1.6, 3.2])
def test_depth_error_grows_with_the_square_of_the_distance(distance: float) -> None:
    noise = _only(disparity_sigma=0.1, baseline=0.06)
    error = _flat(noise, distance).double() - distance
    expected = distance**2 * 0.1 / (FOCAL * 0.06)
    assert float(error.std()) == pytest.approx(expected, rel=0.05)
    assert abs(float(error.mean())) < 0.05 * expected + distance * (expected / distance) ** 2 * 2
    assert float(noise.depth_sigma(torch.tensor(distance), FOCAL)) == pytest.approx(expected)


@pytest.mark.parametrize("height", [0.6, 1.2])
def test_the_rendered_table_shows_the_stated_error(height: float) -> None:
    camera = Camera.pinhole(fx=FOCAL, fy=FOCAL, cx=79.5, cy=59.5, size=(120, 160))
    noise = _only(disparity_sigma=0.08)
    scene = tabletop(0, 0, noise=noise, camera=camera, world_from_camera=look_at((0, 0, height))[None])
    error = (scene.frame.depth.double() - scene.truth.depth)[scene.truth.labels == 0]
    assert float(error.std()) == pytest.approx(height**2 * 0.08 / (FOCAL * 0.055), rel=0.05)


def test_depth_is_rounded_to_its_unit() -> None:
    depth = torch.linspace(0.5, 2.0, 4000).double().reshape(1, 40, 100)
    reading = _only(depth_step=0.001).apply(depth, torch.tensor([FOCAL]), [seeded(0)]).double()
    assert float((reading * 1000 - (reading * 1000).round()).abs().max()) < 1e-3  # float32 at 2000 mm
    error = (reading - depth).abs()
    assert float(error.max()) == pytest.approx(0.0005, rel=0.02)


def test_disparity_steps_leave_gaps_that_grow_with_distance() -> None:
    depth = torch.linspace(0.9, 1.1, 20000).double().reshape(1, 100, 200)
    step = 1 / 16
    reading = _only(disparity_step=step, baseline=0.05).apply(depth, torch.tensor([FOCAL]), [seeded(0)])
    levels = reading.unique()
    disparity = FOCAL * 0.05 / levels.double()
    torch.testing.assert_close(disparity / step, (disparity / step).round(), atol=1e-3, rtol=0)
    near_one_metre = levels[(levels > 0.98) & (levels < 1.02)].diff()
    assert float(near_one_metre.mean()) == pytest.approx(step / (FOCAL * 0.05), rel=0.05)


def test_dropout_loses_the_stated_part() -> None:
    lost = _flat(_only(dropout=0.2), 1.0, size=400) == 0
    assert float(lost.double().mean()) == pytest.approx(0.2, abs=0.005)  # 8 sigma


def test_edge_dropout_loses_the_stated_part_of_the_edge_and_nothing_else() -> None:
    reading = _only(edge_dropout=0.3).apply(_step_edge(), torch.tensor([FOCAL]), [seeded(0)])
    lost = reading[0] == 0
    assert float(lost[:, 199:201].double().mean()) == pytest.approx(0.3, abs=0.065)  # 4 sigma of 800
    assert not bool(lost[:, :199].any())
    assert not bool(lost[:, 201:].any())


def test_flying_pixels_lie_between_the_two_sides() -> None:
    reading = _only(flying_pixels=0.5).apply(_step_edge(), torch.tensor([FOCAL]), [seeded(0)])[0]
    between = (reading > 1.0001) & (reading < 1.4999)
    assert float(between[:, 199:201].double().mean()) == pytest.approx(0.5, abs=0.07)
    assert not bool(between[:, :199].any())
    assert not bool(between[:, 201:].any())
    assert float(reading.min()) >= 1.0
    assert float(reading.max()) <= 1.5


def test_an_edge_is_both_sides_of_a_jump_and_the_rim_of_nothing() -> None:
    depth = torch.ones(1, 3, 6).double()
    depth[..., 2:] = 1.5
    depth[..., 5:] = 0.0
    across = facing_depth(depth)
    edge = SensorNoise(edge_jump=0.02).edges(depth, across)
    assert edge[0, 1].tolist() == [False, True, True, False, True, True]
    assert across[0, 1, [1, 2, 4]].tolist() == [1.5, 1.0, 0.0]


def test_a_slanted_plane_has_no_edges() -> None:
    scene = tabletop(0, 0)
    edge = SensorNoise().edges(scene.truth.depth, facing_depth(scene.truth.depth))
    top = (scene.truth.labels == 0)[:, 1:-1, 1:-1]
    inner = top & (scene.truth.labels[:, 2:, 1:-1] == 0) & (scene.truth.labels[:, :-2, 1:-1] == 0)
    inner &= (scene.truth.labels[:, 1:-1, 2:] == 0) & (scene.truth.labels[:, 1:-1, :-2] == 0)
    assert int(inner.sum()) > 100_000
    assert not bool((edge[:, 1:-1, 1:-1] & inner).any())


def test_readings_outside_the_range_are_lost() -> None:
    depth = torch.tensor([[[0.1, 0.3, 1.0, 2.9, 3.1, 0.0]]]).double()
    reading = _only(min_range=0.2, max_range=3.0, edge_jump=100.0).apply(depth, torch.tensor([FOCAL]), [seeded(0)])
    torch.testing.assert_close(reading, torch.tensor([[[0.0, 0.3, 1.0, 2.9, 0.0, 0.0]]]))


def test_noise_never_gives_negative_or_non_finite_depth() -> None:
    noise = _only(disparity_sigma=5.0, dropout=0.1, flying_pixels=1.0, disparity_step=1.0)
    depth = _step_edge() * 8
    depth[:, ::7] = 0.0
    reading = noise.apply(depth, torch.tensor([FOCAL]), [seeded(0)])
    assert bool(torch.isfinite(reading).all())
    assert float(reading.min()) == 0.0
    assert bool((reading[:, ::7] == 0).all())


def test_switching_one_effect_leaves_the_draws_of_the_others() -> None:
    few = _flat(_only(dropout=0.1), 1.0) == 0
    more = _flat(_only(dropout=0.1, disparity_sigma=0.1, edge_dropout=0.5), 1.0) == 0
    assert torch.equal(few, more)


@pytest.fixture(scope="module")
def still() -> Tabletop:
    return tabletop(4, num_views=2, size=(60, 80), noise="stereo")


def test_renders_of_a_still_scene_differ_in_noise_alone(still: Tabletop) -> None:
    frames = list(still.noisy_frames(3))
    assert [frame.capture_index for frame in frames] == [0, 1, 2]
    assert torch.equal(frames[0].depth, still.frame.depth)
    assert not torch.equal(frames[0].depth, frames[1].depth)
    assert torch.equal(frames[2].depth, still.render(seed_noise=2).depth)
    for frame in frames:
        assert frame.colors is still.frame.colors
        assert frame.labels is still.frame.labels
        assert frame.provenance["seed_noise"] == frame.capture_index


def test_averaging_n_frames_divides_the_error_by_the_root_of_n() -> None:
    noise = _only(disparity_sigma=0.1)
    scene = tabletop(4, 0, size=(60, 80), noise=noise, floor=False)
    seen = scene.truth.depth > 0
    errors = [(frame.depth.double() - scene.truth.depth)[seen] for frame in scene.noisy_frames(16)]
    single, averaged = float(errors[0].std()), float(torch.stack(errors).mean(0).std())
    assert averaged == pytest.approx(single / 4, rel=0.1)


def test_views_have_noise_of_their_own(still: Tabletop) -> None:
    alone = tabletop(4, num_views=1, size=(60, 80), noise="stereo")
    assert torch.equal(alone.frame.depth[0], still.frame.depth[0])
    camera = Camera.pinhole(fx=FOCAL, fy=FOCAL, cx=10, cy=10, size=(20, 20))
    poses = look_at((0, 0, 1))[None].repeat(2, 1, 1)
    twice = tabletop(4, 0, noise="stereo", camera=camera, world_from_camera=poses)
    assert torch.equal(twice.truth.depth[0], twice.truth.depth[1])
    assert not torch.equal(twice.frame.depth[0], twice.frame.depth[1])


@pytest.mark.parametrize("fields", [{"dropout": 1.5}, {"baseline": 0.0}, {"disparity_sigma": math.nan}])
def test_impossible_sensors_are_refused(fields: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(fields))):
        SensorNoise(**fields)
