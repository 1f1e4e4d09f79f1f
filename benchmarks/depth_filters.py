"""Time every depth filter on one thread on a 1280x720 frame, next to OpenCV's nearest operator in the same run.

And the chain of four over a stream, with one thread and with one per core: percentiles of the time on the clock, which
other work on the machine lengthens, and of the processor's.

    PCDATA_TEST_DATA=... python benchmarks/depth_filters.py     # prints the table, writes results/depth_filters.json

Method: ours and OpenCV's run in turn; each runs once to warm up, then ``--repeats`` times, a peer that takes longer
than a second only once. Medians and interquartile ranges of the process's CPU time are kept: with one thread that is
the time on a core of one's own, whatever else the machine does. OpenCV has no operator with the same result for most
filters, so each row says what differs. A camera gives 30 frames a second, so 33 ms is what a filter may take.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from timing import RESULTS, in_turn, spread

import pcdata
from pcdata import functional as F
from pcdata.geometry import rigid
from pcdata.live import LiveTemporalFilter
from pcdata.report import text_table
from pcdata.structures import Camera, DepthFrame
from pcdata.synthetic import tabletop

SIZE = (720, 1280)
BUDGET_MS = 1000 / 30
_WARM_UP = 50  # frames
_ONCE_AFTER = 1.0  # seconds: slower peers are timed once


@dataclass
class Case:
    filter: str
    ours: Callable[[], Any]
    peer: str
    theirs: Callable[[], Any]
    differs: str  # what the peer does otherwise
    frames: int = 1  # that one call consumes


@dataclass
class Row:
    filter: str
    pcdata_ms: float  # per frame
    pcdata_iqr_ms: float
    frames_per_second: float
    peer: str
    peer_ms: float
    peer_iqr_ms: float
    differs: str


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--only", default="", help="run only filters whose name contains this")
    parser.add_argument("--frames", type=int, default=2000, help="of each stream")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    frame, name = load_frame()
    rows = []
    for case in cases(frame):
        if arguments.only in case.filter:
            rows.append(measure(case, arguments.repeats))
            print(f"{rows[-1].filter}: {rows[-1].pcdata_ms:.1f} ms", flush=True)
    header = ["filter", "ms per frame", "frames/s", "OpenCV", "ms", "what differs"]
    table = [
        [r.filter, f"{r.pcdata_ms:.1f}", f"{r.frames_per_second:.0f}", r.peer, f"{r.peer_ms:.1f}", r.differs]
        for r in rows
    ]
    print(text_table(header, table))
    streams = [] if arguments.only else list(stream_rows(frame, arguments.frames))
    slow = [row.filter for row in rows if row.pcdata_ms > BUDGET_MS]
    print(f"slower than 30 frames a second: {', '.join(slow) or 'none'}")
    if not arguments.only:
        write(rows, streams, name, arguments.repeats)


def load_frame() -> tuple[DepthFrame, str]:
    """A real frame with a tenth of holes, or a rendered one where no captures are at hand."""
    folder = os.environ.get("PCDATA_TEST_DATA")
    if folder:
        frame = pcdata.open_source(Path(folder) / "graspnet_frame").load("graspnet_frame")
        return frame, "graspnet_frame"
    camera = Camera.pinhole(fx=630.0, fy=630.0, cx=640.0, cy=360.0, size=SIZE)
    return tabletop(0, noise="stereo", camera=camera).frame, "tabletop"


def cases(frame: DepthFrame) -> Iterator[Case]:
    depth, focal = frame.depth, frame.camera.intrinsics[:, 0, 0]
    image = depth[0].numpy()
    holes = (image == 0).astype(np.uint8)
    disparity = F.depth_to_disparity(depth, focal, 0.05)
    noise = torch.Generator().manual_seed(0)
    many = torch.where(depth > 0, depth + 0.001 * torch.randn((10, *depth.shape), generator=noise), 0.0)
    stack = many[:, 0].numpy()

    yield Case(
        "average of 10 frames", lambda: F.average_depth(many), "numpy.median", lambda: np.median(stack, axis=0),
        "holes count as 0, no variance, no jitter count", frames=10,
    )  # fmt: skip
    for factor in (2, 4, 8):
        size = (SIZE[1] // factor, SIZE[0] // factor)
        yield Case(
            f"decimate by {factor}", lambda factor=factor: F.decimate_depth(depth, factor=factor), "resize INTER_AREA",
            lambda size=size: cv2.resize(image, size, interpolation=cv2.INTER_AREA), "blends edges and holes",
        )  # fmt: skip
    yield Case(
        "resize to 848x480, nearest", lambda: F.resize_depth(depth, size=(480, 848)), "resize INTER_NEAREST_EXACT",
        lambda: cv2.resize(image, (848, 480), interpolation=cv2.INTER_NEAREST_EXACT), "the same result",
    )  # fmt: skip
    yield Case(
        "resize to 848x480, on surfaces", lambda: F.resize_depth(depth, size=(480, 848), max_jump=0.02),
        "resize INTER_LINEAR", lambda: cv2.resize(image, (848, 480)), "blends edges and holes",
    )  # fmt: skip
    yield Case(
        "depth to disparity and back",
        lambda: F.disparity_to_depth(F.depth_to_disparity(depth, focal, 0.05), focal, 0.05),
        "divide, twice", lambda: cv2.divide(1.0, cv2.divide(1.0, image)), "no checks",
    )  # fmt: skip
    yield Case(
        "spatial filter, 2 iterations", lambda: F.spatial_filter(disparity), "bilateralFilter 5 x 5",
        lambda: cv2.bilateralFilter(disparity[0].numpy(), 5, 20.0, 3.0), "a smaller window, holes blend in",
    )  # fmt: skip
    for reach in (1, 2):
        side = 2 * reach + 1
        yield Case(
            f"median filter {side} x {side}", lambda reach=reach: F.median_filter(depth, reach=reach),
            f"medianBlur {side} x {side}", lambda side=side: cv2.medianBlur(image, side), "holes count as 0",
        )  # fmt: skip
    yield Case(
        "bilateral filter 5 x 5", lambda: F.bilateral_filter(depth), "bilateralFilter 5 x 5",
        lambda: cv2.bilateralFilter(image, 5, 0.01, 1.5), "a round window, a table of weights, holes blend in",
    )  # fmt: skip
    _, state = F.temporal_filter(disparity)
    average = disparity[0].numpy().copy()
    yield Case(
        "temporal filter", lambda: F.temporal_filter(disparity, state), "accumulateWeighted",
        lambda: cv2.accumulateWeighted(disparity[0].numpy(), average, 0.4), "no edges, no holes, no persistence",
    )  # fmt: skip
    for rule in ("left", "farthest", "nearest"):
        yield Case(
            f"fill holes, {rule}", lambda rule=rule: F.fill_holes(depth, rule=rule), "inpaint Navier-Stokes",
            lambda: cv2.inpaint(image, holes, 3, cv2.INPAINT_NS), "continues surfaces smoothly",
        )  # fmt: skip
    yield Case(
        "flying pixels", lambda: F.flying_pixel_mask(depth), "medianBlur 3 x 3 and compare",
        lambda: np.abs(cv2.medianBlur(image, 3) - image) > 0.02 * image, "another rule",
    )  # fmt: skip
    for size in (SIZE, (480, 640)):
        yield chain_case(frame if size == SIZE else pcdata.ResizeDepth(size=size)(frame))
    yield from registration_cases(frame)


def chain_case(frame: DepthFrame) -> Case:
    """Return flying pixels, spatial and temporal filter and holes, one after another, as a live stream has them."""
    steps = pcdata.RemoveFlyingPixels(), pcdata.SpatialFilterDepth(), LiveTemporalFilter(), pcdata.FillHoles()
    image = frame.depth[0].numpy()
    holes, average = (image == 0).astype(np.uint8), image.copy()

    def ours() -> DepthFrame:
        filtered = frame
        for step in steps:
            filtered = step(filtered)
        return filtered

    def theirs() -> Any:
        smooth = cv2.bilateralFilter(cv2.medianBlur(image, 3), 5, 0.01, 1.5)
        cv2.accumulateWeighted(smooth, average, 0.4)
        return cv2.inpaint(average, holes, 3, cv2.INPAINT_NS)

    name = f"the chain of four at {image.shape[1]}x{image.shape[0]}"
    peer = "medianBlur, bilateralFilter, accumulateWeighted, inpaint"
    return Case(name, ours, peer, theirs, "other filters of the same kinds")


def registration_cases(frame: DepthFrame) -> Iterator[Case]:
    turn = rigid.rotation_about_axis(torch.tensor([0.0, 0.0, 1.0]), torch.tensor(0.01))
    color_from_depth = rigid.from_rotation_translation(turn, torch.tensor([-0.025, 0.0, 0.0]))[None]
    depth, k = frame.depth, frame.camera.intrinsics
    grid = np.meshgrid(np.arange(SIZE[1], dtype=np.float32) - 20, np.arange(SIZE[0], dtype=np.float32))
    for size in (SIZE, (1080, 1920)):
        color = frame.camera.resized(size).intrinsics
        yield Case(
            f"register to {size[1]}x{size[0]} color",
            lambda size=size, color=color: F.register_depth(depth, k, color, color_from_depth, color_size=size),
            "remap INTER_NEAREST", lambda: cv2.remap(depth[0].numpy(), *grid, cv2.INTER_NEAREST),
            "a fixed map: no projection, no z-buffer",
        )  # fmt: skip


def measure(case: Case, repeats: int) -> Row:
    case.ours()
    timed(case.theirs, first := [])
    ours, theirs = in_turn(case, repeats, timed, first, once_after=_ONCE_AFTER)
    mine = 1000 * statistics.median(ours) / case.frames
    other = 1000 * statistics.median(theirs) / case.frames
    spreads = (spread(seconds) / case.frames for seconds in (ours, theirs))
    my_spread, other_spread = spreads
    return Row(case.filter, mine, my_spread, 1000 / mine, case.peer, other, other_spread, case.differs)


def timed(body: Callable[[], Any], seconds: list[float]) -> None:
    started = time.process_time()
    body()
    seconds.append(time.process_time() - started)


@dataclass
class StreamRow:
    chain: str
    threads: int
    frames: int
    p50_ms: float  # on the clock
    p99_ms: float
    processor_p50_ms: float  # of all threads
    processor_p99_ms: float


def stream_rows(frame: DepthFrame, count: int) -> Iterator[StreamRow]:
    """Send a frame through the chain again and again, as a camera would."""
    for threads in dict.fromkeys((1, os.cpu_count() or 1)):
        torch.set_num_threads(threads)
        for size in (SIZE, (480, 640)):
            case = chain_case(frame if size == SIZE else pcdata.ResizeDepth(size=size)(frame))
            clock, processor = [], []
            for _ in range(count + _WARM_UP):
                started = time.perf_counter()
                timed(case.ours, processor)
                clock.append(time.perf_counter() - started)
            found = [
                1000 * float(np.percentile(seconds[_WARM_UP:], percent))
                for seconds in (clock, processor)
                for percent in (50, 99)
            ]
            row = StreamRow(case.filter, threads, count, *found)
            print(f"{row.chain}, {threads} threads: p50 {row.p50_ms:.1f} ms, p99 {row.p99_ms:.1f} ms", flush=True)
            yield row
    torch.set_num_threads(1)


def write(rows: list[Row], streams: list[StreamRow], name: str, repeats: int) -> None:
    result = {
        "frame": name,
        "repeats": repeats,
        "clock": "CPU time of the process",
        "machine": {"cores": os.cpu_count(), "threads": torch.get_num_threads(), "processor": platform.machine()},
        "versions": {"pcdata": pcdata.__version__, "torch": torch.__version__, "opencv": cv2.__version__},
        "rows": [asdict(row) for row in rows],
        "streams": [asdict(row) for row in streams],
    }
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "depth_filters.json").write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
