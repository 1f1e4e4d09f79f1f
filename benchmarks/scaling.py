"""How time and memory of every operation grow with the number of points, threads and clouds.

    python benchmarks/scaling.py             # 50k to 5M points; prints a table, writes results/scaling.json
    python benchmarks/scaling.py --only dbscan --points 5000000

A synthetic surface, hills on a table at an even density: a neighborhood holds about as many points at every size.
Every measurement is a process of its own: it makes the cloud, runs the operation once (its peak of resident memory
above what was there before, less the result, is the working space), then ``--repeats`` times for the median.

Held: no operation takes more than 100 bytes per point beside its result; DBSCAN of 5 million points stays below 1 GB.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import resource
import statistics
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import torch

import pcdata
from pcdata import functional as F
from pcdata.functional.rows import ptr_after_mask, ptr_from_counts
from pcdata.report import text_table

RESULTS = Path(__file__).parent / "results"
POINTS = (50_000, 200_000, 800_000, 2_000_000, 5_000_000)
BATCHES = (1, 8, 32)  # clouds, of 800,000 points together
BATCH_POINTS = 800_000
SPACING = 0.001  # metres between neighbors
BYTES_PER_POINT = 100
DBSCAN_BYTES = 1 << 30

Operation = Callable[[torch.Tensor, torch.Tensor], Any]

# Radii of three spacings hold 28 neighbors on average.
OPERATIONS: dict[str, Operation] = {
    "statistical_outlier_mask": lambda p, ptr: F.statistical_outlier_mask(p, ptr, num_neighbors=20),
    "radius_outlier_mask": lambda p, ptr: F.radius_outlier_mask(p, ptr, min_neighbors=5, radius=3 * SPACING),
    "ransac_plane": lambda p, ptr: F.ransac_plane(p, ptr, distance=SPACING, num_hypotheses=100),
    "dbscan": lambda p, ptr: F.dbscan(p, ptr, eps=3 * SPACING, min_points=10),
    "voxel_downsample": lambda p, ptr: F.voxel_downsample(p, ptr, voxel_size=3 * SPACING),
    "farthest_point_sample": lambda p, ptr: F.farthest_point_sample(p, ptr, num_samples=1024),
    "estimate_normals": lambda p, ptr: F.estimate_normals(p, ptr, radius=3 * SPACING, max_neighbors=30),
    "knn": lambda p, ptr: F.knn(p, ptr, k=8),
    "select": lambda p, ptr: thinned(p, ptr),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--points", type=int, nargs="*", default=list(POINTS))
    parser.add_argument("--threads", type=int, nargs="*", default=[1, 2])
    parser.add_argument("--only", default="", help="only operations whose name contains this")
    arguments = parser.parse_args()
    rows = []
    for name in OPERATIONS:
        if arguments.only not in name:
            continue
        cases = [(points, 1, threads) for points in arguments.points for threads in arguments.threads]
        cases += [(BATCH_POINTS, clouds, max(arguments.threads)) for clouds in BATCHES[1:]]
        for case in cases:
            rows.append(measure_apart(name, *case, arguments.repeats))
            print(line(rows[-1]), flush=True)
    print("\n" + table(rows))
    RESULTS.mkdir(exist_ok=True)
    if not arguments.only:
        facts = {"cores": os.cpu_count(), "repeats": arguments.repeats, "rows": rows}
        (RESULTS / "scaling.json").write_text(json.dumps(facts, indent=1) + "\n")
    hold(rows)


def hold(rows: list[dict[str, Any]]) -> None:
    """Raise if an operation takes more working space than it may."""
    for row in rows:
        # A small cloud's share of what does not grow with it says nothing.
        if row["points"] >= 800_000:
            assert row["bytes_per_point"] <= BYTES_PER_POINT, line(row)
        if row["operation"] == "dbscan":
            assert row["working_bytes"] < DBSCAN_BYTES, line(row)


# -- one measurement ---------------------------------------------------------------------------------------------------


def measure_apart(*case: Any) -> dict[str, Any]:
    """Measure in a fresh process, as the peak of resident memory never goes down; it is forked before anything ran."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("fork")) as process:
        return process.submit(measure_here, *case).result()


def measure_here(name: str, points: int, clouds: int, threads: int, repeats: int) -> dict[str, Any]:
    torch.set_num_threads(threads)
    operation = OPERATIONS[name]
    small = surface(3000, 1)
    operation(*small)  # loads the core and starts the first threads
    cloud = surface(points, clouds)
    before = max(peak(), resident())
    result = operation(*cloud)
    working = max(0, peak() - before - bytes_of(result))
    seconds = []
    for _ in range(repeats):
        started = time.perf_counter()
        operation(*cloud)
        seconds.append(time.perf_counter() - started)
    return {
        "operation": name,
        "points": points,
        "clouds": clouds,
        "threads": threads,
        "milliseconds": 1000 * statistics.median(seconds),
        "nanoseconds_per_point": 1e9 * statistics.median(seconds) / points,
        "working_bytes": working,
        "bytes_per_point": working / points,
    }


def surface(points: int, clouds: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Clouds of ``points`` in all: a table with hills on it, its points in random order."""
    generator = torch.Generator().manual_seed(0)
    own = points // clouds
    # In place and by parts: making the cloud must not be what takes most memory.
    cloud = torch.empty(own * clouds, 3)
    for part in cloud.split(own):
        side = SPACING * own**0.5
        part[:, :2].uniform_(0.0, side, generator=generator)
        part[:, 2].normal_(0.0, SPACING / 10, generator=generator)
        for start in range(0, own, 65536):
            some = part[start : start + 65536]
            # Half-waves 4 cm wide rise from the table where both sines are positive.
            hill = (some[:, 0] * 78.5).sin().clamp_(min=0).mul_((some[:, 1] * 78.5).sin().clamp_(min=0))
            some[:, 2] += 0.02 * hill
    return cloud, ptr_from_counts([own] * clouds)


def thinned(points: torch.Tensor, ptr: torch.Tensor) -> pcdata.PointCloud:
    """Every field of three of four points."""
    cloud = pcdata.PointCloud(points=points, ptr=ptr, frame_id="camera", normals=points)
    keep = torch.ones(len(points), dtype=torch.bool)
    keep[::4] = False
    return cloud.select(keep, ptr_after_mask(keep, ptr))


def bytes_of(result: Any) -> int:
    if isinstance(result, torch.Tensor):
        return result.nbytes
    if isinstance(result, pcdata.PointCloud):
        return sum(value.nbytes for value in result.fields().values())
    return sum(bytes_of(one) for one in result)


def peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


# -- printing ----------------------------------------------------------------------------------------------------------


def line(row: dict[str, Any]) -> str:
    return (
        f"{row['operation']}: {row['points']:,} points in {row['clouds']} clouds, {row['threads']} threads: "
        f"{row['milliseconds']:.1f} ms, {row['bytes_per_point']:.0f} bytes of working space per point"
    )


def table(rows: list[dict[str, Any]]) -> str:
    """One line per operation: milliseconds by size at the most threads, then bytes per point of the largest."""
    threads = max(row["threads"] for row in rows)
    sizes = sorted({row["points"] for row in rows if row["clouds"] == 1})
    lines = []
    for name in dict.fromkeys(row["operation"] for row in rows):
        own = {(r["points"], r["clouds"], r["threads"]): r for r in rows if r["operation"] == name}
        times = [f"{own[size, 1, threads]['milliseconds']:.1f}" for size in sizes]
        batches = [f"{own[BATCH_POINTS, clouds, threads]['milliseconds']:.1f}" for clouds in BATCHES[1:]]
        lines.append([name, *times, *batches, f"{own[sizes[-1], 1, threads]['bytes_per_point']:.0f}"])
    batch_names = [f"{BATCH_POINTS:,} in {clouds}" for clouds in BATCHES[1:]]
    header = [f"ms at {threads} threads", *(f"{size:,}" for size in sizes), *batch_names, "bytes/point"]
    return text_table(header, lines)


if __name__ == "__main__":
    main()
