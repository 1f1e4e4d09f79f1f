"""The tabletop scene: every image agrees with the geometry it was made from."""

from __future__ import annotations

import math
import pickle

import pytest
import torch
from torch import Tensor

from pcdata.errors import ConfigError, ShapeError
from pcdata.structures import Camera, DepthFrame
from pcdata.synthetic import Cylinder, Miscalibration, SensorNoise, Tabletop, look_at, tabletop

SMALL = (120, 160)


@pytest.fixture(scope="module", params=[0, 1, 2])
def scene(request: pytest.FixtureRequest) -> Tabletop:
    return tabletop(request.param, num_objects=6, num_views=3, size=SMALL)


def _deprojected(frame: DepthFrame, poses: Tensor) -> tuple[Tensor, Tensor]:
    """Textbook pinhole model: (V, H, W, 3) base points and (V, H, W) bool where there is depth."""
    z = frame.depth.double()
    height, width = frame.size
    v, u = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    k = frame.camera.intrinsics[:, :, :, None, None]
    x = (u - k[:, 0, 2]) * z / k[:, 0, 0]
    y = (v - k[:, 1, 2]) * z / k[:, 1, 1]
    camera_points = torch.stack([x, y, z], dim=-1)
    base_points = torch.einsum("vij,vhwj->vhwi", poses[:, :3, :3], camera_points) + poses[:, None, None, :3, 3]
    return base_points, z > 0


def _object_grid(scene: Tabletop) -> Tensor:
    x, y, z = (torch.arange(a, b, 0.01, dtype=torch.float64) for a, b in ((-0.65, 0.65), (-0.45, 0.45), (-0.02, 0.25)))
    return torch.cartesian_prod(x, y, z)


def test_deprojected_depth_lies_on_the_true_surfaces(scene: Tabletop) -> None:
    points, valid = _deprojected(scene.frame, scene.truth.world_from_camera)
    assert float(valid.double().mean()) > 0.99
    assert float(scene.surface_distance(points[valid]).max()) < 1e-5


def test_surface_distance_is_the_height_above_an_empty_table() -> None:
    empty = tabletop(0, num_objects=0, size=(8, 8), floor=False)
    points = torch.tensor([[0.1, 0.2, 0.3], [0.0, 0.0, -0.01], [0.7, 0.0, 0.0]])
    torch.testing.assert_close(empty.surface_distance(points), torch.tensor([0.3, 0.01, 0.1]).double())
    with pytest.raises(ShapeError, match=r"\(N, 3\)"):
        empty.surface_distance(points[0])


def test_labels_name_the_shape_that_the_pixel_lies_on(scene: Tabletop) -> None:
    points, valid = _deprojected(scene.frame, scene.truth.world_from_camera)
    labels = scene.frame.labels
    assert labels is not None
    assert set(labels.unique().tolist()) <= {-1, 0, 1, 2, 3, 4, 5, 6}
    for shape in (scene.truth.table, *scene.truth.objects):
        mine = points[valid & (labels == shape.label)]
        assert len(mine) > 20, f"label {shape.label} is hardly seen"
        assert float(shape.signed_distance(mine).abs().max()) < 1e-5
    background = points[valid & (labels == -1)]
    torch.testing.assert_close(background[:, 2], torch.full_like(background[:, 2], -0.75), atol=1e-5, rtol=0)


def test_no_true_surface_lies_between_the_camera_and_a_pixel(scene: Tabletop) -> None:
    points, valid = _deprojected(scene.frame, scene.truth.world_from_camera)
    eyes = scene.truth.world_from_camera[:, None, None, :3, 3].expand_as(points)
    for part in (0.5, 0.8, 0.9, 0.95, 0.99):
        between = (eyes + part * (points - eyes))[valid]
        for shape in scene.truth.shapes:
            assert float(shape.signed_distance(between).min()) > 0


def test_normals_are_unit_and_face_the_camera(scene: Tabletop) -> None:
    points, valid = _deprojected(scene.frame, scene.truth.world_from_camera)
    normals = scene.truth.normals[valid]
    torch.testing.assert_close(normals.norm(dim=-1), torch.ones(len(normals)).double())
    toward = (scene.truth.world_from_camera[:, None, None, :3, 3] - points)[valid]
    assert float((normals * toward).sum(-1).min()) >= -1e-6


def test_normals_match_finite_differences_away_from_edges() -> None:
    scene = tabletop(1, num_objects=6)
    points, _ = _deprojected(scene.frame, scene.truth.world_from_camera)
    points, normals, labels = points[0], scene.truth.normals[0], scene.truth.labels[0]
    across, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    measured = torch.nn.functional.normalize(torch.linalg.cross(down, across), dim=-1)
    middle, label_here = normals[1:-1, 1:-1], labels[1:-1, 1:-1]
    sides = [(slice(1, -1), slice(2, None)), (slice(1, -1), slice(None, -2)), (slice(2, None), slice(1, -1))]
    sides += [(slice(None, -2), slice(1, -1))]
    same = [((middle * normals[side]).sum(-1) > 0.99) & (labels[side] == label_here) for side in sides]
    smooth = torch.stack(same).all(0)
    cosine = (measured * middle).sum(-1)
    for label in range(7):
        chosen = cosine[smooth & (label_here == label)]
        assert len(chosen) > 200
        assert float(chosen.quantile(0.02)) > math.cos(math.radians(2.0))


def test_objects_rest_on_the_table(scene: Tabletop) -> None:
    grid = _object_grid(scene)
    for shape in scene.truth.objects:
        below_center = shape.center * torch.tensor([1.0, 1.0, 0.0])
        assert abs(float(shape.signed_distance(below_center[None]))) < 1e-12
        assert float(grid[shape.signed_distance(grid) <= 0][:, 2].min()) > -1e-9
        inside = grid[shape.signed_distance(grid) < 0]
        assert float(inside[:, 0].abs().max()) < 0.6
        assert float(inside[:, 1].abs().max()) < 0.4


def test_objects_stay_clear_of_each_other() -> None:
    for seed in range(4):
        scene = tabletop(seed, num_objects=15, size=(4, 4))
        distances = torch.stack([shape.signed_distance(_object_grid(scene)) for shape in scene.truth.objects])
        assert int((distances < 0).any(1).sum()) == 15  # the grid reaches into each
        # In a gap g wide, the two nearest distances add up to at least g everywhere.
        nearest = distances.topk(2, dim=0, largest=False).values.sum(0)
        assert float(nearest.min()) >= 0.0119


def test_the_kinds_of_objects_are_mixed_and_colors_differ() -> None:
    scene = tabletop(5, num_objects=6, size=(4, 4))
    kinds = [type(shape).__name__ for shape in scene.truth.objects]
    assert sorted(kinds) == ["Box", "Box", "Cylinder", "Cylinder", "Sphere", "Sphere"]
    assert len({shape.color for shape in scene.truth.objects}) == 6
    assert [shape.label for shape in scene.truth.objects] == [1, 2, 3, 4, 5, 6]


def test_two_views_agree_in_the_base_frame(scene: Tabletop) -> None:
    """A point that view 0 saw is, where view 1 looks at its pixel, the same point or behind something nearer."""
    points, valid = _deprojected(scene.frame, scene.truth.world_from_camera)
    camera_from_base = torch.linalg.inv(scene.truth.world_from_camera[1])
    in_view_1 = points[0][valid[0]] @ camera_from_base[:3, :3].T + camera_from_base[:3, 3]
    projected = in_view_1 @ scene.frame.camera.intrinsics[1].T
    column, row = (projected[:, :2] / projected[:, 2:]).round().long().unbind(-1)
    inside = (in_view_1[:, 2] > 0) & (column >= 0) & (column < SMALL[1]) & (row >= 0) & (row < SMALL[0])
    behind = in_view_1[inside, 2] - scene.truth.depth[1, row[inside], column[inside]]
    same = behind.abs() < 0.02
    assert float(same.double().mean()) > 0.6
    labels = scene.truth.labels
    agree = labels[0][valid[0]][inside][same] == labels[1, row[inside], column[inside]][same]
    assert float(agree.double().mean()) > 0.97  # rounding to a pixel costs a little at outlines
    assert float((behind < -0.02).double().mean()) < 0.02  # nothing seen floats before what view 1 saw


def test_a_camera_straight_above_sees_the_table_at_its_own_height() -> None:
    camera = Camera.pinhole(fx=150.0, fy=150.0, cx=79.5, cy=59.5, size=SMALL)
    scene = tabletop(0, num_objects=0, camera=camera, world_from_camera=look_at((0.0, 0.0, 0.7))[None])
    torch.testing.assert_close(scene.truth.depth, torch.full((1, *SMALL), 0.7).double())
    assert bool((scene.truth.labels == 0).all())


def test_a_standing_cylinder_seen_from_above_covers_its_cap() -> None:
    scene = next(
        s
        for s in (tabletop(seed, num_objects=3, size=(4, 4)) for seed in range(50))
        if any(isinstance(o, Cylinder) and abs(float(o.base_from_object[2, 2])) > 0.9 for o in s.truth.objects)
    )
    can = next(shape for shape in scene.truth.objects if isinstance(shape, Cylinder))
    x, y, _ = can.center.tolist()
    focal, eye = 900.0, 1.0
    camera = Camera.pinhole(fx=focal, fy=focal, cx=79.5, cy=59.5, size=SMALL)
    above = tabletop(
        scene.seed, num_objects=3, camera=camera, world_from_camera=look_at((x, y, eye), (x, y, 0.0))[None]
    )
    area = math.pi * (can.radius * focal / (eye - can.height)) ** 2
    assert int((above.truth.labels == can.label).sum()) == pytest.approx(area, rel=0.03)


def test_a_distorted_camera_sees_the_same_surfaces() -> None:
    from pcdata.geometry.lens import undistort_normalized

    lens = (0.05, -0.08, 0.001, -0.0005, 0.01)
    camera = Camera.pinhole(fx=150.0, fy=152.0, cx=80.0, cy=58.0, size=SMALL, distortion=lens)
    scene = tabletop(0, camera=camera)
    v, u = torch.meshgrid(torch.arange(120).double(), torch.arange(160).double(), indexing="ij")
    seen = torch.stack([(u - 80.0) / 150.0, (v - 58.0) / 152.0], dim=-1)[None]
    assert camera.distortion is not None
    rays = torch.nn.functional.pad(undistort_normalized(seen, camera.distortion), (0, 1), value=1.0)[0]
    pose = scene.truth.world_from_camera[0]
    points = (rays * scene.truth.depth[0][..., None]) @ pose[:3, :3].T + pose[:3, 3]
    assert float(scene.surface_distance(points.reshape(-1, 3)).max()) < 1e-9
    assert float((rays[..., :2] - seen[0]).abs().max()) > 1e-3  # the lens does bend


def test_without_a_floor_the_background_is_empty() -> None:
    scene = tabletop(0, size=SMALL, floor=False)
    background = scene.truth.labels == -1
    assert bool(background.any())
    assert bool((scene.frame.depth[background] == 0).all())
    assert bool((scene.frame.depth[~background] > 0).all())


def test_the_table_plane_is_the_table(scene: Tabletop) -> None:
    points, valid = _deprojected(scene.frame, scene.truth.world_from_camera)
    up = scene.truth.normals[..., 2] > 0.5
    top = points[valid & (scene.truth.labels == 0) & up]
    plane = scene.truth.table_plane
    assert float((top @ plane[:3] + plane[3]).abs().max()) < 1e-5


def test_the_same_seed_gives_the_same_bytes_and_another_seed_another_scene() -> None:
    one, again, other = (tabletop(seed, size=SMALL, num_views=2, noise="stereo") for seed in (3, 3, 4))
    assert one.frame.colors is not None
    assert again.frame.colors is not None
    assert torch.equal(one.frame.depth, again.frame.depth)
    assert torch.equal(one.frame.colors, again.frame.colors)
    assert torch.equal(one.truth.world_from_camera, again.truth.world_from_camera)
    assert not torch.equal(one.truth.labels, other.truth.labels)


def test_the_scene_does_not_depend_on_noise_views_or_the_global_generator() -> None:
    reference = tabletop(7, num_views=1, size=SMALL)
    torch.manual_seed(99)
    state = torch.get_rng_state()
    noisy = tabletop(7, num_views=3, size=SMALL, noise=SensorNoise(dropout=0.5), miscalibration=Miscalibration())
    assert torch.equal(torch.get_rng_state(), state)
    for one, other in zip(reference.truth.objects, noisy.truth.objects, strict=True):
        assert torch.equal(one.base_from_object, other.base_from_object)
    for name in ("depth", "labels", "normals", "world_from_camera"):
        assert torch.equal(getattr(reference.truth, name)[0], getattr(noisy.truth, name)[0]), name
    assert reference.frame.colors is not None
    assert noisy.frame.colors is not None
    assert torch.equal(reference.frame.colors[0], noisy.frame.colors[0])


def test_more_objects_leave_the_first_ones_in_place() -> None:
    few, many = (tabletop(2, num_objects=count, size=(4, 4)).truth.objects for count in (3, 8))
    for one, other in zip(few, many):
        assert torch.equal(one.base_from_object, other.base_from_object)


def test_the_frame_is_complete_and_pickles() -> None:
    scene = tabletop(12, num_views=2, size=SMALL, noise="stereo")
    frame = scene.frame
    assert (frame.sample_id, frame.frame_id, frame.capture_index) == ("tabletop-0012", "base", 0)
    assert frame.provenance["seed"] == 12
    assert frame.provenance["noise"]["baseline"] == 0.055
    assert frame.depth.dtype == torch.float32
    copy = pickle.loads(pickle.dumps(scene))
    assert torch.equal(copy.render(3).depth, scene.render(3).depth)


def test_colors_tell_the_objects_from_the_table() -> None:
    scene = tabletop(0, num_objects=6, size=SMALL)
    assert scene.frame.colors is not None
    image, labels = scene.frame.colors[0].double(), scene.truth.labels[0]
    means = torch.stack([image[labels == label].mean(0) for label in range(7)])
    apart = torch.cdist(means, means) + 1e3 * torch.eye(7)
    assert float(apart.min()) > 15


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_objects": 200}, "ask for fewer"),
        ({"num_objects": -1}, "num_objects >= 0"),
        ({"num_views": 0}, "num_views >= 1"),
        ({"noise": "sterio"}, "did you mean 'stereo'"),
        ({"miscalibration": Miscalibration(translation=(0.1, 0.2))}, "2 amounts for 1 views"),
    ],
)
def test_wrong_requests_say_what_to_do(arguments: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        tabletop(0, **{"size": (4, 4), **arguments})
