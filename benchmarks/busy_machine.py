"""Commands on a machine with other work: `pcdata demo` and `pcdata validate` alone and beside busy loops, one a core.

    python benchmarks/busy_machine.py [--runs 3] [--json benchmarks/results/busy_machine.json]

Each command runs in a process of its own, quiet and busy by turns; the medians count. Exit code 1 when a command takes
more than three times its quiet time: half the time is what two loops on two cores leave a command that wants both.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import Image

AT_MOST = 3.0  # times the quiet time


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=3, help="runs of each command, quiet and busy (default: 3)")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    arguments = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        captures = write_captures(Path(scratch) / "captures")
        commands = {
            "demo": ["demo", f"{scratch}/demo"],
            "validate, 4 captures of 640x480": ["validate", str(captures)],
        }
        for name, command in commands.items():
            run(command)  # files and bytecode come into memory
            quiet, busy = [], []
            for _ in range(arguments.runs):
                quiet.append(run(command))
                with busy_loops(os.cpu_count() or 1):
                    busy.append(run(command))
            row = {"command": name, "quiet_s": statistics.median(quiet), "busy_s": statistics.median(busy)}
            row["ratio"] = row["busy_s"] / row["quiet_s"]
            rows.append(row)
            print(
                f"{name:34s} quiet {row['quiet_s']:6.2f} s  busy {row['busy_s']:6.2f} s  {row['ratio']:.2f}x",
                flush=True,
            )
    if arguments.json:
        about = {"cores": os.cpu_count(), "machine": platform.machine(), "python": platform.python_version()}
        arguments.json.write_text(json.dumps({"about": about, "runs": arguments.runs, "rows": rows}, indent=2) + "\n")
    return int(any(row["ratio"] > AT_MOST for row in rows))


def run(command: list[str]) -> float:
    """Seconds that a command takes; a folder that it made is removed."""
    start = time.perf_counter()
    done = subprocess.run([sys.executable, "-m", "pcdata", *command], capture_output=True, text=True, check=False)
    seconds = time.perf_counter() - start
    if done.returncode not in (0, 1):  # 1: the captures are judged, which is no matter here
        raise SystemExit(f"{command}: exit code {done.returncode}\n{done.stderr}")
    if command[0] == "demo":
        shutil.rmtree(command[1])
    return seconds


@contextmanager
def busy_loops(count: int) -> Iterator[None]:
    """Keep ``count`` processes computing."""
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        time.sleep(0.5)
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


def write_captures(folder: Path) -> Path:
    """Write four noisy depth images of a box on a table, as a plain capture folder."""
    (folder / "depth").mkdir(parents=True)
    rng = np.random.default_rng(0)
    for number in range(4):
        depth = np.full((480, 640), 800.0) + rng.normal(0, 1, (480, 640))
        depth[160:320, 200 + 10 * number : 420] = 650 + rng.normal(0, 1, (160, 220 - 10 * number))
        depth[rng.random(depth.shape) < 0.02] = 0
        Image.fromarray(np.rint(depth).astype(np.uint16)).save(folder / "depth" / f"{number:04d}.png")
    stated = {"width": 640, "height": 480, "fx": 600, "fy": 600, "cx": 319.5, "cy": 239.5, "metres_per_unit": 0.001}
    (folder / "intrinsics.json").write_text(json.dumps(stated))
    return folder


if __name__ == "__main__":
    raise SystemExit(main())
