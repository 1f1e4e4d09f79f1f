"""Frames take the memory that those before them freed: no frame fetches its images page by page."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import pytest

COUNT = """
import resource, torch
from pcdata.live.kept_memory import keep_freed_memory
print(keep_freed_memory(), keep_freed_memory())
def frame(state):
    first, second = (torch.full((900_000,), 1.0) for _ in range(2))
    state[0] = torch.full((900_000,), 2.0)
    last = torch.full((900_000,), 3.0)
    del first, second
    state[1] = torch.full((700_000,), 4.0)
    return last
state = [None, None]
def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    frame(state)
before = faults()
for _ in range(100):
    frame(state)
print(faults() - before)
"""


def run(**environment: str) -> list[str]:
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("MALLOC_", "GLIBC_"))}
    done = subprocess.run([sys.executable, "-c", COUNT], env=kept | environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="set in glibc alone")
def test_frames_take_the_memory_that_was_freed():
    first, second, faults = run()
    assert first == second == "True"
    assert int(faults) < 900  # one image has as many pages


def test_limits_of_the_environment_stay():
    assert run(MALLOC_TRIM_THRESHOLD_="131072")[0] == "False"
