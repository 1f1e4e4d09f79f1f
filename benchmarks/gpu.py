"""Every operation, step and fusion on a GPU: the same answers as on the CPU, and how long they take.

    benchmarks/gpu.sh                      # from a bare machine; or, where everything is installed:
    PYTHONPATH=. python benchmarks/gpu.py  # writes results/gpu.json
    PYTHONPATH=. python benchmarks/gpu.py --rehearse   # without a GPU, on the device of the tests; keeps nothing

Parity: the examples of the contract suites and fused fields, by every backend that serves them. Masks, indices and
labels are the same; other numbers differ by at most 2e-6. Timings: medians of wall time, synchronized before and
after, on a warm device, for a synthetic 1280x720 frame; ``waits`` counts the calls in which torch says that the host
waited, ``kernels`` those of pcdata that were started: none means that plain torch ran, or a captured graph. One error
stops nothing: it is a row, and the exit code is 1.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import statistics
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import pcdata
from pcdata import functional as F
from pcdata import transforms as T
from pcdata.contracts import dispatch
from pcdata.kernels.cuda import launching
from pcdata.live import LivePipeline
from pcdata.rng import seeded
from pcdata.structures import DepthFrame, PointCloud, TSDFVolume
from pcdata.synthetic import tabletop
from tests.factories import differences, tree
from tests.functional import test_op_contract as operations
from tests.transforms import test_contract as steps

RESULTS = Path(__file__).parent / "results"
TOLERANCE = 2e-6
REPEATS = 10
SLOW = 2.0  # seconds: what takes longer is timed once


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=RESULTS / "gpu.json")
    parser.add_argument("--rehearse", action="store_true", help="run on the device of the tests; keep nothing")
    parser.add_argument("--only", default="", help="rows whose name contains this; keep nothing")
    arguments = parser.parse_args()
    device = rehearsed() if arguments.rehearse else torch.device("cuda", torch.cuda.current_device())
    backends = dispatch.AUTO_ORDER.get(device.type, dispatch.OTHER_DEVICES)
    result: dict[str, Any] = {"device": about(device), "backends": {}, "parity": [], "timings": []}
    for backend in backends:
        result["backends"][backend] = dispatch.why_unavailable(backend) or "live"
        print(f"backend {backend}: {result['backends'][backend]}", flush=True)
    for name, compare in parity_cases(device):
        if arguments.only in name:
            result["parity"].append(compared(name, compare))
    for name, goal, call in timing_cases(device, (36, 64) if arguments.rehearse else (720, 1280)):
        if arguments.only in name:
            result["timings"].append(timed(name, goal, call, device))
    bad = [row["name"] for row in result["parity"] if not row["same"]]
    failed = [row["name"] for row in result["timings"] if "error" in row]
    print(f"{len(result['parity'])} compared, {len(bad)} differ: {bad}; {len(failed)} timings failed: {failed}")
    if not arguments.rehearse and not arguments.only:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        arguments.out.write_text(json.dumps(result, indent=1) + "\n")
    return bool(bad or failed)


def rehearsed() -> torch.device:
    from tests import pretend_device
    from tests.kernels.cuda import harness

    if harness.unavailable() is None:
        harness.register()
        dispatch.AUTO_ORDER[pretend_device.NAME] = (harness.BACKEND, "torch_tree", "torch")
    return pretend_device.device()


def about(device: torch.device) -> dict[str, Any]:
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else device.type
    return {"name": name, "torch": torch.__version__, "cuda": torch.version.cuda, "pcdata": pcdata.__version__}


# Parity


def parity_cases(device: torch.device) -> Iterator[tuple[str, Callable[[], list[str]]]]:
    """Yield names, and calls that return what differs."""
    for example in operations.EXAMPLES:
        for backend in live_backends(device, example.name):
            name = f"{example.name} ({example.cloud.__name__}) by {backend}"
            yield name, lambda e=example, b=backend: operation_differences(e, device, b)
    for name, examples in steps.EXAMPLES.items():
        for number, example in enumerate(examples):
            yield f"{name} ({number})", lambda e=example: step_differences(e, device)
    for backend in live_backends(device, "integrate_view"):
        for options in ({}, {"weighting": "angle", "carve": "everywhere"}, {"carve": "never"}):
            name = f"TSDFVolume {options or ''} by {backend}"
            yield name, lambda b=backend, o=options: volume_differences(device, b, o)


def operation_differences(example: operations.Example, device: torch.device, backend: str) -> list[str]:
    arguments = operations.packed(example, operations.clouds_of(example))
    expected = operations.call(example, arguments, backend="torch")
    found = operations.call(example, {key: value.to(device) for key, value in arguments.items()}, backend=backend)
    return [
        f"output {place}: {told}" for place, pair in enumerate(zip(found, expected)) if (told := apart(*pair, device))
    ]


def apart(found: Tensor, expected: Tensor, device: torch.device) -> str:
    """Say how two tensors differ; nothing where they are the same."""
    if found.device.type != device.type:
        return f"lies on {found.device}"
    there = found.to("cpu")
    if there.shape != expected.shape or there.dtype != expected.dtype:
        return f"{tuple(there.shape)} {there.dtype}, expected {tuple(expected.shape)} {expected.dtype}"
    if not expected.is_floating_point():
        return "" if torch.equal(there, expected) else f"{int((there != expected).sum())} of {expected.numel()} differ"
    most = float((there.double() - expected.double()).nan_to_num(0.0, 0.0, 0.0).abs().max()) if there.numel() else 0.0
    same = torch.equal(there.isfinite(), expected.isfinite()) and most <= TOLERANCE * (
        1 + float(expected[expected.isfinite()].abs().max()) if bool(expected.isfinite().any()) else 1
    )
    return "" if same else f"up to {most:.2e}"


def step_differences(example: Any, device: torch.device) -> list[str]:
    data = example.make(steps.COUNTS)
    found = steps.run(example, data.to(device))
    if found.device.type != device.type:
        return [f"lies on {found.device}"]
    return list(differences(tree(steps.run(example, data)), tree(found.to("cpu")), tolerance=TOLERANCE))


def volume_differences(device: torch.device, backend: str, options: dict[str, Any]) -> list[str]:
    """Compare a field of two captures, every stored bit of it, and its surface."""
    size, voxel_size = ((120, 160), 0.01) if device.type == "cuda" else ((24, 32), 0.04)

    def fused(where: torch.device, by: str) -> TSDFVolume:
        volume = TSDFVolume(voxel_size=voxel_size, backend=by, device=where, **options)
        for seed in range(2):
            volume.integrate(tabletop(seed, size=size, num_views=2).frame.to(where))
        return volume

    here, there = fused(torch.device("cpu"), "torch"), fused(device, backend)
    assert here.blocks is not None
    assert there.blocks is not None
    told = [f"keys: {found}"] if (found := apart(there.blocks.keys, here.blocks.keys, device)) else []
    for one, other in zip(there.blocks.chunks, here.blocks.chunks):
        told += [f"{name}: {found}" for name in other if (found := apart(one[name], other[name], device))]
    told += differences(tree(here.extract_points()), tree(there.extract_points().to("cpu")), tolerance=TOLERANCE)
    return told + list(
        differences(tree(here.extract_mesh()), tree(there.extract_mesh().to("cpu")), tolerance=TOLERANCE)
    )


def live_backends(device: torch.device, *names: str) -> list[str]:
    """Return the backends that serve operations there, the references last."""
    ordered = dispatch.AUTO_ORDER.get(device.type, dispatch.OTHER_DEVICES)
    return [
        backend
        for backend in ordered
        if dispatch.why_unavailable(backend) is None
        and all(dispatch.OPERATIONS[name].serves(backend) for name in names)
    ]


def compared(name: str, compare: Callable[[], list[str]]) -> dict[str, Any]:
    try:
        told = compare()
    except Exception as error:  # a row, so that one fault does not hide the next
        told = [f"{type(error).__name__}: {str(error)[:300]}", traceback.format_exc(limit=-2)[-600:]]
    if told:
        print(f"DIFFERS {name}: {told[0]}", flush=True)
    return {"name": name, "same": not told, "told": told[:4]}


# Timings


def timing_cases(device: torch.device, size: tuple[int, int]) -> Iterator[tuple[str, float | None, Callable[[], Any]]]:
    """Yield names, milliseconds to reach, and calls."""
    frame = tabletop(0, noise="stereo", size=size).frame.to(device)
    chain = T.Compose(
        [
            T.MaskDepth(near=0.2, far=2.0),
            T.Deproject(),
            T.RemoveStatisticalOutliers(num_neighbors=20, std_ratio=2.0),
            T.RemoveRadiusOutliers(radius=0.02 if size[0] >= 100 else 0.2, min_neighbors=10),
            T.RemovePlane(distance=0.01),
            T.FarthestPointSample(num_points=256 if size[0] < 100 else 1024),
            T.EstimateNormals(radius=0.02, max_neighbors=30),
        ]
    )
    crop = T.Compose([T.Deproject(), T.CropWorkspace(frame="camera", lower=(-1, -1, 0), upper=(1, 1, 2))])
    yield "deproject and crop", 0.05, lambda: crop(frame)
    cloud = T.Deproject()(frame)
    points, grid = cloud.points.contiguous(), cloud.image_grid()
    yield (
        "statistical outliers 20",
        0.4,
        lambda: F.statistical_outlier_mask(points, num_neighbors=20, std_ratio=2.0, grid=grid),
    )
    yield (
        "radius outliers 2 cm, 10",
        0.1,
        lambda: F.radius_outlier_mask(points, radius=0.02, min_neighbors=10, grid=grid),
    )
    yield "RANSAC 1000", 0.5, lambda: F.ransac_plane(points, distance=0.01)
    _, on_plane = F.ransac_plane(points, distance=0.01)
    above = points[~on_plane].contiguous()
    yield "DBSCAN 2 cm, 10", 1.0, lambda: F.dbscan(above, eps=0.02, min_points=10)
    yield "voxels 5 mm", 0.25, lambda: F.voxel_downsample(points, voxel_size=0.005)
    some = points[torch.randperm(len(points), generator=seeded(0)).to(device)[: 3 * len(points) // 10]].contiguous()
    for wanted, goal in ((1024, 2.0), (4096, 8.0), (20_000, 40.0)):
        if wanted < len(some):
            yield (
                f"farthest points {len(some)} to {wanted}",
                goal,
                lambda w=wanted: F.farthest_point_sample(some, num_samples=w),
            )
    each = 3000 if size[0] >= 100 else 30
    many = points[:1].new_empty((128 * each, 3))
    many.copy_(torch.rand(128 * each, 3, generator=seeded(0)))
    ptr = (torch.arange(129, device="cpu") * each).to(device)
    few = min(128, each)
    yield (
        f"farthest points 128 x {each} to {few}",
        0.15,
        lambda: F.farthest_point_sample(many, ptr, num_samples=few),
    )
    yield "normals 2 cm, 30", 0.6, lambda: F.estimate_normals(points, radius=0.02, max_neighbors=30, grid=grid)
    yield from depth_cases(frame)
    batch = augmented_batch(32, 8192 if size[0] >= 100 else 50).to(device)
    motions = [T.RandomRotation(), T.RandomScale(), T.RandomTranslation(), T.RandomJitter(), T.RandomPointDropout()]
    augment = T.Compose(motions)
    yield "augmentation 32 x 8192", None, lambda: augment(batch, generator=seeded(0))
    yield "16 nearest", None, lambda: F.knn(points, k=16)
    yield "chain to 1024 points", 3.0, lambda: chain(frame)
    yield "chain to 1024 points, four clouds", 4.0, lambda: [chain(frame) for _ in range(4)]
    for cameras, goal in ((1, 2.0), (4, 4.0)):
        yield f"captured chain, {cameras} cameras", goal, live_call(cameras, size, device, chain)
    for backend in live_backends(device, "integrate_view"):
        volume = TSDFVolume(voxel_size=0.02 if size[0] < 100 else 0.002, backend=backend, device=device)
        yield f"TSDF 2 mm, colors and labels, by {backend}", 0.3, lambda v=volume: v.integrate(frame)
        yield f"TSDF 2 mm, points by {backend}", 0.5, lambda v=volume: v.extract_points()
        yield f"TSDF 2 mm, triangles by {backend}", None, lambda v=volume: v.extract_mesh()


def augmented_batch(clouds: int, each: int) -> PointCloud:
    points = torch.rand((clouds * each, 3), generator=seeded(0))
    ptr = torch.arange(clouds + 1, dtype=torch.int64) * each
    return PointCloud(points=points, ptr=ptr, normals=torch.nn.functional.normalize(points), frame_id="base")


def depth_cases(frame: DepthFrame) -> Iterator[tuple[str, float | None, Callable[[], Any]]]:
    """Yield what is done with depth images before they are points."""
    depth, intrinsics, identity = frame.depth, frame.camera.intrinsics, frame.depth.new_zeros((1, 4, 4)).double()
    identity[:] = torch.eye(4, dtype=torch.float64, device="cpu").to(depth.device)
    size, disparity = frame.size, F.spatial_filter(30 / depth.clamp(min=0.1))
    yield "deproject", 0.05, lambda: F.deproject_depth(depth, intrinsics)
    yield (
        "register depth to color",
        None,
        lambda: F.register_depth(depth, intrinsics, intrinsics, identity, color_size=size),
    )
    yield "decimate depth by 2", None, lambda: F.decimate_depth(depth, factor=2)
    yield "flying pixels", None, lambda: F.flying_pixel_mask(depth)
    yield "spatial filter", None, lambda: F.spatial_filter(disparity)
    yield "bilateral filter 5 x 5", None, lambda: F.bilateral_filter(depth)
    yield "median filter 3 x 3", None, lambda: F.median_filter(depth)
    yield "fill holes", None, lambda: F.fill_holes(depth)


def live_call(cameras: int, size: tuple[int, int], device: torch.device, chain: T.Compose) -> Callable[[], Any]:
    """Return a call that answers the next of two frames, as a stream gives them."""
    made = [tabletop(seed, noise="stereo", size=size, num_views=cameras).frame for seed in (0, 1)]
    frames = [replace(one, camera=made[0].camera, labels=None).to(device) for one in made]
    live = LivePipeline(chain, like=frames[0])
    print(f"captured for {cameras} cameras: {', '.join(live.captured) or 'nothing'}", flush=True)
    turns = itertools.cycle(frames[::-1])

    def call() -> Any:
        result = live(next(turns))
        if result.cloud is None:
            raise RuntimeError(f"{result.fault}: {result.reason}")
        return result.cloud

    return call


def timed(name: str, goal: float | None, call: Callable[[], Any], device: torch.device) -> dict[str, Any]:
    try:
        with kernels_started() as kernels:
            seconds = [run_once(call, device)]  # warms up
        waits = waits_of(call, device)
        seconds = [run_once(call, device) for _ in range(1 if seconds[0] > SLOW else REPEATS)]
    except Exception as error:  # a row, as above
        print(f"FAILED {name}: {error}", flush=True)
        return {"name": name, "error": f"{type(error).__name__}: {str(error)[:300]}"}
    low, _, high = statistics.quantiles(seconds, n=4) if len(seconds) > 1 else (seconds[0],) * 3
    row = {
        "name": name,
        "ms": 1e3 * statistics.median(seconds),
        "iqr_ms": 1e3 * (high - low),
        "goal_ms": goal,
        "waits": waits,
        "kernels": len(kernels),
    }
    print(
        f"{name}: {row['ms']:.3f} ms ({row['iqr_ms']:.3f}), goal {goal}, {waits} waits, {len(kernels)} kernels",
        flush=True,
    )
    return row


@contextlib.contextmanager
def kernels_started() -> Iterator[list[str]]:
    """Give the names of pcdata's kernels that are started meanwhile."""
    names: list[str] = []
    ways = {name: getattr(launching.Launcher, name) for name in ("launch", "launch_blocks")}

    def noting(way: Callable[..., None]) -> Callable[..., None]:
        def start(self: launching.Launcher, name: str, *arguments: Any, **options: Any) -> None:
            names.append(name)
            way(self, name, *arguments, **options)

        return start

    try:
        for name, way in ways.items():
            setattr(launching.Launcher, name, noting(way))
        yield names
    finally:
        for name, way in ways.items():
            setattr(launching.Launcher, name, way)


def run_once(call: Callable[[], Any], device: torch.device) -> float:
    synchronize(device)
    start = time.perf_counter()
    call()
    synchronize(device)
    return time.perf_counter() - start


def synchronize(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def waits_of(call: Callable[[], Any], device: torch.device) -> int | None:
    """Count the calls of one run in which the host waited for the device."""
    if device.type != "cuda":
        return None
    before = torch.cuda.get_sync_debug_mode()
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            call()
    finally:
        torch.cuda.set_sync_debug_mode(before)
    return sum("synchroniz" in str(one.message) for one in told)


if __name__ == "__main__":
    sys.exit(main())
