"""The entry point: parse, run one command, turn errors into exit codes."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

from pcdata import __version__
from pcdata.cli import calib, datasets, export, models, sensors, validate
from pcdata.cli.progress import signals_interrupt
from pcdata.errors import ConfigError, PcdataError


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return the exit code: 0 done, 1 the data or a file is at fault, 2 the request is."""
    arguments = _parser().parse_args(argv)
    try:
        with signals_interrupt():
            verdict = arguments.run(arguments)  # a command that judges returns its exit code
            sys.stdout.flush()
    except KeyboardInterrupt:
        print("interrupted; nothing half-written was left behind", file=sys.stderr)
        return 130
    except PcdataError as error:
        if arguments.debug:
            raise
        print(f"pcdata: {error}", file=sys.stderr)
        for note in getattr(error, "__notes__", ()):
            print(f"  {note}", file=sys.stderr)
        return 2 if isinstance(error, ConfigError) else 1
    except BrokenPipeError:  # "pcdata inspect ... | head" has read enough
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115  # for the flush at exit
        return 0
    except OSError as error:
        if arguments.debug:
            raise
        print(f"pcdata: {error}", file=sys.stderr)
        return 1
    return verdict or 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="pcdata", description="From raw depth frames to training-ready point clouds.")
    parser.add_argument("--version", action="version", version=f"pcdata {__version__}")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for group in (datasets, export, validate, models, sensors, calib):
        group.add_to(commands)
    for command in commands.choices.values():  # also after the command, where one adds it to a line that failed
        command.add_argument("--debug", action="store_true", default=argparse.SUPPRESS, help=argparse.SUPPRESS)
    return parser
