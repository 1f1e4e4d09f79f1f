"""Clouds, meshes and volumes rendered where their surface is known."""

from __future__ import annotations

import pytest
import torch

from pcdata import Camera, Deproject, DepthFrame, TSDFVolume, render
from pcdata.errors import CaptureError, FrameError
from pcdata.geometry.rotations import rotation_from_euler

SIZE = (48, 64)
LENS = {"distortion": [-0.01, 0.04, -0.03, 0.006], "lens": "fisheye"}
CAMERA = Camera.pinhole(fx=60, fy=61, cx=31, cy=23.5, size=SIZE, **LENS)
POSE = torch.eye(4, dtype=torch.float64)[None].clone()
POSE[0, :3, :3] = rotation_from_euler(torch.tensor([0.1, -0.2, 0.05], dtype=torch.float64), "xyz")
POSE[0, :3, 3] = torch.tensor([0.3, -0.1, 0.2])


def wall() -> DepthFrame:
    half = torch.zeros(1, *SIZE, dtype=torch.int64)
    half[..., 32:] = 1
    return DepthFrame(
        depth=torch.full((1, *SIZE), 0.9),
        camera=CAMERA,
        colors=(half * 200).to(torch.uint8)[..., None].expand(-1, -1, -1, 3).contiguous(),
        labels=half,
        world_from_camera=POSE,
        frame_id="base",
    )


def test_the_cloud_of_a_capture_renders_to_that_capture():
    frame = wall()
    seen = render(Deproject()(frame), CAMERA)
    for name in ("depth", "colors", "labels"):
        assert torch.equal(getattr(seen.frame, name), getattr(frame, name)), name
    assert torch.equal(seen.index.flatten(), torch.arange(SIZE[0] * SIZE[1]))
    moved = render(Deproject()(frame).to_frame("base"), CAMERA, POSE, point_size=0.01)
    torch.testing.assert_close(moved.frame.depth, frame.depth, atol=1e-5, rtol=0)
    assert moved.frame.frame_id == "base"


def test_a_fused_wall_is_seen_flat_with_its_colors_labels_and_normals():
    volume = TSDFVolume(voxel_size=0.02)
    volume.integrate(wall())
    seen = render(volume, CAMERA, POSE)
    hit = seen.frame.depth > 0
    assert float(hit.float().mean()) > 0.8
    assert float((seen.frame.depth[hit] - 0.9).abs().max()) < 2e-3
    toward = seen.normals[hit] @ torch.tensor([0.0, 0.0, -1.0])
    assert float(toward.median()) > 0.99
    left, right = hit[0, :, :28], hit[0, :, 36:]
    assert bool((seen.frame.labels[0, :, :28][left] == 0).all())
    assert bool((seen.frame.labels[0, :, 36:][right] == 1).all())
    assert int(seen.frame.colors[0, :, 36:][right].min()) > 190
    assert bool((seen.frame.labels[~hit] == -1).all())


def test_what_cannot_be_rendered_is_refused_with_the_way_out():
    cloud = Deproject()(wall())
    with pytest.raises(FrameError, match="clouds in 'camera' need none"):
        render(cloud, CAMERA, POSE)
    with pytest.raises(FrameError, match="is in 'base' and no pose is given"):
        render(cloud.to_frame("base"), CAMERA)
    volume = TSDFVolume(voxel_size=0.05)
    volume.integrate(wall())
    with pytest.raises(CaptureError, match="no point_size"):
        render(volume, CAMERA, POSE, point_size=0.1)
