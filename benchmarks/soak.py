"""Run the usual chain on 10,000 small frames and show that memory does not grow.

    python benchmarks/soak.py                # also 1000 batches per way to start workers; writes results/soak.json

Resident memory is read after the first hundred frames and then every hundred; it must not grow by 2 MB. Afterwards two
DataLoader workers make 1000 batches under fork, forkserver and spawn, all started after the kernels ran in the parent,
and every batch must equal what the parent makes.
"""

from __future__ import annotations

import argparse
import dataclasses
import gc
import json
import time
from pathlib import Path
from typing import Any

import torch
from torch.utils.data import DataLoader

import pcdata
from pcdata.synthetic import tabletop

RESULTS = Path(__file__).parent / "results"
WARM_UP = 100  # frames in which allocators find their size
LIMIT = 2 << 20  # bytes
SIZE = (120, 160)
METHODS = ("fork", "forkserver", "spawn")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=10_000)
    parser.add_argument("--batches", type=int, default=1_000)
    arguments = parser.parse_args()
    torch.set_num_threads(2)
    result: dict[str, Any] = {"threads": torch.get_num_threads(), "chain": soak(arguments.frames)}
    print(result["chain"], flush=True)
    result["workers"] = {}
    for method in METHODS:
        result["workers"][method] = run_workers(method, arguments.batches)
        print(method, result["workers"][method], flush=True)
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "soak.json").write_text(json.dumps(result, indent=1) + "\n")
    assert result["chain"]["growth_bytes"] < LIMIT, f"memory grew by {result['chain']['growth_bytes'] / 2**20:.1f} MB"


# -- a long loop -------------------------------------------------------------------------------------------------------


def usual_chain() -> pcdata.Compose:
    """From a capture to an augmented sample, with every kind of step."""
    return pcdata.Compose(
        [
            pcdata.MaskDepth(near=0.2, far=3.0),
            pcdata.Deproject(),
            pcdata.ToFrame(frame="base"),
            pcdata.CropWorkspace(frame="base", lower=(-0.5, -0.5, -0.02), upper=(0.5, 0.5, 0.5)),
            pcdata.RemoveStatisticalOutliers(num_neighbors=20, std_ratio=2.0),
            pcdata.RemoveRadiusOutliers(min_neighbors=3, radius=0.03),
            pcdata.RemovePlane(distance=0.005, num_hypotheses=100),
            pcdata.ClusterObjects(eps=0.02, min_points=5, min_size=20),
            pcdata.FarthestPointSample(num_points=256, if_short="repeat"),
            pcdata.EstimateNormals(radius=0.03, max_neighbors=20),
            pcdata.RandomRotation(degrees=15),
            pcdata.RandomScale(),
            pcdata.RandomJitter(),
            pcdata.RandomPointDropout(),
        ]
    )


def frames() -> list[pcdata.DepthFrame]:
    """A few scenes; the loop takes them in turn."""
    return [tabletop(seed, num_objects=4, noise="stereo", size=SIZE).frame for seed in range(8)]


def soak(count: int) -> dict[str, Any]:
    """Run the chain on ``count`` frames and report how resident memory went."""
    chain, captures = usual_chain(), frames()
    memory = []
    started = time.perf_counter()
    for number in range(count):
        # Another depth for every frame, so that counts and sizes vary as they do between captures.
        capture = captures[number % len(captures)]
        nearer = dataclasses.replace(capture, depth=capture.depth * (1 - 0.0002 * (number % 97)))
        cloud = chain(nearer, generator=torch.Generator().manual_seed(number))
        assert cloud.num_points > 0
        if (number + 1) % WARM_UP == 0:
            del cloud
            gc.collect()
            memory.append(resident())
    seconds = time.perf_counter() - started
    return {
        "frames": count,
        "size": SIZE,
        "seconds": seconds,
        "frames_per_second": count / seconds,
        "resident_bytes_after_100": memory[0],
        "resident_bytes_at_end": memory[-1],
        "resident_bytes_at_most": max(memory),
        "growth_bytes": max(memory) - memory[0],
    }


def resident() -> int:
    """Bytes of this process that lie in memory."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096


# -- workers -----------------------------------------------------------------------------------------------------------


class Captures:
    """A few captures under many ids, made where they are asked for."""

    def __init__(self, count: int) -> None:
        self.ids = [f"capture-{number}" for number in range(count)]
        self._scenes = [tabletop(seed, num_objects=4, size=(60, 80)).frame for seed in range(4)]

    def load(self, sample_id: str) -> pcdata.DepthFrame:
        scene = self._scenes[int(sample_id.split("-")[1]) % len(self._scenes)]
        return dataclasses.replace(scene, sample_id=sample_id)


def run_workers(method: str, batches: int) -> dict[str, Any]:
    """Let two workers make batches, after the kernels ran here, and compare every one."""
    dataset = pcdata.CloudDataset(Captures(2 * batches), usual_chain(), seed=3)
    _ = dataset[0]  # kernels and their threads
    loader = DataLoader(
        dataset,
        batch_size=2,
        num_workers=2,
        collate_fn=pcdata.collate_packed,
        multiprocessing_context=method,
        timeout=120,
    )
    started = time.perf_counter()
    made = 0
    for number, batch in enumerate(loader):
        if number % 50 == 0:  # the parent makes some again: it must get the same, and its kernels must still run
            expected = pcdata.collate_packed([dataset[2 * number], dataset[2 * number + 1]])
            assert torch.equal(batch.points, expected.points), f"{method}: batch {number} differs"
            assert torch.equal(batch.labels, expected.labels), f"{method}: batch {number} differs"
        made += 1
    assert made == batches
    return {"batches": made, "batches_per_second": made / (time.perf_counter() - started)}


if __name__ == "__main__":
    main()
