"""How fast batches come from a built dataset, beside other ways to keep clouds and beside copying the bytes.

    python benchmarks/loading.py     # some minutes on a quiet machine; writes results/loading.json

Clouds of 4096 points with colors, 96 KB each, 64 a batch, shuffled, by a DataLoader with two workers that has run for a
while: the median rate of several stretches, all ways in turns, so that a load from elsewhere meets each of them. Nobody
looks at the batches.

What the rates stand beside:

- ``memcpy``: a loop in one process that copies the same bytes, sample by sample in the same order, out of one array
  into one batch that is used again.
- ``a number`` and ``memcpy in workers``: what no loader by torch's DataLoader can pass. Its workers hand over a number
  and nothing else; or copy the bytes as ``memcpy`` does, into memory that is there already and that they share, and
  hand over which part of it they filled.
- ``torch's ceiling``: a Dataset whose ``__getitems__`` gives one tensor that is in shared memory already, so that
  nothing is read, copied or allocated; ``fresh tensor``: a new tensor of that size for every batch, which torch moves
  to shared memory.
- ``npz and default_collate``, ``hdf5 group per sample``: what most training code does.
- ``webdataset``: the tars that pcdata builds, by key at random, and streamed shard by shard.
- WebDataset, LitData, Zarr and Lance, each as its documentation shows, where they are installed.

The set is some times as large as the processor's last cache (``cache`` in the JSON says how large that is), so that
rows come from memory, and from the system's cache of files. ``memcpy, larger set`` and ``packed, larger set`` are of
one eight times as large again: where they are as fast, no cache helps the others.

The time of the processors for a batch, in the process that takes it and in all workers, is told beside the rates: it
hardly depends on what else a machine does.

Augmented are every sample by RandomRotation, RandomScale and RandomJitter, and also by RandomPointDropout.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import math
import multiprocessing
import os
import platform
import statistics
import tarfile
import tempfile
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset, IterableDataset, default_collate, get_worker_info

from pcdata import CachedCloudDataset, PointCloud, StreamedCloudDataset, collate_fixed, collate_packed
from pcdata.build import build_dataset, config_from_yaml
from pcdata.rng import seeded

RESULTS = Path(__file__).parent / "results"
BATCH, POINTS = 64, 4096
BYTES = POINTS * 6 * 4  # of a sample
SUFFIXES = {
    "rotate, scale, jitter": "[RandomRotation: {degrees: 180}, RandomScale: {low: 0.9, high: 1.1}, RandomJitter: "
    "{sigma: 0.001}]",
    "rotate, scale, jitter, dropout": "[RandomRotation: {degrees: 180}, RandomScale: {low: 0.9, high: 1.1}, "
    "RandomJitter: {sigma: 0.001}, RandomPointDropout]",
}


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


class _Groups(Dataset):
    """What a script does that keeps one HDF5 group for every sample."""

    def __init__(self, path: Path, clouds: _Clouds) -> None:
        self.path, self.ids, self.file = path, clouds.ids, None
        with h5py.File(path, "w") as file:
            for sample_id in clouds.ids:
                cloud = clouds.load(sample_id)
                file[f"{sample_id}/points"], file[f"{sample_id}/colors"] = cloud.points.numpy(), cloud.colors.numpy()

    def __len__(self) -> int:
        return len(self.ids)

    def __getitem__(self, index: int) -> dict[str, Any]:
        self.file = self.file or h5py.File(self.path)
        group = self.file[self.ids[index]]
        return {"points": group["points"][()], "colors": group["colors"][()]}


class _Ready(Dataset):
    """A batch that lies in shared memory; or, as ``fresh``, in memory of its own each time."""

    def __init__(self, size: int, *, fresh: bool) -> None:
        self.size, self.fresh = size, fresh
        self.batch = torch.ones(BATCH, POINTS, 6).share_memory_()

    def __len__(self) -> int:
        return self.size

    def __getitems__(self, indices: Sequence[int]) -> torch.Tensor:
        return self.batch.clone() if self.fresh else self.batch


class _Copied(Dataset):
    """The number of a slot that a worker has copied a batch into, or of none, where nothing is copied."""

    slots = 4  # of a worker: more than are on their way

    def __init__(self, samples: np.ndarray | None, size: int, workers: int) -> None:
        self.samples, self.size, self.filled = samples, size, 0
        if samples is not None:
            self.memory = torch.zeros(max(1, workers), self.slots, BATCH, POINTS, 6).share_memory_()

    def __len__(self) -> int:
        return self.size

    def __getitems__(self, indices: Sequence[int]) -> int:
        if self.samples is None:
            return 0
        worker = get_worker_info()
        slot = self.filled % self.slots
        batch = self.memory[0 if worker is None else worker.id, slot].numpy()
        for place, index in enumerate(indices):
            batch[place] = self.samples[index]
        self.filled += 1
        return slot


def _as_it_is(batch: Any) -> Any:
    return batch


class _Loaded:
    """A way to load: batches from a loader that is begun again when it ends."""

    def __init__(self, loader: Callable[[int], Any]) -> None:
        self._loader, self._pass = loader, 0
        self._batches: Iterator[Any] = iter(())

    def batches(self, count: int) -> Iterator[Any]:
        while count:
            batch = next(self._batches, None)
            if batch is None:
                self._batches = iter(self._loader(self._pass))
                self._pass += 1
                continue
            yield batch
            count -= 1


def loader_of(data: Dataset, collate: Callable[..., Any], workers: int, passes: int) -> _Loaded:
    """Batches of many passes over a dataset: workers begin once."""

    def begin(number: int) -> DataLoader:
        generator = seeded(number)
        order = torch.cat([torch.randperm(len(data), generator=generator) for _ in range(passes)]).tolist()
        if hasattr(data, "set_epoch"):
            data.set_epoch(number)
        return DataLoader(data, batch_size=BATCH, sampler=order, num_workers=workers, collate_fn=collate)

    return _Loaded(begin)


def streamed(data: CachedCloudDataset, workers: int, passes: int) -> _Loaded:
    """Batches of many passes over a dataset that is gone through shard by shard, in a window as large as the peer's."""

    def begin(number: int) -> DataLoader:
        data.set_epoch(number)
        stream = StreamedCloudDataset(data, batch_size=BATCH, shuffle_buffer=256, drop_last=True)
        return DataLoader(_Passes(stream, passes), batch_size=None, num_workers=workers, collate_fn=collate_fixed)

    return _Loaded(begin)


class _Passes(IterableDataset):
    """Several passes in a row: workers begin once."""

    def __init__(self, data: StreamedCloudDataset, passes: int) -> None:
        self.data, self.passes = data, passes

    def __iter__(self) -> Iterator[Any]:
        for _ in range(self.passes):
            yield from self.data


def copied(samples: np.ndarray) -> _Loaded:
    """The loop of memcpy, of bytes that lie in memory."""
    batch = np.empty((BATCH, POINTS, 6), np.float32)

    def begin(number: int) -> Iterator[Any]:
        order = np.random.default_rng(number).permutation(len(samples))
        for first in range(0, len(order) - BATCH + 1, BATCH):
            for place, sample in enumerate(order[first : first + BATCH].tolist()):
                batch[place] = samples[sample]
            yield batch

    return _Loaded(begin)


def peers(folder: Path, clouds: _Clouds, workers: int, passes: int) -> dict[str, _Loaded | str]:
    """Other libraries' ways, or why there is none."""
    found: dict[str, _Loaded | str] = {}
    for name, make in (("WebDataset", _webdataset), ("LitData", _litdata), ("Zarr", _zarr), ("Lance", _lance)):
        try:
            found[name] = make(folder, clouds, workers, passes)
        except Exception as error:  # not installed, or another interface than the one written for
            found[name] = f"{type(error).__name__}: {error}"[:200]
    return found


def _arrays(clouds: _Clouds, sample_id: str) -> np.ndarray:
    cloud = clouds.load(sample_id)
    return np.concatenate([cloud.points.numpy(), cloud.colors.numpy()], axis=1)


def _webdataset(folder: Path, clouds: _Clouds, workers: int, passes: int) -> _Loaded:
    import webdataset

    for shard in range(4):
        with tarfile.open(folder / f"{shard}.tar", "w") as tar:
            for sample_id in clouds.ids[shard::4]:
                content = io.BytesIO()
                np.save(content, _arrays(clouds, sample_id))
                entry = tarfile.TarInfo(f"{sample_id}.npy")
                entry.size = len(content.getvalue())
                tar.addfile(entry, io.BytesIO(content.getvalue()))
    urls = [str(folder / f"{shard}.tar") for shard in range(4)]

    def begin(number: int) -> Any:
        data = webdataset.WebDataset(urls * passes, shardshuffle=100, seed=number).shuffle(256).decode().to_tuple("npy")
        return DataLoader(data.batched(BATCH), batch_size=None, num_workers=workers)

    return _Loaded(begin)


def _litdata(folder: Path, clouds: _Clouds, workers: int, passes: int) -> _Loaded:
    from litdata import StreamingDataLoader, StreamingDataset
    from litdata.streaming.writer import BinaryWriter

    target = folder / "litdata"
    target.mkdir()
    writer = BinaryWriter(str(target), chunk_bytes="64MB")
    for number, sample_id in enumerate(clouds.ids):
        writer[number] = {"cloud": torch.from_numpy(_arrays(clouds, sample_id))}
    writer.done()
    writer.merge()
    data = StreamingDataset(str(target), shuffle=True)
    return _Loaded(lambda number: StreamingDataLoader(data, batch_size=BATCH, num_workers=workers))


class _ZarrSamples(Dataset):
    def __init__(self, path: str, size: int) -> None:
        self.path, self.size, self.array = path, size, None

    def __len__(self) -> int:
        return self.size

    def __getitem__(self, index: int) -> Any:
        import zarr

        if self.array is None:
            self.array = zarr.open_array(self.path, mode="r")
        return self.array[index]


def _zarr(folder: Path, clouds: _Clouds, workers: int, passes: int) -> _Loaded:
    import zarr

    path = str(folder / "samples.zarr")
    shape = (len(clouds), POINTS, 6)
    array = zarr.create_array(path, shape=shape, chunks=(1, POINTS, 6), dtype="float32", compressors=None)
    for number, sample_id in enumerate(clouds.ids):
        array[number] = _arrays(clouds, sample_id)
    return loader_of(_ZarrSamples(path, len(clouds)), default_collate, workers, passes)


class _LanceSamples(Dataset):
    def __init__(self, path: str, size: int) -> None:
        self.path, self.size, self.data = path, size, None

    def __len__(self) -> int:
        return self.size

    def __getitems__(self, indices: Sequence[int]) -> Any:
        import lance

        self.data = self.data or lance.dataset(self.path)
        taken = self.data.take(list(indices), columns=["cloud"])["cloud"].combine_chunks()
        return torch.from_numpy(taken.flatten().to_numpy().reshape(len(indices), POINTS, 6).copy())


def _lance(folder: Path, clouds: _Clouds, workers: int, passes: int) -> _Loaded:
    import lance
    import pyarrow

    flat = np.concatenate([_arrays(clouds, sample_id).reshape(-1) for sample_id in clouds.ids])
    table = pyarrow.table({"cloud": pyarrow.FixedSizeListArray.from_arrays(pyarrow.array(flat), POINTS * 6)})
    lance.write_dataset(table, str(folder / "samples.lance"))
    return loader_of(_LanceSamples(str(folder / "samples.lance"), len(clouds)), _as_it_is, workers, passes)


class _Rate(NamedTuple):
    """Of some batches."""

    samples_per_second: float
    own_time: float  # of the processors for a batch, in milliseconds: in this process
    workers_time: float  # and in its workers; NaN = some began or ended meanwhile, or the system does not say


def rate(way: _Loaded, batches: int, waiting: int) -> _Rate:
    """Measure so many batches, after those that workers made while others were measured."""
    for _ in way.batches(waiting):
        pass
    before, own, begun = _times_of_workers(), time.process_time(), time.perf_counter()
    for _ in way.batches(batches):
        pass
    wall, own, after = time.perf_counter() - begun, time.process_time() - own, _times_of_workers()
    workers = sum(after[one] - before[one] for one in after) if before.keys() == after.keys() != set() else math.nan
    return _Rate(batches * BATCH / wall, 1e3 * own / batches, 1e3 * workers / batches)


def _times_of_workers() -> dict[int, float]:
    """Return the seconds of the processors that each worker of this process has had; none where nobody says."""
    found = {}
    for worker in multiprocessing.active_children():
        with contextlib.suppress(OSError):
            found[worker.pid or 0] = int(Path(f"/proc/{worker.pid}/schedstat").read_text().split()[0]) / 1e9
    return found


def last_cache() -> int | None:
    """Return the bytes of the processor's last cache, where the system says."""
    sizes = []
    for path in Path("/sys/devices/system/cpu/cpu0/cache").glob("index*/size"):
        with contextlib.suppress(OSError, ValueError):
            sizes.append(int(path.read_text().strip().removesuffix("K")) << 10)
    return max(sizes, default=None)


def _median(values: Iterable[float]) -> float | None:
    known = [value for value in values if not math.isnan(value)]
    return round(statistics.median(known), 3) if known else None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--samples", type=int, default=1024)
    parser.add_argument("--larger", type=int, default=8, help="times the samples, of the larger set; 0 = none")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--batches", type=int, default=1024, help="of a stretch; slow ways have an eighth")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path, default=RESULTS / "loading.json")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", UserWarning)  # a second pass in one epoch: the order is of many passes
    clouds = _Clouds(arguments.samples)
    samples = np.stack([_arrays(clouds, sample_id) for sample_id in clouds.ids])
    stretch = arguments.batches + 4 * arguments.workers
    passes = 1 + stretch * BATCH * (arguments.repeats + 1) // arguments.samples  # workers begin once

    def loaded(data: Dataset, collate: Callable[..., Any]) -> _Loaded:
        return loader_of(data, collate, arguments.workers, passes)

    with tempfile.TemporaryDirectory() as named:
        folder = Path(named)
        ways: dict[str, Any] = {
            "memcpy": copied(samples),
            "a number": loaded(_Copied(None, len(clouds), arguments.workers), _as_it_is),
            "memcpy in workers": loaded(_Copied(samples, len(clouds), arguments.workers), _as_it_is),
            "torch's ceiling": loaded(_Ready(arguments.samples, fresh=False), _as_it_is),
            "fresh tensor": loaded(_Ready(arguments.samples, fresh=True), _as_it_is),
            "npz and default_collate": loaded(_PlainFiles(folder / "plain", clouds), default_collate),
            "hdf5 group per sample": loaded(_Groups(folder / "groups.h5", clouds), default_collate),
        }
        for number, (name, steps) in enumerate(SUFFIXES.items()):
            built = folder / f"packed{number}"
            config = config_from_yaml(f"cloud: [Center]\naugment: {steps}\noutput: {{format: packed}}\n")
            build_dataset(config, clouds, built)
            if number == 0:
                ways["packed"] = loaded(CachedCloudDataset(built, augment=None), collate_fixed)
            ways[f"packed, {name}"] = loaded(CachedCloudDataset(built), collate_packed)
        built = folder / "tars"
        build_dataset(config_from_yaml("cloud: [Center]\noutput: {format: webdataset}\n"), clouds, built)
        ways["webdataset"] = loaded(CachedCloudDataset(built), collate_fixed)
        ways["webdataset, streamed"] = streamed(CachedCloudDataset(built), arguments.workers, passes)
        if arguments.larger:
            many = _Clouds(arguments.samples * arguments.larger)
            built = folder / "larger"
            build_dataset(config_from_yaml("cloud: [Center]\noutput: {format: packed}\n"), many, built)
            ways["memcpy, larger set"] = copied(np.ones((len(many), POINTS, 6), np.float32))
            ways["packed, larger set"] = loaded(CachedCloudDataset(built), collate_fixed)
            rate(ways["packed, larger set"], len(many) // BATCH, 0)  # records are compared when they are first read
        skipped = {}
        for name, way in peers(folder, clouds, arguments.workers, passes).items():
            (skipped if isinstance(way, str) else ways)[name] = way
        rates: dict[str, list[_Rate]] = {name: [] for name in ways}
        for number in range(arguments.repeats + 1):  # the first stretch begins workers and fills caches
            for name, way in list(ways.items()):
                is_ours = name.startswith(("memcpy", "a number", "torch's ceiling", "packed", "webdataset"))
                count = arguments.batches if is_ours else max(8, arguments.batches // 8)
                try:
                    found = rate(way, count, 4 * arguments.workers)
                except Exception as error:  # a peer whose interface changed
                    skipped[name] = f"{type(error).__name__}: {error}"[:200]
                    del ways[name], rates[name]
                    continue
                if number:
                    rates[name].append(found)
        del ways
    walls = {name: [one.samples_per_second for one in found] for name, found in rates.items()}
    per_second = {name: round(statistics.median(found)) for name, found in walls.items()}
    packed = per_second["packed"]
    document = {
        "benchmark": "loading",
        "samples": arguments.samples,
        "points": POINTS,
        "bytes_per_sample": BYTES,
        "batch": BATCH,
        "workers": arguments.workers,
        "cores": os.cpu_count(),
        "machine": platform.machine(),
        "torch": torch.__version__,
        "cache": {
            "last_level_bytes": last_cache(),
            "set_bytes": arguments.samples * BYTES,
            "larger_set_bytes": arguments.samples * arguments.larger * BYTES,
        },
        "samples_per_second": per_second,
        "quartiles": {name: [round(part) for part in np.percentile(found, [25, 75])] for name, found in walls.items()},
        "cpu_ms_per_batch": {
            name: {
                "this process": _median(one.own_time for one in found),
                "workers": _median(one.workers_time for one in found),
            }
            for name, found in rates.items()
        },
        "gigabytes_per_second": {name: round(found * BYTES / 1e9, 2) for name, found in per_second.items()},
        "packed_over": {name: round(packed / found, 2) for name, found in per_second.items() if name != "packed"},
        "share_of_memcpy": {name: round(found / per_second["memcpy"], 3) for name, found in per_second.items()},
        "share_of_memcpy_in_workers": {
            name: round(found / per_second["memcpy in workers"], 3) for name, found in per_second.items()
        },
        "rate_lost_to_augmentation": {name: round(1 - per_second[f"packed, {name}"] / packed, 3) for name in SUFFIXES},
        "not_measured": skipped,
    }
    print(json.dumps(document, indent=1))
    arguments.out.parent.mkdir(exist_ok=True)
    arguments.out.write_text(json.dumps(document, indent=1) + "\n")


if __name__ == "__main__":
    main()
