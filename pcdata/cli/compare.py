"""The command that puts two sources side by side: compare."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from pcdata.cli.argument_types import positive
from pcdata.cli.options import add_capture_options, given_flags, open_captures
from pcdata.cli.outputs import text_files
from pcdata.cli.progress_bar import ProgressBar


def add_to(commands: Any) -> None:
    """Add the command to the parser."""
    compare = commands.add_parser(
        "compare",
        help="how do two sources differ, and which step closes it? simulation and real, yesterday and today",
        epilog="Exit code 1 where a difference fails, 0 where none does. The limits of each number: docs/compare.md.",
    )
    compare.add_argument("path", metavar="A", help="captures, a recording, one cloud file, or a dataset")
    compare.add_argument("source", metavar="B", help="what it is compared with")
    add_capture_options(compare)
    compare.add_argument(
        "--captures", type=positive, metavar="N", default=100, help="of each, spread evenly over it (default: 100)"
    )
    compare.add_argument("--json", metavar="FILE", help="write every number of both to FILE, replacing it")
    compare.add_argument("--out", metavar="FILE.html", help="show the differences on a page")
    compare.set_defaults(run=_compare)


def _compare(arguments: argparse.Namespace) -> int:
    from pcdata.files.strict_json import json_text
    from pcdata.report.html.compare_page import compare_page
    from pcdata.validation.comparison import compare_sources
    from pcdata.verdicts import Verdict

    a, b = (_opened(path, arguments) for path in (arguments.path, arguments.source))
    _refuse_unused(arguments)
    with text_files("compare", json=arguments.json, out=arguments.out) as write:
        with ProgressBar("compare", unit="capture") as progress:
            result = compare_sources(a, b, captures=arguments.captures, progress=progress)
        write("json", json_text(result.to_json(), indent=1))
        write("out", compare_page(result))
    print(result.text())
    return int(result.verdict is Verdict.FAIL)


def _opened(path: str, arguments: argparse.Namespace) -> Any:
    """Open captures, or the stored clouds of a dataset, which need no options."""
    from pcdata.datasets.stored_clouds import StoredClouds
    from pcdata.io.store.manifest import Manifest

    return StoredClouds(path) if Manifest.is_one(Path(path)) else open_captures(path, arguments)


def _refuse_unused(arguments: argparse.Namespace) -> None:
    """Refuse options about captures where both sources are datasets."""
    from pcdata.errors import ConfigError
    from pcdata.io.store.manifest import Manifest

    given = given_flags(arguments)
    if given and all(Manifest.is_one(Path(path)) for path in (arguments.path, arguments.source)):
        raise ConfigError(f"{', '.join(given)}: of captures, and both sources are datasets; leave it out")
