"""Options that several commands share, and what they open."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from pcdata.cli.argument_types import name_and_value, value_of
from pcdata.cli.capture_flags import COMBINATOR_FLAGS, LAYOUT_FLAGS
from pcdata.cli.known_names import KINDS, SENSORS

_NO_OPTIONS = {  # of opening captures, not of their layout
    "path": "the path itself",
    "kind": "--kind",
    "only": "--only",
    "limit": "--limit",
    "skip": "--skip",
    "skip_refused": "--skip-refused",
}


def add_capture_options(command: argparse.ArgumentParser, *, can_skip_refused: bool = True) -> None:
    """Add what says how captures are to be read, and which are left out."""
    command.add_argument(
        "--kind",
        metavar="LAYOUT",
        help=f"capture layout, where it cannot be told from the files: {', '.join(KINDS)}",
    )
    add_layout_options(command, tuple(LAYOUT_FLAGS))
    add_combinator_options(command)
    add_skip_options(command, can_skip_refused=can_skip_refused)
    add_import_option(command)


def add_depths_of_interest(command: argparse.ArgumentParser) -> None:
    """Add what the depths are judged against."""
    depths = command.add_mutually_exclusive_group()
    depths.add_argument(
        "--workspace",
        type=float,
        nargs=2,
        metavar=("NEAR", "FAR"),
        help="depths of the task's scene in metres, such as 0.2 1.5, which most readings must lie in "
        "(default: not judged)",
    )
    depths.add_argument(
        "--sensor", metavar="NAME", help=f"depths that a sensor measures, in their place: of {', '.join(SENSORS)}"
    )


def depths_of_interest(arguments: argparse.Namespace) -> Any:
    """Return the limits of checks that follow from the depths of interest."""
    from pcdata.validation import CaptureLimits

    if arguments.workspace:
        return CaptureLimits(workspace=tuple(arguments.workspace))
    return CaptureLimits.for_sensor(arguments.sensor) if arguments.sensor else CaptureLimits()


def add_import_option(command: argparse.ArgumentParser) -> None:
    """Add what runs a file of the user's own before the command."""
    command.add_argument(
        "--import",
        dest="imports",
        action="append",
        default=[],
        metavar="FILE.py",
        help="run this Python file first: transforms, layouts and combinators of your own; repeatable",
    )


def add_layout_options(command: argparse.ArgumentParser, names: tuple[str, ...]) -> None:
    """Add the flags of some options of the layouts."""
    for name in names:
        flag, settings = LAYOUT_FLAGS[name]
        command.add_argument(flag, **settings)


def add_combinator_options(command: argparse.ArgumentParser) -> None:
    """Add what says how captures are combined, and any option by its name."""
    command.add_argument(
        "--option",
        action="append",
        default=[],
        type=name_and_value,
        metavar="NAME=VALUE",
        help="any option of the layout by its name in Python, or a field of a combinator, such as "
        "averaged.max_jump=0.05; repeatable",
    )
    for name, (_, described) in COMBINATOR_FLAGS.items():
        command.add_argument(f"--{name}", **described)


def add_skip_options(command: argparse.ArgumentParser, *, can_skip_refused: bool = True) -> None:
    """Add what leaves captures out."""
    command.add_argument(
        "--only", action="append", metavar="PATTERN", help="keep captures whose ids fit, such as 'left_*'; repeatable"
    )
    command.add_argument("--skip", action="append", metavar="ID", help="leave this capture out; repeatable")
    command.add_argument("--skip-file", metavar="FILE", help="leave out the captures listed in FILE, one id on a line")
    if can_skip_refused:
        command.add_argument(
            "--skip-refused",
            action="store_const",
            const=True,
            help="leave out captures that cannot be read or processed, and say which and why (default: stop at one)",
        )


def given_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the options of a layout and the combinators that the command line states, by their names in Python.

    Raises:
        ConfigError: one is stated twice.
    """
    from pcdata.errors import ConfigError

    given: dict[str, Any] = {}
    for name, (flag, _) in LAYOUT_FLAGS.items():
        value = getattr(arguments, attribute_of(flag), None)
        if value is not None:
            given[name] = value
    if "folders" in given:
        given["folders"] = {role: folder or None for role, folder in given["folders"]}
    given |= {name: dict(given[name]) for name in ("camera_info", "poses") if name in given}
    if "signals" in given:
        given["signals"] = {name: _stated_kind(said) for name, said in given["signals"]}
    for name, (field, _) in COMBINATOR_FLAGS.items():
        if (value := getattr(arguments, name, None)) is not None:
            given[name] = value if field == "num_frames" else {field: value}
    for name, text in getattr(arguments, "option", []):
        combinator, dot, inner = name.partition(".")
        if dot:
            fields = given.get(combinator, {})
            fields = dict(fields) if isinstance(fields, dict) else {"num_frames": fields}
            if inner in fields:
                raise ConfigError(f"--option {name}: this field is given twice; give it once")
            given[combinator] = {**fields, inner: value_of(text)}
            continue
        if name in _NO_OPTIONS:
            raise ConfigError(f"--option {name}: is no option of a layout; say it with {_NO_OPTIONS[name]}")
        if name in given:
            raise ConfigError(f"--option {name}: this option is given twice; give it once")
        given[name] = value_of(text)
    return given


def _stated_kind(text: str) -> dict[str, str] | None:
    """Read ``KIND in FRAME`` or ``KIND``; nothing = the stream is left out."""
    kind, mark, frame = (part.strip() for part in text.rpartition(" in "))
    return ({"kind": kind, "frame": frame} if mark else {"kind": frame}) if text.strip() else None


def given_flags(arguments: argparse.Namespace, *others: str) -> list[str]:
    """Return the flags about captures, and those of ``others``, that the command line states."""
    layout = [flag for flag, _ in LAYOUT_FLAGS.values()]
    combined = [f"--{name}" for name in COMBINATOR_FLAGS]
    flags = ["--kind", *layout, *combined, "--option", "--only", "--skip", "--skip-file", "--skip-refused"]
    return [flag for flag in (*flags, *others) if getattr(arguments, attribute_of(flag), None)]


def said_again(arguments: argparse.Namespace, *without: str) -> list[str]:
    """Return the words that followed the command: path and options, but for some flags with a value."""
    kept: list[str] = []
    words = iter(arguments.words)
    for word in words:
        if word in without:
            next(words, None)
        elif word != "--debug" and not word.startswith(tuple(f"{flag}=" for flag in without)):
            kept.append(word)
    return kept


def skip_list(arguments: argparse.Namespace) -> list[str]:
    """Return the ids that the command line leaves out."""
    from pcdata.io.sources.open_source import read_skip_file

    listed = list(arguments.skip or [])
    return listed + (read_skip_file(arguments.skip_file) if arguments.skip_file else [])


def open_captures(path: str, arguments: argparse.Namespace, limit: int | None = None) -> Any:
    """Open the captures at a path as the options say; captures that are left out are told on stderr."""
    from pcdata.io import open_source

    source = open_source(
        path,
        kind=arguments.kind,
        only=arguments.only or (),
        limit=limit,
        skip=skip_list(arguments),
        skip_refused=bool(getattr(arguments, "skip_refused", False)),
        **given_options(arguments),
    )
    tell_skipped(source.skipped)
    return source


def tell_skipped(skipped: dict[str, str]) -> None:
    """Say on stderr how many captures were left out, and which and why for the first."""
    from pcdata.files.sample_names import counted

    for sample_id, reason in list(skipped.items())[:20]:
        print(f"left out {sample_id}: {reason}", file=sys.stderr)
    if len(skipped) > 20:
        print(f"left out {counted(len(skipped), 'capture')} in all", file=sys.stderr)


def attribute_of(flag: str) -> str:
    """Return the attribute that argparse keeps a flag in."""
    return flag.removeprefix("--").replace("-", "_")
