"""Registration of depth to color, against the same scene rendered from the color camera."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from pcdata.errors import CaptureError, ConfigError, PoseError
from pcdata.functional import deproject_depth, project_points, register_depth
from pcdata.functional.depth.depth_to_color import RegisteredDepth
from pcdata.functional.rows import transform_points
from pcdata.geometry import rigid
from pcdata.rng import seeded
from pcdata.structures import Camera
from pcdata.synthetic import Tabletop, tabletop

DEPTH_CAMERA = Camera.pinhole(fx=210.0, fy=208.0, cx=160.0, cy=118.0, size=(240, 320))


def pose(turn: float, *shift: float, axis: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> Tensor:
    rotation = rigid.rotation_about_axis(torch.tensor(axis), torch.tensor(turn))
    return rigid.from_rotation_translation(rotation, torch.tensor(shift, dtype=torch.float64))[None]


@dataclass(frozen=True)
class Pair:
    """A scene seen by both cameras without noise, and the depth registered."""

    depth: Tensor
    depth_from_color: Tensor
    color_camera: Camera
    truth: Tensor  # (1, Hc, Wc) what the color camera would measure
    registered: RegisteredDepth


@functools.cache
def scene_seen() -> Tabletop:
    return tabletop(3, num_objects=6, camera=DEPTH_CAMERA)


def pair(color_camera: Camera, depth_from_color: Tensor) -> Pair:
    scene = scene_seen()
    there = scene.truth.world_from_camera @ depth_from_color
    truth = tabletop(scene.seed, num_objects=6, camera=color_camera, world_from_camera=there).truth.depth.float()
    registered = register_depth(
        scene.frame.depth,
        DEPTH_CAMERA.intrinsics,
        color_camera.intrinsics,
        rigid.invert_rigid(depth_from_color),
        color_size=color_camera.size,
        color_distortion=color_camera.distortion,
    )
    return Pair(scene.frame.depth, depth_from_color, color_camera, truth, registered)


def seen_by_depth_camera(one: Pair) -> Tensor:
    """(Hc, Wc): the color pixels whose true surface the depth camera measures too, clear of its edges."""
    camera, truth = one.color_camera, one.truth
    points, ptr, index = deproject_depth(truth, camera.intrinsics, distortion=camera.distortion)
    there = transform_points(points, ptr, one.depth_from_color)
    pixels, depth = project_points(there, ptr, intrinsics=DEPTH_CAMERA.intrinsics)
    # The 3 x 3 readings around must lie on one surface, as max_jump has it, and that must be the one looked at.
    far, near = torch.nn.functional.max_pool2d(one.depth, 3, 1, 1), -torch.nn.functional.max_pool2d(-one.depth, 3, 1, 1)
    u, v = pixels.round().long().unbind(1)
    inside = (u >= 2) & (v >= 2) & (u < DEPTH_CAMERA.size[1] - 2) & (v < DEPTH_CAMERA.size[0] - 2)
    u, v = torch.where(inside, u, 0), torch.where(inside, v, 0)
    inside &= (far <= 1.02 * near)[0, v, u] & ((far[0, v, u] - depth).abs() < 0.03 * depth)
    seen = torch.zeros(camera.size, dtype=torch.bool).flatten()
    seen[index] = inside
    return seen.reshape(camera.size)


CAMERAS = {
    "the same size": Camera.pinhole(fx=210.0, fy=210.0, cx=160.0, cy=120.0, size=(240, 320)),
    "twice as large": Camera.pinhole(fx=427.0, fy=427.0, cx=320.0, cy=240.0, size=(480, 640)),
    "a third": Camera.pinhole(fx=70.0, fy=70.0, cx=53.0, cy=40.0, size=(80, 107)),
    "with a lens": Camera.pinhole(
        fx=300.0, fy=300.0, cx=200.0, cy=150.0, size=(300, 400), distortion=[0.08, -0.15, 0.001, -0.001, 0.05]
    ),
}
POSES = {
    "beside": pose(0.01, 0.025, 0.001, -0.002),
    "far beside": pose(0.05, 0.1, 0.0, 0.0, axis=(0.0, 1.0, 0.0)),
    "lying": pose(1.5, 0.0, 0.03, 0.0),
}


@functools.cache
def pair_of(size: str, at: str) -> Pair:
    return pair(CAMERAS[size], POSES[at])


each_pair = pytest.mark.parametrize("at", POSES)
each_camera = pytest.mark.parametrize("size", CAMERAS)


@each_pair
@each_camera
def test_what_both_cameras_see_is_registered_without_a_crack(size, at):
    one = pair_of(size, at)
    seen = seen_by_depth_camera(one)
    assert float(seen.float().mean()) > 0.4
    assert int((seen & (one.registered.depth[0] == 0)).sum()) == 0


@each_pair
@each_camera
def test_the_registered_depth_is_what_the_color_camera_would_measure(size, at):
    one = pair_of(size, at)
    got = one.registered.depth[0] > 0
    error = (one.registered.depth - one.truth).abs()[0][got] / one.truth[0][got]
    assert float(error.median()) < 0.004  # half a depth pixel on a slanted table
    assert float((error > 0.03).float().mean()) < 0.01  # half a pixel beside an edge: the other surface


@each_pair
def test_no_background_shines_through_a_nearer_surface(at):
    one = pair_of("twice as large", at)
    got = one.registered.depth[0]
    behind = seen_by_depth_camera(one) & (got > 1.03 * one.truth[0])
    assert int(behind.sum()) == 0


@each_pair
@each_camera
def test_hidden_readings_are_those_that_the_color_camera_cannot_see(size, at):
    one = pair_of(size, at)
    camera = one.color_camera
    points, ptr, index = deproject_depth(one.depth, DEPTH_CAMERA.intrinsics)
    there = transform_points(points, ptr, rigid.invert_rigid(one.depth_from_color))
    pixels, depth = project_points(there, ptr, intrinsics=camera.intrinsics, distortion=camera.distortion)
    u, v = (pixels + 0.5).floor().unbind(1)
    inside = (u >= 0) & (v >= 0) & (u < camera.size[1]) & (v < camera.size[0])
    assert torch.equal(one.registered.hidden.flatten()[index] & ~inside, ~inside), "outside the image is hidden"
    u, v = torch.where(inside, u, 0).long(), torch.where(inside, v, 0).long()
    occluded = inside & (depth - one.truth[0, v, u] > 0.03 * depth)
    open_ = inside & ((depth - one.truth[0, v, u]).abs() < 0.01 * depth)
    hidden = one.registered.hidden.flatten()[index]
    assert float(hidden[open_].float().mean()) < 0.01
    if int(occluded.sum()) > 200:
        # Beside an occluder's outline, half a pixel decides; farther in, all are found.
        assert float(hidden[occluded].float().mean()) > 0.75
    assert not bool(one.registered.hidden[one.depth == 0].any())


def test_an_occluder_hides_what_lies_behind_it_and_marks_where():
    # A plate at 0.5 m before a wall at 1 m; the color camera stands 10 cm to the right: the plate moves 20 pixels to
    # the left in its image, the wall 10, so the plate covers 10 columns of the wall that the depth camera sees.
    depth = torch.full((1, 40, 100), 1.0)
    depth[..., 50:70] = 0.5
    k = torch.tensor([[[100.0, 0, 50], [0, 100, 20], [0, 0, 1]]], dtype=torch.float64)
    result = register_depth(depth, k, k, rigid.invert_rigid(pose(0.0, 0.1, 0.0, 0.0)), color_size=(40, 100))
    row = result.depth[0, 20]
    assert bool((row[:30] == 1).all())
    assert bool((row[30:50] == 0.5).all())
    assert bool((row[50:60] == 0).all()), "seen by the color camera alone"
    assert bool((row[60:90] == 1).all())
    assert bool((row[90:] == 0).all()), "beyond the depth image"
    assert result.hidden[0, 20].nonzero().flatten().tolist() == [*range(10), *range(40, 50)]
    assert result.occluding[0, 20].nonzero().flatten().tolist() == list(range(30, 40))
    assert result.pixel_index[0, 20, 30:50].tolist() == list(range(2050, 2070))
    assert result.pixel_index[0, 20, 50:60].tolist() == [-1] * 10


def test_the_same_camera_gives_the_same_image():
    depth = 0.5 + torch.rand(2, 30, 40, generator=seeded(0))
    depth[torch.rand(depth.shape, generator=seeded(1)) < 0.3] = 0
    k = torch.tensor([[35.0, 0, 20], [0, 36, 14], [0, 0, 1]], dtype=torch.float64).repeat(2, 1, 1)
    identity = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    result = register_depth(depth, k, k, identity, color_size=(30, 40))
    # Every reading lands on its own pixel; at edges, where a cell ends half a pixel off, its side may touch the next.
    assert float((result.depth == depth).float().mean()) > 0.95
    assert not bool(result.hidden[depth == 0].any())
    assert not bool((result.depth[depth > 0] == 0).any())


def test_readings_behind_the_color_camera_are_hidden():
    depth = torch.full((1, 4, 4), 0.5)
    k = torch.tensor([[[4.0, 0, 2], [0, 4, 2], [0, 0, 1]]], dtype=torch.float64)
    result = register_depth(depth, k, k, pose(0.0, 0.0, 0.0, -0.6), color_size=(4, 4))
    assert bool(result.hidden.all())
    assert not bool(result.depth.any())


def test_bad_requests_are_refused():
    depth, k = torch.ones(1, 4, 4), torch.tensor([[[4.0, 0, 2], [0, 4, 2], [0, 0, 1]]], dtype=torch.float64)
    identity = torch.eye(4, dtype=torch.float64)[None]
    with pytest.raises(ConfigError, match="color_size must be"):
        register_depth(depth, k, k, identity, color_size=(0, 4))
    with pytest.raises(ConfigError, match="max_jump"):
        register_depth(depth, k, k, identity, color_size=(4, 4), max_jump=0.0)
    with pytest.raises(PoseError, match=r"register_depth: color_from_depth: .* is not rigid"):
        register_depth(depth, k, k, 2 * identity, color_size=(4, 4))
    with pytest.raises(CaptureError, match="positive focal lengths"):
        register_depth(depth, k, -k * torch.tensor([1.0, 1.0, -1.0])[:, None], identity, color_size=(4, 4))
    with pytest.raises(CaptureError, match="negative"):
        register_depth(-depth, k, k, identity, color_size=(4, 4))
