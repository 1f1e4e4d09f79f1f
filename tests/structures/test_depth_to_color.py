"""A frame registered to a color camera, against the same scene rendered from there."""

from __future__ import annotations

import dataclasses
import json

import pytest
import torch

from pcdata.errors import ShapeError
from pcdata.functional.rows import transform_points
from pcdata.geometry import rigid
from pcdata.structures import Camera, DepthFrame, register_to_color
from pcdata.synthetic import tabletop
from pcdata.transforms import Deproject

COLOR_CAMERA = Camera.pinhole(fx=330.0, fy=330.0, cx=215.0, cy=160.0, size=(320, 430))
DEPTH_FROM_COLOR = rigid.from_rotation_translation(
    rigid.rotation_about_axis(torch.tensor([0.0, 1.0, 0.0]), torch.tensor(0.02)),
    torch.tensor([0.06, 0.001, 0.0], dtype=torch.float64),
)
COLOR_FROM_DEPTH = rigid.invert_rigid(DEPTH_FROM_COLOR)


@pytest.fixture(scope="module")
def scene():
    return tabletop(5, num_objects=6, num_views=2, size=(240, 320), floor=False)


@pytest.fixture(scope="module")
def color(scene) -> DepthFrame:
    """What the color camera sees, rendered."""
    there = scene.truth.world_from_camera @ DEPTH_FROM_COLOR
    return tabletop(5, num_objects=6, camera=COLOR_CAMERA, world_from_camera=there, floor=False).frame


@pytest.fixture(scope="module")
def registered(scene, color) -> DepthFrame:
    return register_to_color(scene.frame, color.colors, COLOR_CAMERA, COLOR_FROM_DEPTH)


def test_points_keep_their_place_in_the_world_and_lie_on_the_surfaces(scene, color, registered):
    torch.testing.assert_close(registered.world_from_camera, color.world_from_camera)
    cloud = Deproject()(registered)
    in_base = transform_points(cloud.points, cloud.ptr, registered.world_from_camera)
    distance = scene.surface_distance(in_base)
    assert float(distance.median()) < 0.003
    assert float((distance > 0.01).float().mean()) < 0.01


def test_every_point_has_the_color_and_label_of_its_own_surface(color, registered):
    got = registered.depth > 0
    assert float((registered.labels == color.labels)[got].float().mean()) > 0.985  # half a pixel beside outlines
    assert torch.equal(registered.colors, color.colors)
    # Ghosts: points of the table that took the color of the object before them, other than along its outline.
    outline = torch.nn.functional.max_pool2d(color.labels.float(), 5, 1, 2) != -torch.nn.functional.max_pool2d(
        -color.labels.float(), 5, 1, 2
    )
    ghosts = got & (registered.labels == 0) & (color.labels > 0) & ~outline
    assert int(ghosts.sum()) == 0


def test_pixels_without_a_reading_have_nothing(scene, color):
    frame = dataclasses.replace(
        scene.frame,
        confidence=torch.full(scene.frame.depth.shape, 2, dtype=torch.uint8),
        mask=torch.ones_like(scene.frame.depth, dtype=torch.bool),
    )
    result = register_to_color(frame, color.colors, COLOR_CAMERA, COLOR_FROM_DEPTH)
    got = result.depth > 0
    assert bool(got.any())
    assert not bool(got.all())
    assert torch.equal(result.confidence, got.to(torch.uint8) * 2)
    assert torch.equal(result.mask, got)
    assert bool((result.labels[~got] == -1).all())


def test_it_says_what_it_was_registered_with(scene, registered):
    facts = json.loads(json.dumps(registered.provenance["registered"], allow_nan=False))
    assert facts["depth_camera"] == scene.frame.camera.to_dict()
    assert facts["readings"] == (scene.frame.depth > 0).sum(dim=(1, 2)).tolist()
    assert all(0 < hidden < readings for hidden, readings in zip(facts["hidden"], facts["readings"]))
    assert facts["color_from_depth"][0] == COLOR_FROM_DEPTH.tolist()


def test_depth_alone_is_registered_too(scene, color, registered):
    bare = DepthFrame(depth=scene.frame.depth, camera=scene.frame.camera)
    result = register_to_color(bare, color.colors, COLOR_CAMERA, COLOR_FROM_DEPTH)
    assert torch.equal(result.depth, registered.depth)
    assert result.labels is result.confidence is result.mask is result.world_from_camera is None


def test_images_and_cameras_that_do_not_match_are_refused(scene, color):
    with pytest.raises(ShapeError, match="the color camera describes"):
        register_to_color(scene.frame, color.colors[:, 1:], COLOR_CAMERA, COLOR_FROM_DEPTH)
    with pytest.raises(ShapeError, match="V=1 but depth has V=2"):
        register_to_color(scene.frame, color.colors[:1], COLOR_CAMERA, COLOR_FROM_DEPTH)
    three = dataclasses.replace(COLOR_CAMERA, intrinsics=COLOR_CAMERA.intrinsics.repeat(3, 1, 1))
    with pytest.raises(ShapeError, match="color_camera describes 3"):
        register_to_color(scene.frame, color.colors, three, COLOR_FROM_DEPTH)
