"""Random batches of clouds of different sizes: the packed store beside Lance and Zarr v3, and beside copying the bytes.

    pip install pylance zarr
    python benchmarks/packed_peers.py     # two minutes; writes results/packed_peers.json

2,000 clouds of 1,000 to 8,000 points, six float32 each, are stored without compression. One process reads batches of
64 at random and puts each together as one array of all points, with row pointers. In turns, medians of five passes.
What each peer does is what its documentation shows for rows of different lengths: Lance has a list of floats in every
row and takes 64 rows at a time; Zarr has one array of all points, cut into chunks (a megabyte, or a cloud's mean size),
of which slices are read one by one. ``packed`` is ``CachedCloudDataset.__getitems__`` and ``collate_packed``: the same,
and the checks and histories of a cloud; "first" is the pass that compares every record with its digest.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pcdata import CachedCloudDataset, PointCloud, collate_packed
from pcdata.build import build_dataset, config_from_yaml

RESULTS = Path(__file__).parent / "results"
SAMPLES, BATCH, ROUNDS = 2000, 64, 5

Read = Callable[[Sequence[int]], int]  # returns the points read


class _Clouds:
    name = "clouds"

    def __init__(self, points: list[np.ndarray]) -> None:
        self.points = points
        self.ids = [f"{number:05d}" for number in range(len(points))]

    def __len__(self) -> int:
        return len(self.ids)

    def load(self, sample_id: str) -> PointCloud:
        rows = torch.from_numpy(self.points[int(sample_id)])
        return PointCloud(points=rows[:, :3].contiguous(), colors=rows[:, 3:].contiguous(), frame_id="base")


def _packed(folder: Path, points: list[np.ndarray]) -> Read:
    config = config_from_yaml(f"cloud: [Center]\noutput: {{format: packed, shard_size: {SAMPLES}}}\n")
    build_dataset(config, _Clouds(points), folder / "packed")
    dataset = CachedCloudDataset(folder / "packed")
    return lambda which: collate_packed(dataset.__getitems__(which)).num_points


def _memcpy(folder: Path, points: list[np.ndarray]) -> Read:
    whole, ends = np.concatenate(points), np.cumsum([0, *map(len, points)])

    def read(which: Sequence[int]) -> int:
        return len(np.concatenate([whole[ends[number] : ends[number + 1]] for number in which]))

    return read


def _zarr(rows: int) -> Callable[[Path, list[np.ndarray]], Read]:
    def make(folder: Path, points: list[np.ndarray]) -> Read:
        import zarr

        whole, ends = np.concatenate(points), np.cumsum([0, *map(len, points)])
        path = str(folder / f"points{rows}.zarr")
        array = zarr.create_array(path, shape=whole.shape, chunks=(rows, 6), dtype="float32", compressors=None)
        array[:] = whole
        array = zarr.open_array(path, mode="r")

        def read(which: Sequence[int]) -> int:
            return len(np.concatenate([array[ends[number] : ends[number + 1]] for number in which]))

        return read

    return make


def _lance(folder: Path, points: list[np.ndarray]) -> Read:
    import lance
    import pyarrow as pa

    values = pa.array(np.concatenate(points).reshape(-1))
    ends = pa.array(np.cumsum([0, *(rows.size for rows in points)]), pa.int64())
    table = pa.table({"points": pa.LargeListArray.from_arrays(ends, values)})
    data = lance.write_dataset(table, str(folder / "points.lance"))

    def read(which: Sequence[int]) -> int:
        column = data.take(list(which)).column("points").combine_chunks()
        if isinstance(column, pa.ChunkedArray):
            column = column.chunk(0)
        return len(column.flatten().to_numpy().reshape(-1, 6).copy())

    return read


def _passes(read: Read, order: list[list[int]]) -> dict[str, float]:
    started, cpu = time.perf_counter(), time.process_time()
    points = sum(read(which) for which in order)
    return {"seconds": time.perf_counter() - started, "cpu_seconds": time.process_time() - cpu, "points": points}


def main() -> None:
    """Measure all of them in turns."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=RESULTS / "packed_peers.json")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    draw = np.random.default_rng(0)
    points = [draw.random((int(count), 6), dtype=np.float32) for count in draw.integers(1000, 8000, SAMPLES)]
    ways: dict[str, Callable[[Path, list[np.ndarray]], Read]] = {
        "memcpy": _memcpy,
        "packed": _packed,
        "lance": _lance,
        "zarr, chunks of 1 MB": _zarr(43_690),
        "zarr, chunks of a cloud": _zarr(4_500),
    }
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        reads, found = {}, {}
        for way, make in ways.items():
            before = _bytes_below(folder)
            started = time.perf_counter()
            reads[way] = make(folder, points)
            found[way] = {
                "write_seconds": round(time.perf_counter() - started, 2),
                "bytes": _bytes_below(folder) - before,
            }
        taken: dict[str, list[dict[str, float]]] = {way: [] for way in ways}
        for number in range(ROUNDS + 1):
            order = np.random.default_rng(number).permutation(SAMPLES).tolist()
            batches = [order[begin : begin + BATCH] for begin in range(0, SAMPLES, BATCH)]
            for way, read in reads.items():
                taken[way].append(_passes(read, batches))
    assert len({each["points"] for way in taken.values() for each in way}) == 1
    for way, (first, *rest) in taken.items():
        for what in ("seconds", "cpu_seconds"):
            each = statistics.median(one[what] for one in rest) / SAMPLES * 1e6
            found[way][f"micro{what}_a_cloud"] = round(each, 1)
        found[way]["first_microcpu_seconds_a_cloud"] = round(first["cpu_seconds"] / SAMPLES * 1e6, 1)
        print(way, found[way])
    arguments.out.write_text(json.dumps({"about": _about(), "ways": found}, indent=1) + "\n")


def _bytes_below(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def _about() -> dict[str, Any]:
    import lance
    import zarr

    versions = {
        "lance": lance.__version__,
        "zarr": zarr.__version__,
        "numpy": np.__version__,
        "torch": torch.__version__,
    }
    return {**versions, "cores": os.cpu_count(), "samples": SAMPLES, "batch": BATCH, "points": "1000 to 8000"}


if __name__ == "__main__":
    main()
