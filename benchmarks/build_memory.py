"""Resident memory of a build of 3,000 small clouds, every 250 samples, for every store: it must not grow with them.

    python benchmarks/build_memory.py [--samples 3000]     # writes results/build_memory.json

Each store is built in a process of its own. What a build keeps of every sample is its row of the manifest and of the
report: about a kilobyte.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results"
STORES = ("hdf5", "hdf5, compression: gzip", "npz", "pt")
EVERY = 250
LIMIT = 4 << 10  # bytes a sample may add, after the first two readings, in which allocators find their size


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=3000)
    parser.add_argument("--store", help=argparse.SUPPRESS)  # what a process of its own builds
    arguments = parser.parse_args()
    if arguments.store:
        print(json.dumps(resident(arguments.store, arguments.samples)))
        return
    result: dict[str, Any] = {"samples": arguments.samples, "every": EVERY, "stores": {}}
    for store in STORES:
        call = [sys.executable, __file__, "--store", store, "--samples", str(arguments.samples)]
        told = subprocess.run(call, check=True, stdout=subprocess.PIPE, text=True).stdout
        megabytes = json.loads(told)
        per_sample = (megabytes[-1] - megabytes[1]) * 2**20 / (arguments.samples - 2 * EVERY)
        result["stores"][store] = {"resident_mb": megabytes, "bytes_per_sample": round(per_sample)}
        print(f"{store:26} {' '.join(f'{value:.0f}' for value in megabytes)} MB; {per_sample:.0f} bytes a sample")
    (RESULTS / "build_memory.json").write_text(json.dumps(result, indent=1) + "\n")
    worst = max(store["bytes_per_sample"] for store in result["stores"].values())
    sys.exit(f"memory grows by {worst} bytes a sample" if worst > LIMIT else 0)


def resident(store: str, count: int) -> list[float]:
    """Build and return the resident memory in MB after every so many samples."""
    import torch

    from pcdata import PointCloud
    from pcdata.build import build_dataset, config_from_yaml

    class Clouds:
        ids = [f"{number:05}" for number in range(count)]

        def load(self, sample_id: str) -> PointCloud:
            points = torch.rand(512, 3, generator=torch.Generator().manual_seed(int(sample_id)))
            return PointCloud(points=points, frame_id="base", colors=points.flip(1))

    found = []

    def progress(done: int, total: int, sample_id: str) -> None:
        if done % EVERY == 0:
            fields = Path("/proc/self/statm").read_text().split()
            found.append(int(fields[1]) * 4096 / 2**20)

    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        config = config_from_yaml(f"cloud: [Center]\noutput: {{format: {store}}}\n")
        build_dataset(config, Clouds(), Path(folder) / "out", progress=progress)
    return found


if __name__ == "__main__":
    main()
