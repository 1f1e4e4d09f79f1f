"""How well objects on a table are told apart, on real scenes with ground truth, beside the plain recipe and Open3D's.

    PCDATA_TEST_DATA=... python benchmarks/segmentation.py [--parts PART ...] [--pictures FOLDER]

Scenes: the Object Segmentation Database as modified by Alexandrov (`osd/`, or --osd FOLDER); a number says its kind.
One set of numbers for all of them. `heaps`: 20 touching objects, rendered in 4 views that are merged; `one_view`: 6
to 20, each heap seen by one camera. `kinds` fits three numbers on three kinds of scenes and scores the fourth.
`enlarged`: the same scenes as a stereo camera whose depth lies on the pixels of color would give them, smoothed and
enlarged. Prints tables and writes results/segmentation.json.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import platform
import statistics
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from PIL import Image, ImageDraw
from scipy.ndimage import binary_dilation, distance_transform_edt, uniform_filter
from torch import Tensor

import pcdata
from pcdata.errors import TooFewPointsError
from pcdata.functional import ParallelJaw, check_grasps
from pcdata.functional.touching import joining, regions, separation
from pcdata.functional.touching.limits import Limits
from pcdata.io import open_source, read_labels, read_pcd
from pcdata.report import text_table
from pcdata.report.html.pictures import rims
from pcdata.structures import DepthFrame, PointCloud
from pcdata.synthetic import tabletop
from pcdata.transforms import (
    ClusterObjects,
    Compose,
    Deproject,
    LeftOutWarning,
    MergeViews,
    RandomSensorNoise,
    RemovePlane,
    ToFrame,
)
from pcdata.validation import SegmentationScores, mean_scores, score_segmentation

OUTLINES = Path(__file__).parent / "apc_outlines.json"  # frame -> object -> corners (u, v), the nearest object last
RESULT = Path(__file__).parent / "results" / "segmentation.json"
PARTS = ("table", "time", "ablation", "kinds", "other", "enlarged", "heaps", "one_view")
HEAPS = {"seen while the method was made": range(6), "unseen": range(100, 106)}  # seeds
HEAP_SENSORS = ("kinect_v1", "realsense_d415")
ONE_VIEW = {"seen while the method was made": range(200, 212), "unseen": range(500, 512)}
ONE_VIEW_OBJECTS = (6, 12, 20)
ENLARGED = {  # pixels that depth is smoothed over, and how many times as large it then is
    "enlarged": (1, 2.133),
    "smoothed over 3 pixels": (3, 1.0),
    "smoothed over 3, enlarged": (3, 2.133),
}
KINDS = {"boxes": range(17), "stacked": range(17, 25), "occluded": range(25, 33), "cylinders": range(33, 45)}
SHOWN = ("overlap_f", "boundary_f", "found", "mean_iou")
HEAP_SHOWN = ("overlap_f", "found", "mean_iou")  # a merged cloud has no boundaries
TABLE = RemovePlane(which="supporting", cut="measured", probability=0.9999)
PLAIN = Compose([RemovePlane(distance=0.01), ClusterObjects()])

Method = Callable[[PointCloud], Tensor]  # labels of every point, -1 = none
Scene = tuple[str, str, PointCloud, Tensor]  # name, kind, cloud, truth of every point


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--osd", type=Path, help="folder of the scenes (default: osd/ of PCDATA_TEST_DATA)")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS, help="the others keep their old results")
    parser.add_argument("--pictures", type=Path, help="draw the worst scenes into this folder")
    parser.add_argument("--limit", type=int, help="only every so many-th scene")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", LeftOutWarning)  # the plain recipe loses a heap: the table says so
    folder = arguments.osd or Path(os.environ["PCDATA_TEST_DATA"]) / "osd"
    scenes = list(osd(folder))[:: arguments.limit or 1]
    found: dict[str, Any] = json.loads(RESULT.read_text(encoding="utf-8")) if RESULT.exists() else {}
    found["about"] = {
        "pcdata": pcdata.__version__,
        "torch": torch.__version__,
        "python": platform.python_version(),
        "threads": torch.get_num_threads(),
        "cpu": platform.processor() or platform.machine(),
    }
    if "table" in arguments.parts:
        found["table"] = table(scenes, arguments.pictures)
    if "time" in arguments.parts:
        found["time"] = timing(scenes)
    if {"ablation", "kinds"} & set(arguments.parts):
        without_table = [(name, kind, cloud, truth, TABLE(cloud)) for name, kind, cloud, truth in scenes]
        if "ablation" in arguments.parts:
            found["ablation"] = ablation(without_table)
        if "kinds" in arguments.parts:
            found["kinds"] = cross_validation(without_table)
    if "other" in arguments.parts:
        found["other"] = other_sensors(Path(os.environ["PCDATA_TEST_DATA"]))
    if "enlarged" in arguments.parts:
        found["enlarged"] = enlarged(scenes)
    if "heaps" in arguments.parts:
        found["heaps"] = heaps(arguments.limit or 1)
    if "one_view" in arguments.parts:
        found["one_view"] = one_view(arguments.limit or 1)
    if arguments.osd is None and arguments.limit is None:
        RESULT.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


def osd(folder: Path) -> Iterator[Scene]:
    for path in sorted(folder.glob("*.pcd"), key=lambda path: int("".join(filter(str.isdecimal, path.stem)))):
        number = int("".join(filter(str.isdecimal, path.stem)))
        cloud = read_pcd(path)
        assert cloud.labels is not None
        kind = next((kind for kind, numbers in KINDS.items() if number in numbers), "other")
        thing = cloud.labels // 10  # objects are labeled in parts; 0 in the tens is the table
        yield path.stem, kind, cloud.with_fields(labels=None), torch.where(thing > 0, thing, -1)


# -- methods ----------------------------------------------------------------------------------------------------------


def labels_by(steps: Callable[[PointCloud], PointCloud], cloud: PointCloud) -> Tensor:
    numbered = cloud.with_extra("row", torch.arange(cloud.num_points), "invariant")
    found = steps(numbered)
    labels = torch.full((cloud.num_points,), -1)
    assert found.labels is not None
    labels[found.extra["row"]] = found.labels
    return labels


def plain(cloud: PointCloud) -> Tensor:
    return labels_by(PLAIN, cloud)


def touching(cloud: PointCloud) -> Tensor:
    return labels_by(Compose([TABLE, ClusterObjects(split_touching=True)]), cloud)


def open3d(cloud: PointCloud) -> Tensor:
    import open3d as o3d

    whole = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.points.double().numpy()))
    o3d.utility.random.seed(0)
    _, inliers = whole.segment_plane(0.01, 3, 1000)
    rest = np.setdiff1d(np.arange(cloud.num_points), inliers)
    found = torch.from_numpy(np.asarray(whole.select_by_index(rest).cluster_dbscan(0.02, 50))).long()
    size = torch.bincount(found + 1)
    keep = (size >= 100) & (size <= 50_000)
    keep[0] = False
    labels = torch.full((cloud.num_points,), -1)
    labels[torch.from_numpy(rest)] = torch.where(keep[found + 1], found, -1)
    return labels


def score(cloud: PointCloud, labels: Tensor, truth: Tensor) -> SegmentationScores:
    height, width = cloud.meta[0]["organized_size"]
    images = torch.full((3, height * width), -1)
    assert cloud.source_index is not None
    images[0, cloud.source_index], images[1, cloud.source_index], images[2, cloud.source_index] = labels, truth, 0
    guess, right, there = images.reshape(3, height, width)
    return score_segmentation(guess, right, ignore=there < 0)


# -- tables -----------------------------------------------------------------------------------------------------------


def table(scenes: list[Scene], pictures: Path | None) -> dict[str, Any]:
    methods: dict[str, Method] = {"plain recipe": plain}
    if importlib.util.find_spec("open3d"):
        methods["Open3D's recipe"] = open3d
    methods["split_touching"] = touching
    result: dict[str, Any] = {}
    for method_name, method in methods.items():
        method(scenes[0][2])  # warm
        scores, seconds = {}, {}
        for name, _, cloud, truth in scenes:
            start = time.perf_counter(), time.process_time()
            labels = method(cloud)
            seconds[name] = time.perf_counter() - start[0], time.process_time() - start[1]
            scores[name] = score(cloud, labels, truth)
        result[method_name] = {
            "mean": mean_scores([*scores.values()]),
            "kinds": by_kind(scenes, scores),
            "milliseconds": {
                "wall": round(1000 * statistics.median(wall for wall, _ in seconds.values()), 1),
                "cpu": round(1000 * statistics.median(cpu for _, cpu in seconds.values()), 1),
            },
            "scenes": {name: [round(getattr(one, key), 4) for key in SHOWN] for name, one in scores.items()},
        }
        if pictures is not None and method is touching:
            draw(scenes, scores, method, pictures)
    each = [
        [name, *(f"{value:.3f}" for one in result.values() for value in one["scenes"][name][:3])] for name, *_ in scenes
    ]
    print(text_table(("scene", *(f"{method}: {key}" for method in result for key in SHOWN[:3])), each))
    rows = [
        [method, kind, *(f"{means[key]:.3f}" for key in SHOWN), one["milliseconds"]["cpu"] if kind == "all" else ""]
        for method, one in result.items()
        for kind, means in [*one["kinds"].items(), ("all", one["mean"])]
    ]
    print(text_table(("method", "scenes", *SHOWN, "CPU ms"), rows))
    return result


def by_kind(scenes: list[Any], scores: dict[str, SegmentationScores]) -> dict[str, dict[str, float | None]]:
    kinds = {kind: [name for name, its, *_ in scenes if its == kind] for kind in dict.fromkeys(s[1] for s in scenes)}
    return {kind: mean_scores([scores[name] for name in names]) for kind, names in kinds.items()}


def draw(scenes: list[Scene], scores: dict[str, SegmentationScores], method: Method, folder: Path) -> None:
    """Draw the truth beside what was found for the six scenes with the lowest overlap F."""
    folder.mkdir(parents=True, exist_ok=True)
    palette = np.random.default_rng(3).integers(60, 255, (256, 3), dtype=np.uint8)
    palette[0] = 0
    for name, _, cloud, truth in sorted(scenes, key=lambda scene: scores[scene[0]].overlap_f)[:6]:
        height, width = cloud.meta[0]["organized_size"]
        image = np.zeros((2, height * width), dtype=np.int64)
        image[:, cloud.source_index] = torch.stack([truth, method(cloud)]).clamp(min=-1).numpy() + 1
        picture = palette[image.reshape(2, height, width) % 256]
        Image.fromarray(np.concatenate([*picture], axis=1)).save(folder / f"{name}_{scores[name].overlap_f:.3f}.png")


# -- time -------------------------------------------------------------------------------------------------------------

HAND = ParallelJaw(
    opening=0.08,
    finger_length=0.045,
    finger_thickness=0.01,
    finger_width=0.02,
    palm_length=0.06,
    palm_span=0.2,
    tip=0.1,
)


def timing(scenes: list[Scene]) -> dict[str, Any]:
    """Time the steps of the method with two threads: the least of three runs, then the median over the scenes."""
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        seconds: dict[str, list[tuple[float, float]]] = {}
        part = ClusterObjects(split_touching=True)
        warm = part(TABLE(scenes[0][2]))
        for _, _, cloud, _ in scenes:
            rest, table_took = least_time(lambda cloud=cloud: TABLE(cloud))
            _, part_took = least_time(lambda rest=rest: part(rest))
            seconds.setdefault("RemovePlane", []).append(table_took)
            seconds.setdefault("ClusterObjects", []).append(part_took)
            both = table_took[0] + part_took[0], table_took[1] + part_took[1]
            seconds.setdefault("a frame", []).append(both)
        points, given = grasps_at(warm)
        _, took = least_time(lambda: check_grasps(points, **given))
        seconds["10,000 grasps, 20,000 points"] = [took]
    finally:
        torch.set_num_threads(threads)
    result = {
        step: {
            "wall": round(1000 * statistics.median(wall for wall, _ in took), 1),
            "cpu": round(1000 * statistics.median(cpu for _, cpu in took), 1),
        }
        for step, took in seconds.items()
    }
    rows = [[step, *(f"{one[key]:.1f}" for key in ("wall", "cpu"))] for step, one in result.items()]
    print(text_table(("with 2 threads", "ms", "CPU ms"), rows))
    return result


def least_time(call: Callable[[], Any], runs: int = 3) -> tuple[Any, tuple[float, float]]:
    """Return a result, and the least wall and CPU seconds of a few runs."""
    found, taken = None, []
    for _ in range(runs):
        start = time.perf_counter(), time.process_time()
        found = call()
        taken.append((time.perf_counter() - start[0], time.process_time() - start[1]))
    return found, (min(wall for wall, _ in taken), min(cpu for _, cpu in taken))


def grasps_at(objects: PointCloud) -> tuple[Tensor, dict[str, Any]]:
    """Return 20,000 points of objects, and 10,000 grasps at them from all sides."""
    generator = torch.Generator().manual_seed(0)
    points = objects.points[torch.randint(objects.num_points, (20_000,), generator=generator)]
    grasps = torch.eye(4, dtype=torch.float64).repeat(10_000, 1, 1)
    turn = torch.linalg.qr(torch.randn(10_000, 3, 3, generator=generator, dtype=torch.float64))[0]
    grasps[:, :3, :3] = turn * torch.linalg.det(turn)[:, None, None]
    grasps[:, :3, 3] = points[:10_000].double() - 0.1 * grasps[:, :3, 2]
    return points, {"grasps": grasps, "gripper": HAND}


# -- what each ingredient brings --------------------------------------------------------------------------------------

Prepared = tuple[str, str, PointCloud, Tensor, PointCloud]  # a scene, and its cloud without the table


def scored(scenes: list[Prepared], step: ClusterObjects) -> dict[str, SegmentationScores]:
    return {
        name: score(cloud, placed(cloud, step(rest)), truth) for name, _, cloud, truth, rest in scenes
    }  # fmt: skip


def placed(cloud: PointCloud, found: PointCloud) -> Tensor:
    assert cloud.source_index is not None
    assert found.source_index is not None
    assert found.labels is not None
    height, width = cloud.meta[0]["organized_size"]
    image = torch.full((height * width,), -1)
    image[found.source_index] = found.labels
    return image[cloud.source_index]


@contextmanager
def changed(**values: Any) -> Iterator[None]:
    """Change numbers or steps of the method for a while."""
    with ExitStack() as stack:
        limits = {name: value for name, value in values.items() if name in Limits._fields}
        if limits:
            stack.enter_context(mock.patch.object(separation, "Limits", return_value=Limits(**limits)))
        for name, value in values.items():
            if name not in limits:
                stack.enter_context(mock.patch.object(separation if callable(value) else joining, name, value))
        yield


def nothing(objects: Any) -> None:
    """Stand in for a step that is left out."""


def uncut(*arguments: Any, backend: str) -> regions.Regions:
    """Find regions that reach over jumps, and over lines which are too steep."""
    with mock.patch.object(regions, "cut_regions", lambda inverse, label, *_: label):
        return regions.smooth_regions(*arguments, backend="torch")


NEVER = {"gap_from": 1e6, "gap_full": 2e6}
ABLATIONS: dict[str, dict[str, Any]] = {
    "full": {},
    "no hollows": {"join_hollows": nothing},
    "no occlusion joining": {"join_occluded": nothing},
    "regions and contacts alone": {"join_hollows": nothing, "join_occluded": nothing},
    "steps alone, no creases": {"angle_from": 3.0, "angle_full": 4.0},
    "creases alone, no steps": NEVER,
    "convex creases do not bound regions": {"convex_part": 0.0},
    "no cuts at jumps and steep lines": {"smooth_regions": uncut},
    "no rough seeds": {"roughest": 1.0},
    "limit 0.2": {"PARTS_FROM": 0.2},
    "limit 0.5": {"PARTS_FROM": 0.5},
}


def ablation(scenes: list[Prepared]) -> dict[str, Any]:
    result = {}
    for name, values in ABLATIONS.items():
        with changed(**values):
            result[name] = mean_scores([*scored(scenes, ClusterObjects(split_touching=True)).values()])
    slab = [
        (name, kind, cloud, truth, RemovePlane(distance=0.01)(cloud)) for name, kind, cloud, truth, _ in scenes
    ]  # fmt: skip
    result["table cut as a slab of 1 cm"] = mean_scores([*scored(slab, ClusterObjects(split_touching=True)).values()])
    result["table measured, plain clusters"] = mean_scores([*scored(scenes, ClusterObjects()).values()])
    print(text_table(("left out", *SHOWN), [[name, *(f"{m[key]:.3f}" for key in SHOWN)] for name, m in result.items()]))
    return result


# -- does it hold on scenes that it was not fitted to -----------------------------------------------------------------

# Limit of a contact; factors of the angles and of the steps that count.
GRID = [(limit, *factors) for limit in (0.25, 0.35, 0.45) for factors in ((0.75, 1.33), (1.0, 1.0), (1.33, 0.75))]


def cross_validation(scenes: list[Prepared]) -> dict[str, Any]:
    kinds = list(dict.fromkeys(kind for _, kind, *_ in scenes))
    base = Limits()
    tried: dict[tuple[float, ...], dict[str, SegmentationScores]] = {}
    for limit, angle, step in GRID:
        values = {name: angle * getattr(base, name) for name in ("angle_from", "angle_full")}
        values |= {name: step * getattr(base, name) for name in NEVER}
        with changed(PARTS_FROM=limit, **values):
            tried[limit, angle, step] = scored(scenes, ClusterObjects(split_touching=True))
    result: dict[str, Any] = {}
    for kind in kinds:

        def merit(point: tuple[float, ...], kind: str = kind) -> float:
            seen = mean_scores([tried[point][name] for name, its, *_ in scenes if its != kind])
            return sum(seen[key] or 0.0 for key in SHOWN[:3])

        best = max(GRID, key=merit)
        own = [name for name, its, *_ in scenes if its == kind]
        result[kind] = {
            "chosen": best,
            "held out": mean_scores([tried[best][name] for name in own]),
            "as shipped": mean_scores([tried[0.35, 1.0, 1.0][name] for name in own]),
        }
    means = [mean_scores([*one.values()]) for one in tried.values()]
    spread = {key: [fold(one[key] or 0.0 for one in means) for fold in (min, max)] for key in SHOWN}
    result["spread over the grid"] = spread
    rows = []
    for kind in kinds:
        both = (result[kind][which][key] for which in ("held out", "as shipped") for key in SHOWN)
        rows.append([kind, str(result[kind]["chosen"]), *(f"{value:.3f}" for value in both)])
    print(text_table(("held out", "limit, angles, steps", *SHOWN, *(f"shipped {key}" for key in SHOWN)), rows))
    print("over the whole grid:", {key: [round(value, 3) for value in ends] for key, ends in spread.items()})
    return result


# -- other sensors, nothing changed -----------------------------------------------------------------------------------


def other_sensors(data: Path) -> dict[str, Any]:
    result = {}
    for name, frame, truth, ignore, before in (*m2t2(data), *apc(data)):
        steps = Compose([Deproject(), *before, ClusterObjects(split_touching=True, max_size=1_000_000)])
        found = steps(frame)
        guess = torch.full((truth.numel(),), -1)
        guess[found.source_index] = found.labels
        scores = score_segmentation(guess.reshape(truth.shape), truth, ignore=ignore)
        result[name] = {key: getattr(scores, key) for key in SHOWN} | {
            "objects": len(scores.objects),
            "predicted": scores.num_predicted,
        }
    rows = [
        [name, *(f"{one[key]:.3f}" for key in SHOWN), one["objects"], one["predicted"]] for name, one in result.items()
    ]
    print(text_table(("other sensors", *SHOWN, "objects", "predicted"), rows))
    return result


Other = tuple[str, DepthFrame, Tensor, Tensor, list[Any]]  # name, capture, truth, what is not judged, steps before


def m2t2(data: Path) -> Iterator[Other]:
    """Yield touching boxes on a table; the robot, and what has no label, are not judged."""
    folder = data / "m2t2_real_tabletop" / "03"
    if not folder.is_dir():
        return
    meta = json.loads((folder / "meta_data.json").read_text(encoding="utf-8"))
    labels = read_labels(folder / "seg.png")
    frame = DepthFrame.from_numpy(
        np.load(folder / "depth.npy", allow_pickle=False),
        np.asarray(meta["intrinsics"]),
        world_from_camera=np.asarray(meta["camera_pose"]),
        frame_id="base",
    )
    table_ = RemovePlane(
        which="supporting", cut="measured", probability=0.9999, keep="over", up=(0, 0, 1), frame="base"
    )
    before = [ToFrame(frame="base"), table_]
    down, right = shift_onto_rims(frame.depth[0].numpy(), labels.squeeze(0).numpy())
    moved = torch.roll(labels, (-down, -right), (-2, -1))  # what rolls in at the border lies on no object
    for name, own in (("m2t2 tabletop", labels), (f"m2t2 tabletop, masks moved {-right} {-down}", moved)):
        yield name, frame, torch.where(own > 100, own, -1), (own < 100) & (own != 2), before


def shift_onto_rims(depth: Any, labels: Any, most: int = 16) -> tuple[int, int]:
    """Return by how many pixels, down and right, the outlines of masks lie from the rims of depth near objects.

    The capture's color image, in which the masks were drawn, is not registered to its depth: rims of depth lie on
    edges of color (twice the gradient) when they are moved by about as much.
    """
    outline = np.zeros(labels.shape, dtype=bool)
    outline[:, 1:] |= labels[:, 1:] != labels[:, :-1]
    outline[1:] |= labels[1:] != labels[:-1]
    away = np.minimum(distance_transform_edt(~outline), most - 1)
    rim = np.argwhere(rims(depth) & binary_dilation(labels > 100, iterations=2 * most))
    height, width = labels.shape

    def apart(shift: tuple[int, int]) -> float:
        row, column = (rim + shift).T
        return float(away[row.clip(0, height - 1), column.clip(0, width - 1)].mean())

    shifts = [(down, right) for down in range(-most, most + 1) for right in range(-most, most + 1)]
    return min(shifts, key=apart)


def apc(data: Path) -> Iterator[Other]:
    """Yield objects in the bin of a shelf, depth registered to color; only what the truth holds is judged.

    The set has no ground truth: its masks are what a network was sure of, 0 to 65535, taken here as its authors do
    (more than three deviations over the mean of all views). Beside them stand outlines drawn by hand on the color
    images.
    """
    folder = data / "apc_multiview_shelf"
    if not folder.is_dir():
        return
    source = open_source(folder)
    outlines = json.loads(OUTLINES.read_text(encoding="utf-8"))
    names = sorted(next(iter(outlines.values())))
    sure = torch.stack(
        [
            torch.stack([read_labels(folder / "masks" / f"{sample}.{name}.mask.png").double() for name in names])
            for sample in outlines
        ]
    )  # (views, objects, H, W)
    least = sure.mean((0, 2, 3)) + 3 * sure.std((0, 2, 3))
    for sample, own in zip(outlines, sure):
        frame = source.load(sample)
        highest, number = own.max(0)
        masks = torch.where(highest > least[number], number, -1)
        drawn = Image.new("I", (masks.shape[1], masks.shape[0]), -1)
        for name, corners in outlines[sample].items():  # what is in front comes last
            ImageDraw.Draw(drawn).polygon([tuple(corner) for corner in corners], fill=names.index(name))
        outlined = torch.from_numpy(np.asarray(drawn).astype(np.int64))
        seen = frame.depth[0] > 0
        for what, truth in (("masks", masks), ("outlines", outlined)):
            yield f"apc {sample[-2:]} {what}", frame, truth, (truth < 0) | ~seen, [TABLE]


# -- the scenes as a stereo camera gives them, on the pixels of color --------------------------------------------------


def enlarged(scenes: list[Scene]) -> dict[str, Any]:
    """Score the scenes with 1/z averaged over windows, as stereo matching does, and every reading repeated."""
    steps = Compose([Deproject(), TABLE, ClusterObjects(split_touching=True, max_size=1_000_000)])
    result: dict[str, Any] = {}
    for name, (window, times) in ENLARGED.items():
        scores = {}
        for scene, _, cloud, truth in scenes:
            frame, labels = enlarged_frame(cloud, truth, window, times)
            found = steps(frame)
            guess = torch.full((labels.numel(),), -1)
            guess[found.source_index] = found.labels
            scores[scene] = score_segmentation(guess.reshape(labels.shape), labels, ignore=frame.depth[0] <= 0)
        each = {scene: round(one.overlap_f, 4) for scene, one in scores.items()}
        result[name] = {"mean": mean_scores([*scores.values()]), "overlap_f": each}
    rows = [[name, *(f"{one['mean'][key]:.3f}" for key in SHOWN)] for name, one in result.items()]
    print(text_table(("the same scenes", *SHOWN), rows))
    return result


def enlarged_frame(cloud: PointCloud, truth: Tensor, window: int, times: float) -> tuple[DepthFrame, Tensor]:
    """Return a scene's depth, smoothed and with neighbors repeated, and its truth on those pixels."""
    assert cloud.source_index is not None
    height, width = cloud.meta[0]["organized_size"]
    pixel, points = cloud.source_index.numpy(), cloud.points.double().numpy()
    seen = np.isfinite(points[:, 2]) & (points[:, 2] > 0)
    inverse, labels = np.zeros(height * width), np.full(height * width, -1)
    inverse[pixel[seen]], labels[pixel] = 1 / points[seen, 2], truth.numpy()
    k = np.eye(3)
    for axis, place in enumerate((pixel % width, pixel // width)):  # pixels are linear in x/z and y/z
        along = points[seen, axis] / points[seen, 2]
        focal, middle = np.polyfit(along, place[seen], 1)
        k[axis, axis], k[axis, 2] = focal * times, (middle + 0.5) * times - 0.5
    inverse = inverse.reshape(height, width)
    there = inverse > 0
    share = uniform_filter(there.astype(float), window)
    inverse = np.where(there, uniform_filter(inverse, window) / np.maximum(share, 1e-9), 0)
    rows, columns = ((np.arange(int(size * times)) / times).astype(int) for size in (height, width))
    depth = np.where(there, 1 / np.where(there, inverse, 1), 0).astype(np.float32)[np.ix_(rows, columns)]
    labels = labels.reshape(height, width)[np.ix_(rows, columns)]
    return DepthFrame.from_numpy(np.ascontiguousarray(depth), k), torch.from_numpy(labels.copy())


# -- heaps that several cameras saw -----------------------------------------------------------------------------------


def heaps(every: int) -> dict[str, Any]:
    """Score 20 touching objects in 4 merged views: all points of objects that are left, row by row."""
    step = ClusterObjects(split_touching=True, max_size=1_000_000, keep="all")
    table_ = RemovePlane(cut="measured", keep="over", probability=0.9999, max_tilt=0.2, up=(0, 0, 1), frame="base")
    result: dict[str, Any] = {}
    rows = []
    for sensor in HEAP_SENSORS:
        steps = Compose([RandomSensorNoise(sensor=sensor), Deproject(), ToFrame(frame="base"), MergeViews(), table_])
        for kind, seeds in HEAPS.items():
            scores, seconds = {}, []
            for seed in seeds[::every]:
                frame = tabletop(seed, 20, 4, touching=True, floor=False).frame
                cloud = steps(frame, generator=torch.Generator().manual_seed(seed))
                start = time.process_time()
                labels = step(cloud).labels
                seconds.append(time.process_time() - start)
                scores[seed] = score_segmentation(labels, torch.where(cloud.labels > 0, cloud.labels, -1))
            shown = {key: statistics.fmean(getattr(one, key) for one in scores.values()) for key in HEAP_SHOWN}
            milliseconds = round(1000 * statistics.median(seconds), 1)
            each = {str(seed): round(one.mean_iou, 4) for seed, one in scores.items()}
            result[f"{sensor}, {kind}"] = {"mean": shown, "cpu_milliseconds": milliseconds, "mean_iou": each}
            rows.append([sensor, kind, *(f"{value:.3f}" for value in shown.values()), milliseconds])
    print(text_table(("heaps of 20, 4 views", "seeds", *HEAP_SHOWN, "CPU ms"), rows))
    return result


def one_view(every: int) -> dict[str, Any]:
    """Score heaps that one camera saw, and count those whose table was found."""
    step = ClusterObjects(split_touching=True, max_size=1_000_000, keep="all")
    table_ = RemovePlane(which="supporting", cut="measured", probability=0.9999, up=(0, 0, 1), frame="base")
    result: dict[str, Any] = {}
    rows = []
    for sensor in HEAP_SENSORS:
        seen = Compose([RandomSensorNoise(sensor=sensor), Deproject(), ToFrame(frame="base")])
        for number in ONE_VIEW_OBJECTS:
            for kind, seeds in ONE_VIEW.items():
                scores, tables = {}, 0
                for seed in seeds[::every]:
                    frame = tabletop(seed, number, 1, touching=True, floor=False).frame
                    cloud = seen(frame, generator=torch.Generator().manual_seed(seed))
                    truth = torch.where(cloud.labels > 0, cloud.labels, -1)
                    labels = torch.full_like(truth, -1)
                    try:
                        rest = table_(cloud)
                    except TooFewPointsError:  # all of it was taken for the table
                        rest = None
                    if rest is not None:
                        place = torch.full((int(cloud.source_index.max()) + 1,), -1)
                        place[cloud.source_index] = torch.arange(len(truth))
                        found = step(rest)
                        labels[place[found.source_index]] = found.labels
                        is_left = torch.zeros(len(truth), dtype=torch.bool)
                        is_left[place[rest.source_index]] = True
                        tables += int(float((~is_left)[truth < 0].float().mean()) > 0.9)
                    scores[seed] = score_segmentation(labels, truth)
                shown = {key: statistics.fmean(getattr(one, key) for one in scores.values()) for key in HEAP_SHOWN}
                each = {str(seed): round(one.overlap_f, 4) for seed, one in scores.items()}
                told = f"{tables} of {len(scores)}"
                result[f"{sensor}, {number} objects, {kind}"] = {"mean": shown, "tables": told, "overlap_f": each}
                rows.append([sensor, number, kind, *(f"{value:.3f}" for value in shown.values()), told])
    print(text_table(("heaps in one view", "objects", "seeds", *HEAP_SHOWN, "tables found"), rows))
    return result


if __name__ == "__main__":
    main()
