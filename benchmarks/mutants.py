"""Damage valid files at random and see what every reader makes of them.

    python benchmarks/mutants.py --mutants 3000 --json benchmarks/results/mutants.json
    python benchmarks/mutants.py --readers depth_png meta_mat --mutants 60 --seeds FOLDER

Each mutant is read in a child process, and none may take longer than ten seconds, or more memory than docs/security.md
states. Outcomes: a typed error; accepted with the value of the seed; accepted with another value, which a format
without a checksum cannot tell from an edit (counted); a foreign exception, a crash, a hang, too much memory. The last
four are faults, listed with the number that makes one again (``--only READER:NUMBER``): the same seed gives the same.
Linux only: the peak of one mutant's memory is read from /proc.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from mutant_worker import Server, forms

TIMEOUT = 10.0  # seconds for one mutant
FAULTS = ("foreign exception", "crash", "hang", "memory")


def batch(
    server: Server,
    reader: str,
    seeds: list[Path],
    mutants: int,
    seed: int,
    *,
    first: int = 0,
    timeout: float = TIMEOUT,
    floor: int | None = None,
) -> dict[str, object]:
    """Read so many mutants of one reader and count the outcomes.

    Args:
        server: the process that reads.
        reader: its name.
        seeds: folders of READER/NAME/files.
        mutants: how many.
        seed: of the random numbers.
        first: the number of the first mutant.
        timeout: seconds for each.
        floor: bytes that it may take however small the file is; None = those of the format.
    """
    counts: dict[str, int] = {}
    faults: list[dict[str, object]] = []
    slowest, peak, started, number, last = 0.0, 0, time.monotonic(), first, first + mutants
    while number < last:
        server.start(reader=reader, seeds=[*map(str, seeds)], first=number, last=last, seed=seed, floor=floor)
        while "ended" not in (told := server.next(1.2 * timeout + 0.5)):
            if not told:
                server.stop()
                told = {"outcome": "hang", "what": f"no end within {timeout:g} seconds"}
                break
            if "broken" in told:
                raise RuntimeError(f"{reader}, after mutant {number}: {told['broken']}")
            if told["seconds"] > timeout:
                told |= {"outcome": "hang", "what": f"{told['seconds']:.1f} seconds"}
            _count(counts, faults, number, told)
            slowest, peak, number = max(slowest, told["seconds"]), max(peak, told["peak"]), number + 1
        if number < last:
            _count(counts, faults, number, {"outcome": "crash", "what": f"exit {told.get('ended')}", **told})
            number += 1
    return {
        "mutants": mutants,
        "outcomes": dict(sorted(counts.items())),
        "slowest_seconds": round(slowest, 3),
        "peak_megabytes": round(peak / 2**20, 1),
        "seconds": round(time.monotonic() - started, 1),
        "faults": faults[:20],
    }


def _count(counts: dict[str, int], faults: list[dict[str, object]], number: int, told: dict[str, object]) -> None:
    outcome = str(told["outcome"])
    counts[outcome] = counts.get(outcome, 0) + 1
    if outcome in FAULTS:
        faults.append({"number": number, "outcome": outcome, "what": told["what"]})


def main(argv: list[str] | None = None) -> int:
    from mutant_readers import READERS
    from mutant_seeds import write_seeds

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mutants", type=int, default=3000, help="of each reader")
    parser.add_argument("--readers", nargs="+", choices=sorted(READERS), default=sorted(READERS))
    parser.add_argument("--seeds", type=Path, help="a folder of more seeds: READER/NAME/files")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", help="READER:NUMBER: one mutant, again")
    parser.add_argument("--json", type=Path, help="what it holds of other readers stays")
    options = parser.parse_args(argv)
    first = 0
    if options.only:
        reader, number = options.only.split(":")
        options.readers, options.mutants, first = [reader], 1, int(number)
    found: dict[str, dict[str, object]] = {}
    with tempfile.TemporaryDirectory() as own, Server() as server:
        write_seeds(Path(own))
        seeds = [Path(own), *([options.seeds.resolve()] if options.seeds else [])]
        for reader in options.readers:
            if not forms(reader, seeds):
                found[reader] = {"mutants": 0, "why": "no seed: an extra is not installed"}
                continue
            found[reader] = batch(server, reader, seeds, options.mutants, options.seed, first=first)
            print(reader, json.dumps(found[reader]), flush=True)
            if options.json:
                known = json.loads(options.json.read_text(encoding="utf-8"))["readers"] if options.json.exists() else {}
                text = json.dumps({"seed": options.seed, "readers": dict(sorted({**known, **found}.items()))}, indent=1)
                options.json.write_text(text + "\n", encoding="utf-8")
    wrong = sum(found[r].get("outcomes", {}).get(fault, 0) for r in found for fault in FAULTS)
    print(f"{len(found)} readers, {wrong} faults")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
