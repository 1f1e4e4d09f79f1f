"""Options that several commands share, and what they open."""

from __future__ import annotations

import argparse
from typing import Any


def add_capture_options(command: argparse.ArgumentParser) -> None:
    """Add what says how captures are to be read."""
    command.add_argument("--kind", metavar="LAYOUT", help="capture layout, where it cannot be told from the files")
    command.add_argument("--metres-per-unit", type=float, metavar="M", help="length of one stored depth unit")
    command.add_argument(
        "--calibration", metavar="FILE", help="calibration file: its intrinsics, and with --frame its poses, are used"
    )
    command.add_argument("--camera", metavar="NAME", help="which camera of the calibration (default: the only one)")
    command.add_argument("--frame", metavar="NAME", help="frame that the poses lead to, such as base")


def open_captures(path: str, arguments: argparse.Namespace, limit: int | None = None) -> Any:
    """Open the captures at a path as the options say."""
    from pcdata.io import open_source

    given = {
        "metres_per_unit": arguments.metres_per_unit,
        "calibration": arguments.calibration,
        "camera": arguments.camera,
        "frame_id": arguments.frame,
    }
    options = {name: value for name, value in given.items() if value is not None}
    return open_source(path, kind=arguments.kind, limit=limit, **options)


def name_and_value(text: str) -> tuple[str, str]:
    """Split NAME=VALUE."""
    name, sign, value = text.partition("=")
    if not sign or not name:
        raise argparse.ArgumentTypeError(f"must be NAME=VALUE, got {text!r}")
    return name, value


def positive(text: str) -> int:
    """Parse a whole number of at least 1."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number of at least 1, got {text!r}")
    return int(text)
