"""Time operations against their peers in one run, check that the results are equal, and try 10,000 small clouds.

    OMP_NUM_THREADS=2 python benchmarks/operations.py       # options; writes results/operations.json and docs/speed.md
    PCDATA_TEST_DATA=... python benchmarks/operations.py --frame    # the README's; writes results/operations_*.json
    python benchmarks/operations.py --only fisheye --processor  # those rows alone, in time of the processor
    python benchmarks/operations.py --kept                      # prints the kept results of --frame as in the README

Method: see ``timing.py``; on a machine that others use, seconds of the processor (``--processor``) say more.
The options run on synthetic clouds (or parts of the real tabletop frame where PCDATA_TEST_DATA names it), so that the
whole takes less than three minutes. Peers that are not installed are left out and named. ``ragged`` tells how long
10,000 clouds of 50 points take in one call, and one cloud of the same 500,000 points: a loop over clouds in Python, or
in torch, would show as a large quotient.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from operation_cases import frame, images, neighbors, points, ragged
from operation_cases.page import PAGE, page, table
from timing import RESULTS, Case, Row, facts, measure, processor_time, timed

import pcdata
from pcdata.report import text_table

PEERS = ("open3d", "fpsample", "scipy", "sklearn", "cv2", "kornia", "torch_cluster", "pytorch3d")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--only", default="", help="run only operations whose name contains this; nothing is kept")
    parser.add_argument("--processor", action="store_true", help="count processor time, all threads; nothing is kept")
    parser.add_argument("--frame", action="store_true", help="time the operations of the README on a whole frame")
    parser.add_argument("--kept", action="store_true", help="measure nothing; print the kept results of --frame")
    arguments = parser.parse_args()
    if arguments.kept:
        return print(table(json.loads((RESULTS / "operations_graspnet_frame.json").read_text())["rows"]))
    cloud, name = load_cloud()
    rows = []
    for case in frame.cases(cloud) if arguments.frame else option_cases(cloud):
        if arguments.only in case.operation:
            rows.append(measure(case, arguments.repeats, processor_time if arguments.processor else timed))
            print(line(rows[-1]), flush=True)
    header = ["operation", "points", "pcdata ms", "peer", "peer ms", "ratio", "results"]
    cells = [
        [r.operation, r.points, f"{r.pcdata_ms:.1f}", r.peer, f"{r.peer_ms:.1f}", f"{r.ratio:.1f}x", r.results]
        for r in rows
    ]
    print("\n" + text_table(header, cells))
    result = {"frame": name, "repeats": arguments.repeats}
    result |= facts(frame.PEERS if arguments.frame else PEERS) | {"rows": [asdict(row) for row in rows]}
    if not arguments.frame and not arguments.processor:
        result["ragged"] = ragged.rows(arguments.only)
    if not arguments.only and not arguments.processor:
        RESULTS.mkdir(exist_ok=True)
        kept = RESULTS / (f"operations_{name}.json" if arguments.frame else "operations.json")
        kept.write_text(json.dumps(result, indent=1) + "\n")
        if not arguments.frame:
            PAGE.write_text(page(result), encoding="utf-8")


def option_cases(cloud: pcdata.PointCloud) -> Iterator[Case]:
    """The options of all operations, each beside the peers that are installed."""
    yield from points.cases(cloud)
    yield from neighbors.cases(cloud)
    yield from images.cases(cloud)


def load_cloud() -> tuple[pcdata.PointCloud, str]:
    """The real tabletop frame where it is at hand, else a synthetic one; all its valid pixels."""
    folder = os.environ.get("PCDATA_TEST_DATA")
    if folder:
        source = pcdata.open_source(Path(folder) / "graspnet_frame")
        return pcdata.Deproject()(source.load(source.ids[0])), "graspnet_frame"
    from pcdata.synthetic import tabletop

    return pcdata.Deproject()(tabletop(0, noise="stereo", size=(720, 1280)).frame), "synthetic"


def line(row: Row) -> str:
    return (
        f"{row.operation} ({row.points:,}): {row.pcdata_ms:.1f} ms, {row.peer} {row.peer_ms:.1f} ms, {row.ratio:.1f}x"
        f" ({row.results})"
    )


if __name__ == "__main__":
    main()
