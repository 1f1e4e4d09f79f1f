"""Integrate frames into Open3D's legacy ScalableTSDFVolume, one line of JSON per order read from the standard input.

    PYTHON fusion_legacy.py FRAMES.npz VOXEL_SIZE TRUNCATION

PYTHON is an interpreter with Open3D 0.19: in release 0.20 this volume integrates nothing. An order is the number of a
frame, or ``extract``. benchmarks/fusion.py starts this with ``--legacy-python``; it needs only NumPy and Open3D.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import open3d as o3d
from fusion_memory import Growth

_FAR = 10.0  # metres, beyond every reading


def main() -> None:
    path, voxel_size, truncation = sys.argv[1], float(sys.argv[2]), float(sys.argv[3])
    views = read_views(path)
    volume = o3d.pipelines.integration.ScalableTSDFVolume(
        voxel_length=voxel_size,
        sdf_trunc=truncation,
        color_type=o3d.pipelines.integration.TSDFVolumeColorType.RGB8,
    )
    say({"version": o3d.__version__})
    growth = Growth()
    for order in map(str.strip, sys.stdin):
        if order == "extract":
            before = growth.peak()
            cloud, times = timed(volume.extract_point_cloud)
            say({**times, "points": len(cloud.points), "integrated": before, "extracted": growth.peak()})
        else:
            view = views[int(order)]
            say(timed(lambda view=view: volume.integrate(*view))[1])


def read_views(path: str) -> list[tuple[Any, Any, Any]]:
    """The arguments of ``integrate``, made before any clock starts."""
    views = []
    with np.load(path) as arrays:
        for depth, color, k, pose in zip(*(arrays[name] for name in ("depth", "color", "intrinsics", "pose"))):
            image = o3d.geometry.RGBDImage.create_from_color_and_depth(
                o3d.geometry.Image(np.ascontiguousarray(color)),
                o3d.geometry.Image(np.ascontiguousarray(depth)),
                depth_scale=1.0,
                depth_trunc=_FAR,
                convert_rgb_to_intensity=False,
            )
            height, width = depth.shape
            pinhole = o3d.camera.PinholeCameraIntrinsic(width, height, k[0, 0], k[1, 1], k[0, 2], k[1, 2])
            views.append((image, pinhole, np.linalg.inv(pose)))
    return views


def timed(body: Callable[[], Any]) -> tuple[Any, dict[str, float]]:
    cpu, wall = time.process_time(), time.perf_counter()
    result = body()
    return result, {"cpu": time.process_time() - cpu, "wall": time.perf_counter() - wall}


def say(answer: dict[str, Any]) -> None:
    print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
