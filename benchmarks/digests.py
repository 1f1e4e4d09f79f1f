"""Record a digest of every result of pcdata, to prove that a change of its insides leaves them equal, bit for bit.

    PCDATA_TEST_DATA=... python benchmarks/digests.py --out before.json
    ... change the code; adapt benchmarks/digest_names.py where names moved ...
    PCDATA_TEST_DATA=... python benchmarks/digests.py --out after.json
    python benchmarks/digests.py --compare before.json after.json        # prints every difference; exit code 1 if any

All of them take 90 s of one core. ``--only PREFIX`` makes those digests alone (``--only op/knn``), and ``--leaves`` one
digest per array and number, which tells where in a result a difference lies. benchmarks/results/digests.json holds the
digests of one machine: bits of floating-point sums depend on the libraries below (torch, OpenCV, SciPy) and on the
processor, so make both files on one machine, with one installation.

A key is ``what/name/input``; those that end in ``facts`` hash the history and where a result came from, the others its
numbers. An input that is refused has the value "refused"; what cannot run here (no compiled core, an extra that is
missing) has no key, and is told. Where a result is meant to change, the commit that changes it says which keys differ
and why; ``RENAMED`` in digest_names.py hides a mere change of a field's name.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

Case = tuple[str, Callable[[], Any]]
MODULES = [
    "digest_operations",
    "digest_inner",
    "digest_functions",
    "digest_transforms",
    "digest_files",
    "digest_data",
    "digest_checks",
    "digest_calibrations",
]


def all_cases() -> Iterator[Case]:
    """Yield every case by its name; nothing is computed before it is called."""
    for module in MODULES:
        yield from importlib.import_module(module).cases()


def record(cases: Iterator[Case], *, only: tuple[str, ...] = (), by_leaf: bool = False) -> dict[str, str]:
    """Run the cases and return their digests by name.

    Raises:
        ValueError: two have one name.
    """
    from digest_hash import digests_of
    from digest_names import Refused

    found: dict[str, str] = {}
    for name, make in cases:
        if only and not name.startswith(only):
            continue
        try:
            value = make()
        except Refused:
            made = [(name, "refused")]
        except Exception as error:
            error.add_note(f"in the case {name}") if hasattr(error, "add_note") else None
            raise
        else:
            made = list(digests_of(name, value, by_leaf=by_leaf))
        for key, text in made:
            if key in found:
                raise ValueError(f"two cases are called {key}")
            found[key] = text
    return found


def write(found: dict[str, str], path: Path) -> None:
    """Write one line per digest, sorted."""
    path.write_text(json.dumps(found, indent=0, sort_keys=True, ensure_ascii=False) + "\n", encoding="utf-8")


def differences(before: dict[str, str], after: dict[str, str]) -> list[str]:
    """Return a line for every digest that changed, is missing, or is new."""
    lines = [f"changed  {key}" for key in sorted(before.keys() & after.keys()) if before[key] != after[key]]
    lines += [f"missing  {key}" for key in sorted(before.keys() - after.keys())]
    lines += [f"new      {key}" for key in sorted(after.keys() - before.keys())]
    return lines


def compare(before: Path, after: Path) -> int:
    """Print every difference of two files; return 1 if there is one."""
    one, other = (json.loads(path.read_text(encoding="utf-8")) for path in (before, after))
    lines = differences(one, other)
    for line in lines:
        print(line)
    print(f"{len(one)} digests before, {len(other)} after: {f'{len(lines)} differences' if lines else 'all equal'}")
    return 1 if lines else 0


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, metavar="FILE.json", help="write the digests there")
    parser.add_argument("--compare", nargs=2, type=Path, metavar=("BEFORE", "AFTER"), help="print every difference")
    parser.add_argument("--only", nargs="+", default=[], metavar="PREFIX", help="only the cases that begin so")
    parser.add_argument("--leaves", action="store_true", help="a digest for every array and number")
    parser.add_argument("--threads", type=int, default=1, help="of torch (default 1)")
    given = parser.parse_args(arguments)
    if given.compare:
        return compare(*given.compare)
    if given.out is None:
        parser.error("give --out or --compare")
    # Before torch and OpenCV are loaded: sums on several threads are taken in another order.
    for variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[variable] = str(given.threads)
    import torch

    torch.set_num_threads(given.threads)
    warnings.simplefilter("ignore")
    started = time.perf_counter()
    found = record(all_cases(), only=tuple(given.only), by_leaf=given.leaves)
    write(found, given.out)
    print(f"{len(found)} digests in {time.perf_counter() - started:.0f} s -> {given.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
