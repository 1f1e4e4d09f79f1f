"""Time surface extraction next to Open3D's tensor grid: points and triangles of the same ten hand-held frames.

    OMP_NUM_THREADS=2 PCDATA_TEST_DATA=... python benchmarks/fusion_surface.py    # results/fusion_surface.json

Method: both libraries hold a field of the same frames and extract it in turn, in one process, with the threads that
OMP_NUM_THREADS gives to both; least of the repeats, by the clock on the wall and by the CPU time of the process. One
run is kept per voxel size and number of threads. Results are freed before the other library starts.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from fusion_peer import Open3DGrid, Open3DView

import pcdata
from pcdata.report import text_table
from pcdata.structures import DepthFrame, TSDFVolume

RESULTS = Path(__file__).parent / "results" / "fusion_surface.json"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=10)
    parser.add_argument("--voxel", type=float, default=0.005)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--skip-mesh", action="store_true")
    arguments = parser.parse_args()
    threads = int(os.environ.get("OMP_NUM_THREADS", "0"))
    if threads < 1:
        parser.error("set OMP_NUM_THREADS: both libraries take their number of threads from it")
    torch.set_num_threads(threads)
    source = pcdata.open_source(Path(os.environ["PCDATA_TEST_DATA"]) / "seven_scenes", limit=arguments.frames)
    volume, grid = fields_of([source.load(name) for name in source.ids], arguments.voxel)
    rows = [compare("points", volume.extract_points, grid.extract_point_cloud, arguments.repeats)]
    if not arguments.skip_mesh:
        rows.append(compare("triangles", volume.extract_mesh, grid.extract_triangle_mesh, arguments.repeats))
    known = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    known[f"{1000 * arguments.voxel:g} mm, {threads} threads"] = rows
    RESULTS.write_text(json.dumps(known, indent=1) + "\n")
    text = [[f"{value:.4g}" if isinstance(value, float) else str(value) for value in row.values()] for row in rows]
    print(text_table(list(rows[0]), text), flush=True)


def fields_of(frames: list[DepthFrame], voxel_size: float) -> tuple[TSDFVolume, Any]:
    volume, peer = TSDFVolume(voxel_size=voxel_size, max_bytes=16 << 30), Open3DGrid(voxel_size, 5)
    for frame in frames:
        volume.integrate(frame)
        peer.integrate(Open3DView.of(frame))
    return volume, peer.grid


def compare(what: str, ours: Callable[[], Any], theirs: Callable[..., Any], repeats: int) -> dict[str, Any]:
    mine, peers = [], []
    for _ in range(repeats):
        mine.append(timed(ours))
        peers.append(timed(lambda: theirs(weight_threshold=0.5)))  # whatever was seen
    (wall, cpu, found), (peer_wall, peer_cpu, peer_found) = (
        (min(run[0] for run in runs), min(run[1] for run in runs), runs[0][2]) for runs in (mine, peers)
    )
    return {
        "what": what,
        "ours": found,
        "Open3D's": peer_found,
        "ms": 1000 * wall,
        "Open3D ms": 1000 * peer_wall,
        "times faster": peer_wall / wall,
        "CPU ms": 1000 * cpu,
        "Open3D CPU ms": 1000 * peer_cpu,
        "times less CPU": peer_cpu / cpu,
    }


def timed(body: Callable[[], Any]) -> tuple[float, float, int]:
    """Return wall seconds, CPU seconds and how many points or triangles came out."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = body()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return wall, cpu, size_of(result)


def size_of(result: Any) -> int:
    """Count points or triangles, ours or Open3D's."""
    if isinstance(result, pcdata.PointCloud):
        return result.num_points
    if isinstance(result, pcdata.SurfaceMesh):
        return len(result.triangles)
    return len(result.triangle.indices if hasattr(result, "triangle") else result.point.positions)


if __name__ == "__main__":
    main()
