"""Memory and random access of large recordings: opened, and images of it loaded in any order, in every container.

    python benchmarks/bag_memory.py [--gigabytes 0.5 5] [--folder DIR]     # writes results/bag_memory.json

The recording is written on the fly: depth and color of 640x480, joints and a moving camera in tf at 100 Hz. Each
container is read in a process of its own; results of other sizes stay as they are. What a source keeps of a message
that it reads is its time and its place. Milliseconds are given by the clock and of the processor: on a busy machine the
second tell what an image takes.
"""

from __future__ import annotations

import argparse
import itertools
import json
import pickle
import random
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.fusion_memory import Growth
from pcdata import open_source
from tests.ros_recordings import EPOCH, STEP, Types

RESULTS = Path(__file__).parent / "results"
CONTAINERS = {"mcap": ("mcap", False), "mcap, zstd": ("mcap", True), "db3": ("db3", False), "bag": ("bag", False)}
SIZE = (480, 640)
LOADED = 200  # images, in an order that has nothing to do with that of the file
LIMIT_MS = 50.0  # of the processor, of the median image
LIMIT_GROWTH = 100 << 20  # bytes at the highest point, whatever the size of the recording


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gigabytes", type=float, nargs="+", default=[1.0])
    parser.add_argument("--containers", nargs="+", choices=CONTAINERS, default=list(CONTAINERS))
    parser.add_argument("--folder", help="where the recordings are written, one after another (default: a new one)")
    parser.add_argument("--read", help=argparse.SUPPRESS)  # what a process of its own reads
    arguments = parser.parse_args()
    if arguments.read:
        print(json.dumps(measured(Path(arguments.read))))
        return
    kept = RESULTS / "bag_memory.json"
    result: dict[str, Any] = json.loads(kept.read_text()) if kept.exists() else {"size": SIZE, "containers": {}}
    slow, grown = [], []
    for name, gigabytes in itertools.product(arguments.containers, arguments.gigabytes):
        form, packed = CONTAINERS[name]
        with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
            path = written(Path(folder), form, packed, int(gigabytes * 1e9))
            call = [sys.executable, "-m", "benchmarks.bag_memory", "--read", str(path)]
            told = json.loads(subprocess.run(call, check=True, stdout=subprocess.PIPE, text=True).stdout)
        result["containers"].setdefault(name, {})[f"{gigabytes:g} GB"] = told
        print(
            f"{name:11} {told['images']} images, {told['file_mb']:.0f} MB: opened in {told['open_s']:.2f} s (processor "
            f"{told['open_cpu_s']:.2f}), {told['median_ms']:.1f} ms an image (processor {told['median_cpu_ms']:.1f}), "
            f"memory grows by {told['growth_mb']:.0f} MB to {told['peak_mb']:.0f}, {told['pickle_kb']:.0f} kB to a "
            "worker",
            flush=True,
        )
        kept.write_text(json.dumps(result, indent=1) + "\n")
        slow += [f"{name}, {gigabytes:g} GB"] * (told["median_cpu_ms"] > LIMIT_MS)
        grown += [f"{name}, {gigabytes:g} GB"] * (told["growth_mb"] > LIMIT_GROWTH / 2**20)
    sys.exit(f"slow: {slow}; grown: {grown}" if slow or grown else 0)


def messages(make: Types, num_bytes: int) -> Iterator[tuple[str, int, Any]]:
    """Yield as many messages as take so many bytes, in the order of time."""
    draw = np.random.default_rng(0)
    slope = np.linspace(500, 1500, SIZE[1], dtype=np.float32)[None]
    k = [600.0, 0, 320, 0, 600, 240, 0, 0, 1]
    yield "/tf_static", EPOCH - 1, make.transform(0, "hand", "camera_optical", (0, 0, 0.1))
    joints = 0
    for number in range(num_bytes // (5 * SIZE[0] * SIZE[1])):
        stamp = EPOCH + number * STEP
        while (at := EPOCH + joints * 10_000_000) <= stamp + STEP:
            yield "/joint_states", at, make.joints(at, a=0.1 * joints, b=1.0)
            yield "/tf", at, make.transform(at, "base", "hand", (0.001 * joints, 0, 0))
            joints += 1
        units = (slope + draw.integers(0, 8, SIZE)).astype(np.uint16)
        pixels = draw.integers(0, 256, (*SIZE, 3), dtype=np.uint8)
        yield "/cam/depth/image_raw", stamp, make.image(stamp, units, "16UC1")
        yield "/cam/depth/camera_info", stamp, make.camera_info(stamp, size=SIZE, k=k)
        yield "/cam/color/image_raw", stamp, make.image(stamp, pixels, "rgb8")


def written(folder: Path, form: str, packed: bool, num_bytes: int) -> Path:
    """Write a recording, message by message."""
    from rosbags import rosbag1, rosbag2

    make = Types(1 if form == "bag" else 2)
    serialize = make.store.serialize_ros1 if form == "bag" else make.store.serialize_cdr
    if form == "bag":
        writer: Any = rosbag1.Writer(folder / "take.bag")
    else:
        plugin = rosbag2.StoragePlugin.MCAP if form == "mcap" else rosbag2.StoragePlugin.SQLITE3
        writer = rosbag2.Writer(folder / "take", version=9, storage_plugin=plugin)
        if packed:
            writer.set_compression(rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD)
    known: dict[str, Any] = {}
    with writer:
        for topic, stamp, message in messages(make, num_bytes):
            kind = message.__msgtype__
            if topic not in known:
                known[topic] = writer.add_connection(topic, kind, typestore=make.store)
            writer.write(known[topic], stamp, serialize(message, kind))
    return folder / ("take.bag" if form == "bag" else "take")


def measured(path: Path) -> dict[str, float]:
    """Open a recording and load images of it, and tell what that took."""
    files = [path] if path.is_file() else [one for one in path.iterdir() if one.suffix != ".yaml"]
    size = sum(file.stat().st_size for file in files)
    growth = Growth()
    start, begun = time.perf_counter(), time.process_time()
    source = open_source(path, frame_id="base")
    opened, work = time.perf_counter() - start, time.process_time() - begun
    ids = random.Random(0).choices(source.ids, k=LOADED)
    taken, worked = [], []
    for sample_id in ids:
        start, begun = time.perf_counter(), time.process_time()
        source.load(sample_id)
        taken.append(1000 * (time.perf_counter() - start))
        worked.append(1000 * (time.process_time() - begun))
    return {
        "images": len(source),
        "file_mb": size / 1e6,
        "open_s": opened,
        "open_cpu_s": work,
        "median_ms": statistics.median(taken),
        "median_cpu_ms": statistics.median(worked),
        "p95_ms": sorted(taken)[int(0.95 * len(taken))],
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "growth_mb": growth.peak() / 2**20,
        "pickle_kb": len(pickle.dumps(source)) / 1024,
    }


if __name__ == "__main__":
    main()
