"""How long a dataset of many samples takes to open, and what memory that needs.

    python benchmarks/index_opening.py      # 100 to 1,000,000 samples; writes results/index_opening.json
    python benchmarks/index_opening.py --samples 10000000      # a gigabyte on disk

The index is a synthetic one: ids of 26 letters, a thousand shards that hold nothing. Every size is opened in a process
of its own, five times; the least of the times is kept, in seconds of the clock and of the processor, of
``Manifest.read`` and of the whole ``CachedCloudDataset``. Memory is what the process holds besides afterwards:
``private`` is its own, ``mapped`` are pages of the index, which all processes share and the system may drop.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from pcdata import CachedCloudDataset
from pcdata.io.store.manifest import FILE_NAME, Manifest, checksum_of
from pcdata.io.store.sample_index import Sample
from pcdata.io.store.shards import seal_shard, shard_folder, shard_size_of
from pcdata.transforms import Compose

RESULTS = Path(__file__).parent / "results"
SIZES = (100, 10_000, 100_000, 1_000_000)
ROUNDS = 5


def write(folder: Path, num_samples: int) -> None:
    """Write a dataset that has an index alone."""
    each = shard_size_of(num_samples)
    tables = [bytes.fromhex(seal_shard(shard_folder(folder, number))) for number in range(-(-num_samples // each))]
    steps = Compose([])
    one = [Sample("a", "a", 1, "0" * 64)]
    Manifest("packed", "none", steps.stored_fingerprint(), steps.sections(), one).write(folder)
    numbers = np.arange(num_samples)
    places = [numbers // 100 // 10**power % 10 for power in range(5, -1, -1)]
    steps_in = [numbers % 100 // 10 % 10, numbers % 10]
    letters = np.tile(np.frombuffer(b"episode_000000/step_000000", np.uint8), (num_samples, 1))
    for column, digits in zip([*range(8, 14), 24, 25], [*places, *steps_in], strict=True):
        letters[:, column] += digits.astype(np.uint8)
    arrays = {
        "ids": letters.reshape(-1),
        "id_ends": (numbers + 1) * letters.shape[1],
        "num_points": np.full(num_samples, 4096),
        "digests": np.random.default_rng(0).integers(0, 256, (num_samples, 32), dtype=np.uint8),
        "shards": (numbers // each).astype("<i4"),
        "shard_tables": np.frombuffer(b"".join(tables), np.uint8).reshape(-1, 32),
    }
    content = json.loads((folder / FILE_NAME).read_text()) | {"num_samples": num_samples}
    del content["checksum"]
    for name, array in arrays.items():
        path = folder / "index" / f"{name}.npy"
        np.save(path, array)
        sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
        content["index"][path.name] = {"bytes": path.stat().st_size, "sha256": sha256}
    (folder / FILE_NAME).write_text(json.dumps({**content, "checksum": checksum_of(content)}))


def memory() -> dict[str, int]:
    """Return the memory of this process in bytes."""
    status = Path("/proc/self/status").read_text()
    return {
        name: int(status.split(key)[1].split()[0]) << 10
        for name, key in (("private", "RssAnon:"), ("mapped", "RssFile:"))
    }


def opened(folder: Path) -> dict[str, float]:
    """Open a dataset and return what that took."""
    found: dict[str, float] = {}
    for what, opening in (("manifest", Manifest.read), ("dataset", CachedCloudDataset)):
        before, held, times = memory(), None, []
        for _ in range(ROUNDS):
            held = None
            started = time.perf_counter(), time.process_time()
            held = opening(folder)
            times.append((time.perf_counter() - started[0], time.process_time() - started[1]))
        found[f"{what}_seconds"], found[f"{what}_cpu_seconds"] = (round(min(each), 4) for each in zip(*times))
        found |= {f"{what}_{name}_bytes": memory()[name] - before[name] for name in before}
    assert isinstance(held, CachedCloudDataset)
    ids, last = held.ids, len(held) - 1
    for what in ("first_lookup", "lookup"):
        started = time.process_time(), 0.0
        assert ids.index(ids[last]) == last
        found[f"{what}_cpu_seconds"] = round(time.process_time() - started[0], 6)
    return found


def main() -> None:
    """Measure every size in a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, nargs="+", default=SIZES)
    parser.add_argument("--open", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, default=RESULTS / "index_opening.json")
    arguments = parser.parse_args()
    if arguments.open:
        print(json.dumps(opened(arguments.open)))
        return
    found = {}
    for size in arguments.samples:
        with tempfile.TemporaryDirectory() as folder:
            write(Path(folder), size)
            told = subprocess.run(
                [sys.executable, __file__, "--open", folder], capture_output=True, text=True, check=True
            )
            size_on_disk = sum(path.stat().st_size for path in Path(folder, "index").iterdir())
        found[str(size)] = {"index_bytes": size_on_disk, **json.loads(told.stdout)}
        print(size, found[str(size)])
    about = {"python": platform.python_version(), "numpy": np.__version__, "torch": torch.__version__}
    if arguments.out.exists():
        found = json.loads(arguments.out.read_text())["samples"] | found
    arguments.out.write_text(json.dumps({"about": about, "rounds": ROUNDS, "samples": found}, indent=1) + "\n")


if __name__ == "__main__":
    main()
