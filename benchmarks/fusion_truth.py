"""Fusion against the truth: rendered tables with exact surfaces and labels, seen with and without noise."""

from __future__ import annotations

import statistics
import time
from typing import Any

import torch
from torch import Tensor

from pcdata.functional.depth.deproject import deproject_depth
from pcdata.functional.neighbors import knn
from pcdata.functional.rows import transform_points
from pcdata.structures import DepthFrame, PointCloud, TSDFVolume
from pcdata.synthetic import Tabletop, tabletop
from pcdata.transforms import MaskDepth

VOXEL_SIZE = 0.002
_AWAY = 0.01  # metres from every other solid: where a label cannot be in doubt


def truth_rows() -> list[dict[str, Any]]:
    """One to eight views of one table, without and with the noise of a stereo camera."""
    rows = []
    for noise in ("none", "stereo"):
        scenes = [tabletop(1, num_objects=4, num_views=views, noise=noise, floor=False) for views in (1, 2, 4, 8)]
        rows += [against_truth(scene, noise) for scene in scenes]
    return rows


def against_truth(scene: Tabletop, noise: str) -> dict[str, Any]:
    """Fuse a capture and measure the points, normals and labels against the scene."""
    views = scene.frame.num_views
    cloud = fused(scene.frame)
    singles = [cloud] if views == 1 else [fused(scene.frame.view(number)) for number in range(views)]
    kept = fused(scene.frame, carve="never")
    _, distance = knn(cloud.points, queries=visible_surface(scene)[::97], k=1)
    on_table = (cloud.points[:, 2].abs() < 0.003) & (cloud.labels == 0) & (cloud.points[:, :2].abs().amax(1) < 0.38)
    angle = torch.rad2deg(torch.acos(cloud.normals[on_table, 2].clamp(-1, 1)))
    right, clear = label_accuracy(scene, cloud)
    return {
        "views": views,
        "noise": noise,
        "points": cloud.num_points,
        "mean error, mm": mean_error(scene, cloud),
        "median error, mm": 1000 * float(scene.surface_distance(cloud.points).median()),
        "no carving, mean error, mm": mean_error(scene, kept),
        "best single view, mean error, mm": min(mean_error(scene, single) for single in singles),
        "covered within 4 mm": float((distance < 0.004).float().mean()),
        "median normal error, degrees": float(angle.median()),
        "labels right away from contacts": right,
        "points away from contacts": clear,
    }


def fused(frame: DepthFrame, **options: Any) -> PointCloud:
    """The surface of one capture."""
    volume = TSDFVolume(voxel_size=VOXEL_SIZE, **options)
    volume.integrate(frame)
    return volume.extract_points()


def mean_error(scene: Tabletop, cloud: PointCloud) -> float:
    """The mean distance of points to the true surface, in millimetres."""
    return 1000 * float(scene.surface_distance(cloud.points).mean())


def label_accuracy(scene: Tabletop, cloud: PointCloud) -> tuple[float, float]:
    """The share of right labels among points more than 1 cm from every other solid than the nearest; and their share.

    The right label of a point is that of the solid whose surface is nearest.
    """
    distances = torch.stack([shape.signed_distance(cloud.points.double()).abs() for shape in scene.truth.shapes])
    clear = distances.sort(dim=0).values[1] > _AWAY
    labels = torch.tensor([shape.label for shape in scene.truth.shapes])[distances.argmin(0)]
    return float((cloud.labels == labels)[clear].float().mean()), float(clear.float().mean())


def visible_surface(scene: Tabletop) -> Tensor:
    """(N, 3): the true surface at every pixel of every view."""
    truth = scene.truth
    points, ptr, _ = deproject_depth(truth.depth.float(), truth.camera.intrinsics)
    return transform_points(points, ptr, truth.world_from_camera)


def workspace_rate() -> dict[str, Any]:
    """Four cameras on a tabletop at 3 mm: integrate a capture of four views into a running volume."""
    scene = tabletop(1, num_objects=5, num_views=4, noise="stereo")
    frames = [MaskDepth(far=1.3)(frame) for frame in scene.noisy_frames(8)]
    volume = TSDFVolume(voxel_size=0.003)
    seconds = []
    for frame in frames:
        started = time.process_time()
        volume.integrate(frame)
        seconds.append(time.process_time() - started)
    started = time.process_time()
    for _ in range(5):
        volume.extract_points()
    extract = (time.process_time() - started) / 5
    typical = statistics.median(seconds[1:])
    return {
        "captures": "4 views of 640x480, 3 mm, color and labels",
        "first ms": 1000 * seconds[0],
        "median ms": 1000 * typical,
        "captures per second": 1 / typical,
        "extract ms": 1000 * extract,
        "MiB": volume.num_bytes / 2**20,
    }
