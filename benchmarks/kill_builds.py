"""Stop a build of 200 synthetic captures at random moments, let it go on, and compare it with an undisturbed one.

    python benchmarks/kill_builds.py [--seed 0] [--stops 50] [--start spawn]    # results/kill_builds_fork.json

Ways, in turn: SIGKILL of a worker; of the parent, with and without workers; a disk that is full (RLIMIT_FSIZE); an
exception in the middle; no memory (RLIMIT_AS). Each stop hits a build that goes on from the stop before, so that most
builds are stopped several times. A build that ends is compared byte for byte, card and all, and the next one begins
anew. Before that, this process, workers, three parts and, where it is installed, Ray must give the same bytes.

Builds are forks of one process that has loaded torch, and so are their workers, unless ``--start spawn`` is given.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import json
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pcdata.build import build_dataset, config_from_yaml
from pcdata.build.engines import pool
from pcdata.files.scratch import living_claims
from pcdata.structures import DepthFrame
from pcdata.synthetic import SyntheticSource

RESULTS = Path(__file__).parent / "results"
CONFIG = """
depth: [MaskDepth: {near: 0.1, far: 3.0}, Deproject]
cloud: [ToFrame: {frame: base}, FarthestPointSample: {num_points: 64, if_short: repeat}]
output: {format: packed, shard_size: 4}
"""
CAPTURES = 200
WAYS = ("worker", "parent of workers", "parent", "disk", "exception", "memory")
WORKERS = {"worker": 2, "parent of workers": 2, "parent": 0, "disk": 2, "exception": 0, "memory": 0}
LOADED, SPARE = 1 << 26, 1 << 22  # bytes of memory that a capture takes while it is loaded, and that are left


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--stops", type=int, default=50)
    parser.add_argument("--start", choices=("fork", "spawn"), default="fork", help="of workers")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    pool.START = arguments.start
    draw, source = random.Random(arguments.seed), Rendered(CAPTURES)
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        seconds = {way: undisturbed(source, work, way) for way in WAYS[:3]}
        whole = tree(work / "whole")
        assert {"README.md", "croissant.json", "dataset.json"} <= {*whole}
        engines = other_engines(source, work)
        assert all(tree(path) == whole for path in work.iterdir())
        for number in range(arguments.stops):
            way = WAYS[number % len(WAYS)]
            usual = seconds["parent" if not WORKERS[way] else "worker"]
            rows.append(stop(source, work, way, draw.uniform(0.05, 0.6) * usual, draw))
            print(f"{number:3} {rows[-1]}", flush=True)
            if rows[-1]["outcome"] == "done":
                rows[-1]["same"] = tree(work / "out") == whole
                shutil.rmtree(work / "out")
        pid = started(source, work, "parent", draw, with_fault=False)
        assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0, (work / "said").read_text()
        last = tree(work / "out") == whole
        left = sorted(path.name for path in work.iterdir() if path.name.startswith(".out"))
    counts = Counter((row["way"], row["outcome"]) for row in rows)
    result = {
        "captures": CAPTURES,
        "stops": len(rows),
        "seed": arguments.seed,
        "start": arguments.start,
        "same_bytes": ["this process", "2 workers", *engines],
        "outcomes": [{"way": way, "outcome": what, "count": count} for (way, what), count in sorted(counts.items())],
        "compared": sum("same" in row for row in rows) + 1,
        "different": sum(not row.get("same", True) for row in rows) + (not last),
        "left_behind": left,
    }
    (RESULTS / f"kill_builds_{arguments.start}.json").write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result, indent=1))
    sys.exit(bool(result["different"] or left))


def undisturbed(source: Rendered, work: Path, way: str) -> float:
    """Build without a fault, as a way does; return the seconds."""
    begun = time.perf_counter()
    build_dataset(config_from_yaml(CONFIG), source, work / f"whole {way}", workers=WORKERS[way])
    if way == "parent":
        shutil.copytree(work / f"whole {way}", work / "whole")
    return time.perf_counter() - begun


def other_engines(source: Rendered, work: Path) -> list[str]:
    """Build in three parts, and with Ray where it is installed; return what was done."""
    config = config_from_yaml(CONFIG)
    for part in range(3):
        build_dataset(config, source, work / "whole parts", part=(part, 3))
    if importlib.util.find_spec("ray") is None:
        return ["3 parts"]
    build_dataset(config, source, work / "whole ray", engine="ray", workers=2)
    return ["3 parts", "Ray, 2 tasks"]


class Rendered:
    """Synthetic captures that are rendered once; each takes a while to load, and memory."""

    def __init__(self, captures: int) -> None:
        scenes = SyntheticSource(num_scenes=captures, num_objects=1, size=(24, 32))
        self.ids = scenes.ids
        self.frames = {sample_id: scenes.load(sample_id) for sample_id in scenes.ids}

    def __len__(self) -> int:
        return len(self.ids)

    def load(self, sample_id: str) -> DepthFrame:
        """Return one capture."""
        np.empty(LOADED, np.uint8)
        return self.frames[sample_id]


def stop(source: Rendered, work: Path, way: str, delay: float, draw: random.Random) -> dict[str, Any]:
    """Let a build begin or go on, disturb it, and say what came of it."""
    before = records(work)
    pid = started(source, work, way, draw)
    time.sleep(delay)
    with suppress(ProcessLookupError, IndexError, FileNotFoundError):  # it has ended, or has no worker now
        disturb(pid, way, draw)
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    while living_claims(work / ".out.building" / "claims"):
        time.sleep(0.02)  # forked workers hold the lock of their parent, until they find that it is gone
    outcome = {0: "done", 3: "done, some quarantined"}.get(code, "stopped")
    if code == 3:  # as it must be where the machine failed; nothing to compare
        shutil.rmtree(work / "out")
    return {"way": way, "at": round(delay, 2), "outcome": outcome, "code": code, "found": before, "kept": records(work)}


def disturb(pid: int, way: str, draw: random.Random) -> None:
    if way == "worker":
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        os.kill(int(draw.choice(children)), signal.SIGKILL)
    elif way.startswith("parent"):
        os.kill(pid, signal.SIGKILL)
    elif way == "disk":
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        for one in (pid, *map(int, children)):
            resource.prlimit(one, resource.RLIMIT_FSIZE, (draw.choice([0, 100, 1000]), resource.RLIM_INFINITY))
    elif way == "memory":
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[0])
        resource.prlimit(pid, resource.RLIMIT_AS, (pages * resource.getpagesize() + SPARE, resource.RLIM_INFINITY))


def started(source: Rendered, work: Path, way: str, draw: random.Random, *, with_fault: bool = True) -> int:
    """Start a build of its own process."""
    raises_at = draw.randrange(1, CAPTURES)
    pid = os.fork()
    if pid:
        return pid
    code = 1
    try:
        os.dup2(os.open(work / "said", os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 2)

        def progress(done: int, total: int, sample_id: str) -> None:
            if with_fault and way == "exception" and done >= raises_at:
                raise RuntimeError("stopped")

        report = build_dataset(config_from_yaml(CONFIG), source, work / "out", workers=WORKERS[way], progress=progress)
        code = 3 if report.quarantined else 0
    except BaseException as error:
        os.write(2, f"{type(error).__name__}: {error}\n".encode())
    finally:
        os._exit(code)


def records(work: Path) -> int:
    place = work / ".out.building" / "records"
    return len(list(place.glob("*.json"))) if place.is_dir() else 0


def tree(path: Path) -> dict[str, str]:
    """Return the digest of every file below a folder."""
    files = [file for file in path.rglob("*") if file.is_file()]
    return {file.relative_to(path).as_posix(): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


if __name__ == "__main__":
    main()
