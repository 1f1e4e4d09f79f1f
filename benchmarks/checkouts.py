"""Time operations, the whole chain and fusion in this checkout and in another one, by turns, in one run.

    PCDATA_TEST_DATA=... python benchmarks/checkouts.py OTHER [--repeats 15] [--json results/checkouts.json]

Each checkout runs in a process of its own, with its own package and compiled core and this file's list of work, so
that both do the same on the same frame; a job runs in one, then in the other, with the order swapped each time. Shown
are medians, and the median of the ratios of neighboring runs: above 1 this checkout is slower. Exit code 1 when a ratio
passes ``--limit``.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parents[1]
WAIT = 0.015  # seconds: threads of the run before go to sleep


def jobs() -> dict[str, Callable[[], Any]]:
    """The work, by name; only interfaces that both checkouts have."""
    import torch

    import pcdata
    from pcdata import functional as F

    folder = os.environ.get("PCDATA_TEST_DATA")
    if folder:
        source = pcdata.open_source(Path(folder) / "graspnet_frame")
        frame = source.load(source.ids[0])
    else:
        from pcdata.synthetic import tabletop

        frame = tabletop(0, noise="stereo", size=(720, 1280)).frame
    cloud = pcdata.Deproject()(frame)
    points, grid = cloud.points.contiguous(), cloud.image_grid()
    above = points[~F.ransac_plane(points)[1]].contiguous()
    few = points[:: len(points) // 4096].contiguous()
    steps = pcdata.Compose(
        [
            pcdata.MaskDepth(near=0.2, far=1.5),
            pcdata.Deproject(),
            pcdata.RemoveStatisticalOutliers(num_neighbors=20, std_ratio=2.0),
            pcdata.RemoveRadiusOutliers(min_neighbors=5, radius=0.01),
            pcdata.RemovePlane(distance=0.01, num_hypotheses=1000),
            pcdata.EstimateNormals(radius=0.02, max_neighbors=30),
            pcdata.FarthestPointSample(num_points=1024),
        ]
    )
    generator = torch.Generator()

    def run_chain() -> Any:
        return steps(frame, generator=generator.manual_seed(0))

    posed = replace(frame, world_from_camera=torch.eye(4, dtype=torch.float64)[None], frame_id="world")

    def fuse() -> Any:
        volume = pcdata.TSDFVolume(voxel_size=0.005)
        volume.integrate(posed)
        return volume.extract_points()

    return {
        "deproject": lambda: F.deproject_depth(frame.depth, frame.camera.intrinsics),
        "statistical outliers, organized": lambda: F.statistical_outlier_mask(points, grid=grid),
        "statistical outliers": lambda: F.statistical_outlier_mask(points),
        "radius outliers, organized": lambda: F.radius_outlier_mask(points, grid=grid),
        "radius outliers": lambda: F.radius_outlier_mask(points),
        "normals, organized": lambda: F.estimate_normals(points, grid=grid),
        "normals": lambda: F.estimate_normals(points),
        "plane": lambda: F.ransac_plane(points),
        "DBSCAN": lambda: F.dbscan(above),
        "voxels": lambda: F.voxel_downsample(points, voxel_size=0.003),
        "farthest points, 1024": lambda: F.farthest_point_sample(points, num_samples=1024),
        "kNN, 20": lambda: F.knn(points, k=20),
        "normals of 4,096 points": lambda: F.estimate_normals(few, radius=0.05),
        "farthest points, 1024 of 4,096": lambda: F.farthest_point_sample(few, num_samples=1024),
        "chain": run_chain,
        "fuse one view": fuse,
    }


def serve() -> None:
    """Run the jobs that are asked for by name, and answer with seconds."""
    work = jobs()
    print(json.dumps(list(work)), flush=True)
    for line in sys.stdin:
        body = work[json.loads(line)]
        until = time.perf_counter() + WAIT
        while time.perf_counter() < until:
            pass  # busy: an idle processor would clock down
        started = time.perf_counter()
        body()
        print(json.dumps(time.perf_counter() - started), flush=True)


class Checkout:
    """A process that serves one checkout."""

    def __init__(self, folder: Path) -> None:
        self.process = subprocess.Popen(
            [sys.executable, __file__, "--serve", str(folder)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(folder)},
        )
        self.jobs: list[str] = self._answer()

    def seconds(self, job: str) -> float:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(job) + "\n")
        self.process.stdin.flush()
        return self._answer()

    def _answer(self) -> Any:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit("a checkout's process ended; see its message above")
        return json.loads(line)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("other", type=Path, help="the folder of another checkout, with its compiled core")
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--only", default="", help="run only jobs whose name contains this")
    parser.add_argument("--limit", type=float, default=1.1)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve()
        return 0
    here, there = Checkout(HERE), Checkout(options.other.resolve())
    rows = []
    for job in here.jobs:
        if options.only not in job:
            continue
        for one in (here, there):  # warm up
            one.seconds(job)
        ours, theirs = [], []
        for turn in range(options.repeats):
            pair = ((here, ours), (there, theirs))
            for one, seconds in pair if turn % 2 else pair[::-1]:
                seconds.append(one.seconds(job))
        ratio = statistics.median(a / b for a, b in zip(ours, theirs, strict=True))
        row = {
            "job": job,
            "here_ms": 1e3 * statistics.median(ours),
            "other_ms": 1e3 * statistics.median(theirs),
            "ratio": ratio,
        }
        rows.append(row)
        print(f"{job:34s} {row['here_ms']:9.2f} ms  {row['other_ms']:9.2f} ms  {ratio:5.2f}", flush=True)
    if options.json:
        options.json.write_text(json.dumps({"repeats": options.repeats, "rows": rows}, indent=1) + "\n")
    return int(any(row["ratio"] > options.limit for row in rows))


if __name__ == "__main__":
    raise SystemExit(main())
