"""How many Python calls the four paths take: a reader steps through them, and a loop pays for each."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

from pcdata.contracts.dispatch import why_unavailable

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
LIMITS = {  # calls, files; counted with Python before 3.12, where comprehensions are calls
    "points": (413, 44),  # sampling is told its options by the reference, whose step a kernel does; so is the way back;
    # what a step has found is kept for the next, selections are run together, others are asked by name, rays shared
    # of eight steps in five passes; checksums have a file of their own; a plane takes as many rounds as it needs;
    # kernels of outliers and of normals have one each, and so have what both ask of the core, how passes are run, and
    # what all samplers do alike
    "live": (553, 51),  # answering a frame and running the steps have a file each
    "build": (
        3520,
        128,  # the options have a file of their own, and so do numbers in words, what the core finds of planes, motions
    ),  # of which 200 and 6 files look at the unit of what is read, for which it was read again before, 600 keep what a
    # build was when it is stopped, 700 write its card, 30 tell rows, 16 look at poses, 20 at intrinsics, 56 have the
    # hull and the rows of a plane found by the core, on one thread of torch's, 15 and 2 files tell its surface
    "open": (
        857,
        34,
    ),  # six arrays of the index, each a file that is checked; every field of a step is; limits that are off
}


@pytest.fixture
def found(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    calls = importlib.import_module("calls")
    return calls.summary(calls.measure())


@pytest.mark.skipif(why_unavailable("cpu") is not None, reason="without the compiled core other bodies run")
def test_no_path_takes_more_calls_or_files_than_it_did(found):
    for name, (calls, files) in LIMITS.items():
        assert found[name]["calls"] <= calls, name
        assert found[name]["files"] <= files, name
