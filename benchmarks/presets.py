"""Time every preset from capture to the model's tensors, against the sum of its parts, and the checks on its batch.

    python benchmarks/presets.py     # prints the table, writes results/presets.json

Method: one synthetic 640x480 capture of a table, one sample per batch, one thread. Parts are the pipeline's steps, each
timed inside the same run by stepping through it, and making the tensors. After a warm-up, medians of ``--repeats`` runs
of the process's CPU time: with one thread that is the time on a core of one's own. What the whole takes beyond its
parts is the cost of composing, recording and refusing (collate runs the cheap check). Of every part the bytes are
counted that its torch operations newly allocate (what NumPy, OpenCV and the compiled core allocate inside is not seen),
and of every step how often it runs: more than once is an error here.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

import pcdata
from pcdata.models import CONTRACTS, check, preset
from pcdata.models.batching import batch_of
from pcdata.report import text_table
from pcdata.rng import seeded
from pcdata.structures import DepthFrame
from pcdata.synthetic import BASE_FRAME, tabletop

RESULTS = Path(__file__).parent / "results"
ANSWERS: dict[str, Any] = {
    "frame": BASE_FRAME,
    "crop": ((-0.3, -0.3, -0.05), (0.3, 0.3, 0.6)),
    "category": 3,
}


def timed(call: Callable[[], Any]) -> tuple[float, Any]:
    start = time.process_time()
    result = call()
    return (time.process_time() - start) * 1000, result


class Allocations(TorchDispatchMode):
    """Counts the bytes of every tensor that an operation returns in storage that it was not given."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.bytes = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        given = {leaf.untyped_storage().data_ptr() for leaf in _tensors((args, kwargs))}
        result = func(*args, **(kwargs or {}))
        self.bytes += sum(
            leaf.numel() * leaf.element_size()
            for leaf in _tensors(result)
            if leaf.untyped_storage().data_ptr() not in given
        )
        return result


def _tensors(tree: Any) -> list[torch.Tensor]:
    return [leaf for leaf in tree_leaves(tree) if isinstance(leaf, torch.Tensor)]


def measure(name: str, frame: DepthFrame, repeats: int) -> dict[str, Any]:
    choices = {choice: ANSWERS[choice] for choice in CONTRACTS[name].required_choices}
    made = preset(name, **choices)

    def run() -> Any:
        return made.pipeline(frame, generator=seeded(0))

    try:
        sample = run()
        batch = made.collate([sample])
    except pcdata.errors.PcdataError as error:
        return {"preset": name, "refused": str(error)}
    whole, steps, tensors, full, cheap = [], [], [], [], []
    for _ in range(repeats):
        whole.append(timed(lambda: made.collate([run()]))[0])
        tensors.append(timed(lambda: batch_of([sample], made.contract, made.choices))[0])
        steps.append(_step_times(made, frame))
        full.append(timed(lambda: check(batch, name))[0])
        cheap.append(timed(lambda: [check(batch, name, cheap=True) for _ in range(100)])[0] / 100)
    parts = {step: statistics.median(times[step] for times in steps) for step in steps[0]}
    allocated = _step_bytes(made, frame, sample)
    parts["tensors"] = statistics.median(tensors)
    return {
        "preset": name,
        "whole_ms": round(statistics.median(whole), 3),
        "sum_of_parts_ms": round(sum(parts.values()), 3),
        "parts_ms": {step: round(value, 3) for step, value in parts.items()},
        "allocated_mb": {step: round(count / 1e6, 2) for step, count in allocated.items()},
        "check_ms": round(statistics.median(full), 3),
        "cheap_check_ms": round(statistics.median(cheap), 4),
    }


def _step_times(made: Any, frame: DepthFrame) -> dict[str, float]:
    times: dict[str, float] = {}
    start = time.process_time()
    for step, _ in made.pipeline.step_through(frame, generator=seeded(0)):
        name = type(step).__name__
        assert name not in times, f"{made!r} runs {name} twice"
        times[name] = (time.process_time() - start) * 1000
        start = time.process_time()
    return times


def _step_bytes(made: Any, frame: DepthFrame, sample: Any) -> dict[str, int]:
    counts: dict[str, int] = {}
    steps = made.pipeline.step_through(frame, generator=seeded(0))
    while True:
        with Allocations() as allocations:
            step, _ = next(steps, (None, None))
        if step is None:
            break
        counts[type(step).__name__] = allocations.bytes
    with Allocations() as allocations:
        batch_of([sample], made.contract, made.choices)
    return {**counts, "tensors": allocations.bytes}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--only", nargs="*", default=list(CONTRACTS), metavar="NAME")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    frame = tabletop(3, num_objects=4, num_views=1, size=(480, 640), sample_id="scene").frame
    rows = [measure(name, frame, arguments.repeats) for name in arguments.only]
    table = [
        [
            row["preset"],
            row.get("whole_ms", "refused"),
            row.get("sum_of_parts_ms", ""),
            row.get("check_ms", ""),
            row.get("cheap_check_ms", ""),
        ]
        for row in rows
    ]
    print(text_table(["preset", "whole ms", "sum of parts ms", "check ms", "cheap check ms"], table))
    parts = [
        [row["preset"], step, value, row["allocated_mb"][step]]
        for row in rows
        for step, value in row.get("parts_ms", {}).items()
    ]
    print(text_table(["preset", "part", "ms", "MB allocated"], parts))
    machine = {"cpu": platform.processor() or platform.machine(), "cores": os.cpu_count(), "torch": torch.__version__}
    RESULTS.mkdir(exist_ok=True)
    document = {"benchmark": "presets", "pcdata": pcdata.__version__, "threads": 1, "machine": machine, "rows": rows}
    (RESULTS / "presets.json").write_text(json.dumps(document, indent=1) + "\n")


if __name__ == "__main__":
    main()
