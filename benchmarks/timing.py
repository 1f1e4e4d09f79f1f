"""Timing an operation beside its peers: both run in turn, in one process, and their results are compared.

Each runs once to warm up (the results of that run are compared), then ``repeats`` times; a peer that takes longer than
two seconds only once. Before every run there is a (busy) wait in which the threads of the run before go to sleep:
OpenMP's spin for some milliseconds. Medians and interquartile ranges are kept.
"""

from __future__ import annotations

import importlib.util
import os
import platform
import statistics
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

import pcdata
from pcdata.contracts import dispatch

RESULTS = Path(__file__).parent / "results"
_ONCE_AFTER = 2.0  # seconds: slower peers are timed once
_WAIT = 0.015  # seconds

Clock = Callable[[Callable[[], Any], list[float]], Any]  # runs a call and appends its seconds


@dataclass
class Case:
    """One operation and a peer that does the same."""

    operation: str
    points: int
    ours: Callable[[], Any]
    peer: str
    theirs: Callable[[], Any]
    compare: Callable[[Any, Any], str]


@dataclass
class Row:
    """What was measured."""

    operation: str
    points: int
    pcdata_ms: float
    pcdata_iqr_ms: float
    peer: str
    peer_ms: float
    peer_iqr_ms: float
    ratio: float  # the peer's time over ours: above 1 we are faster
    results: str


def measure(case: Case, repeats: int, clock: Clock | None = None) -> Row:
    clock = clock or timed
    verdict = case.compare(case.ours(), clock(case.theirs, first := []))
    ours, theirs = in_turn(case, repeats, clock, first, once_after=_ONCE_AFTER)
    mine, other = 1000 * statistics.median(ours), 1000 * statistics.median(theirs)
    return Row(case.operation, case.points, mine, spread(ours), case.peer, other, spread(theirs), other / mine, verdict)


class Compared(Protocol):
    """Two calls that are timed beside each other."""

    ours: Callable[[], Any]
    theirs: Callable[[], Any]


def in_turn(
    case: Compared, repeats: int, timed: Clock, first: list[float], *, once_after: float
) -> tuple[list[float], list[float]]:
    """Seconds of every run of ours and theirs; a peer whose first took ``once_after`` or more keeps that one alone."""
    ours: list[float] = []
    theirs: list[float] = []
    for _ in range(repeats):
        timed(case.ours, ours)
        if first[0] < once_after:
            timed(case.theirs, theirs)
    return ours, theirs or first


def timed(body: Callable[[], Any], seconds: list[float]) -> Any:
    until = time.perf_counter() + _WAIT
    while (started := time.perf_counter()) < until:
        pass  # busy: an idle processor would clock down
    result = body()
    seconds.append(time.perf_counter() - started)
    return result


def processor_time(body: Callable[[], Any], seconds: list[float]) -> Any:
    """Append the seconds of all threads of this process; those of torch wait busily for some of them."""
    started = time.process_time()
    result = body()
    seconds.append(time.process_time() - started)
    return result


def spread(seconds: list[float]) -> float:
    low, high = np.percentile(seconds, [25, 75])
    return 1000 * float(high - low)


def installed(peer: str) -> bool:
    return importlib.util.find_spec(peer) is not None


def same(ours: np.ndarray, theirs: np.ndarray) -> str:
    """Say how many of two arrays of values differ."""
    if len(ours) != len(theirs):
        return f"{len(ours)} and {len(theirs)} values"
    different = int((ours != theirs).sum())
    return "identical" if different == 0 else f"{different} of {len(ours)} differ"


def facts(peers: Iterable[str]) -> dict[str, Any]:
    """What a result says about the machine, the versions, and which peers took part."""
    there = [peer for peer in peers if installed(peer)]
    return {
        "machine": {
            "cores": os.cpu_count(),
            "threads": torch.get_num_threads(),
            "processor": platform.machine(),
            "load_before": os.getloadavg()[0],
        },
        "backends": [backend for backend in dispatch.backends() if dispatch.why_unavailable(backend) is None],
        "versions": {"pcdata": pcdata.__version__, "torch": torch.__version__}
        | {peer: _version(peer) for peer in there},
        "left_out": [peer for peer in peers if peer not in there],
    }


def _version(package: str) -> str:
    names = {"cv2": "opencv-python", "sklearn": "scikit-learn", "torch_cluster": "torch-cluster"}
    try:
        return version(names.get(package, package))
    except PackageNotFoundError:
        return str(getattr(importlib.import_module(package), "__version__", "unknown"))
