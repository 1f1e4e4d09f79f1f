"""What sanitizers leave out is what another of their cases does in memory."""

from __future__ import annotations

import pytest

from pcdata.kernels.cpu.native import INSTRUCTION_SETS
from tests.sanitized import repeats_in_memory

CORE = "tests/kernels/cpu/test_neighbors.py::test_x"


@pytest.mark.parametrize("best", INSTRUCTION_SETS)
def test_of_cases_that_only_name_an_instruction_set_that_of_the_best_is_left(best: str):
    run = [name for name in INSTRUCTION_SETS if not repeats_in_memory(CORE, {"instruction_set": name}, best)]
    assert run == [best]


def test_every_number_of_threads_runs_with_the_best_library_and_once():
    machines = [(1, None), (7, None), *((2, name) for name in INSTRUCTION_SETS)]
    assert [one for one in machines if not repeats_in_memory(CORE, {"machine": one}, "avx512")] == machines[:2]


def test_random_cases_and_those_without_a_machine_all_run():
    fuzz = "tests/kernels/cpu/test_fuzz_core.py::test_x"
    assert not any(repeats_in_memory(fuzz, {"machine": name}, "avx512") for name in INSTRUCTION_SETS)
    assert not repeats_in_memory(CORE, {}, "avx512")
    assert not repeats_in_memory(CORE, {"name": "baseline", "k": 3}, "avx512")
