"""Export small recordings for every target and open what was written with the models' own loaders, unmodified.

    PCDATA_TEST_DATA=... python benchmarks/official_loaders.py CHECKOUTS --python OTHER/bin/python
        [--only dp3 ...] [--json results/official_loaders.json]

CHECKOUTS is a folder with the repositories by name (``3D-Diffusion-Policy``, ``RISE``, ``Pointcept``, ... : those of
``SUITES`` in ``official_open.py``); a file COMMIT in one says which commit it is, where there is no git.
Recordings are written, built and exported by the commands that docs/exports.md shows, in this Python;
the loaders run in OTHER, with the old NumPy and zarr that they were written for (numpy 1.23, zarr 2.12, torch, numba,
h5py, scikit-image, imageio, opencv, open3d, trimesh, graspnetAPI). Nothing of theirs is edited: heavy imports that are
not installed are replaced by empty modules, which the result names, with the git blob id of every file that ran.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from official_cases import CASES, Bench, Case

import pcdata
from pcdata.exports import TARGETS

HERE = Path(__file__).resolve().parent


def open_in(python: str, target: str, checkouts: Path, case: Case, scratch: Path) -> dict[str, Any]:
    """Run the loaders of a target in their own Python and return what they found."""
    out, held, told = case
    truth = scratch / f"truth_{target}.npz"
    np.savez(truth, **{key.replace("/", "|"): value for key, value in held.items()})
    result = scratch / f"result_{target}.json"
    words = [
        python,
        str(HERE / "official_open.py"),
        target,
        str(checkouts),
        str(out),
        str(truth),
        str(result),
        json.dumps(told),
    ]
    done = subprocess.run(words, capture_output=True, text=True, env={**os.environ, "MPLBACKEND": "Agg"}, cwd=scratch)
    (scratch / f"log_{target}.txt").write_text(done.stdout + done.stderr)
    if done.returncode or not result.is_file():
        return {"failed": (done.stderr.strip().splitlines() or ["no result"])[-1]}
    return json.loads(result.read_text())


def main() -> None:
    """Run all targets, print a line each, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkouts", type=Path)
    parser.add_argument("--python", default=sys.executable, help="the Python that has what the loaders need")
    parser.add_argument("--only", nargs="*", default=list(CASES), choices=list(CASES))
    parser.add_argument("--json", type=Path, default=None)
    parser.add_argument("--keep", type=Path, default=None, help="work in this folder and leave it")
    args = parser.parse_args()
    for target in sorted(set(TARGETS) - set(CASES)):
        print(f"{target}: not run, there is no case for it")
    scratch = Path(args.keep or tempfile.mkdtemp()).resolve()
    scratch.mkdir(parents=True, exist_ok=True)
    bench, results = Bench(scratch), {}
    for target in args.only:
        print(f"{target}:", flush=True)
        results[target] = open_in(args.python, target, args.checkouts.resolve(), CASES[target](bench), scratch)
        print("  ->", json.dumps(results[target])[:2000], flush=True)
    if args.json is not None:
        args.json.write_text(json.dumps({"pcdata": pcdata.__version__, "targets": results}, indent=1) + "\n")
    if args.keep is None:
        shutil.rmtree(scratch)
    wrong = [name for name, result in results.items() if "failed" in result or not all(result["equal"].values())]
    sys.exit(f"not equal: {', '.join(wrong)}" if wrong else 0)


if __name__ == "__main__":
    main()
