"""Damaged files of every format end in a typed error or a value: the short form of benchmarks/mutants.py."""

from __future__ import annotations

import random
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import mutant_readers
import mutants


@pytest.fixture(scope="module")
def seeds(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("seeds")
    mutant_readers.write_seeds(folder)
    return folder


@pytest.mark.parametrize("reader", sorted(mutant_readers.READERS))
def test_damaged_files_end_in_a_typed_error_or_a_value(seeds, reader):
    if not mutants.forms(reader, [seeds]):
        pytest.skip("its seed needs an extra")
    found = mutants.batch(reader, [seeds], 60, seed=1)
    assert found["faults"] == []
    assert sum(found["outcomes"].values()) == 60
    assert found["outcomes"].get("typed", 0) > 0, "no mutant was refused: are they read at all?"


def test_the_same_number_makes_the_same_mutant():
    data = b"some words: 1, 2\n" * 30
    made = [mutants.mutant(data, random.Random("7")) for _ in range(2)]
    assert made[0] == made[1] != data
