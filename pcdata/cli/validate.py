"""The command that judges raw captures: validate."""

from __future__ import annotations

import argparse
import shlex
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

from pcdata.cli.argument_types import positive
from pcdata.cli.known_names import CHECKS
from pcdata.cli.options import (
    add_capture_options,
    add_depths_of_interest,
    depths_of_interest,
    open_captures,
    said_again,
)
from pcdata.cli.progress_bar import ProgressBar


def add_to(commands: Any) -> None:
    """Add the command to the parser."""
    validate = commands.add_parser(
        "validate",
        help="check raw captures, each camera alone and against others",
        epilog=f"The checks: {', '.join(CHECKS)}; and those of FILE.py (--import) that it registers.",
    )
    validate.add_argument(
        "path", metavar="PATH", help="folder of captures, or of several cameras' folders, or one cloud file"
    )
    add_capture_options(validate, can_skip_refused=False)
    validate.add_argument("--limit", type=positive, metavar="N", help="only the first N captures")
    add_depths_of_interest(validate)
    validate.add_argument("--json", metavar="FILE", help="write every check on every capture to FILE, replacing it")
    validate.set_defaults(run=_validate)


def _validate(arguments: argparse.Namespace) -> int:
    from pcdata.errors import CaptureError, PoseError, UnitError
    from pcdata.files.opening import replacing
    from pcdata.report.unopened_text import needed_options
    from pcdata.report.validation_text import validation_text
    from pcdata.validation import WHOLE, SampleReport, Summary, check_of_error, validate_source
    from pcdata.verdicts import Verdict

    limits = depths_of_interest(arguments)
    summary = Summary()
    total = 0
    unread: list[str] = []
    needed = ""  # options without which captures cannot be read
    try:
        source = open_captures(arguments.path, arguments, limit=arguments.limit)
        reports, total, unread = validate_source(source, limits=limits), len(source), source.unread()
    except (CaptureError, PoseError, UnitError) as error:  # what no capture can be read with
        if not Path(arguments.path).exists():
            raise
        reports = iter([SampleReport(WHOLE, (check_of_error(error, whole=True),), whole=True)])
    target = replacing("validate --json", arguments.json) if arguments.json else nullcontext()
    with target as temporary, ProgressBar("validate") as progress:
        writer = None if temporary is None else _Writer(temporary, arguments.path, asdict(limits))
        for done, report in enumerate(reports, 1):
            summary.add(report)
            failed = (one.found for one in report.findings if one.verdict is Verdict.FAIL)
            needed = needed or next(filter(None, map(needed_options, failed)), "")
            if writer is not None:
                writer.add(report.to_json())
            if not report.whole:
                progress(done, total, report.sample_id)
        if writer is not None:
            writer.close(summary.to_json(), unread)
    print(validation_text(summary))
    for line in unread:
        print(f"not read: {line}")
    if needed:
        print(f"next: pcdata validate {shlex.join(said_again(arguments))} {needed}")
    return int(summary.verdict is Verdict.FAIL)


class _Writer:
    """Writes the JSON document report by report, so that a long recording need not fit into memory."""

    def __init__(self, path: Path, source: str, limits: dict[str, Any]) -> None:
        from pcdata.files.strict_json import json_text

        self._text = json_text
        self._file: IO[str] = open(path, "w", encoding="utf-8")  # noqa: SIM115  # closed by close
        head = {"schema": "pcdata.validation/1", "source": str(source), "limits": limits}
        self._file.write(self._text(head, indent=1)[:-2] + ',\n "samples": [')
        self._first = True

    def add(self, report: dict[str, Any]) -> None:
        """Write one report."""
        self._file.write(("\n  " if self._first else ",\n  ") + self._text(report))
        self._first = False

    def close(self, summary: dict[str, Any], unread: list[str]) -> None:
        """Write the end."""
        end = f'"not_read": {self._text(unread)},\n "summary": {self._text(summary)}'
        self._file.write(f"\n ],\n {end}\n}}\n")
        self._file.close()
