"""Time every cleaning operation against Open3D on one frame, in one run, and check that the results are equal.

    PCDATA_TEST_DATA=... python benchmarks/against_open3d.py            # prints the table, writes results/*.json

Method: each operation runs once to warm up, then ``--repeats`` times, ours and theirs in turn; medians and the
interquartile range are kept. Parameters are equal, and Open3D's RANSAC may not stop early (probability 1.0).
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
import torch

import pcdata
from pcdata import functional as F
from pcdata.report import text_table

HERE = Path(__file__).parent


@dataclass
class Row:
    operation: str
    points: int
    pcdata_ms: float
    pcdata_iqr: float
    open3d_ms: float
    open3d_iqr: float
    ratio: float  # Open3D's time over ours: above 1 we are faster
    equality: str


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--max-points", type=int, default=None, help="random subset of the frame")
    arguments = parser.parse_args()
    points, name = load_points(arguments.max_points)
    rows = [compare(*case, arguments.repeats) for case in cases(points)]
    cells = [
        [r.operation, r.points, f"{r.pcdata_ms:.0f}", f"{r.open3d_ms:.0f}", f"{r.ratio:.2f}x", r.equality] for r in rows
    ]
    print(text_table(["operation", "points", "pcdata ms", "Open3D ms", "ratio", "results"], cells))
    write(rows, name, arguments.repeats)


def load_points(limit: int | None) -> tuple[torch.Tensor, str]:
    """The real tabletop frame where it is at hand, else a synthetic one, both 1280x720."""
    folder = os.environ.get("PCDATA_TEST_DATA")
    if folder:
        frame, name = pcdata.open_source(Path(folder) / "graspnet_frame"), "graspnet_frame"
        capture = frame.load(frame.ids[0])
    else:
        from pcdata.synthetic import tabletop

        capture, name = tabletop(0, noise="stereo", size=(720, 1280)).frame, "synthetic"
    points = pcdata.Deproject()(capture).points
    if limit is not None and limit < len(points):
        points = points[torch.randperm(len(points), generator=torch.Generator().manual_seed(0))[:limit].sort().values]
    return points.contiguous(), name


def cases(
    points: torch.Tensor,
) -> list[tuple[str, int, Callable[[], Any], Callable[[], Any], Callable[[Any, Any], str]]]:
    """(name, points, ours, theirs, how the results compare) of every operation."""
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.double().numpy()))
    count = len(points)

    def masks(ours: torch.Tensor, theirs: Any) -> str:
        kept = np.zeros(count, dtype=bool)
        kept[np.asarray(theirs[1])] = True
        different = int((kept == ours.numpy()).sum())
        return "identical" if different == 0 else f"{different} differ"

    _, inliers = F.ransac_plane(points)
    above = points[~inliers]
    above_cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(above.double().numpy()))

    def labels(ours: torch.Tensor, theirs: Any) -> str:
        different = int((ours.numpy() != np.asarray(theirs)).sum())
        return "identical" if different == 0 else f"{different} of {len(ours)} differ"

    def voxels(ours: Any, theirs: Any) -> str:
        a, b = ours[0].double().numpy(), np.asarray(theirs.points)
        if len(a) != len(b):
            return f"{len(a)} and {len(b)} voxels"
        distance = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(a)).compute_point_cloud_distance(theirs)
        return f"equal within {max(distance):.0e} m"

    def plane(ours: Any, theirs: Any) -> str:
        normal = np.array(theirs[0][:3]) / np.linalg.norm(theirs[0][:3])
        angle = np.degrees(np.arccos(np.clip(abs(normal @ ours[0][0, :3].double().numpy()), 0, 1)))
        return f"normals {angle:.3f} degrees apart"

    def normals(ours: torch.Tensor, theirs: Any) -> str:
        cosine = np.abs((ours.double().numpy() * np.asarray(theirs)).sum(1)).clip(0, 1)
        return f"{100 * (np.degrees(np.arccos(cosine)) < 0.5).mean():.2f} % within 0.5 degrees"

    def their_normals() -> Any:
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=0.02, max_nn=30))
        return cloud.normals

    return [
        ("statistical outliers 20, 2.0", count, lambda: F.statistical_outlier_mask(points),
         lambda: cloud.remove_statistical_outlier(20, 2.0), masks),
        ("radius outliers 5, 1 cm", count, lambda: F.radius_outlier_mask(points),
         lambda: cloud.remove_radius_outlier(5, 0.01), masks),
        ("plane 1 cm, 1000 hypotheses", count, lambda: F.ransac_plane(points),
         lambda: cloud.segment_plane(0.01, 3, 1000, probability=1.0), plane),
        ("DBSCAN 2 cm, 50", len(above), lambda: F.dbscan(above), lambda: above_cloud.cluster_dbscan(0.02, 50), labels),
        ("voxels 3 mm", count, lambda: F.voxel_downsample(points, voxel_size=0.003),
         lambda: cloud.voxel_down_sample(0.003), voxels),
        ("normals 2 cm, 30", count, lambda: F.estimate_normals(points), their_normals, normals),
        ("farthest points, 1024", count, lambda: F.farthest_point_sample(points, num_samples=1024)[0],
         lambda: cloud.farthest_point_down_sample(1024),
         lambda ours, theirs: "identical" if np.array_equal(points[ours].double().numpy(), np.asarray(theirs.points))
         else "differ"),
    ]  # fmt: skip


def compare(
    operation: str,
    points: int,
    ours: Callable[[], Any],
    theirs: Callable[[], Any],
    equality: Callable[[Any, Any], str],
    repeats: int,
) -> Row:
    verdict = equality(ours(), theirs())
    times: dict[str, list[float]] = {"ours": [], "theirs": []}
    for _ in range(repeats):
        for name, body in (("ours", ours), ("theirs", theirs)):
            started = time.perf_counter()
            body()
            times[name].append(1000 * (time.perf_counter() - started))
    mine, other = statistics.median(times["ours"]), statistics.median(times["theirs"])
    return Row(operation, points, mine, iqr(times["ours"]), other, iqr(times["theirs"]), other / mine, verdict)


def iqr(values: list[float]) -> float:
    low, high = np.percentile(values, [25, 75])
    return float(high - low)


def write(rows: list[Row], name: str, repeats: int) -> None:
    result = {
        "frame": name,
        "repeats": repeats,
        "machine": {"cores": os.cpu_count(), "threads": torch.get_num_threads(), "processor": platform.machine()},
        "versions": {"pcdata": pcdata.__version__, "torch": torch.__version__, "open3d": o3d.__version__},
        "rows": [asdict(row) for row in rows],
    }
    path = HERE / "results" / f"against_open3d_{name}.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
