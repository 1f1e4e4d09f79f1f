"""The command that writes captures in another layout: convert."""

from __future__ import annotations

import argparse
from typing import Any

from pcdata.cli.argument_types import name_and_value, positive, value_of
from pcdata.cli.known_names import WRITERS
from pcdata.cli.options import add_capture_options, open_captures
from pcdata.cli.progress_bar import ProgressBar


def add_to(commands: Any) -> None:
    """Add the command to the parser."""
    convert = commands.add_parser(
        "convert", help="write captures of any layout as ROS 2 recordings, a plain folder, ...: docs/convert.md"
    )
    convert.add_argument("path", metavar="PATH", help="folder or file of captures, or a pattern of them")
    convert.add_argument("--to", required=True, metavar="NAME", help=f"layout to write: {', '.join(WRITERS)}")
    convert.add_argument("--out", required=True, metavar="DIR", help="a new folder")
    convert.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="OPTION=VALUE",
        type=name_and_value,
        help="option of the layout that is written; repeatable: "
        + "; ".join(f"{name}: {', '.join(options)}" for name, options in WRITERS.items() if options),
    )
    convert.add_argument(
        "--dry-run", action="store_true", help="write nothing: tell what would be written and lost, by a few captures"
    )
    add_capture_options(convert)
    convert.add_argument("--limit", type=positive, metavar="N", help="only the first N captures")
    convert.set_defaults(run=_convert)


def _convert(arguments: argparse.Namespace) -> None:
    from pcdata.errors import ConfigError
    from pcdata.io import convert
    from pcdata.io.writers.registry import writer_named
    from pcdata.report.conversion_text import conversion_text

    options = {name: value_of(value) for name, value in arguments.set}
    if len(options) != len(arguments.set):
        raise ConfigError("convert: an option is set twice; set it once")
    writer_named("convert", arguments.to, options)  # a wrong name must not wait for a folder to be listed
    source = open_captures(arguments.path, arguments, limit=arguments.limit)
    with ProgressBar("convert") as progress:
        report = convert(source, arguments.to, arguments.out, progress=progress, dry_run=arguments.dry_run, **options)
    print(conversion_text(report))
