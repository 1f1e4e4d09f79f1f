"""The entry point: parse, run one command, turn errors into exit codes."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
from collections.abc import Sequence
from contextlib import suppress

from pcdata import __version__
from pcdata.cli import signals
from pcdata.cli.printable import printable_output
from pcdata.cli.signals import signals_interrupt
from pcdata.cli.threads import wait_asleep
from pcdata.cli.warning_lines import warnings_in_one_line
from pcdata.errors import ConfigError, PcdataError, is_out_of_memory, near_matches

_NOTHING_LEFT = "nothing half-written was left behind"


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return the exit code: 0 done, 1 the data or a file is at fault, 2 the request is.

    3 of a build that is done but for captures that were quarantined; 128 and the number of the signal where one ended
    it. Without ``argv`` this is the whole life of the process.
    """
    with printable_output(), warnings_in_one_line(), signals_interrupt(until_exit=argv is None) as heard:
        kept: list[str] = []  # what an unfinished build says of itself
        try:
            return _run(argv)
        except KeyboardInterrupt as error:
            heard.over = True
            kept = [str(note) for note in getattr(error, "__notes__", ())]
        except Exception:  # a library may turn what a signal raises into an error of its own
            if heard.first is None:
                raise
            heard.over = True
        with suppress(OSError):  # the terminal may be gone
            print("; ".join(["interrupted", *(kept or [_NOTHING_LEFT])]), file=sys.stderr, flush=True)
        return heard.code


def _run(argv: Sequence[str] | None) -> int:
    wait_asleep()
    words = sys.argv[1:] if argv is None else [*argv]
    arguments = _parsed(words)
    arguments.words = words[next((place for place, word in enumerate(words) if word[:1] != "-"), 0) + 1 :]
    try:
        _import(getattr(arguments, "imports", []))
        _refuse_empty(arguments)
        _refuse_url(arguments)
        _refuse_replacing(arguments)
        verdict: int | None = arguments.run(arguments)  # a command that judges returns its exit code
        sys.stdout.flush()
    except PcdataError as error:
        if arguments.debug or signals.current.first is not None:
            raise
        print(f"pcdata: {error}", file=sys.stderr)
        for note in getattr(error, "__notes__", ()):
            print(f"  {note}", file=sys.stderr)
        _tell_how_to_leave_out(arguments, error)
        _tell_what_is_needed(words, str(error))
        return 2 if isinstance(error, ConfigError) else 1
    except BrokenPipeError:  # "pcdata inspect ... | head" has read enough
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115  # for the flush at exit
        return 0
    except (OSError, MemoryError, RuntimeError) as error:
        starved = is_out_of_memory(error)
        if arguments.debug or signals.current.first is not None or not (starved or isinstance(error, OSError)):
            raise
        told = str(error).splitlines()[0] if str(error) else ""
        print(f"pcdata: {'not enough memory: ' * starved}{told}".removesuffix(": "), file=sys.stderr)
        return 1
    return verdict or 0


def _parsed(words: Sequence[str]) -> argparse.Namespace:
    """Read the words; of one that the command does not know, say which it may have been."""
    parser = _parser()
    _refuse_unknown_command(parser, words)
    arguments, unknown = parser.parse_known_args(words)
    if not unknown:
        return arguments
    for word in words:
        below = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
        parser = below[0].choices.get(word, parser) if below else parser
    flags = [flag for action in parser._actions for flag in action.option_strings]
    strange = next((word for word in unknown if word.startswith("-")), unknown[0])
    parser.error(f"unrecognized arguments: {' '.join(unknown)}{near_matches(strange.partition('=')[0], flags)}")


def _refuse_unknown_command(parser: argparse.ArgumentParser, words: Sequence[str]) -> None:
    """Say which command may have been meant; argparse would list them all, in an order of its own."""
    for word in words:
        below = next((one for one in parser._actions if isinstance(one, argparse._SubParsersAction)), None)
        if below is None or word.startswith("-"):
            if word in ("-h", "--help") or below is None:
                return
            continue
        if word not in below.choices:
            hint = near_matches(word, below.choices)
            parser.error(f"there is no command {word!r}{hint}; {parser.prog} --help lists them")
        parser = below.choices[word]


def _refuse_empty(arguments: argparse.Namespace) -> None:
    """Refuse a path without a letter, which would stand for the folder that one is in."""
    for name in (
        "path",
        "reference",
        "dataset",
        "source",
        "config",
        "out",
        "file",
        "json",
        "figure",
        "png",
        "calibration",
        "table",
    ):
        if getattr(arguments, name, None) == "":
            raise ConfigError(f"{name}: is empty; give a path, or leave it out (is a variable of the shell not set?)")


def _refuse_url(arguments: argparse.Namespace) -> None:
    """Refuse a URL as --out of a command that writes to the disk alone, before it does anything."""
    out = getattr(arguments, "out", None)
    if isinstance(out, str) and ":" in out and not hasattr(arguments, "out_may_be_url"):
        from pcdata.files.urls import url_hint

        if hint := url_hint(out):
            raise ConfigError(f"--out: {hint}")


def _refuse_replacing(arguments: argparse.Namespace) -> None:
    """Refuse what is written among what is read: it could replace a file there, or be taken for one of them."""
    for written in ("json", "figure", "png", "out"):
        place = getattr(arguments, written, None)
        if not isinstance(place, str) or place == "-" or (written == "out" and hasattr(arguments, "out_may_be_url")):
            continue
        for read in ("path", "source", "reference", "images", "poses"):
            given = getattr(arguments, read, None)
            for path in given if isinstance(given, list) else [given]:
                if isinstance(path, str):
                    from pcdata.io.sources.capture_source import check_apart

                    check_apart(f"--{written}", place, path)


def _tell_how_to_leave_out(arguments: argparse.Namespace, error: PcdataError) -> None:
    """Say which options leave a capture out that stopped the command, where it takes them and nothing said so."""
    notes = [str(note) for note in getattr(error, "__notes__", ())]
    if not hasattr(arguments, "skip") or error.sample_id is None or any("--skip" in note for note in notes):
        return
    if any(note.startswith("while loading sample") for note in notes):
        others = ", or all such captures with --skip-refused" if hasattr(arguments, "skip_refused") else ""
        print(f"  leave it out with --skip {shlex.quote(error.sample_id)}{others}", file=sys.stderr)


def _tell_what_is_needed(words: Sequence[str], message: str) -> None:
    """Give the command once more with the options that captures are said to need; inspect does so by itself."""
    from pcdata.report.unopened_text import needed_options

    if "inspect" not in words[:2] and (needed := needed_options(message)):
        print(f"  next: pcdata {shlex.join(words)} {needed}", file=sys.stderr)


def _import(paths: Sequence[str]) -> None:
    if paths:
        from pcdata.imports import import_file

        for path in paths:
            import_file(path)


def _parser() -> argparse.ArgumentParser:
    # Imported here, where a signal is heard already.
    from pcdata.cli import (
        build,
        calib,
        card,
        clouds,
        compare,
        convert,
        datasets,
        drift,
        evaluate,
        export,
        fuse,
        models,
        report,
        sensors,
        split,
        validate,
        verify,
        view,
    )

    parser = argparse.ArgumentParser(prog="pcdata", description="From raw depth frames to training-ready point clouds.")
    parser.add_argument("--version", action="version", version=f"pcdata {__version__}")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    groups = (
        datasets,
        build,
        split,
        card,
        verify,
        convert,
        clouds,
        fuse,
        export,
        validate,
        report,
        view,
        drift,
        compare,
        evaluate,
        models,
        sensors,
        calib,
    )
    for group in groups:
        group.add_to(commands)
    for command in commands.choices.values():  # also after the command, where one adds it to a line that failed
        command.add_argument("--debug", action="store_true", default=argparse.SUPPRESS, help=argparse.SUPPRESS)
    return parser
