"""Depth along the rays read as z, and z read as along the rays, are told from one view; right depth never alarms."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from pcdata import open_source
from pcdata.functional.depth.rendered import ray_lengths
from pcdata.geometry.lens import undistort_normalized
from pcdata.io import write_depth
from pcdata.structures import Camera, DepthFrame
from pcdata.validation import CaptureLimits, validate_frame
from pcdata.validation.checks.depth_axis import NAME, depth_axis
from pcdata.verdicts import Finding, Verdict
from tests.validation.captures import SIZE, scene

POWERS = {"z": 0, "ray": 1, "divided": -1}
LENS = torch.tensor([[-0.28, 0.07, 0.0002, 0.0001, 0.0]], dtype=torch.float64)


def camera(degrees: float = 58.0, distortion: Tensor | None = None) -> Camera:
    height, width = SIZE
    focal = width / 2 / np.tan(np.radians(degrees) / 2)
    k = torch.tensor([[[focal, 0, width / 2 - 3], [0, focal, height / 2 + 5], [0, 0, 1]]], dtype=torch.float64)
    return Camera(intrinsics=k, size=SIZE, distortion=distortion)


def rays(of: Camera) -> Tensor:  # (H, W, 3)
    height, width = SIZE
    v, u = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    k = of.intrinsics[0].double()
    return torch.stack([(u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], torch.ones_like(u)], dim=-1)


def plane(of: Camera, tilt: tuple[float, float] = (0.0, 0.0), distance: float = 0.8) -> Tensor:
    """z of a plane before a lens without distortion; its normal leans by tilt (radians) to the right and down."""
    normal = torch.tensor([np.tan(tilt[0]), np.tan(tilt[1]), 1.0], dtype=torch.float64)
    z = distance / (rays(of) @ normal)
    return torch.where(z > 0, z, 0.0)


def sphere(of: Camera, center: float, radius: float, *, inside: bool = False) -> Tensor:
    """z of a ball on the optical axis, or of the far half of a hollow one; 0 beside it."""
    direction = rays(of)
    a, b, c = direction.square().sum(-1), center * direction[..., 2], center**2 - radius**2
    root = b * b - a * c
    z = (b + (1 if inside else -1) * root.clamp(min=0).sqrt()) / a
    return torch.where((root > 0) & (z > 0), z, 0.0)


def frame(z: Tensor, of: Camera, power: int = 0, noise: float = 0.002) -> DepthFrame:
    """z as a capture would have it whose depth is z times a power of the rays' lengths."""
    depth = z * ray_lengths(SIZE, of.intrinsics, of.distortion)[0] ** power
    generator = torch.Generator().manual_seed(0)
    depth = depth * (1 + noise * torch.randn(SIZE, generator=generator, dtype=torch.float64))
    return DepthFrame(depth=depth.float()[None], camera=of)


def judged(of: DepthFrame) -> Finding:
    (finding,) = depth_axis(of, CaptureLimits(), [])
    return finding


def with_holes(z: Tensor) -> Tensor:
    kept = torch.rand(SIZE, generator=torch.Generator().manual_seed(1)) > 0.4
    kept[60:140, 100:230] = False
    return torch.where(kept, z, 0.0)


def with_objects(z: Tensor) -> Tensor:
    nearer = z.clone()
    nearer[40:130, 60:200] *= 0.85
    nearer[150:200, 200:290] = 0.5
    return nearer


SCENES = {
    "frontal": lambda of: plane(of),
    "tilted": lambda of: plane(of, (0.5, -0.6)),
    "steep": lambda of: plane(of, (0.0, 1.0)),
    "holes": lambda of: with_holes(plane(of, (0.2, 0.3))),
    "objects": lambda of: with_objects(plane(of, (-0.3, 0.3))),
    "floor and wall": lambda of: torch.minimum(plane(of, (0.0, 1.0), 1.4), plane(of, (0.1, -0.3), 1.6)),
}


@pytest.mark.parametrize("scene_name", SCENES)
@pytest.mark.parametrize(("kind", "power"), POWERS.items())
def test_what_depth_is_measured_along_is_named_from_one_plane(scene_name: str, kind: str, power: int) -> None:
    of = camera()
    finding = judged(frame(SCENES[scene_name](of), of, power))
    assert finding.verdict is (Verdict.PASS if kind == "z" else Verdict.FAIL), finding.found
    if kind == "ray":
        assert "--option convention.depth=ray" in finding.advice
    if kind == "divided":
        assert "multiply depth by" in finding.advice


def test_lenses_with_distortion_and_wide_ones_are_judged_as_well() -> None:
    for of in (camera(80.0, LENS), camera(100.0)):
        xy = rays(of)
        if of.distortion is not None:  # the rays that the pixels see
            xy = torch.cat([undistort_normalized(xy[None, ..., :2], LENS)[0], xy[..., 2:]], dim=-1)
        z = 0.8 / (xy @ torch.tensor([0.2, -0.4, 1.0], dtype=torch.float64))
        for power, verdict in ((0, Verdict.PASS), (1, Verdict.FAIL), (-1, Verdict.FAIL)):
            finding = judged(frame(torch.where(z > 0, z, 0.0), of, power))
            assert finding.verdict is verdict, finding.found


def room_corner(of: Camera) -> Tensor:
    return torch.minimum(torch.minimum(plane(of, (0.8, 0.4)), plane(of, (-0.8, 0.4))), plane(of, (0.0, -0.9)))


def box_corner(of: Camera) -> Tensor:
    return torch.maximum(torch.maximum(plane(of, (0.8, 0.4)), plane(of, (-0.8, 0.4))), plane(of, (0.0, -0.9)))


def pile(of: Camera) -> Tensor:
    generator = torch.Generator().manual_seed(2)
    coarse = torch.rand((1, 1, 8, 10), generator=generator, dtype=torch.float64)
    return 0.8 + 0.2 * torch.nn.functional.interpolate(coarse, size=SIZE, mode="bicubic")[0, 0]


def cylinder(of: Camera) -> Tensor:
    """A column whose radius is its distance: bent to one side as depth along rays is to all."""
    x, one = rays(of)[..., 0], torch.ones(SIZE, dtype=torch.float64)
    a, b, c = x * x + one, 1.6 * one, 1.6**2 - 0.8**2
    return (b - (b * b - a * c).clamp(min=0).sqrt()) / a


RIGHT = {
    "room corner": room_corner,
    "box corner": box_corner,
    "pile": pile,
    "column": cylinder,
    "ball before a wall": lambda of: torch.where(
        sphere(of, 0.9, 0.3) > 0, sphere(of, 0.9, 0.3), plane(of, distance=1.2)
    ),
    "ball alone": lambda of: sphere(of, 0.8, 0.3),
    "hollow": lambda of: sphere(of, 0.5, 0.6, inside=True),
    "noise alone": lambda of: 0.5 + torch.rand(SIZE, generator=torch.Generator().manual_seed(3)).double(),
}


@pytest.mark.parametrize("name", RIGHT)
def test_right_depth_of_curved_and_cornered_scenes_is_never_named(name: str) -> None:
    for degrees in (25.0, 58.0, 90.0):
        of = camera(degrees)
        for noise in (0.0, 0.005):
            finding = judged(frame(RIGHT[name](of), of, noise=noise))
            assert finding.verdict in (Verdict.PASS, Verdict.UNKNOWN), (degrees, noise, finding.found)


@pytest.mark.parametrize("name", SCENES)
def test_right_depth_of_planes_never_alarms_at_any_noise_and_in_narrow_lenses(name: str) -> None:
    for degrees in (8.0, 25.0, 70.0):
        of = camera(degrees)
        z = SCENES[name](of)
        for noise in (0.0, 0.01, 0.1):
            verdict = judged(frame(z, of, noise=noise)).verdict
            assert verdict in (Verdict.PASS, Verdict.UNKNOWN), (degrees, noise)


@pytest.mark.parametrize("name", ["pile", "noise alone", "ball alone"])
def test_scenes_without_a_plane_are_unknown(name: str) -> None:
    of = camera()
    finding = judged(frame(RIGHT[name](of), of))
    assert finding.verdict is Verdict.UNKNOWN
    assert finding.found.startswith("not measurable")


def test_lenses_too_narrow_and_readings_too_few_to_tell_are_unknown_under_every_reading() -> None:
    for power in POWERS.values():
        narrow = camera(8.0)
        assert judged(frame(plane(narrow), narrow, power)).verdict is Verdict.UNKNOWN
        few = torch.zeros(SIZE, dtype=torch.float64)
        few[:20, :20] = 0.7
        assert judged(frame(few, camera(), power)).verdict is Verdict.UNKNOWN


def test_every_view_is_judged_by_itself_and_poses_are_not_needed() -> None:
    good = replace(scene(num_views=2).frame, world_from_camera=None, frame_id=None)
    lengths = ray_lengths(good.size, good.camera.intrinsics, good.camera.distortion).float()
    depth = good.depth.clone()
    depth[1] *= lengths[1]
    found = [finding for finding in validate_frame(replace(good, depth=depth)) if finding.name == NAME]
    assert [(finding.view, finding.verdict) for finding in found] == [(0, Verdict.PASS), (1, Verdict.FAIL)]


def test_a_view_without_a_reading_is_left_out() -> None:
    assert depth_axis(frame(torch.zeros(SIZE, dtype=torch.float64), camera()), CaptureLimits(), []) == []


@pytest.mark.parametrize("power", [0, 1])
def test_the_option_that_is_advised_mends_it_and_one_too_many_is_named(tmp_path: Path, power: int) -> None:
    of = camera()
    (fx, _, cx), (_, fy, cy), _ = of.intrinsics[0].tolist()
    (tmp_path / "depth").mkdir()
    depth = frame(SCENES["objects"](of), of, power).depth[0]
    write_depth(tmp_path / "depth" / "a.png", depth, metres_per_unit=0.001, round_to_unit=True)
    facts = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": SIZE[1], "height": SIZE[0], "metres_per_unit": 0.001}
    (tmp_path / "intrinsics.json").write_text(json.dumps(facts))
    as_stored = judged(open_source(tmp_path).load("a"))
    converted = judged(open_source(tmp_path, convention={"depth": "ray"}).load("a"))
    assert [as_stored.verdict, converted.verdict] == (
        [Verdict.FAIL, Verdict.PASS] if power else [Verdict.PASS, Verdict.FAIL]
    )
    if not power:
        assert converted.advice == "these files hold z already: read them without convention.depth=ray"


def test_a_large_frame_takes_a_few_milliseconds_of_one_processor() -> None:
    of = camera()
    big = frame(plane(of, (0.3, 0.4)), of)
    depth = torch.nn.functional.interpolate(big.depth[None], size=(960, 1280))[0]
    k = of.intrinsics.clone()
    k[:, :2] *= 4
    large = DepthFrame(depth=depth, camera=Camera(intrinsics=k, size=(960, 1280)))
    judged(large)
    times = []
    for _ in range(5):
        begin = time.process_time()
        judged(large)
        times.append(time.process_time() - begin)
    assert min(times) < 0.03
