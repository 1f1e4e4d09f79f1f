"""How builds scale with workers, and the memory of a worker over many captures.

    python benchmarks/build_scaling.py [--captures 400] [--many 10000]    # results/build_scaling.json

Needs a machine with nothing else to do. The source renders synthetic captures, so nothing is read from a disk; where
memory is watched, twenty of them come again and again. Workers are spawned, as builds do; the seconds that they take to
start are measured by a build of one capture each, and told.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import torch

from pcdata.build import build_dataset, config_from_yaml
from pcdata.structures import DepthFrame
from pcdata.synthetic import SyntheticSource

SMALL = (24, 32)
RESULTS = Path(__file__).parent / "results"
CONFIG = """
depth: [MaskDepth: {near: 0.1, far: 3.0}, Deproject]
cloud:
  - ToFrame: {frame: base}
  - RemoveRadiusOutliers: {radius: RADIUS}
  - FarthestPointSample: {num_points: 1024, if_short: repeat}
output: {format: packed, shard_size: SHARD}
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--captures", type=int, default=400)
    parser.add_argument("--many", type=int, default=10_000, help="captures over which memory is watched")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    result: dict[str, Any] = {"captures": arguments.captures, "cores": os.cpu_count(), "seconds": {}, "start": {}}
    for workers in (1, 2):
        result["start"][workers] = timed(workers, workers, SMALL, 1)[0]
        result["seconds"][workers] = timed(arguments.captures, workers, (240, 320), 10)[0]
    work = {workers: result["seconds"][workers] - result["start"][workers] for workers in (1, 2)}
    result["speedup"] = round(result["seconds"][1] / result["seconds"][2], 3)
    result["speedup_without_start"] = round(work[1] / work[2], 3)
    seconds, memory = timed(arguments.many, 1, SMALL, 100)
    result["memory"] = {"captures": arguments.many, "seconds": seconds, "megabytes": memory}
    tenth = max(1, len(memory) // 10)
    result["memory"]["growth"] = round(max(memory[-tenth:]) - max(memory[tenth : 2 * tenth] or memory), 1)
    (RESULTS / "build_scaling.json").write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result, indent=1))


def timed(captures: int, workers: int, size: tuple[int, int], shard_size: int) -> tuple[float, list[float]]:
    """Build; return the seconds, and the megabytes of a worker at every hundredth of the way."""
    source = Again(captures, size) if size == SMALL else SyntheticSource(num_scenes=captures, num_objects=2, size=size)
    memory: list[float] = []
    every = max(1, captures // 100)

    def progress(done: int, total: int, sample_id: str) -> None:
        if done % every == 0 and (child := next(iter(children()), None)) is not None:
            memory.append(round(resident(child), 1))

    with tempfile.TemporaryDirectory() as folder:
        begun = time.perf_counter()
        config = config_from_yaml(CONFIG.replace("SHARD", str(shard_size)).replace("RADIUS", str(4.0 / size[1])))
        build_dataset(config, source, Path(folder) / "out", workers=workers, progress=progress)
        return round(time.perf_counter() - begun, 2), memory


class Again:
    """So many captures, of which only twenty are rendered."""

    def __init__(self, captures: int, size: tuple[int, int]) -> None:
        self.scenes = SyntheticSource(num_scenes=min(20, captures), num_objects=2, size=size)
        self.ids = [f"{number:06d}" for number in range(captures)]
        self._rendered: dict[int, DepthFrame] = {}

    def __len__(self) -> int:
        return len(self.ids)

    def load(self, sample_id: str) -> DepthFrame:
        """Return one capture."""
        number = int(sample_id) % len(self.scenes)
        if number not in self._rendered:
            self._rendered[number] = self.scenes.load(self.scenes.ids[number])
        return self._rendered[number]


def children() -> list[int]:
    """Return the worker processes; the tracker of resources that spawning starts is none."""
    listed = Path(f"/proc/{os.getpid()}/task/{threading.get_native_id()}/children").read_text().split()
    return [int(pid) for pid in listed if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]


def resident(pid: int) -> float:
    """Return the megabytes of memory that a process occupies."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


if __name__ == "__main__":
    main()
