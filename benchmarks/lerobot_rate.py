"""The rate and the memory of reading a LeRobot dataset step after step, beside PyAV and pyarrow alone.

    python benchmarks/lerobot_rate.py [--folder DIR]     # writes results/lerobot_rate.json

Depth of 640x480 is read as pcdata writes it (FFV1), and as PNG in one row group, as others write it. Blocks of steps
are read in turn, by pcdata and by the libraries alone, which check nothing and make no frame; frames a second are of
the processor's time, on one core, the best block of each. Memory is that of a process of its own, once for 200 steps of
320x240 and once for 5,000.
"""

from __future__ import annotations

import argparse
import io
import itertools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow.parquet as parquet
import torch
from PIL import Image

from benchmarks.fusion_memory import Growth
from pcdata import open_source
from pcdata.io import convert
from pcdata.structures import Camera, DepthFrame, Episode, Signal

RESULTS = Path(__file__).parent / "results"
BLOCK, BLOCKS = 25, 6
LIMIT_RATIO = 0.8  # of the rate of PyAV alone
LIMIT_GROWTH_MB = 20.0  # from 200 steps to 5,000


@dataclass
class Made:
    """Captures made as they are asked for: a slope with noise and holes, joints."""

    count: int
    size: tuple[int, int]
    name: str = "made"
    episodes: list[Episode] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.ids = [f"{number:05d}" for number in range(self.count)]
        self.episodes = [Episode("all", 0, self.count)]
        self._camera = Camera.pinhole(fx=300, fy=300, cx=self.size[1] / 2, cy=self.size[0] / 2, size=self.size)

    def __len__(self) -> int:
        return self.count

    def load(self, sample_id: str) -> DepthFrame:
        draw = np.random.default_rng(int(sample_id) % 50)
        millimetres = np.linspace(500, 1500, self.size[1])[None] + draw.normal(0, 2, self.size)
        millimetres[draw.random(self.size) < 0.05] = 0
        return DepthFrame(
            depth=torch.from_numpy((millimetres.astype(np.uint16) * 0.001).astype(np.float32))[None],
            camera=self._camera,
            sample_id=sample_id,
            provenance={"metres_per_unit": 0.001},
            recorded_signals={"joints": Signal(torch.full((1, 7), float(sample_id)), "invariant")},
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", help="where the datasets are written (default: a new one)")
    parser.add_argument("--read", help=argparse.SUPPRESS)  # what a process of its own reads
    arguments = parser.parse_args()
    if arguments.read:
        print(json.dumps(memory(Path(arguments.read))))
        return
    torch.set_num_threads(1)
    result: dict[str, Any] = {"cpus": os.cpu_count(), "rate": {}, "memory": {}}
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        for name, options, alone in (("ffv1", {}, by_av), ("png in one row group", {"depth": "image"}, by_arrow)):
            path = Path(folder) / name
            convert(Made(BLOCK * BLOCKS + 1, (480, 640)), "lerobot", path, **options)
            if options:
                one_row_group(path)
            result["rate"][name] = found = rates(path, alone)
            print(f"{name}: {found['pcdata']} frames a second and core, {found['alone']} alone: {found['ratio']:.2f}")
        for count in (200, 5000):
            path = Path(folder) / str(count)
            convert(Made(count, (240, 320)), "lerobot", path)
            call = [sys.executable, "-m", "benchmarks.lerobot_rate", "--read", str(path)]
            told = json.loads(subprocess.run(call, check=True, stdout=subprocess.PIPE, text=True).stdout)
            result["memory"][f"{count} steps"] = told
            print(f"{count} steps: memory grows by {told['growth_mb']} MB")
    (RESULTS / "lerobot_rate.json").write_text(json.dumps(result, indent=1) + "\n")
    growths = [told["growth_mb"] for told in result["memory"].values()]
    is_slow = result["rate"]["ffv1"]["ratio"] < LIMIT_RATIO
    sys.exit(is_slow or growths[1] - growths[0] > LIMIT_GROWTH_MB)


def rates(path: Path, alone: Callable[[Path], Iterator[Any]]) -> dict[str, float]:
    """Return frames a second of the processor, of the best block of each."""
    source = open_source(path)
    ours, theirs = map(source.load, source.ids), alone(path)
    best = {"pcdata": 0.0, "alone": 0.0}
    next(ours), next(theirs)  # what opens files
    for _ in range(BLOCKS):
        for name, frames in (("pcdata", ours), ("alone", theirs)):
            start = time.process_time()
            for _ in itertools.islice(frames, BLOCK):
                pass
            best[name] = max(best[name], BLOCK / (time.process_time() - start))
    return {name: round(rate, 1) for name, rate in best.items()} | {"ratio": best["pcdata"] / best["alone"]}


def by_av(path: Path) -> Iterator[Any]:
    """Decode the depth, and nothing else."""
    with av.open(str(next(path.rglob("videos/depth*/**/*.mkv")))) as container:
        container.streams.video[0].codec_context.thread_count = 1
        for frame in container.decode(video=0):
            yield frame.to_ndarray()


def by_arrow(path: Path) -> Iterator[Any]:
    """Decode the depth images of the rows, and nothing else."""
    key = "observation.images.view0_depth"
    for batch in parquet.ParquetFile(next(path.rglob("data/**/*.parquet"))).iter_batches(16, columns=[key]):
        for image in batch.column(key).to_pylist():
            yield np.asarray(Image.open(io.BytesIO(image["bytes"])))


def one_row_group(path: Path) -> None:
    """Write the rows anew as others do: all of a file in one row group."""
    file = next(path.rglob("data/**/*.parquet"))
    parquet.write_table(parquet.read_table(file), file, row_group_size=1 << 20)


def memory(path: Path) -> dict[str, float]:
    """Read every step; return by how much memory grows after the first."""
    source = open_source(path)
    source.load(source.ids[0])
    growth = Growth()
    for name in source.ids[1:]:
        source.load(name)
    return {"steps": len(source), "growth_mb": round(growth.peak() / 2**20, 1)}


if __name__ == "__main__":
    main()
