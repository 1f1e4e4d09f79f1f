"""Damaged files of every format end in a typed error or a value: the short form of benchmarks/mutants.py."""

from __future__ import annotations

import random
import sys
from pathlib import Path

import pytest

if sys.platform != "linux":
    pytest.skip("memory is read from /proc", allow_module_level=True)

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import mutant_readers
import mutant_seeds
import mutants
from mutant_edits import mutant
from mutant_worker import Server, forms

FAKES = """
import os, signal, time
from mutant_readers import READERS
from pcdata.errors import CaptureError

def hang(): time.sleep(60)
def stop(): os.kill(os.getpid(), signal.SIGSTOP)
def crash(): os.kill(os.getpid(), signal.SIGSEGV)
def leave(): os._exit(0)
def foreign(): {}["a"]
def chatter(): raise CaptureError("a" * 30_000)
def take(): return len(b"1" * (40 << 20))
def run_out(): raise MemoryError
def run_out_typed(): raise CaptureError("does not fit") from MemoryError()
def typed(): raise CaptureError("damaged")

def damaged(action):
    def read(folder):
        content = (folder / "a.txt").read_bytes()
        return content if content == b"The seed: 1, 2, 3" * 20 else action()
    return read

for action in (hang, stop, crash, leave, foreign, chatter, take, run_out, run_out_typed, typed):
    READERS[action.__name__] = "a.txt", damaged(action)
"""
TOLD = {
    "hang": ("hang", "no end within 0.3"),
    "stop": ("hang", "no end within 0.3"),
    "crash": ("crash", "exit -11"),
    "leave": ("crash", "exit 0"),
    "foreign": ("foreign exception", "KeyError"),
    "chatter": ("foreign exception", "30000 characters"),
    "take": ("memory", "MiB for"),
    "run_out": ("memory", "MemoryError"),
    "run_out_typed": ("memory", ""),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("mutants")


@pytest.fixture(scope="module")
def seeds(folder) -> Path:
    mutant_seeds.write_seeds(folder / "seeds")
    return folder / "seeds"


@pytest.fixture(scope="module")
def server(folder):
    (folder / "fakes.py").write_text(FAKES)
    with Server(["fakes"], [folder]) as server:
        yield server


@pytest.mark.parametrize("reader", sorted(mutant_readers.READERS))
def test_damaged_files_end_in_a_typed_error_or_a_value(server, seeds, reader):
    if not forms(reader, [seeds]):
        pytest.skip("its seed needs an extra")
    count = 10 if reader == "bag" else 40  # rosbags takes a tenth of a second to begin
    found = mutants.batch(server, reader, [seeds], count, seed=1)
    assert found["faults"] == []
    assert sum(found["outcomes"].values()) == count
    assert found["outcomes"].get("typed", 0) > 0, "no mutant was refused: are they read at all?"


@pytest.mark.parametrize("reader", TOLD)
def test_a_reader_at_fault_is_told(server, folder, reader):
    form = folder / "fake_seeds" / reader / "own"
    form.mkdir(parents=True)
    (form / "a.txt").write_bytes(b"The seed: 1, 2, 3" * 20)
    found = mutants.batch(server, reader, [folder / "fake_seeds"], 2, seed=1, timeout=0.3, floor=1 << 25)
    outcome, words = TOLD[reader]
    assert found["outcomes"] == {outcome: 2}
    assert [fault["number"] for fault in found["faults"]] == [0, 1]
    assert all(words in fault["what"] for fault in found["faults"])


def test_a_reader_that_refuses_is_at_no_fault(server, folder):
    form = folder / "fake_seeds" / "typed" / "own"
    form.mkdir(parents=True)
    (form / "a.txt").write_bytes(b"The seed: 1, 2, 3" * 20)
    found = mutants.batch(server, "typed", [folder / "fake_seeds"], 5, seed=1)
    assert found["outcomes"] == {"typed": 5}
    assert found["faults"] == []


def test_the_same_number_makes_the_same_mutant():
    data = b"some words: 1, 2\n" * 30
    made = [mutant(data, random.Random("7")) for _ in range(2)]
    assert made[0] == made[1] != data
