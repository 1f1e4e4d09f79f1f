"""Time and check fusion: against Open3D's tensor grid on hand-held frames, and against the truth on a rendered table.

    OMP_NUM_THREADS=1 PCDATA_TEST_DATA=... python benchmarks/fusion.py     # tables, and results/fusion.json

Method: frames are loaded before the clock starts; both libraries integrate the same frames in turn, in one process, on
one thread. The clock is the CPU time of the process: with one thread that is the time on a core of one's own, whatever
else the machine does. Medians over the frames are kept, and the memory of the stored voxels. The first frame of each is
left out of the median: it pays for what is made once.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from fusion_peer import open3d_grid, open3d_integrate

import pcdata
from pcdata.functional import rigid
from pcdata.functional.depth import deproject_depth
from pcdata.functional.neighbors import knn
from pcdata.report import text_table
from pcdata.structures import DepthFrame, TSDFVolume
from pcdata.synthetic import Tabletop, tabletop
from pcdata.transforms import MaskDepth

RESULTS = Path(__file__).parent / "results"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=10)
    parser.add_argument("--skip-open3d", action="store_true")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    result: dict[str, Any] = {
        "machine": {"cores": os.cpu_count(), "threads": 1, "clock": "CPU time of the process"},
        "versions": {"pcdata": pcdata.__version__, "torch": torch.__version__},
        "truth": [against_truth(views, noise) for noise in ("none", "stereo") for views in (1, 2, 4, 8)],
        "workspace": workspace_rate(),
    }
    show(result["truth"])
    show([result["workspace"]])
    folder = os.environ.get("PCDATA_TEST_DATA")
    if folder and not arguments.skip_open3d:
        source = pcdata.open_source(Path(folder) / "seven_scenes", limit=arguments.frames)
        frames = [source.load(name) for name in source.ids]
        result["open3d"] = [against_open3d(frames, voxel_size) for voxel_size in (0.005, 0.002)]
        show(result["open3d"])
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "fusion.json").write_text(json.dumps(result, indent=1) + "\n")


def show(rows: list[dict[str, Any]]) -> None:
    text = [[f"{value:.4g}" if isinstance(value, float) else str(value) for value in row.values()] for row in rows]
    print(text_table(list(rows[0]), text), flush=True)


def against_truth(num_views: int, noise: str) -> dict[str, Any]:
    scene = tabletop(1, num_objects=4, num_views=num_views, noise=noise, floor=False)
    volume = TSDFVolume(voxel_size=0.002)
    volume.integrate(scene.frame)
    cloud = volume.extract_points()
    error = scene.surface_distance(cloud.points)
    _, distance = knn(cloud.points, queries=visible_surface(scene)[::97], k=1)
    on_table = (cloud.points[:, 2].abs() < 0.003) & (cloud.labels == 0) & (cloud.points[:, :2].abs().amax(1) < 0.38)
    angle = torch.rad2deg(torch.acos(cloud.normals[on_table, 2].clamp(-1, 1)))
    return {
        "views": num_views,
        "noise": noise,
        "points": cloud.num_points,
        "mean error, mm": 1000 * float(error.mean()),
        "median error, mm": 1000 * float(error.median()),
        "covered within 4 mm": float((distance < 0.004).float().mean()),
        "median normal error, degrees": float(angle.median()),
    }


def visible_surface(scene: Tabletop) -> torch.Tensor:
    truth = scene.truth
    points, ptr, _ = deproject_depth(truth.depth.float(), truth.camera.intrinsics)
    return rigid.transform_points(points, ptr, truth.world_from_camera)


def workspace_rate() -> dict[str, Any]:
    """Four cameras on a tabletop at 3 mm: integrate a capture of four views into a running volume."""
    scene = tabletop(1, num_objects=5, num_views=4, noise="stereo")
    frames = [MaskDepth(far=1.3)(frame) for frame in scene.noisy_frames(8)]
    volume = TSDFVolume(voxel_size=0.003)
    seconds = [timed(lambda frame=frame: volume.integrate(frame)) for frame in frames]
    extract = [timed(volume.extract_points) for _ in range(5)]
    typical = statistics.median(seconds[1:])
    return {
        "captures": "4 views of 640x480, 3 mm, colour and labels",
        "first ms": 1000 * seconds[0],
        "median ms": 1000 * typical,
        "captures per second": 1 / typical,
        "extract ms": 1000 * statistics.median(extract),
        "MiB": volume.num_bytes / 2**20,
    }


def against_open3d(frames: list[DepthFrame], voxel_size: float) -> dict[str, Any]:
    volume = TSDFVolume(voxel_size=voxel_size, max_bytes=16 << 30)
    grid = open3d_grid(voxel_size)
    ours, theirs = [], []
    for frame in frames:
        ours.append(timed(lambda frame=frame: volume.integrate(frame)))
        theirs.append(timed(lambda frame=frame: open3d_integrate(grid, frame, voxel_size, 5 * voxel_size)))
    clouds: list[Any] = []
    extract = timed(lambda: clouds.append(volume.extract_points()))
    extract_again = timed(volume.extract_points)
    their_extract = timed(lambda: clouds.append(grid.extract_point_cloud(weight_threshold=0.5)))
    a, b = clouds[0].points, torch.from_numpy(clouds[1].point.positions.numpy().copy())
    apart = [float(knn(y, queries=x[:: max(1, len(x) // 20000)], k=1)[1].median()) for x, y in ((a, b), (b, a))]
    bytes_there = sum(grid.attribute(name).numpy().nbytes for name in ("tsdf", "weight", "color"))
    mine, peer = statistics.median(ours[1:]), statistics.median(theirs[1:])
    return {
        "voxel mm": 1000 * voxel_size,
        "frames": len(frames),
        "ms": 1000 * mine,
        "Open3D ms": 1000 * peer,
        "times faster": peer / mine,
        "extract ms": 1000 * min(extract, extract_again),
        "Open3D extract ms": 1000 * their_extract,
        "extract faster": their_extract / min(extract, extract_again),
        "MiB": volume.num_bytes / 2**20,
        "Open3D MiB": bytes_there / 2**20,
        "ours to theirs, mm": 1000 * apart[0],
        "theirs to ours, mm": 1000 * apart[1],
    }


def timed(body: Callable[[], Any]) -> float:
    started = time.process_time()
    body()
    return time.process_time() - started


if __name__ == "__main__":
    main()
