"""Count the Python calls of pcdata on its four paths, and the source files that they lie in.

    python benchmarks/calls.py            # prints a table; --where also tells which functions are called most
    python benchmarks/calls.py --out benchmarks/results/calls.json

Time differs between machines; what a reader must step through does not. A call is an entry of a function, method or
generator whose source lies in pcdata, as ``sys.setprofile`` reports it; Python before 3.12 counts a list comprehension
as one. Every path runs once before it is counted, so imports and caches do not count.

* ``points``: a depth image, color and a pose in NumPy become 1,024 points in the robot's frame (five steps).
* ``build``: one capture of a folder becomes a dataset, by ``configs/tabletop_policy.yaml``.
* ``open``: that dataset is opened.
* ``live``: a frame of a stream goes through mask, flying pixels, crop, both outlier filters, farthest points, normals.
"""

from __future__ import annotations

import argparse
import itertools
import json
import platform
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import pcdata
from pcdata.live import LivePipeline
from pcdata.synthetic import tabletop

ROOT = Path(__file__).resolve().parents[1]
_OWN = str(Path(pcdata.__file__).parent)
SIZE = (120, 160)
LIVE_SIZE = (240, 320)  # so many pixels that selections are run together

_BY_TIME = ("_polls",)  # the core asks for Ctrl-C every 20 ms: how often, the load of the machine tells

Calls = Counter[tuple[str, str]]  # (file, function) -> entries


def counted(path: Callable[[], Any]) -> Calls:
    """Run a path and return the entries of pcdata's own functions."""
    calls: Calls = Counter()

    def note(frame: Any, event: str, _: Any) -> None:
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(_OWN) and code.co_name not in _BY_TIME:
            calls[code.co_filename[len(_OWN) + 1 :], code.co_name] += 1

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        path()
    finally:
        sys.setprofile(before)
    return calls


def points_path() -> Callable[[], Any]:
    """Return the way from arrays to 1,024 points."""
    scene = tabletop(1, num_views=1, size=SIZE).frame
    depth = np.rint(scene.depth[0].numpy() * 1000).astype(np.uint16)
    color, pose = scene.colors[0].numpy(), scene.world_from_camera[0].numpy()
    intrinsics, frame = scene.camera.intrinsics[0].numpy(), scene.frame_id
    chain = pcdata.Compose(
        [
            pcdata.MaskDepth(near=0.2, far=2.0),
            pcdata.Deproject(),
            pcdata.ToFrame(frame=frame),
            pcdata.CropWorkspace(frame=frame, lower=(-0.4, -0.4, -0.02), upper=(0.4, 0.4, 0.5)),
            pcdata.FarthestPointSample(num_points=1024),
        ]
    )

    def run() -> None:
        capture = pcdata.DepthFrame.from_numpy(
            depth, intrinsics, metres_per_unit=0.001, colors=color, world_from_camera=pose, frame_id=frame
        )
        assert chain(capture).num_points == 1024

    return run


def live_path() -> Callable[[], Any]:
    """Return the answer to one frame, with stamps that rise."""
    scene = tabletop(1, num_views=1, size=LIVE_SIZE).frame
    chain = pcdata.Compose(
        [
            pcdata.MaskDepth(near=0.2, far=2.0),
            pcdata.RemoveFlyingPixels(),
            pcdata.Deproject(),
            pcdata.CropWorkspace(frame="camera", lower=(-0.5, -0.5, 0.2), upper=(0.5, 0.5, 1.5)),
            pcdata.RemoveStatisticalOutliers(),
            pcdata.RemoveRadiusOutliers(),
            pcdata.FarthestPointSample(num_points=1024),
            pcdata.EstimateNormals(),
        ]
    )
    live, stamps = LivePipeline(chain, like=scene, same_pixels=False), itertools.count()

    def run() -> None:
        cloud = live(scene, stamp=float(next(stamps))).cloud
        assert cloud is not None
        assert cloud.num_points == 1024

    return run


def dataset_paths(folder: Path) -> tuple[Callable[[], Any], Callable[[], Any]]:
    """Return the build of a dataset out of one capture, and its opening."""
    scene = tabletop(1, num_views=1, size=SIZE).frame
    pcdata.write_capture(scene, folder / "captures")
    config = pcdata.load_config(ROOT / "configs" / "tabletop_policy.yaml")
    source = pcdata.open_source(folder / "captures" / "view0")

    names = itertools.count()

    def build() -> None:
        pcdata.build_dataset(config, source, folder / f"dataset{next(names)}")

    return build, lambda: pcdata.CachedCloudDataset(folder / "dataset0")


def measure() -> dict[str, Calls]:
    """Return the calls of every path, once it has run: the fewest of three, as a clock sets some off now and then."""
    with tempfile.TemporaryDirectory() as folder:
        build, opening = dataset_paths(Path(folder))
        found, arrays = {}, {"points": points_path(), "live": live_path()}
        for name, path in {**arrays, "build": build, "open": opening}.items():
            path()
            found[name] = min((counted(path) for _ in range(3)), key=Calls.total)
        return found


def summary(found: dict[str, Calls]) -> dict[str, dict[str, int]]:
    """Return the number of calls and of files of every path."""
    return {name: {"calls": calls.total(), "files": len({file for file, _ in calls})} for name, calls in found.items()}


def main() -> None:
    """Print the figures, and keep them where that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="a JSON file for the figures")
    parser.add_argument("--where", type=int, metavar="N", default=0, help="also print the N functions called most")
    arguments = parser.parse_args()
    found = measure()
    for name, figures in summary(found).items():
        print(f"{name:8} {figures['calls']:6} calls in {figures['files']:3} files")
        for (file, function), count in found[name].most_common(arguments.where):
            print(f"    {count:5}  {file}: {function}")
    if arguments.out is not None:
        figures = {"python": platform.python_version(), "paths": summary(found)}
        arguments.out.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
