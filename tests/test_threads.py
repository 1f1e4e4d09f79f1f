"""Torch's threads are put aside and brought back; a command says how they wait before torch is loaded."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import torch

import pcdata
from pcdata.synthetic import SyntheticSource, tabletop
from pcdata.threads import core_threads, in_threads, torch_on_one_thread, while_reading
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


@pytest.mark.parametrize("at_once", [1, 2])
def test_what_is_read_in_the_callers_thread_is_worked_on_in_others_in_order(three_threads, at_once):
    readers, workers, in_memory, most = set(), set(), set(), 0

    def read(item):
        nonlocal most
        readers.add(threading.get_ident())
        in_memory.add(item)
        most = max(most, len(in_memory))
        return item

    def work(item):
        workers.add((threading.get_ident(), (torch.get_num_threads(), core_threads())))
        time.sleep(0.02 if item % 2 else 0.0)
        in_memory.discard(item)
        return item * item

    assert [*while_reading(read, work, range(9), at_once=at_once)] == [item * item for item in range(9)]
    assert readers == {threading.get_ident()}
    assert most <= at_once + 1
    assert threading.get_ident() not in {who for who, _ in workers}
    assert {numbers for _, numbers in workers} == {(1, 3)}
    assert (torch.get_num_threads(), core_threads()) == (3, 3)


@pytest.mark.parametrize("stage", ["read", "work"])
def test_an_error_comes_in_its_turn_and_what_was_before_it_is_given(three_threads, stage):
    def fails(item):
        if item == 3:
            raise KeyError(item)
        return item

    same = [lambda item: item, fails]
    read, work = same[::-1] if stage == "read" else same
    taken = while_reading(read, work, range(6))
    assert [next(taken) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(KeyError, match="3"):
        next(taken)
    assert torch.get_num_threads() == 3


def test_who_stops_early_leaves_no_thread_behind(three_threads):
    before = threading.active_count()
    taken = while_reading(lambda item: item, lambda item: item, range(1000))
    assert next(taken) == 0
    taken.close()
    assert threading.active_count() == before


def test_one_thread_reads_and_works_in_turns():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        done = []
        for item in while_reading(lambda item: done.append(f"read {item}") or item, lambda item: item, range(2)):
            done.append(f"given {item}")
        assert done == ["read 0", "given 0", "read 1", "given 1"]
    finally:
        torch.set_num_threads(before)
