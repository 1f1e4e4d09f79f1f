"""Augmentation with a stated geometry: ranges, boxes, half spaces, rays, turned captures, mixed scenes."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from scipy.optimize import linprog

from pcdata import transforms as T
from pcdata.errors import ConfigError, DTypeError, FrameError, IntrinsicsError, ShapeError
from pcdata.functional import project_points
from pcdata.rng import seeded
from pcdata.structures import Camera, Kind, PointCloud
from tests.factories import cloud_in_base, frame_with_counts

MANY = (2,) * 400


def matrices(step: T.Transform) -> torch.Tensor:
    data = cloud_in_base(MANY)
    return step(data, generator=seeded(0)).source_from_cloud.inverse() @ data.source_from_cloud


def test_rotations_stay_in_their_range_about_the_axes_and_the_point_that_are_stated():
    matrix = matrices(T.RandomRotation(degrees=(-10.0, 40.0), about=(0.1, 0.0, -0.2)))
    angle = torch.rad2deg(torch.atan2(matrix[:, 1, 0], matrix[:, 0, 0]))
    assert -10 <= float(angle.min()) < -7
    assert 37 < float(angle.max()) <= 40
    center = torch.tensor([0.1, 0.0, -0.2, 1.0], dtype=torch.float64)
    torch.testing.assert_close(matrix @ center, center.expand(len(matrix), 4))
    matrix = matrices(T.RandomRotation(degrees_xyz=((-5.0, 5.0), (0.0, 0.0), (10.0, 80.0))))
    about_x = torch.rad2deg(torch.atan2(matrix[:, 2, 1], matrix[:, 2, 2]))
    about_y = torch.rad2deg(torch.asin(-matrix[:, 2, 0]))
    about_z = torch.rad2deg(torch.atan2(matrix[:, 1, 0], matrix[:, 0, 0]))
    for found, (low, high) in ((about_x, (-5, 5)), (about_y, (0, 0)), (about_z, (10, 80))):
        assert low - 1e-6 <= float(found.min()) <= low + (high - low) * 0.05 + 1e-6
        assert high - (high - low) * 0.05 - 1e-6 <= float(found.max()) <= high + 1e-6
    for wrong in (
        {"degrees": (40.0, -10.0)},
        {"degrees_xyz": ((0.0, 400.0),) * 3},
        {"axis": None, "degrees": (0.0, 1.0)},
    ):
        with pytest.raises(ConfigError):
            T.RandomRotation(**wrong)


def test_scales_and_offsets_stay_in_ranges_of_each_axis():
    scale = torch.diagonal(matrices(T.RandomScale(low=(0.9, 1.0, 2.0), high=(1.0, 1.0, 3.0), per_axis=True)), 0, 1, 2)
    assert 0.9 <= float(scale[:, 0].min()) < 0.91 < 0.99 < float(scale[:, 0].max()) <= 1.0
    torch.testing.assert_close(scale[:, 1], torch.ones(400, dtype=torch.float64))
    assert 2.0 <= float(scale[:, 2].min()) < 2.05
    offset = matrices(T.RandomTranslation(min_offset=(0.1, -0.3, 0.0), max_offset=(0.2, -0.1, 0.0)))[:, :3, 3]
    assert 0.1 <= float(offset[:, 0].min()) < 0.105 < 0.195 < float(offset[:, 0].max()) <= 0.2
    assert -0.3 <= float(offset[:, 1].min()) < float(offset[:, 1].max()) <= -0.1
    assert float(offset[:, 2].abs().max()) < 1e-12
    with pytest.raises(ConfigError, match="per_axis"):
        T.RandomScale(low=(0.9, 1.0, 1.0))
    with pytest.raises(ConfigError, match="is no range"):
        T.RandomTranslation(max_offset=-0.1)


def test_jitter_along_the_ray_moves_no_point_across_it():
    data = cloud_in_base((500,))
    moved = T.RandomJitter(sigma=0.01, along_ray=True)(data, generator=seeded(1)).points - data.points
    ray = torch.nn.functional.normalize(data.points - data.viewpoint_per_point(), dim=1)
    along = (moved * ray).sum(1, keepdim=True)
    assert float((moved - along * ray).norm(dim=1).max()) < 1e-6
    assert float(along.std()) == pytest.approx(0.01, rel=0.1)
    spread = (T.RandomJitter(sigma=(0.0, 0.01, 0.03))(data, generator=seeded(1)).points - data.points).std(0)
    assert spread.tolist() == pytest.approx([0.0, 0.01, 0.03], rel=0.1)
    unseen = PointCloud(points=data.points, frame_id="base")
    with pytest.raises(FrameError, match="along_ray needs to know where the sensor stood"):
        T.RandomJitter(along_ray=True)(unseen, generator=seeded(0))
    with pytest.raises(ConfigError, match="one sigma"):
        T.RandomJitter(sigma=(0.1, 0.1, 0.1), along_ray=True)


def test_a_cuboid_is_a_box_about_a_point_of_the_cloud():
    data = cloud_in_base((300,))
    kept = T.RandomCuboid(low=0.2, high=0.2, keep="inside")(data, generator=seeded(3))
    extent = kept.points.amax(0) - kept.points.amin(0)
    assert float(extent.max()) <= 0.2 + 1e-6
    center = [p for p in kept.points if bool(((kept.points - p).abs() <= 0.1 + 1e-6).all())]
    assert center
    dropped = T.RandomCuboid(low=0.2, high=0.2)(data, generator=seeded(3))
    assert sorted(kept.extra["row"].tolist() + dropped.extra["row"].tolist()) == list(range(300))
    assert T.RandomCuboid(low=9.0, high=9.0)(data, generator=seeded(3)).num_points == 1


def test_an_occlusion_is_a_half_space_through_the_viewpoint():
    data = cloud_in_base((400,))
    for seed in range(5):
        kept = T.RandomOcclusion(low=0.3, high=0.3)(data, generator=seeded(seed))
        assert kept.num_points == 280
        ray = (data.points - data.viewpoint_per_point()).double()
        mask = torch.zeros(400, dtype=torch.bool)
        mask[kept.extra["row"]] = True
        # A plane through the viewpoint separates the two: a linear classifier of rays finds one.
        unit = torch.nn.functional.normalize(ray, dim=1)
        signed = torch.where(mask[:, None], unit, -unit).numpy()
        found = linprog(
            [0, 0, 0, -1], [[*(-row), 1] for row in signed], [0.0] * 400, bounds=[(-1, 1)] * 3 + [(None, 1)]
        )
        assert found.x[3] > 0
    with pytest.raises(FrameError, match="needs the viewpoint"):
        T.RandomOcclusion()(PointCloud(points=data.points, frame_id="base"), generator=seeded(0))


def test_a_turned_capture_shows_the_same_points_in_the_base():
    frame = frame_with_counts((40, 30))
    lens = torch.tensor([[0.1, -0.05, 0.01, -0.02, 0.003]], dtype=torch.float64).expand(frame.num_views, 5)
    frame = replace(frame, camera=replace(frame.camera, distortion=lens.contiguous()))
    chain = [T.Deproject(), T.ToFrame(frame=frame.frame_id)]
    straight = T.Compose(chain)(frame)
    for turns in (1, 2, 3):
        turned = T.Compose([T.TurnDepth(quarter_turns=turns), *chain])(frame)
        for one, other in zip(straight, turned):
            order, again = (
                torch.from_numpy(__import__("numpy").lexsort(c.points.round(decimals=3).T.numpy()))
                for c in (one, other)
            )
            torch.testing.assert_close(one.points[order], other.points[again], atol=2e-6, rtol=0)
    four = frame
    for _ in range(4):
        four = T.TurnDepth()(four)
    assert torch.equal(four.depth, frame.depth)
    torch.testing.assert_close(four.camera.intrinsics, frame.camera.intrinsics)
    torch.testing.assert_close(four.camera.distortion, frame.camera.distortion)


def test_turned_pixels_project_to_turned_places_whatever_the_lens():
    lens = [0.1, -0.05, 0.01, -0.02, 0.003, 0.02, 0.01, 0.001, 0.01, -0.02, 0.03, 0.005]
    camera = Camera.pinhole(fx=90.0, fy=100.0, cx=41.0, cy=28.0, size=(60, 80), distortion=lens)
    points = torch.rand(50, 3, generator=seeded(0)) - 0.5
    points[:, 2] += 2.0
    turn = torch.tensor([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turned = camera.turned()
    pixel, _ = project_points(points, intrinsics=camera.intrinsics, distortion=camera.distortion)
    again, _ = project_points(
        (points @ turn.T).contiguous(), intrinsics=turned.intrinsics, distortion=turned.distortion
    )
    torch.testing.assert_close(again, torch.stack([pixel[:, 1], 79 - pixel[:, 0]], 1), atol=1e-3, rtol=0)
    for lens, numbers in {
        "fisheye": [0.1, -0.02, 0.003, 0.001],
        "inverse_brown_conrady": [0.1, -0.05, 0.01, -0.02, 0.003],
    }.items():
        other = Camera.pinhole(fx=90.0, fy=100.0, cx=41.0, cy=28.0, size=(60, 80), distortion=numbers, lens=lens)
        pixel, _ = project_points(points, intrinsics=other.intrinsics, distortion=other.distortion)
        again, _ = project_points(
            (points @ turn.T).contiguous(), intrinsics=turned.intrinsics, distortion=other.turned().distortion
        )
        torch.testing.assert_close(again, torch.stack([pixel[:, 1], 79 - pixel[:, 0]], 1), atol=1e-3, rtol=0)
    skewed = camera.intrinsics.clone()
    skewed[:, 0, 1] = 0.3
    with pytest.raises(IntrinsicsError, match="skewed axes cannot be turned"):
        Camera(intrinsics=skewed, size=(60, 80)).turned()


def test_scenes_are_mixed_with_their_labels_kept_apart():
    first, second = cloud_in_base((30, 20)), cloud_in_base((10, 0))
    mixed = T.mix_scenes(first, second)
    assert mixed.counts.tolist() == [40, 20]
    assert torch.equal(mixed[0].points, torch.cat([first[0].points, second[0].points]))
    ours, theirs = mixed[0].labels[:30], mixed[0].labels[30:]
    assert torch.equal(ours, first[0].labels)
    assert not set(ours[ours >= 0].tolist()) & set(theirs[theirs >= 0].tolist())
    assert torch.equal(theirs < 0, second[0].labels < 0)
    assert mixed.extra["scene"].tolist() == [0] * 30 + [1] * 10 + [0] * 20
    assert torch.equal(mixed[0].source_index[:30], first[0].source_index)
    assert mixed[0].source_index[30:].tolist() == [-1] * 10
    entries = [history[-1] for history in mixed.history]
    assert [entry["params"] for entry in entries] == [{"partner": one["sample_id"]} for one in second.meta]
    assert [(entry["points_before"], entry["points"]) for entry in entries] == [(30, 40), (20, 20)]
    with pytest.raises(ShapeError, match="as many clouds"):
        T.mix_scenes(first, cloud_in_base((3,)))
    with pytest.raises(DTypeError, match="give both the same fields"):
        T.mix_scenes(first, second.with_fields(colors=None))
    with pytest.raises(FrameError, match="by ToFrame"):
        T.mix_scenes(first, second.to_frame("camera"))
    with pytest.raises(DTypeError, match="mixed already"):
        T.mix_scenes(mixed, mixed)


def test_only_numbers_of_objects_are_kept_apart_in_a_mixed_scene():
    first, second = cloud_in_base((30,)), cloud_in_base((10,))
    kept = T.mix_scenes(first, second, apart=())
    assert torch.equal(kept.labels, torch.cat([first.labels, second.labels]))
    numbered = [
        one.with_extra("instance", torch.arange(one.num_points) % 4 - 1, Kind.INVARIANT) for one in (first, second)
    ]
    mixed = T.mix_scenes(*numbered, apart=("instance",))
    assert torch.equal(mixed.labels, kept.labels)
    assert mixed.extra["instance"][30:].tolist() == [-1, 3, 4, 5, -1, 3, 4, 5, -1, 3]
    for wrong in ("weight", "colors", "nothing"):
        with pytest.raises(DTypeError, match=f"'{wrong}' is to be kept apart"):
            T.mix_scenes(first, second, apart=(wrong,))


def test_every_point_of_a_mixed_scene_keeps_the_viewpoint_that_saw_it():
    first, second = cloud_in_base((30, 20)), cloud_in_base((10, 5))
    second = replace(second, viewpoint=first.viewpoint + 1.0)
    mixed = T.mix_scenes(first, second)
    assert mixed.viewpoint is None
    expected = torch.cat(
        [part.viewpoint_per_point() for pair in zip(first.unbatch(), second.unbatch()) for part in pair]
    )
    assert torch.equal(mixed.viewpoint_per_point(), expected)
    turned = T.RandomRotation()(mixed, generator=seeded(0))
    before = (mixed.points - mixed.viewpoint_per_point()).norm(dim=1)
    torch.testing.assert_close((turned.points - turned.viewpoint_per_point()).norm(dim=1), before)
    with pytest.raises(FrameError, match=r"of the first clouds it is known where the sensor stood, of the second"):
        T.mix_scenes(first, replace(second, viewpoint=None))


def test_colors_are_lost_with_the_probability():
    data = cloud_in_base(MANY)
    gray = T.RandomColorDrop(probability=0.25, color=(0.5, 0.5, 0.5))(data, generator=seeded(0))
    lost = (gray.colors == 0.5).all(1).reshape(-1, 2)
    assert torch.equal(lost[:, 0], lost[:, 1])
    assert float(lost.float().mean()) == pytest.approx(0.25, abs=4 * math.sqrt(0.25 * 0.75 / 400))
