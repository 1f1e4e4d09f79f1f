"""The command that tells whether a camera moved: drift."""

from __future__ import annotations

import argparse
from typing import Any

from pcdata.cli.argument_types import positive
from pcdata.cli.options import add_capture_options, open_captures
from pcdata.cli.outputs import text_files
from pcdata.cli.progress_bar import ProgressBar


def add_to(commands: Any) -> None:
    """Add the command to the parser."""
    drift = commands.add_parser("drift", help="did a camera move during a recording, or since another one?")
    drift.add_argument("path", metavar="PATH", help="captures in order: a folder, a recording, several cameras")
    drift.add_argument("--reference", metavar="PATH", help="where the cameras were at first (default: PATH's begin)")
    add_capture_options(drift)
    drift.add_argument("--limit", type=positive, metavar="N", help="only the first N captures")
    drift.add_argument("--window", type=positive, metavar="N", default=5, help="captures averaged (default: 5)")
    drift.add_argument("--json", metavar="FILE", help="write every camera's way to FILE, replacing it")
    drift.add_argument("--out", metavar="FILE.html", help="draw every camera's way on a page")
    drift.set_defaults(run=_drift)


def _drift(arguments: argparse.Namespace) -> int:
    from pcdata.files.strict_json import json_text
    from pcdata.report.html.drift_page import drift_page
    from pcdata.validation.drift import measure_drift
    from pcdata.verdicts import Verdict

    source = open_captures(arguments.path, arguments, limit=arguments.limit)
    reference = open_captures(arguments.reference, arguments) if arguments.reference else None
    with text_files("drift", json=arguments.json, out=arguments.out) as write:
        with ProgressBar("drift") as progress:
            result = measure_drift(source, reference=reference, window=arguments.window, progress=progress)
        write("json", json_text(result.to_json(), indent=1))
        write("out", drift_page(result, f"Drift of {source}"))
    print(result.text())
    return int(result.verdict is Verdict.FAIL)
