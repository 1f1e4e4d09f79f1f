"""Torch's threads are put aside and brought back; a command says how they wait before torch is loaded."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

import pcdata
from pcdata.synthetic import SyntheticSource, tabletop
from pcdata.threads import core_threads, in_threads, torch_on_one_thread
from pcdata.validation import validate_frame, validate_source


@pytest.fixture
def three_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


def test_torch_has_one_thread_and_the_core_keeps_its_own(three_threads):
    with torch_on_one_thread():
        assert (torch.get_num_threads(), core_threads()) == (1, 3)
        with torch_on_one_thread():
            assert (torch.get_num_threads(), core_threads()) == (1, 3)
        assert (torch.get_num_threads(), core_threads()) == (1, 3)
    assert (torch.get_num_threads(), core_threads()) == (3, 3)


def test_an_error_brings_the_threads_back(three_threads):
    with pytest.raises(KeyError), torch_on_one_thread():
        raise KeyError
    assert (torch.get_num_threads(), core_threads()) == (3, 3)


def test_scenes_and_validation_run_their_many_short_operations_on_one_thread(three_threads, monkeypatch):
    seen = set()
    stack = torch.stack

    def spy(*arguments, **options):
        seen.add(torch.get_num_threads())
        return stack(*arguments, **options)

    monkeypatch.setattr(torch, "stack", spy)
    scene = tabletop(seed=0, num_objects=2, num_views=2, size=(48, 64))
    validate_frame(scene.frame)
    list(validate_source(SyntheticSource(num_scenes=1, num_views=1, size=(48, 64))))
    assert seen == {1}
    assert torch.get_num_threads() == 3


def waits(**given: str) -> list[str]:
    """What a command's process says of how threads wait, when torch is loaded in it."""
    code = """
import os, sys
from pcdata.cli import main
main(["inspect", "nowhere"])
print([os.environ.get(name) for name in ("OMP_WAIT_POLICY", "KMP_BLOCKTIME")], file=sys.stderr)
"""
    names = ("OMP_WAIT_POLICY", "KMP_BLOCKTIME", "GOMP_SPINCOUNT")
    environment = {name: value for name, value in os.environ.items() if name not in names} | given
    environment["PYTHONPATH"] = os.pathsep.join([str(Path(pcdata.__file__).parent.parent), *filter(None, sys.path)])
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    return ast.literal_eval(done.stderr.splitlines()[-1])


def test_a_command_lets_threads_wait_asleep():
    assert waits() == ["passive", "0"]


def test_what_the_user_says_about_waiting_stays():
    assert waits(OMP_WAIT_POLICY="active") == ["active", None]


@pytest.mark.parametrize("threads", [1, 3])
def test_what_runs_in_threads_comes_back_in_order(threads):
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        assert in_threads(lambda n: (time.sleep(0.01 * (3 - n)), n)[1], range(4)) == [0, 1, 2, 3]
        assert torch.get_num_threads() == threads
        seen = in_threads(lambda _: torch.get_num_threads(), range(4))
        assert set(seen) == {1}
    finally:
        torch.set_num_threads(before)


def test_the_first_error_of_threads_is_raised():
    def fails(number: int) -> None:
        if number:
            raise ValueError(number)

    with pytest.raises(ValueError, match="1"):
        in_threads(fails, range(4))
