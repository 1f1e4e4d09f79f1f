"""Time and check fusion: on rendered tables against the truth, on hand-held frames of a room against Open3D.

    PCDATA_TEST_DATA=... python benchmarks/fusion.py --legacy-python PYTHON    # results/fusion.json and docs/fusion.md
    python benchmarks/fusion.py --kept                                         # the page's tables from the kept results

Method: every row is a process of its own (benchmarks/fusion_frames.py) with one thread or two. In it the libraries
integrate the same frames in turn, frame by frame, and medians over the frames are kept. With one thread the clock is
the CPU time of the process: the time on a core of one's own, whatever else the machine does. With two it is the wall
clock, worth as much as the machine is quiet. Memory is watched in further processes in which one library works alone.
``--legacy-python`` names an interpreter with Open3D 0.19, whose ScalableTSDFVolume is then timed on the first ten
frames (it takes 7 GB for those); that of release 0.20 integrates nothing. At 2 mm all this needs some 16 GB of memory.
Open3D's tensor grid takes its memory before the clock starts, and so does pcdata here (TSDFVolume.reserve), but in the
rows "growing"; no other row of memory or of the legacy volume has it beforehand.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from fusion_page import GROWING, tables, update_page
from fusion_truth import truth_rows, workspace_rate

import pcdata

RESULT = Path(__file__).parent / "results" / "fusion.json"
VOXELS = (0.005, 0.002)
# Voxel and truncation: 5 voxels is pcdata's, 8 Open3D's unless it is told another (at 2 mm that takes 20 GB of memory).
LENGTHS = ((0.005, 5), (0.005, 8), (0.002, 5))
_LEGACY_FRAMES = 10
_FEW_FRAMES = 10  # gone over twice


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=50)
    parser.add_argument("--skip-open3d", action="store_true", help="measure against the truth alone; keep the rest")
    parser.add_argument("--skip-truth", action="store_true", help="measure against Open3D alone; keep the rest")
    parser.add_argument("--legacy-python", help="an interpreter with Open3D 0.19")
    parser.add_argument("--kept", action="store_true", help="measure nothing; write the page from the kept results")
    arguments = parser.parse_args()
    result: dict[str, Any] = json.loads(RESULT.read_text()) if RESULT.exists() else {}
    if not arguments.kept:
        torch.set_num_threads(1)
        packages = {name: version(name) for name in ("torch", "open3d")}
        result |= {"machine": machine(), "versions": {"pcdata": pcdata.__version__, **packages}}
        if not arguments.skip_truth:
            result |= {"truth": truth_rows(), "workspace": workspace_rate()}
        if "PCDATA_TEST_DATA" in os.environ and not arguments.skip_open3d:
            result["recording"] = [tensor(*lengths, arguments.frames) for lengths in LENGTHS]
            if arguments.legacy_python is not None:
                result["legacy"] = [legacy(voxel, arguments.legacy_python) for voxel in VOXELS]
        RESULT.write_text(json.dumps(result, indent=1) + "\n")
    update_page(result)
    for name, table in tables(result).items():
        print(f"\n{name}\n{table}", end="")


def machine() -> dict[str, Any]:
    load = os.getloadavg()[0]  # beyond 1, others were at work and the wall clock is theirs too
    return {"cores": os.cpu_count(), "processor": platform.processor() or platform.machine(), "load": load}


def tensor(voxel_size: float, multiple: float, frames: int) -> dict[str, Any]:
    """Times, memory and agreement of pcdata and Open3D's tensor grid on the frames of a room."""
    lengths = ["--voxel-size", str(voxel_size), "--multiple", str(multiple), "--frames", str(frames)]
    names = ["pcdata", GROWING, "pcdata, no carving", "Open3D tensor"]
    found = run(1, names, *lengths, "--reserve", "--agreement")
    found["two threads"] = run(2, names, *lengths, "--reserve")["libraries"]
    names.remove(GROWING)  # as all do where memory is watched
    found["memory"] = {name: run(1, [name], *lengths, "--memory")["libraries"][name] for name in names}
    few = [*lengths[:-1], str(_FEW_FRAMES), "--again"]
    found["again"] = {str(threads): run(threads, ["pcdata", "Open3D tensor"], *few)["libraries"] for threads in (1, 2)}
    return found


def legacy(voxel_size: float, python: str) -> dict[str, Any]:
    """Times and memory of pcdata and Open3D's legacy volume."""
    lengths = ["--voxel-size", str(voxel_size), "--frames", str(_LEGACY_FRAMES), "--legacy-python", python]
    names = ["pcdata", "Open3D legacy"]
    found = run(1, names, *lengths)
    found["two threads"] = run(2, names, *lengths)["libraries"]
    alone = run(1, ["pcdata"], *lengths, "--memory")["libraries"]
    found["memory"] = {**alone, "Open3D legacy": found["libraries"]["Open3D legacy"]}
    return found


def run(threads: int, libraries: list[str], *options: str) -> dict[str, Any]:
    """Measure in a process of its own."""
    command = [sys.executable, str(Path(__file__).with_name("fusion_frames.py")), "--libraries", *libraries, *options]
    environment = {**os.environ, "OMP_NUM_THREADS": str(threads)}
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    (line,) = (line for line in done.stdout.splitlines() if line.startswith("{"))
    print(line, flush=True)
    return dict(json.loads(line))


if __name__ == "__main__":
    main()
