"""How fast batches come from a built dataset, beside a plain loop over files and beside copying the bytes.

    python benchmarks/loading.py     # a minute; writes results/loading.json

Clouds of 4096 points with colors, without signals, as they are stored and then turned, scaled and jittered; 64 a batch
by one process, shuffled, collated to (B, N, 3). Beside each store stand per-sample ``.npz`` files of the two arrays
alone, read by ``numpy.load`` and put together by torch's ``default_collate``, as most training code does, and a copy of
the same bytes out of one array in memory. In turns, the medians of CPU time kept. "First" is the pass that compares
every record of a packed store with its digest; the other stores do so in every pass.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset, default_collate

from pcdata import CachedCloudDataset, PointCloud, collate_fixed
from pcdata.build import build_dataset, config_from_yaml
from pcdata.rng import seeded

RESULTS = Path(__file__).parent / "results"
BATCH, POINTS = 64, 4096
STORES = ("packed", "hdf5", "npz", "pt")
AUGMENT = (
    "augment: [RandomRotation: {degrees: 180}, RandomScale: {low: 0.9, high: 1.1}, RandomJitter: {sigma: 0.001}]\n"
)


class _Clouds:
    """Random clouds with colors."""

    name = "clouds"

    def __init__(self, num_samples: int) -> None:
        self.ids = [f"{number:05d}" for number in range(num_samples)]

    def __len__(self) -> int:
        return len(self.ids)

    def load(self, sample_id: str) -> PointCloud:
        points = torch.rand(POINTS, 3, generator=seeded(int(sample_id)))
        return PointCloud(points=points, colors=points.flip(0), frame_id="base")


class _PlainFiles(Dataset):
    """What a script does that keeps one file for every sample."""

    def __init__(self, folder: Path, clouds: _Clouds) -> None:
        folder.mkdir()
        self.paths = []
        for sample_id in clouds.ids:
            cloud = clouds.load(sample_id)
            self.paths.append(folder / f"{sample_id}.npz")
            np.savez(self.paths[-1], points=cloud.points.numpy(), colors=cloud.colors.numpy())

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> dict[str, Any]:
        with np.load(self.paths[index]) as stored:
            return {"points": stored["points"], "colors": stored["colors"]}


class _Copied(Dataset):
    """The bytes in memory."""

    def __init__(self, clouds: _Clouds) -> None:
        self.points = torch.stack([clouds.load(sample_id).points for sample_id in clouds.ids])
        self.colors = self.points.flip(1).contiguous()

    def __len__(self) -> int:
        return len(self.points)

    def __getitems__(self, indices: Sequence[int]) -> dict[str, Any]:
        return {"points": self.points[indices], "colors": self.colors[indices]}


def seconds(data: Any, collate: Callable[..., Any]) -> float:
    """CPU seconds of one pass."""
    order = torch.randperm(len(data), generator=seeded(0)).tolist()
    loader = DataLoader(data, batch_size=BATCH, sampler=order, collate_fn=collate)
    if hasattr(data, "set_epoch"):
        data.set_epoch(data.epoch + 1)
    begun = time.process_time()
    for _ in loader:
        pass
    return time.process_time() - begun


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--samples", type=int, default=256)
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    clouds = _Clouds(arguments.samples)
    with tempfile.TemporaryDirectory() as folder:
        read: dict[str, tuple[Any, Callable[..., Any]]] = {
            "copy in memory": (_Copied(clouds), lambda batch: batch),
            "npz and default_collate": (_PlainFiles(Path(folder) / "plain", clouds), default_collate),
        }
        for form in STORES:
            config = config_from_yaml(f"cloud: [Center]\n{AUGMENT}output: {{format: {form}}}\n")
            build_dataset(config, clouds, Path(folder) / form)
            read[form] = CachedCloudDataset(Path(folder) / form, augment=None), collate_fixed
            read[f"{form}, augmented"] = CachedCloudDataset(Path(folder) / form), collate_fixed
        found: dict[str, list[float]] = {name: [] for name in read}
        for _ in range(arguments.repeats + 1):  # in turns: a load from elsewhere meets all of them
            for name, (dataset, collate) in read.items():
                found[name].append(1e6 * seconds(dataset, collate) / arguments.samples)
    row = {name: round(statistics.median(times[1:]), 1) for name, times in found.items()}
    plain = row["npz and default_collate"]
    document = {
        "benchmark": "loading",
        "samples": arguments.samples,
        "points": POINTS,
        "batch": BATCH,
        "repeats": arguments.repeats,
        "microseconds_per_sample": row,
        "first_pass_of_packed": round(found["packed"][0], 1),
        "speed_over_npz_and_default_collate": {name: round(plain / row[name], 2) for name in row},
        "share_of_the_rate_of_a_copy": {name: round(row["copy in memory"] / row[name], 3) for name in row},
    }
    print(json.dumps(document, indent=1))
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "loading.json").write_text(json.dumps(document, indent=1) + "\n")


if __name__ == "__main__":
    main()
