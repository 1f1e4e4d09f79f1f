"""Time the whole way from a 1280x720 frame to objects with normals, as a pipeline, as bare calls, and in Open3D.

    PCDATA_TEST_DATA=... python benchmarks/chain.py        # prints the tables, writes results/chain.json

The chain: mask and deproject, statistical outliers (20, 2.0), radius outliers (5, 1 cm), plane (1 cm, 1000 hypotheses),
DBSCAN (2 cm, 50) with objects of 100 to 50,000 points, 1024 farthest points, normals (2 cm, 30). Also its beginning on
its own, with a crop: mask, deproject with colors, crop.

Method: everything runs once to warm up, then ours and the short Open3D chain ``--repeats`` times in turn; Open3D's
whole chain, which takes a minute, ``--open3d`` times in the same run. Medians and interquartile ranges of wall time,
medians of process time. Parameters are equal, and Open3D's RANSAC may not stop early (probability 1.0). A synthetic
frame stands in for the real one; without Open3D only ours is measured.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from timing import RESULTS, installed, spread

import pcdata
from pcdata import functional as F
from pcdata.report import text_table

BOX = ((-0.3, -0.3, 0.2), (0.3, 0.3, 0.8))  # metres, in the camera's frame
NEAR, FAR = 0.2, 1.5
MIN_SIZE, MAX_SIZE = 100, 50_000

Step = tuple[str, Any]  # its name, and what there is after it


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--open3d", type=int, default=1, help="how often Open3D runs its whole chain; 0: not at all")
    arguments = parser.parse_args()
    frame, name = load_frame()
    with_peer = installed("open3d") and arguments.open3d > 0
    beginning = [("pcdata", pipeline_beginning(frame))]
    if installed("open3d"):
        beginning.append(("Open3D", lambda: open3d_beginning(frame)))
    result = {
        "frame": name,
        "repeats": arguments.repeats,
        "machine": {"cores": os.cpu_count(), "threads": torch.get_num_threads(), "processor": platform.machine()},
        "versions": versions(),
        "beginning": compare_beginnings(measured(beginning, arguments.repeats)),
        "chain": chain(frame, arguments.repeats, arguments.open3d if with_peer else 0),
    }
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "chain.json").write_text(json.dumps(result, indent=1) + "\n")


def load_frame() -> tuple[pcdata.DepthFrame, str]:
    """The real tabletop frame where it is at hand, else a synthetic one with a mask."""
    folder = os.environ.get("PCDATA_TEST_DATA")
    if folder:
        source = pcdata.open_source(Path(folder) / "graspnet_frame")
        frame = source.load(source.ids[0])
        assert isinstance(frame, pcdata.DepthFrame)
        return frame, "graspnet_frame"
    from pcdata.synthetic import tabletop

    return tabletop(0, noise="stereo", size=(720, 1280)).frame, "synthetic"


# -- measuring ---------------------------------------------------------------------------------------------------------


@dataclass
class Times:
    """Seconds of repeated runs of one chain."""

    wall: list[float] = field(default_factory=list)
    process: list[float] = field(default_factory=list)
    result: Any = None

    def run(self, body: Callable[[], Any]) -> None:
        self.result = None  # as in a loop over frames: what is no longer needed is free
        wall, process = time.perf_counter(), time.process_time()
        self.result = body()
        self.wall.append(time.perf_counter() - wall)
        self.process.append(time.process_time() - process)

    def summary(self) -> dict[str, float]:
        return {
            "wall_ms": 1000 * statistics.median(self.wall),
            "wall_iqr_ms": spread(self.wall) if len(self.wall) > 1 else 0.0,
            "wall_best_ms": 1000 * min(self.wall),
            "process_ms": 1000 * statistics.median(self.process),
        }


def measured(bodies: list[tuple[str, Callable[[], Any]]], repeats: int) -> dict[str, Times]:
    times = {name: Times() for name, _ in bodies}
    for _, body in bodies:
        body()
    for _ in range(repeats):
        for name, body in bodies:
            times[name].run(body)
    return times


def measured_steps(steps: Callable[[], Iterator[Step]], repeats: int) -> dict[str, float]:
    """Median milliseconds of every step."""
    taken: dict[str, list[float]] = {}
    for _ in range(repeats):
        started = time.perf_counter()
        for name, _ in steps():
            taken.setdefault(name, []).append(time.perf_counter() - started)
            started = time.perf_counter()
    return {name: 1000 * statistics.median(seconds) for name, seconds in taken.items()}


def last(steps: Iterator[Step]) -> Any:
    *_, (_, result) = steps
    return result


def versions() -> dict[str, str]:
    from importlib.metadata import version

    found = {"pcdata": pcdata.__version__, "torch": torch.__version__}
    return found | ({"open3d": version("open3d")} if installed("open3d") else {})


# -- the beginning: mask, deproject, crop ------------------------------------------------------------------------------


def pipeline_beginning(frame: pcdata.DepthFrame) -> Callable[[], pcdata.PointCloud]:
    steps = pcdata.Compose(
        [
            pcdata.MaskDepth(near=NEAR, far=FAR),
            pcdata.Deproject(),
            pcdata.CropWorkspace(frame="camera", lower=BOX[0], upper=BOX[1]),
        ]
    )
    return lambda: steps(frame)


def open3d_beginning(frame: pcdata.DepthFrame) -> Any:
    import open3d as o3d

    box = o3d.geometry.AxisAlignedBoundingBox(np.array(BOX[0]), np.array(BOX[1]))
    return open3d_cloud(frame, near=NEAR, far=FAR).crop(box)


def compare_beginnings(times: dict[str, Times]) -> dict[str, Any]:
    rows = {name: one.summary() for name, one in times.items()}
    report: dict[str, Any] = {"times": rows, "points": {"pcdata": times["pcdata"].result.num_points}}
    if "Open3D" in times:
        cloud, theirs = times["pcdata"].result, times["Open3D"].result
        report["points"]["Open3D"] = len(theirs.points)
        report["ratio_wall"] = rows["Open3D"]["wall_ms"] / rows["pcdata"]["wall_ms"]
        report["ratio_process"] = rows["Open3D"]["process_ms"] / rows["pcdata"]["process_ms"]
        if len(theirs.points) == cloud.num_points:
            report["largest_difference_m"] = float(np.abs(np.asarray(theirs.points) - cloud.points.numpy()).max())
            report["largest_color_difference"] = float(np.abs(np.asarray(theirs.colors) - cloud.colors.numpy()).max())
    print("mask, deproject with colors, crop")
    table = [[name, *(f"{row[key]:.2f}" for key in row)] for name, row in rows.items()]
    print(text_table(["", "wall ms", "IQR", "best", "process ms"], table))
    print({key: value for key, value in report.items() if key != "times"}, "\n")
    return report


# -- the whole chain ---------------------------------------------------------------------------------------------------


def chain(frame: pcdata.DepthFrame, repeats: int, open3d_runs: int) -> dict[str, Any]:
    whole = pipeline()
    bodies = [("pipeline", lambda: whole(frame)), ("functions", lambda: last(by_functions(frame)))]
    times = measured(bodies, repeats)
    steps = {
        "pipeline": measured_steps(lambda: pipeline_steps(whole, frame), repeats),
        "functions": measured_steps(lambda: by_functions(frame), repeats),
    }
    ours, bare = times["pipeline"].result, times["functions"].result
    report: dict[str, Any] = {"times": {name: one.summary() for name, one in times.items()}, "steps_ms": steps}
    report["functions_equal_pipeline"] = torch.equal(ours.points, bare[0]) and torch.equal(ours.normals, bare[1])
    counts = {"pipeline": {name: count_of(cloud) for name, cloud in pipeline_steps(whole, frame)}}
    if open3d_runs:
        seconds, theirs = run_open3d(frame, open3d_runs)
        steps["Open3D"] = {name: 1000 * statistics.median(taken) for name, taken in seconds.items()}
        counts["Open3D"] = {name: len(cloud.points) for name, cloud in theirs.items()}
        total = sum(steps["Open3D"].values())
        report["times"]["Open3D"] = {"wall_ms": total, "runs": open3d_runs}
        report["ratio"] = {name: total / report["times"][name]["wall_ms"] for name in ("pipeline", "functions")}
        report["results"] = compare_results(theirs)
    report["points"] = counts
    print_chain(report)
    return report


def print_chain(report: dict[str, Any]) -> None:
    names = [name for name in ("pipeline", "functions", "Open3D") if name in report["steps_ms"]]
    table = []
    for step in report["steps_ms"]["pipeline"]:
        counts = [report["points"].get(name, {}).get(step, "") for name in ("pipeline", "Open3D")]
        table.append([step, *(f"{report['steps_ms'][name].get(step, 0):.2f}" for name in names), *counts])
    table.append(["whole", *(f"{report['times'][name]['wall_ms']:.2f}" for name in names), "", ""])
    print(text_table(["step", *(f"{name} ms" for name in names), "points", "Open3D's"], table))
    for key in ("functions_equal_pipeline", "ratio", "results"):
        if key in report:
            print(key, report[key])


def count_of(data: Any) -> int:
    return data.num_points if isinstance(data, pcdata.PointCloud) else int((data.depth > 0).sum())


def pipeline() -> pcdata.Compose:
    return pcdata.Compose(
        [
            pcdata.MaskDepth(),
            pcdata.Deproject(),
            pcdata.RemoveStatisticalOutliers(num_neighbors=20, std_ratio=2.0),
            pcdata.RemoveRadiusOutliers(min_neighbors=5, radius=0.01),
            pcdata.RemovePlane(distance=0.01, num_hypotheses=1000),
            pcdata.ClusterObjects(eps=0.02, min_points=50, min_size=MIN_SIZE, max_size=MAX_SIZE),
            pcdata.FarthestPointSample(num_points=1024),
            pcdata.EstimateNormals(radius=0.02, max_neighbors=30),
        ]
    )


STEPS = {
    "Deproject": "mask, deproject",
    "RemoveStatisticalOutliers": "statistical outliers",
    "RemoveRadiusOutliers": "radius outliers",
    "RemovePlane": "plane",
    "ClusterObjects": "DBSCAN",
    "FarthestPointSample": "farthest points",
    "EstimateNormals": "normals",
}


def pipeline_steps(whole: pcdata.Compose, frame: pcdata.DepthFrame) -> Iterator[Step]:
    for step, cloud in whole.step_through(frame):
        if type(step).__name__ in STEPS:
            yield STEPS[type(step).__name__], cloud


def by_functions(frame: pcdata.DepthFrame) -> Iterator[Step]:
    """The same with tensors alone: points, and the colors and pixels that belong to them."""
    intrinsics, size = frame.camera.intrinsics, frame.size
    depth = frame.depth if frame.mask is None else torch.where(frame.mask, frame.depth, 0.0)
    points, _, pixel = F.deproject_depth(depth, intrinsics)
    colors = frame.colors.reshape(-1, 3)[pixel].float() / 255
    yield "mask, deproject", points

    def keep(rows: torch.Tensor) -> None:
        nonlocal points, pixel, colors
        points, pixel, colors = points[rows], pixel[rows], colors[rows]

    keep(~F.statistical_outlier_mask(points, grid=F.ImageGrid(pixel, size, intrinsics)))
    yield "statistical outliers", points
    keep(~F.radius_outlier_mask(points, grid=F.ImageGrid(pixel, size, intrinsics)))
    yield "radius outliers", points
    keep(~F.ransac_plane(points)[1])
    yield "plane", points
    label = F.dbscan(points, grid=F.ImageGrid(pixel, size, intrinsics))
    count = torch.bincount(label + 1)
    count[0] = 0
    keep(((count >= MIN_SIZE) & (count <= MAX_SIZE))[label + 1])
    yield "DBSCAN", points
    keep(F.farthest_point_sample(points, num_samples=1024)[0])
    yield "farthest points", points
    normals = F.orient_normals(points, F.estimate_normals(points), torch.zeros(1, 3))
    yield "normals", (points, normals)


# -- Open3D ------------------------------------------------------------------------------------------------------------


def open3d_cloud(frame: pcdata.DepthFrame, *, near: float = 0.0, far: float = 1000.0) -> Any:
    import open3d as o3d

    depth, k = frame.depth[0].numpy(), frame.camera.intrinsics[0].tolist()
    keep = (depth >= near) & (depth <= far)
    if frame.mask is not None:
        keep &= frame.mask[0].numpy()
    images = [np.ascontiguousarray(frame.colors[0].numpy()), np.where(keep, depth, np.float32(0))]
    rgbd = o3d.geometry.RGBDImage.create_from_color_and_depth(
        *map(o3d.geometry.Image, images), depth_scale=1.0, depth_trunc=1000.0, convert_rgb_to_intensity=False
    )
    height, width = frame.size
    camera = o3d.camera.PinholeCameraIntrinsic(width, height, k[0][0], k[1][1], k[0][2], k[1][2])
    return o3d.geometry.PointCloud.create_from_rgbd_image(rgbd, camera)


def by_open3d(frame: pcdata.DepthFrame) -> Iterator[Step]:
    import open3d as o3d

    cloud = open3d_cloud(frame)
    yield "mask, deproject", cloud
    cloud, _ = cloud.remove_statistical_outlier(20, 2.0)
    yield "statistical outliers", cloud
    cloud, _ = cloud.remove_radius_outlier(5, 0.01)
    yield "radius outliers", cloud
    _, rows = cloud.segment_plane(0.01, 3, 1000, probability=1.0)
    cloud = cloud.select_by_index(rows, invert=True)
    yield "plane", cloud
    label = np.asarray(cloud.cluster_dbscan(0.02, 50))
    count = np.bincount(label + 1)
    count[0] = 0
    rows = np.flatnonzero(((count >= MIN_SIZE) & (count <= MAX_SIZE))[label + 1])
    cloud = cloud.select_by_index(rows)
    yield "DBSCAN", cloud
    cloud = cloud.farthest_point_down_sample(1024)
    yield "farthest points", cloud
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=0.02, max_nn=30))
    cloud.orient_normals_towards_camera_location(np.zeros(3))
    yield "normals", cloud


def run_open3d(frame: pcdata.DepthFrame, runs: int) -> tuple[dict[str, list[float]], dict[str, Any]]:
    seconds: dict[str, list[float]] = {}
    for _ in range(runs):
        clouds = {}
        started = time.perf_counter()
        for name, cloud in by_open3d(frame):
            seconds.setdefault(name, []).append(time.perf_counter() - started)
            clouds[name] = cloud
            started = time.perf_counter()
    return seconds, clouds


def compare_results(theirs: dict[str, Any]) -> dict[str, float | bool]:
    """Run each of our steps on what Open3D gave the step before, and compare with what Open3D made of it.

    The planes are compared as planes: ours is refitted to its inliers until they settle, theirs is not.
    """
    points = {name: torch.from_numpy(np.asarray(cloud.points)).float() for name, cloud in theirs.items()}

    def same_points(ours: torch.Tensor, name: str) -> bool:
        return torch.equal(ours, points[name])

    start, smooth, close, standing = (points[name] for name in list(points)[:4])
    label = F.dbscan(standing)
    count = torch.bincount(label + 1)
    count[0] = 0
    objects = standing[((count >= MIN_SIZE) & (count <= MAX_SIZE))[label + 1]]
    # Open3D gives the sample in the order of the cloud.
    picked = points["DBSCAN"][F.farthest_point_sample(points["DBSCAN"], num_samples=1024)[0].sort().values]
    normals = F.estimate_normals(points["farthest points"]).double().numpy()
    cosine = np.abs((normals * np.asarray(theirs["normals"].normals)).sum(1)).clip(0, 1)
    removed = len(close) - len(standing)
    return {
        "statistical_outliers_identical": same_points(
            start[~F.statistical_outlier_mask(start)], "statistical outliers"
        ),
        "radius_outliers_identical": same_points(smooth[~F.radius_outlier_mask(smooth)], "radius outliers"),
        "plane_inliers_ours_over_theirs": int(F.ransac_plane(close)[1].sum()) / removed,
        "objects_identical": same_points(objects, "DBSCAN"),
        "farthest_points_identical": same_points(picked, "farthest points"),
        "normals_within_half_a_degree": float((np.degrees(np.arccos(cosine)) < 0.5).mean()),
    }


if __name__ == "__main__":
    main()
