"""Rendering and lenses at 1280x720: Open3D, OpenCV, kornia and the usual NumPy beside them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from timing import Case, installed

import pcdata
from pcdata import functional as F
from pcdata.geometry.lens_models import lens_row
from pcdata.kernels import cameras
from pcdata.structures import Camera
from pcdata.structures.rendering import render
from pcdata.structures.surface_mesh import SurfaceMesh
from pcdata.synthetic import tabletop

SIZE = (720, 1280)
K = torch.tensor([[[640.0, 0.0, 640.0], [0.0, 640.0, 360.0], [0.0, 0.0, 1.0]]])
# A D455's color, a wide fisheye, and a rational lens with thin prism and tilt.
LENSES = {
    "D455's inverse Brown-Conrady": lens_row("", "inverse_brown_conrady", [-0.0563, 0.0667, -0.0008, 0.0002, -0.0215]),
    "fisheye": lens_row("", "fisheye", [-0.02, 0.006, -0.004, 0.0007]),
    "14 coefficients": [0.1, -0.03, 1e-4, -2e-4, 0.004, 0.08, -0.02, 0.002, 1e-4, -5e-5, 2e-4, 3e-5, 0.01, -0.02],
}


def cases(cloud: pcdata.PointCloud) -> Iterator[Case]:
    """All of this file."""
    yield from cloud_cases(cloud)
    yield from mesh_cases()
    yield from lidar_cases()
    yield from lens_cases()


def covered(ours: torch.Tensor, theirs: np.ndarray) -> str:
    """Say where two depth images differ by more than a thousandth."""
    a, b = ours.numpy().reshape(-1), np.asarray(theirs).reshape(-1)
    both = (a > 0) & (b > 0)
    equal = np.abs(a - b)[both] <= 1e-3 * b[both]
    return f"{100 * equal.mean():.2f} % of {int(both.sum())} common pixels within 0.1 %"


def cloud_cases(cloud: pcdata.PointCloud) -> Iterator[Case]:
    points = cloud.points.contiguous()
    colors = cloud.colors if cloud.colors is not None else torch.rand_like(points)
    plain = pcdata.PointCloud(
        points=points, ptr=torch.tensor([0, len(points)]), unit="m", frame_id="camera", colors=colors
    )
    camera = Camera.pinhole(fx=640.0, fy=640.0, cx=640.0, cy=360.0, size=SIZE)
    if not installed("open3d"):
        return
    import open3d as o3d

    theirs = o3d.t.geometry.PointCloud(o3d.core.Tensor(points.numpy()))
    theirs.point.colors = o3d.core.Tensor(colors.float().numpy())
    k = o3d.core.Tensor(K[0].double().numpy())

    def their_depth() -> np.ndarray:
        image = theirs.project_to_depth_image(SIZE[1], SIZE[0], k, depth_scale=1.0, depth_max=100.0)
        return image.as_tensor().numpy()

    yield Case(
        "cloud to depth", len(points), lambda: F.render_points(points, intrinsics=K, size=SIZE).depth, "Open3D tensor",
        their_depth, covered,
    )  # fmt: skip
    yield Case(
        "cloud to depth and color", len(points), lambda: render(plain, camera).frame, "Open3D tensor",
        lambda: theirs.project_to_rgbd_image(SIZE[1], SIZE[0], k, depth_scale=1.0, depth_max=100.0),
        lambda a, b: covered(a.depth, b.depth.as_tensor().numpy()),
    )  # fmt: skip
    yield Case(
        "cloud to depth, points 5 mm wide", len(points),
        lambda: F.render_points(points, intrinsics=K, size=SIZE, point_size=0.005).depth, "Open3D tensor, one pixel",
        their_depth, covered,
    )  # fmt: skip


def mesh_cases() -> Iterator[Case]:
    if not installed("open3d"):
        return
    import open3d as o3d

    scene = tabletop(0, noise=None, size=(360, 640))
    volume = pcdata.TSDFVolume(voxel_size=0.005)
    volume.integrate(scene.frame)
    mesh: SurfaceMesh = volume.extract_mesh()
    vertices, triangles = mesh.vertices.points, mesh.triangles
    lead = torch.linalg.inv(scene.frame.world_from_camera[0].double())
    moved = (vertices.double() @ lead[:3, :3].T + lead[:3, 3]).float().contiguous()
    corners = moved[triangles].contiguous()
    rays = torch.cat([F.pixel_rays(K, SIZE)[0].float(), torch.ones(*SIZE, 1)], -1)
    rays = torch.cat([torch.zeros_like(rays), rays], -1).contiguous()

    def cast() -> np.ndarray:
        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(o3d.core.Tensor(moved.numpy()), o3d.core.Tensor(triangles.numpy().astype(np.uint32)))
        met = scene.cast_rays(o3d.core.Tensor(rays.numpy()))["t_hit"].numpy()
        return np.where(np.isfinite(met), met, 0)

    yield Case(
        "mesh to depth", len(triangles), lambda: F.render_triangles(corners, intrinsics=K, size=SIZE).depth,
        "Open3D RaycastingScene", cast, covered,
    )  # fmt: skip
    camera = Camera.pinhole(fx=640.0, fy=640.0, cx=640.0, cy=360.0, size=SIZE)
    yield Case(
        "TSDF volume to depth, normals, color", len(triangles),
        lambda: render(volume, camera, world_from_camera=scene.frame.world_from_camera).frame.depth,
        "Open3D RaycastingScene, of its mesh", cast, covered,
    )  # fmt: skip


def lidar_cases() -> Iterator[Case]:
    generator = torch.Generator().manual_seed(0)
    direction = torch.nn.functional.normalize(torch.randn(120_000, 3, generator=generator), dim=1)
    points = (direction * (2 + 40 * torch.rand(120_000, 1, generator=generator))).contiguous()
    low, high = -0.4363, 0.0524

    def numpy() -> np.ndarray:  # as in the code that goes with RangeNet++
        x, y, z = points.numpy().T
        depth = np.linalg.norm(points.numpy(), axis=1)
        up = np.arcsin(z / depth)
        row = np.floor((high - up) / (high - low) * 63 + 0.5).astype(np.int32)
        column = np.floor((math.pi - np.arctan2(y, x)) / (2 * math.pi) * 2048).astype(np.int32) % 2048
        image = np.zeros((64, 2048), dtype=np.float32)
        inside = (row >= 0) & (row < 64)
        order = np.argsort(depth[inside])[::-1]
        image[row[inside][order], column[inside][order]] = depth[inside][order]
        return image

    yield Case(
        "lidar to range image", len(points), lambda: F.render_ranges(points, size=(64, 2048)).depth, "NumPy", numpy,
        covered,
    )  # fmt: skip
    ranges = F.render_ranges(points, size=(64, 2048)).depth
    yield Case(
        "range image to points", int((ranges > 0).sum()), lambda: F.deproject_ranges(ranges)[0], "NumPy",
        lambda: numpy_points(ranges[0].numpy(), low, high),
        lambda a, b: f"within {float(np.abs(a.numpy() - b).max()):.0e} m",
    )  # fmt: skip


def numpy_points(image: np.ndarray, low: float, high: float) -> np.ndarray:
    row, column = np.nonzero(image > 0)
    up = high - row * ((high - low) / (image.shape[0] - 1))
    turn = math.pi - (column + 0.5) * (2 * math.pi / image.shape[1])
    length = image[row, column].astype(np.float64)
    return np.stack([np.cos(up) * np.cos(turn) * length, np.cos(up) * np.sin(turn) * length, np.sin(up) * length], 1)


def lens_cases() -> Iterator[Case]:
    generator = torch.Generator().manual_seed(0)
    depth = 0.5 + torch.rand(1, *SIZE, generator=generator)
    color = torch.randint(0, 256, (1, *SIZE, 3), dtype=torch.uint8, generator=generator)
    for name, numbers in LENSES.items():
        lens = torch.tensor([numbers], dtype=torch.float64)
        yield from one_lens(name, lens, depth, color)


def one_lens(name: str, lens: torch.Tensor, depth: torch.Tensor, color: torch.Tensor) -> Iterator[Case]:
    if not installed("cv2"):
        return
    import cv2

    k = K[0].double().numpy()
    is_fisheye = name == "fisheye"
    known = lens[0, 1:6].numpy() if lens.shape[1] == 16 else lens[0].numpy()
    coefficients = known[:4] if is_fisheye else known
    v, u = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float64)
    pixels = np.stack([u, v], -1).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-12)

    def their_rays() -> np.ndarray:
        if is_fisheye:
            return cv2.fisheye.undistortPoints(pixels, k, coefficients)
        return cv2.undistortPointsIter(pixels, k, coefficients, None, None, criteria)

    def their_points() -> np.ndarray:
        rays = their_rays().reshape(-1, 2).astype(np.float32)
        z = depth.numpy().reshape(-1, 1)
        return np.concatenate([rays * z, z], 1)

    def new_lens() -> torch.Tensor:
        cameras.cached_rays.cache_clear()
        return F.deproject_depth(depth, K, distortion=lens)[0]

    def apart(ours: torch.Tensor, theirs: np.ndarray) -> str:
        return f"within {np.nanmax(np.abs(ours.numpy() - theirs)):.0e} m"

    count = SIZE[0] * SIZE[1]
    yield Case(f"deproject, {name}, lens new", count, new_lens, "OpenCV", their_points, apart)
    new_lens()
    rays = their_rays().reshape(-1, 2).astype(np.float32)

    def their_known_points() -> np.ndarray:
        z = depth.numpy().reshape(-1, 1)
        return np.concatenate([rays * z, z], 1)

    yield Case(
        f"deproject, {name}, lens known", count, lambda: F.deproject_depth(depth, K, distortion=lens)[0],
        "NumPy, rays kept", their_known_points, apart,
    )  # fmt: skip
    make: Callable[..., Any] = cv2.fisheye.initUndistortRectifyMap if is_fisheye else cv2.initUndistortRectifyMap
    maps = make(k, coefficients, np.eye(3), k, SIZE[::-1], cv2.CV_32FC1)
    picture = color[0].numpy()
    yield Case(
        f"undistort color, {name}, map known", count, lambda: F.undistort_image(color, K, lens)[0], "OpenCV remap",
        lambda: cv2.remap(picture, *maps, cv2.INTER_LINEAR),
        lambda a, b: f"{np.abs(a[0].numpy().astype(int) - b)[8:-8, 8:-8].mean():.2f} of 255 apart on average",
    )  # fmt: skip
    image = depth[0].numpy()
    yield Case(
        f"undistort depth, {name}, map known", count, lambda: F.undistort_depth(depth, K, lens)[0], "OpenCV remap",
        lambda: cv2.remap(image, *maps, cv2.INTER_NEAREST),
        lambda a, b: f"{100 * (a[0].numpy() != b)[8:-8, 8:-8].mean():.3f} % of the pixels differ",
    )  # fmt: skip
