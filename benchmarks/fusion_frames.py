"""Integrate recorded frames in a process of its own: libraries in turn, frame by frame; the last line is JSON.

    OMP_NUM_THREADS=1 PCDATA_TEST_DATA=... python benchmarks/fusion_frames.py --voxel-size 0.005

benchmarks/fusion.py starts this once per row: threads are fixed when a process starts, and memory can be told apart
only where one library is at work alone. Frames are read and converted to each library's types before any clock starts;
the first frame is left out of the medians, as it pays for what is made once. Open3D's tensor grid gets room for
the blocks that it will need, so that it never has to copy them to grow; so does pcdata with --reserve.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from fusion_agreement import edges_by_cause, surfaces_apart
from fusion_memory import Growth
from fusion_page import GROWING
from fusion_peer import LegacyVolume, Open3DGrid, Open3DView, positions, room_for, write_frames
from torch import Tensor

import pcdata
from pcdata.functional.tsdf import Carving
from pcdata.structures import DepthFrame, TSDFVolume

_WAIT = 0.03  # seconds: OpenMP threads spin for 10 ms after they have worked
LIBRARIES = ("pcdata", GROWING, "pcdata, no carving", "Open3D tensor", "Open3D legacy")


class Library(ABC):
    """One library at work on the frames."""

    cloud: Tensor  # (N, 3), once extracted

    def __init__(self) -> None:
        self.times: list[tuple[float, float]] = []
        self.found: dict[str, Any] = {}

    @abstractmethod
    def start(self) -> None:
        """Make the empty volume."""

    def integrate(self, number: int) -> None:
        """Integrate a frame and keep its times."""
        self.times.append(timed(lambda: self._integrate(number)))

    def extract(self, once: bool) -> None:
        """Extract the surface, twice where that is quick and allowed; keep the shorter times."""
        times = [timed(self._extract)]
        if not once and times[0][1] < 5:
            times.append(timed(self._extract))
        self.found |= {"extract cpu s": min(t[0] for t in times), "extract wall s": min(t[1] for t in times)}
        self.found["points"] = len(self.cloud)

    def row(self) -> dict[str, Any]:
        """What was measured."""
        cpu, wall = (1000 * statistics.median(times) for times in zip(*self.times[1:], strict=True))
        return {"cpu ms": cpu, "wall ms": wall, **self.found}

    @abstractmethod
    def _integrate(self, number: int) -> None: ...

    @abstractmethod
    def _extract(self) -> None: ...


class Ours(Library):
    """pcdata's volume."""

    def __init__(
        self, frames: Sequence[DepthFrame], voxel_size: float, multiple: float, carve: Carving, reserve: bool
    ) -> None:
        super().__init__()
        self._frames = frames
        self._reserve = reserve
        self._lengths = {"voxel_size": voxel_size, "truncation": multiple * voxel_size}
        self._carve = carve

    def start(self) -> None:
        """Make the empty volume, with the memory that it will need if it is to have it beforehand."""
        needed = self._filled().num_bytes if self._reserve else 0
        self._volume = self._empty()
        if needed:
            self._volume.reserve(needed)

    def _empty(self) -> TSDFVolume:
        return TSDFVolume(**self._lengths, carve=self._carve, max_bytes=16 << 30)

    def _filled(self) -> TSDFVolume:
        volume = self._empty()
        for frame in self._frames:
            volume.integrate(frame)
        return volume

    def _integrate(self, number: int) -> None:
        self._volume.integrate(self._frames[number])

    def extract(self, once: bool) -> None:
        """Extract the surface and let go of the volume."""
        super().extract(once)
        self.found["stored MiB"] = self._volume.num_bytes / 2**20
        del self._volume

    def _extract(self) -> None:
        self.cloud = self._volume.extract_points().points


class Theirs(Library):
    """Open3D's tensor grid."""

    def __init__(self, frames: Sequence[DepthFrame], voxel_size: float, multiple: float) -> None:
        super().__init__()
        self.views = [Open3DView.of(frame) for frame in frames]
        self._lengths = voxel_size, multiple, room_for(self.views, voxel_size, multiple)

    def start(self) -> None:
        """Make the empty grid, which takes its memory at once."""
        self.grid = Open3DGrid(*self._lengths)

    def _integrate(self, number: int) -> None:
        self.grid.integrate(self.views[number])

    def _extract(self) -> None:
        self._found = self.grid.extract()

    def extract(self, once: bool) -> None:
        """Extract the surface; the points are copied after the clock has stopped."""
        self.cloud = torch.empty(0, 3)
        super().extract(once)
        self.cloud = positions(self._found)
        self.found |= {"points": len(self.cloud), "stored MiB": self.grid.num_bytes / 2**20}


class Legacy(Library):
    """Open3D's legacy volume, timed where it runs."""

    def __init__(self, frames: Sequence[DepthFrame], voxel_size: float, multiple: float, python: str) -> None:
        super().__init__()
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "frames.npz"
            write_frames(path, frames)
            self._volume = LegacyVolume(python, path, voxel_size, multiple)

    def start(self) -> None:
        """The process has made it."""

    def integrate(self, number: int) -> None:
        """Integrate a frame and keep its times."""
        self.times.append(self._volume.integrate(number))

    def extract(self, once: bool) -> None:
        """Extract the surface; the memory is measured there too, as the process holds nothing else."""
        answer = self._volume.extract()
        self.found |= {"extract cpu s": answer["cpu"], "extract wall s": answer["wall"], "points": answer["points"]}
        self.found |= {"version": self._volume.version, "stored MiB": None}  # it does not tell
        self.found |= {"peak MiB": answer["integrated"] / 2**20, "peak extracting MiB": answer["extracted"] / 2**20}
        self._volume.close()

    def _integrate(self, number: int) -> None: ...

    def _extract(self) -> None: ...


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=50)
    parser.add_argument("--voxel-size", type=float, required=True)
    parser.add_argument("--multiple", type=float, default=5.0, help="truncation in voxels")
    parser.add_argument("--libraries", nargs="+", choices=LIBRARIES, default=LIBRARIES[:4])
    parser.add_argument("--legacy-python")
    parser.add_argument("--reserve", action="store_true", help="give pcdata its memory beforehand, unless it grows")
    parser.add_argument("--agreement", action="store_true", help="compare the surfaces of pcdata and the tensor grid")
    parser.add_argument("--memory", action="store_true", help="watch the peak; give one library")
    parser.add_argument("--again", action="store_true", help="time a second pass over the frames: no new ground")
    arguments = parser.parse_args()
    threads = int(os.environ.get("OMP_NUM_THREADS", "1"))
    torch.set_num_threads(threads)
    source = pcdata.open_source(Path(os.environ["PCDATA_TEST_DATA"]) / "seven_scenes", limit=arguments.frames)
    frames = [source.load(name) for name in source.ids]
    used = {name: library(name, frames, arguments) for name in arguments.libraries}
    growth = Growth() if arguments.memory else None
    for one in used.values():
        one.start()
    for number in range(len(frames)):
        for one in used.values():
            one.integrate(number)
    if arguments.again:
        for one in used.values():
            one.times.clear()
        for number in range(len(frames)):
            for one in used.values():
                one.integrate(number)
    integrated = growth.peak() if growth is not None else 0
    for one in used.values():
        one.extract(once=arguments.memory)
    result: dict[str, Any] = {
        "voxel mm": 1000 * arguments.voxel_size,
        "truncation voxels": arguments.multiple,
        "frames": len(frames),
        "threads": threads,
        "libraries": {name: one.row() for name, one in used.items()},
    }
    if growth is not None:
        (row,) = result["libraries"].values()
        row |= {"peak MiB": integrated / 2**20, "peak extracting MiB": growth.peak() / 2**20}
    if arguments.agreement:
        result |= agreement(frames, used, arguments.voxel_size)
    sys.stdout.write(json.dumps(result) + "\n")


def library(name: str, frames: Sequence[DepthFrame], arguments: argparse.Namespace) -> Library:
    lengths = arguments.voxel_size, arguments.multiple
    if name == "Open3D tensor":
        return Theirs(frames, *lengths)
    if name == "Open3D legacy":
        return Legacy(frames, *lengths, arguments.legacy_python)
    carve: Carving = "never" if name == "pcdata, no carving" else "near"
    return Ours(frames, *lengths, carve, reserve=arguments.reserve and name != GROWING)


def agreement(frames: Sequence[DepthFrame], used: dict[str, Library], voxel_size: float) -> dict[str, Any]:
    theirs = used["Open3D tensor"]
    assert isinstance(theirs, Theirs)
    apart = {
        name: surfaces_apart(one.cloud, theirs.cloud, voxel_size)
        for name, one in used.items()
        if isinstance(one, Ours) and name != GROWING  # whose cloud is that of pcdata
    }
    causes = edges_by_cause(used["pcdata, no carving"].cloud, theirs.cloud, theirs.grid, frames, theirs.views)
    return {"apart": apart, "causes": causes}


def timed(body: Callable[[], Any]) -> tuple[float, float]:
    """Seconds of the processor, all threads together, and of the clock, once others' threads have come to rest."""
    until = time.perf_counter() + _WAIT
    while time.perf_counter() < until:
        pass  # busy: an idle processor would clock down
    cpu, wall = time.process_time(), time.perf_counter()
    body()
    return time.process_time() - cpu, time.perf_counter() - wall


if __name__ == "__main__":
    main()
