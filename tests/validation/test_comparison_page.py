"""The page on comparing tells what the benchmark measured."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "compare.py"


def test_the_table_is_that_of_the_kept_result():
    spec = importlib.util.spec_from_file_location("benchmark_of_compare", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    benchmark = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(benchmark)
    kept = json.loads(benchmark.RESULT.read_text(encoding="utf-8"))
    page = benchmark.PAGE.read_text(encoding="utf-8")
    shown = page.split(benchmark.MARKS[0])[1].split(benchmark.MARKS[1])[0].strip()
    assert shown == benchmark.table(kept), "run python benchmarks/compare.py --kept"
    assert [row["named"] for row in kept["cases"]] == [row["expected"] for row in kept["cases"]]
    assert {row["case"] for row in kept["cases"]} == set(benchmark.cases())
