"""The threads that calls of the core start: they wait for further calls for a while, and never through a fork."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from pcdata.contracts.dispatch import why_unavailable
from tests.warm import run_script

pytestmark = [
    pytest.mark.skipif(why_unavailable("cpu") is not None, reason=str(why_unavailable("cpu"))),
    pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc"),
]

SCRIPT = """
import os
import threading
import time
from pathlib import Path

import torch

import pcdata.functional as F

torch.set_num_threads(2)
points = torch.randn(60_000, 3, generator=torch.Generator().manual_seed(0))
lower, upper = torch.zeros(1, 3), torch.ones(1, 3)


def call():
    return F.box_mask(points, lower=lower, upper=upper, backend="cpu").numpy().tobytes()


def helpers():
    return [one.read_text().strip() for one in Path("/proc/self/task").glob("*/comm")].count("pcdata")


expected = call()
for _ in range(200):  # on a busy machine the helper may have gone before it is counted
    assert call() == expected
    if kept := helpers():
        break
assert kept == 1, "no helper waits for the next call"

pid = os.fork()
if not pid:
    torch.set_num_threads(1)  # as workers of a DataLoader do: torch's own threads do not live on in a child
    os._exit(0 if not helpers() and call() == expected and call() == expected else 1)
assert not helpers(), "a helper lived through a fork"
assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0

given = []
other = threading.Thread(target=lambda: given.append(call()))  # has helpers of its own, which end with it
other.start()
call()
other.join()
assert given == [expected]

for _ in range(100):
    if not helpers():
        break
    time.sleep(0.05)
assert not helpers(), "helpers wait for ever"
allowed = os.sched_getaffinity(0)
for wait in (0.0, 0.02, 0.049, 0.0495, 0.05, 0.0502, 0.051, 0.06) * 4:  # about as long as helpers wait
    time.sleep(wait)
    assert call() == expected
    assert os.sched_getaffinity(0) == allowed, "a helper that has gone took the caller from its processors"
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
assert call() == expected
"""


def test_helpers_wait_for_calls_end_by_themselves_and_before_a_fork(tmp_path: Path):
    script = tmp_path / "helpers.py"
    script.write_text(SCRIPT)
    result = run_script(script, folder=tmp_path)
    assert result.returncode == 0, result.stderr


NESTED = """
import signal

import torch

import pcdata.functional as F

torch.set_num_threads(2)
points = torch.rand(200_000, 3, generator=torch.Generator().manual_seed(0))
small, found = points[:60_000], []
lower, upper = torch.zeros(1, 3), torch.full((1, 3), 0.5)
inside = ((small >= 0) & (small <= 0.5)).all(1)
alone = F.estimate_normals(points, max_neighbors=30, backend="cpu")


def call_again(*_):
    found.append(F.box_mask(small, lower=lower, upper=upper, backend="cpu"))
    signal.setitimer(signal.ITIMER_REAL, 0.01)  # not before this call has ended, however slow it is


signal.signal(signal.SIGALRM, call_again)
signal.setitimer(signal.ITIMER_REAL, 0.01)
interrupted = F.estimate_normals(points, max_neighbors=30, backend="cpu")
signal.setitimer(signal.ITIMER_REAL, 0)
assert found, "the call was too short to be interrupted"
assert all(torch.equal(one, inside) for one in found)
assert torch.equal(alone, interrupted)
"""


def test_a_call_within_a_call_has_helpers_of_its_own(tmp_path: Path):
    script = tmp_path / "nested.py"
    script.write_text(NESTED)
    result = run_script(script, folder=tmp_path)
    assert result.returncode == 0, result.stderr
