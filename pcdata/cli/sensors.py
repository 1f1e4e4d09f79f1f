"""Commands about depth sensors: profiles."""

from __future__ import annotations

import argparse
from typing import Any


def add_to(commands: Any) -> None:
    """Add the commands to the parser."""
    profiles = commands.add_parser("profiles", help="list the depth sensors that are known, or show one")
    profiles.add_argument("name", nargs="?", metavar="NAME", help="show everything about this one, with sources")
    profiles.set_defaults(run=_profiles)


def _profiles(arguments: argparse.Namespace) -> None:
    from pcdata.report.sensor_text import profile_text, profiles_text

    print(profiles_text() if arguments.name is None else profile_text(arguments.name))
