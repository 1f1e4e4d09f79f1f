"""The commands that show and grade captures: report, grade."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

from pcdata.cli.argument_types import positive
from pcdata.cli.options import (
    add_capture_options,
    add_depths_of_interest,
    depths_of_interest,
    given_options,
    open_captures,
)
from pcdata.cli.outputs import text_files
from pcdata.cli.progress_bar import ProgressBar

_PATH = "folder of captures, a recording, one cloud file, or a dataset"


def add_to(commands: Any) -> None:
    """Add the commands to the parser."""
    report = commands.add_parser("report", help="write one page that shows whether captures are good, and why not")
    report.add_argument("path", metavar="PATH", help=_PATH)
    report.add_argument("--out", metavar="FILE.html", help="the page (default: report.html, unless --png is given)")
    report.add_argument(
        "--png",
        metavar="FOLDER",
        help="the same as pictures, drawn without a display: a folder of them, or one where it ends in .png",
    )
    report.add_argument("--config", metavar="FILE.yaml", help="show the steps of this pipeline too")
    report.add_argument("--samples", type=positive, metavar="N", default=12, help="captures shown (default: 12)")
    _add_captures(report)
    report.set_defaults(run=_report)
    grade = commands.add_parser("grade", help="grade a recording from A to F, by camera and episode, with the reasons")
    grade.add_argument("path", metavar="PATH", help=_PATH)
    grade.add_argument("--json", metavar="FILE", help="write the grade with every check's trend to FILE, replacing it")
    _add_captures(grade)
    grade.set_defaults(run=_grade)


def _add_captures(command: argparse.ArgumentParser) -> None:
    add_depths_of_interest(command)
    command.add_argument("--limit", type=positive, metavar="N", help="only the first N captures")
    add_capture_options(command)


def is_dataset(arguments: argparse.Namespace) -> bool:
    """Whether a build wrote what is at the path; refuse then what says how captures are read and gone through."""
    from pcdata.errors import ConfigError
    from pcdata.io.store.manifest import Manifest

    if not Manifest.is_one(Path(arguments.path)):
        return False
    of_captures = ("config", "limit", "sensor", "workspace", "kind", "only", "skip", "skip_file", "skip_refused")
    given = [name for name in of_captures if getattr(arguments, name, None)] + [*given_options(arguments)]
    if given:
        raise ConfigError(
            f"{', '.join(given)}: of captures, and {arguments.path} is a dataset, whose clouds are looked at as they "
            "are, with the steps that made them; leave it out, or give the captures"
        )
    return True


def _report(arguments: argparse.Namespace) -> int:
    from pcdata.build import load_config
    from pcdata.errors import ConfigError
    from pcdata.io.sources.capture_source import check_apart
    from pcdata.report.figures.report_pictures import check_pictures, write_pictures
    from pcdata.report.html.capture_report import page_of_captures
    from pcdata.report.html.dataset_report import gather_dataset
    from pcdata.report.html.gathering import gather_captures

    out = arguments.out if arguments.out or arguments.png else "report.html"
    if out:
        check_apart("--out", out, arguments.path)
    if arguments.png:
        if out and os.path.realpath(out) == os.path.realpath(arguments.png):
            raise ConfigError(f"report: --out and --png are one place, {out}; give two")
        check_pictures(arguments.png)
    page = ""
    with text_files("report", out=out) as write:
        with ProgressBar("report") as progress:
            if is_dataset(arguments):
                gathered = gather_dataset(arguments.path, num_shown=arguments.samples, progress=progress)
            else:
                gathered = gather_captures(
                    open_captures(arguments.path, arguments, limit=arguments.limit),
                    pipeline=None if arguments.config is None else load_config(arguments.config).pipeline,
                    limits=depths_of_interest(arguments),
                    num_shown=arguments.samples,
                    progress=progress,
                )
        if out:
            page = page_of_captures(gathered)
            write("out", page)
    grade = gathered.grading.grade()
    print(f"grade    {grade.letter}: {gathered.grading.standing()}")
    for reason in grade.reasons[:3]:
        print(f"  {reason}")
    if out:
        print(f"page     {out} ({len(page.encode()) / 1e6:.1f} MB)")
    if arguments.png:
        written = write_pictures(gathered, arguments.png)
        print(f"pictures {arguments.png} ({len(written)})")
    return int(gathered.grading.none_read)


def _grade(arguments: argparse.Namespace) -> int:
    from pcdata.files.strict_json import json_text
    from pcdata.io.sources.capture_source import episodes_of
    from pcdata.report.html.dataset_report import dataset_page
    from pcdata.validation import validate_source
    from pcdata.validation.grading import Grading

    with text_files("grade", json=arguments.json) as write:
        with ProgressBar("grade") as progress:
            if is_dataset(arguments):
                _, grading = dataset_page(arguments.path, num_shown=1, progress=progress)
            else:
                source = open_captures(arguments.path, arguments, limit=arguments.limit)
                grading = Grading(source.ids, episodes_of(source))
                for done, report in enumerate(validate_source(source, limits=depths_of_interest(arguments)), 1):
                    grading.add(report)
                    if not report.whole:
                        progress(done, len(source.ids), report.sample_id)
        write("json", json_text(grading.to_json(), indent=1))
    grade = grading.grade()
    print(f"{grade.letter}: {grading.standing()}")
    for reason in grade.reasons:
        print(f"  {reason}")
    return int(grade.letter in "DF")
