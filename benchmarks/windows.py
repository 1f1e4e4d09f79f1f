"""How fast windows of episodes come from a built dataset, beside single samples of the same bytes.

    python benchmarks/windows.py     # a minute; writes results/windows.json

Clouds of 1024 points with colors, five signals, turned at random as they are read. A window is 2 clouds and 16 steps of
actions; beside it stand single clouds of 1024 points, of which 2 are as many bytes, and single clouds of 2048 points,
which are as many bytes in one record. Each is read and collated in batches of 32 by one process, in turns, the medians
of CPU time kept: shuffled, as in training, and signals read. The first pass, in which a packed store compares every
record with its digest, stands apart.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch.utils.data import DataLoader

from pcdata import CachedCloudDataset, Episode, EpisodeWindows, PointCloud, collate_fixed, collate_windows
from pcdata.build import build_dataset, config_from_yaml
from pcdata.rng import seeded
from pcdata.structures import Signal

RESULTS = Path(__file__).parent / "results"
BATCH, NUM_OBS, HORIZON, LENGTH = 32, 2, 16, 32
PIPELINE = "cloud: [Center]\naugment: [RandomRotation: {degrees: 180}]\n"


class Recorded:
    """Episodes of random clouds with the signals of a robot."""

    name = "recorded"

    def __init__(self, num_points: int, num_samples: int) -> None:
        self.num_points = num_points
        self.ids = [f"{number:05d}" for number in range(num_samples)]
        self.episodes = [Episode(f"e{first}", first, LENGTH) for first in range(0, num_samples, LENGTH)]

    def __len__(self) -> int:
        return len(self.ids)

    def signals(self, sample_id: str) -> dict[str, Signal]:
        """Joints, gripper, pose of the hand, action and a text."""
        draw = torch.randn(1, 15, generator=seeded(int(sample_id)))
        return {
            "joints": Signal(draw[:, :7], "invariant"),
            "gripper": Signal(draw[:, 7:8], "invariant"),
            "hand": Signal(torch.eye(4)[None], "pose matrix", "base"),
            "action": Signal(draw[:, 8:15], "position + invariant 4", "base"),
            "task": Signal(("put the cube on the disc",), "text"),
        }

    def load(self, sample_id: str) -> PointCloud:
        """Return the cloud of one step."""
        points = torch.rand(self.num_points, 3, generator=seeded(int(sample_id)))
        return PointCloud(points=points, colors=points, frame_id="base", recorded_signals=self.signals(sample_id))


def seconds(data: Any, collate: Callable[..., Any]) -> float:
    """CPU seconds of one pass."""
    order = torch.randperm(len(data), generator=seeded(0)).tolist()
    loader = DataLoader(data, batch_size=BATCH, sampler=order, collate_fn=collate)
    data.set_epoch(data.epoch + 1)
    begun = time.process_time()
    for batch in loader:
        dict(batch.signals)  # those of single samples are computed when they are read, those of windows are there
    return time.process_time() - begun


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--samples", type=int, default=128)
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    stores: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        for form in ("packed", "hdf5", "npz", "pt"):
            config = config_from_yaml(f"{PIPELINE}output: {{format: {form}}}\n")
            data = {}
            for count in (1024, 2048):
                path = Path(folder) / f"{form}_{count}"
                build_dataset(config, Recorded(count, arguments.samples), path)
                data[count] = CachedCloudDataset(path)
            read = {
                "windows of 2 x 1024": (EpisodeWindows(data[1024], NUM_OBS, HORIZON), collate_windows),
                "2 singles of 1024": (data[1024], collate_fixed),
                "singles of 2048": (data[2048], collate_fixed),
            }
            found: dict[str, list[float]] = {name: [] for name in read}
            for _ in range(arguments.repeats + 1):  # in turns: a load from elsewhere meets all of them
                for name, (dataset, collate) in read.items():
                    of_window = NUM_OBS if name.startswith("2 ") else 1
                    found[name].append(1e3 * of_window * seconds(dataset, collate) / len(dataset))
            row = {name: round(statistics.median(times[1:]), 3) for name, times in found.items()}
            window = row["windows of 2 x 1024"]
            stores[form] = {
                "milliseconds_per_2048_points": row,
                "of_the_first_pass": {name: round(times[0], 3) for name, times in found.items()},
                "speed_of_windows_over_2_singles": round(row["2 singles of 1024"] / window, 3),
                "speed_of_windows_over_singles_of_2048": round(row["singles of 2048"] / window, 3),
            }
            print(form, stores[form])
    document = {
        "benchmark": "windows",
        "samples": arguments.samples,
        "batch": BATCH,
        "num_obs": NUM_OBS,
        "horizon": HORIZON,
        "repeats": arguments.repeats,
        "stores": stores,
    }
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "windows.json").write_text(json.dumps(document, indent=1) + "\n")


if __name__ == "__main__":
    main()
