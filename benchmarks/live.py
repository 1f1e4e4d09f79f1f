"""Latency of a chain on a camera's stream, 848x480: percentiles of each step and of the whole.

    PCDATA_TEST_DATA=... python benchmarks/live.py            # 2,000 frames or more; table, JSON, histograms
    python benchmarks/live.py --quick                         # 60 frames, nothing is kept

The chain: mask, crop, flying pixels, both outlier filters, plane, 1,024 farthest points with normals. The frames: a
room (``seven_scenes``) and a tabletop (``tabletop_stream``) resized to 848x480, and synthetic scenes; each through a
workspace as a robot there would have. Every frame of them goes through the offline pipeline too, and the clouds must be
identical. Wall time is that of ``LivePipeline``, one frame after another without pause. Processor time is of all
threads of the process and says what a busy machine does not blur; of it, what is not spent in functions of the compiled
core is told as ``around``: Python, torch, memory that is given back. Between the frames a probe without pcdata looks
whether two threads have a core each (:mod:`own_cores`): a host may run both processors of a virtual machine on one for
a while. Frames that had two cores are told once more by themselves. Small frames, on which kernels cost next to
nothing, tell the same of each step once more.

Memory is looked at after 100 and after 10,000 small frames through the same chain, and must not have grown.

``--camera 60`` replays the frames by a thread at so many frames a second for ``--seconds`` beside a busy second
process, and counts what is dropped: no frame may be served twice, after a newer one, or when it has lain too long, and
none that came may be waited for.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import itertools
import json
import multiprocessing
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from own_cores import core_probe
from timing import RESULTS, facts

import pcdata
from pcdata.kernels.cpu import native
from pcdata.live import LatestFrame, LivePipeline, LiveResult
from pcdata.report import text_table
from pcdata.synthetic import tabletop
from pcdata.threads import torch_on_one_thread

SIZE = (480, 848)
BAR, STRETCH = 1 / 60, 1 / 90  # seconds
PERCENTILES = (50, 90, 99, 99.9)
MOST_FRAMES = 3  # for each that is asked for: not all have two cores

Box = tuple[tuple[float, float, float], tuple[float, float, float]]
SETS: dict[str, Box] = {  # the workspace in the camera's frame, metres
    "room": ((-0.5, -0.5, 0.3), (0.5, 0.5, 2.0)),
    "tabletop": ((-0.25, -0.2, 0.2), (0.25, 0.2, 1.0)),
    "synthetic": ((-0.4, -0.4, 0.2), (0.4, 0.4, 1.5)),
}


def chain(box: Box, *, radius: float = 0.01, num_points: int = 1024) -> pcdata.Compose:
    """The steps of the measurement; the search for the plane stops when a better one is unlikely to be missed.

    Small frames have their points further apart, and fewer of them.
    """
    return pcdata.Compose(
        [
            pcdata.MaskDepth(near=0.2, far=3.0),
            pcdata.RemoveFlyingPixels(),
            pcdata.Deproject(),
            pcdata.CropWorkspace(frame="camera", lower=box[0], upper=box[1]),
            pcdata.RemoveStatisticalOutliers(),
            pcdata.RemoveRadiusOutliers(radius=radius),
            pcdata.RemovePlane(probability=0.9999),
            pcdata.FarthestPointSample(num_points=num_points),
            pcdata.EstimateNormals(),
        ]
    )


def frames(quick: bool) -> dict[str, list[pcdata.DepthFrame]]:
    """The frames of each set, alike in size, camera and images."""
    found: dict[str, list[pcdata.DepthFrame]] = {}
    folder = os.environ.get("PCDATA_TEST_DATA")
    resize = pcdata.ResizeDepth(size=SIZE)
    if folder:
        room = pcdata.open_source(Path(folder) / "seven_scenes")
        table = pcdata.open_source(
            Path(folder) / "tabletop_stream", intrinsics=(927.17, 927.37, 651.32, 349.62), metres_per_unit=0.001
        )
        for name, source in (("room", room), ("tabletop", table)):
            found[name] = [resize(source.load(own)) for own in source.ids[:: 10 if quick else 1]]
    found["synthetic"] = [
        replace(tabletop(seed, noise="stereo", size=SIZE, num_views=1).frame, labels=None, sample_id=f"seed{seed}")
        for seed in range(2 if quick else 10)
    ]
    return found


def with_one_camera(frames: list[pcdata.DepthFrame]) -> list[list[pcdata.DepthFrame]]:
    """Part frames by their intrinsics: a pipeline is for one camera."""
    parts: dict[tuple[float, ...], list[pcdata.DepthFrame]] = {}
    for frame in frames:
        parts.setdefault(tuple(frame.camera.intrinsics.flatten().tolist()), []).append(frame)
    return list(parts.values())


# -- measuring ---------------------------------------------------------------------------------------------------------


class Measured:
    """What the frames of one set took."""

    def __init__(self) -> None:
        self.seconds: list[float] = []
        self.own_cores: list[bool] = []  # whether two threads of anything had a core each about then
        self.processor: list[float] = []
        self.points: list[int] = []
        self.steps: dict[str, tuple[list[float], ...]] = {}  # seconds by the wall, of processors, of these around

    def add(self, other: Measured) -> None:
        self.seconds += other.seconds
        self.own_cores += other.own_cores
        self.processor += other.processor
        self.points += other.points
        for name, taken in other.steps.items():
            for mine, more in zip(self.steps.setdefault(name, ([], [], [])), taken):
                mine.extend(more)


class InCore:
    """Adds up the processor seconds of functions of the compiled core, while it is entered."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def __enter__(self) -> InCore:
        self._before = dict(native.library())
        for name, function in self._before.items():
            native.library()[name] = function._replace(entry=self._timed(function.entry))
        return self

    def __exit__(self, *raised: object) -> None:
        native.library().update(self._before)

    def _timed(self, entry: Callable[..., int]) -> Callable[..., int]:
        def timed(*arguments: Any) -> int:
            since = time.process_time()
            try:
                return entry(*arguments)
            finally:
                self.seconds += time.process_time() - since

        return timed


def check_identical(live: LivePipeline, frame: pcdata.DepthFrame, offline: pcdata.Compose) -> None:
    """Hold a live cloud to the offline one, bit for bit."""
    answer = cloud_of(live(frame))
    expected = offline(frame)
    assert answer.history == expected.history
    assert answer.meta == expected.meta
    assert answer.fields().keys() == expected.fields().keys()
    for name, values in expected.fields().items():
        assert torch.equal(answer.fields()[name], values), f"{name} of {frame.sample_id} differs"


def cloud_of(answer: LiveResult) -> pcdata.PointCloud:
    assert answer.cloud is not None, f"{answer.fault}: {answer.reason}"
    return answer.cloud


def by_steps(steps: pcdata.Compose, frame: pcdata.DepthFrame, measured: Measured) -> None:
    """Run the chain once more and note what each pass took."""
    names = [type(step).__name__ for step in steps.steps]

    def now() -> tuple[float, float, float]:
        return time.perf_counter(), time.process_time(), core.seconds

    def after(positions: range, data: Any) -> None:
        nonlocal since
        wall, processor, within = (end - begin for end, begin in zip(now(), since))
        name = " + ".join(names[k] for k in positions)
        for taken, seconds in zip(measured.steps.setdefault(name, ([], [], [])), (wall, processor, processor - within)):
            taken.append(seconds)
        if name.endswith("CropWorkspace"):
            measured.points.append(data.num_points)
        since = now()

    with torch_on_one_thread(), torch.no_grad(), InCore() as core:
        since = now()
        steps.run_in_passes(frame, after=after)


def measure(frames: list[pcdata.DepthFrame], box: Box, count: int) -> Measured:
    """Answer frames live until ``count`` had two cores, or thrice as many; every eighth goes by single steps too."""
    measured, offline = Measured(), chain(box)
    for part in with_one_camera(frames):
        live = LivePipeline(chain(box), like=part[0], same_pixels=len(part) > 1)
        for frame in part:
            check_identical(live, frame, offline)
        share = -(-count * len(part) // len(frames))
        with core_probe() as cores:
            cores.look()
            for number, frame in zip(range(MOST_FRAMES * share), itertools.cycle(part)):
                if number >= share and sum(cores.had_own_cores()) >= share:
                    break
                processor = time.process_time()
                answer = live(frame)
                measured.processor.append(time.process_time() - processor)
                cloud_of(answer)
                measured.seconds.append(answer.seconds)
                cores.look()
                if number % 8 == 0:
                    by_steps(offline, frame, measured)
                    cores.look_again()
            measured.own_cores += cores.had_own_cores()
    return measured


def figures(seconds: list[float]) -> dict[str, float]:
    found = {f"p{share:g}_ms": 1000 * float(np.percentile(seconds, share)) for share in PERCENTILES}
    return found | {"worst_ms": 1000 * max(seconds)}


def summary(measured: Measured) -> dict[str, Any]:
    own = [seconds for seconds, had in zip(measured.seconds, measured.own_cores) if had]
    return {
        "frames": len(measured.seconds),
        "own_cores": {"frames": len(own), "wall": figures(own) if own else None},
        "points_after_crop": {"median": int(np.median(measured.points)), "most": max(measured.points)},
        "wall": figures(measured.seconds),
        "processor": figures(measured.processor),
        "steps": {
            name: {"wall": figures(wall), "processor": figures(processor), "around": figures(around)}
            for name, (wall, processor, around) in measured.steps.items()
        },
    }


# -- around the kernels ------------------------------------------------------------------------------------------------


def small_frames(size: tuple[int, int]) -> list[pcdata.DepthFrame]:
    scene = tabletop(0, noise="stereo", size=size, num_views=1)
    return [replace(scene.render(seed_noise=number), labels=None) for number in range(8)]


def small_chain() -> pcdata.Compose:
    return chain(SETS["synthetic"], radius=0.05, num_points=64)


def around_kernels(count: int) -> dict[str, float]:
    """The processor microseconds of each step of small frames, on one thread, that are not the core's: the median."""
    measured, before = Measured(), torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        steps = small_chain()
        for number, frame in zip(range(count), itertools.cycle(small_frames((48, 64)))):
            measured = Measured() if number == 10 else measured  # after those that warm up
            by_steps(steps, frame, measured)
    finally:
        torch.set_num_threads(before)
    return {name: 1e6 * float(np.median(around)) for name, (_, _, around) in measured.steps.items()}


# -- a camera thread ---------------------------------------------------------------------------------------------------

MAX_AGE = 0.1  # seconds that a frame may have lain when it is taken
STALL = 1.0  # seconds without an answer in which none is worked on


def keep_busy() -> None:
    while True:
        pass


def replay(frames: list[pcdata.DepthFrame], box: Box, rate: float, seconds: float) -> dict[str, Any]:
    """Replay frames at a rate beside a busy process; count what came, what was dropped, and that none came twice."""
    busy = multiprocessing.get_context("spawn").Process(target=keep_busy, daemon=True)
    busy.start()
    try:
        told = replay_beside(frames, box, rate, seconds)
        assert busy.is_alive(), "the second process ended, so nothing was busy beside"
        return told
    finally:
        busy.kill()
        busy.join()


def replay_beside(frames: list[pcdata.DepthFrame], box: Box, rate: float, seconds: float) -> dict[str, Any]:
    live = LivePipeline(chain(box), like=frames[0], same_pixels=False)  # a few frames again and again
    given: list[float] = []
    answers: list[LiveResult] = []
    moments = []
    with LatestFrame.reading(camera_at(frames, rate, seconds, given), timeout=STALL, max_age=MAX_AGE) as camera:
        for answer in live.follow(camera):
            answers.append(replace(answer, cloud=None))
            moments.append(time.monotonic())
            assert answer.fault is None, f"{answer.fault}: {answer.reason}"
    stamps = [answer.stamp or 0.0 for answer in answers]
    ages = [answer.age or 0.0 for answer in answers]
    lain = [age - answer.seconds for age, answer in zip(ages, answers)]
    gaps = np.diff(moments)
    waited = gaps - [answer.seconds for answer in answers[1:]]
    stats = live.stats()
    assert stamps == sorted(set(stamps)), "a frame was served twice, or after a newer one"
    assert waited.max() < STALL, "it stalled"
    assert camera.given == len(given) == stats.clouds + stats.dropped, "a frame was neither answered nor counted"
    return {
        "rate": rate,
        "seconds": seconds,
        "given": camera.given,
        "answered": stats.clouds,
        "dropped": stats.dropped,
        "faults": dict(stats.faults),
        "age": figures(ages),
        "age_when_taken": figures(lain),
        "between_answers": figures(gaps.tolist()),
    }


def camera_at(
    frames: list[pcdata.DepthFrame], rate: float, seconds: float, given: list[float]
) -> Callable[[], pcdata.DepthFrame]:
    """Return what gives the next frame when it is due, and notes when."""
    started = time.monotonic()

    def due() -> Iterator[pcdata.DepthFrame]:
        for number, frame in zip(range(int(rate * seconds)), itertools.cycle(frames)):
            time.sleep(max(0.0, started + number / rate - time.monotonic()))
            given.append(time.monotonic())
            yield frame

    return due().__next__


# -- memory -----------------------------------------------------------------------------------------------------------

# Bytes that may be in use more after 10,000 frames than after 100: torch keeps the Python objects of tensors to use
# them again, and their number rises, ever more slowly, to the most that were there at once. glibc keeps some small
# pieces for each thread too, which count as in use: it is measured without.
_KEPT_BY_TORCH = 64 << 10
# Resident memory that may be more: malloc cannot give pages back where small pieces lie between free ones. It grows
# ever more slowly, 3 MB on a machine so busy that threads seldom meet; an image a frame would be 190 MB.
_BETWEEN_PIECES = 4 << 20


_WITHOUT_KEPT_PIECES = {"GLIBC_TUNABLES": "glibc.malloc.tcache_count=0"}


def memory_apart(quick: bool) -> dict[str, dict[str, int]]:
    """Look at the memory of a process of its own."""
    command = [sys.executable, __file__, "--memory", *(["--quick"] if quick else [])]
    done = subprocess.run(command, env=os.environ | _WITHOUT_KEPT_PIECES, stdout=subprocess.PIPE, text=True, check=True)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def memory(quick: bool) -> dict[str, dict[str, int]]:
    """Bytes in use and resident after 104 small frames, after half, and after many; none may be one of a frame."""
    some = small_frames((60, 80))
    live = LivePipeline(small_chain(), like=some[0])
    found: dict[str, dict[str, int]] = {}
    count = 400 if quick else 10_000
    for number, frame in zip(range(1, count + 1), itertools.cycle(some)):
        cloud_of(live(frame))
        if number in (96, 104, count // 2, count):
            gc.collect()
            found[f"after_{number}"] = {
                "in_use": bytes_in_use(),
                "resident": resident(),
                "objects": len(gc.get_objects()),
            }
    del found["after_96"]  # to look takes memory too, once
    early, half, late = found.values()
    more = {name: late[name] - early[name] for name in early}
    assert more["in_use"] < _KEPT_BY_TORCH, f"{more['in_use']} bytes more are in use after {count} frames"
    assert more["resident"] < _BETWEEN_PIECES, f"{more['resident']} bytes more are resident after {count} frames"
    assert more["objects"] <= 8, f"{more['objects']} Python objects more are there after {count} frames"
    if not quick:  # what is left to be kept is kept in the first half
        assert late["in_use"] - half["in_use"] < _KEPT_BY_TORCH / 8, "memory in use still grows"
    return found


def resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def bytes_in_use() -> int:
    """Bytes that glibc's malloc has given out and not got back, in all of its arenas."""
    libc = ctypes.CDLL(None)
    libc.fopen.restype = ctypes.c_void_p
    with tempfile.NamedTemporaryFile("r") as file:
        stream = ctypes.c_void_p(libc.fopen(file.name.encode(), b"w"))
        libc.malloc_info(0, stream)
        libc.fclose(stream)
        told = file.read()
    told = told[told.rindex("</heap>") :]
    sizes = dict(re.findall(r'type="(\w+)"(?: count="\d+")? size="(\d+)"', told))
    return int(sizes["current"]) - int(sizes["fast"]) - int(sizes["rest"]) + int(sizes["mmap"])


# -- telling -----------------------------------------------------------------------------------------------------------


def tell(name: str, told: dict[str, Any]) -> None:
    keys = [f"p{share:g}" for share in PERCENTILES] + ["worst"]
    rows = [
        [label, *(f"{values[f'{key}_ms']:.2f}" for key in keys)]
        for label, values in [("whole", told["wall"]), ("whole, processor", told["processor"])]
    ]
    for step, values in told["steps"].items():
        rows.append([step, *(f"{values['wall'][f'{key}_ms']:.2f}" for key in keys)])
        rows.append(["  processor", *(f"{values['processor'][f'{key}_ms']:.2f}" for key in keys)])
        rows.append(["  around", *(f"{values['around'][f'{key}_ms']:.2f}" for key in keys)])
    own = told["own_cores"]
    if own["wall"] is not None:
        whole = [f"{own['wall'][f'{key}_ms']:.2f}" for key in keys]
        rows.insert(1, [f"  of these, {own['frames']} on two cores", *whole])
    points = told["points_after_crop"]
    print(f"{name}: {told['frames']} frames, {points['median']} points after the crop ({points['most']} at most)")
    print(text_table(["ms", *keys], rows), "\n")


def picture(sets: dict[str, Measured]) -> str:
    """Return an SVG: how many frames took how long, a band for each set, with the limits of 60 and 90 Hz."""
    width, height, left, top = 720, 110, 70, 26
    longest = max(1.25 * BAR, *(float(np.percentile(one.seconds, 99.9)) for one in sets.values()))
    bins = np.linspace(0, longest, 121)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{left + width + 20}" '
        f'height="{top + height * len(sets) + 34}" font-family="sans-serif" font-size="12">',
        '<rect width="100%" height="100%" fill="white"/>',
    ]
    for row, (name, measured) in enumerate(sets.items()):
        counts, _ = np.histogram(np.minimum(measured.seconds, longest * 0.9999), bins)
        base = top + height * (row + 1)
        parts.append(f'<text x="6" y="{base - 4}">{name}</text>')
        parts.append(f'<line x1="{left}" x2="{left + width}" y1="{base}" y2="{base}" stroke="#999"/>')
        for at, count in zip(bins, counts):
            if count:
                tall = (height - 14) * count / counts.max()
                x = left + width * at / longest
                parts.append(
                    f'<rect x="{x:.1f}" y="{base - tall:.1f}" width="{width / 120:.1f}" height="{tall:.1f}" '
                    'fill="#4477aa"/>'
                )
    bottom = top + height * len(sets)
    for label, seconds in (("60 Hz", BAR), ("90 Hz", STRETCH)):
        x = left + width * seconds / longest
        parts.append(f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{top - 6}" y2="{bottom}" stroke="#cc3311"/>')
        parts.append(f'<text x="{x:.1f}" y="{top - 10}" text-anchor="middle" fill="#cc3311">{label}</text>')
    for ms in np.arange(0, 1000 * longest, 5 if longest < 0.06 else 50):
        x = left + width * ms / 1000 / longest
        parts.append(f'<text x="{x:.1f}" y="{bottom + 16}" text-anchor="middle">{ms:g}</text>')
    parts.append(f'<text x="{left + width}" y="{bottom + 30}" text-anchor="end">milliseconds per frame</text></svg>')
    return "\n".join(parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=2000, help="of all sets together")
    parser.add_argument("--quick", action="store_true", help="60 frames; nothing is kept")
    parser.add_argument("--memory", action="store_true", help="look at the memory alone")
    parser.add_argument("--camera", type=float, nargs="*", default=None, metavar="HZ", help="replay at these rates")
    parser.add_argument("--seconds", type=float, default=60.0, help="of each replay")
    parser.add_argument("--out", type=Path, default=RESULTS / "live.json", help="where JSON and picture go")
    arguments = parser.parse_args()
    if arguments.memory:
        print(json.dumps(memory(arguments.quick)))
        return
    found = frames(arguments.quick)
    count = 60 if arguments.quick else arguments.frames
    result: dict[str, Any] = facts([]) | {"size": SIZE, "boxes": {name: SETS[name] for name in found}, "sets": {}}
    sets: dict[str, Measured] = {}
    for name, own in found.items():
        sets[name] = measure(own, SETS[name], -(-count // len(found)))
        result["sets"][name] = summary(sets[name])
        tell(name, result["sets"][name])
    everything = Measured()
    for one in sets.values():
        everything.add(one)
    result["all"] = summary(everything)
    tell("all", result["all"])
    p99 = result["all"]["wall"]["p99_ms"]
    print(f"p99 {p99:.2f} ms; 60 Hz wants {1000 * BAR:.1f}, 90 Hz {1000 * STRETCH:.1f}; identical to offline: yes")
    result["around_us"] = around_kernels(40 if arguments.quick else 400)
    print("around the kernels, microseconds", {name: round(own) for name, own in result["around_us"].items()})
    result["memory"] = memory_apart(arguments.quick)
    print("memory", result["memory"])
    for rate in arguments.camera or ():
        name = next(iter(found))
        told = replay(with_one_camera(found[name])[0], SETS[name], rate, arguments.seconds)
        result.setdefault("camera", []).append(told)
        print(told)
    if not arguments.quick:
        arguments.out.write_text(json.dumps(result, indent=1) + "\n")
        arguments.out.with_suffix(".svg").write_text(picture(sets) + "\n")


if __name__ == "__main__":
    main()
