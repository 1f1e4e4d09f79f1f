"""The command that writes the card of a dataset: card."""

from __future__ import annotations

import argparse
from typing import Any

from pcdata.cli.options import add_import_option

_ANSWERS = {
    "license": ("NAME", "of the source data, such as cc-by-4.0"),
    "license_link": ("URL", "where its text is"),
    "sensor": ("TEXT", "the depth camera: model, serial, settings"),
    "conditions": ("TEXT", "of the captures: lighting, surfaces, working range"),
    "creator": ("TEXT", "who made the data"),
    "url": ("URL", "where it is at home"),
    "date_published": ("DATE", "such as 2026-01-29"),
    "title": ("TEXT", "of the card (default: the first digits of a hash of the contents)"),
    "description": ("TEXT", "one or two sentences"),
}


def add_to(commands: Any) -> None:
    """Add the command to the parser."""
    card = commands.add_parser(
        "card", help="write README.md and croissant.json of a dataset anew, with what only people know"
    )
    card.add_argument("dataset", metavar="DATASET", help="folder that 'pcdata build' wrote")
    for name, (shown, told) in _ANSWERS.items():
        card.add_argument(f"--{name.replace('_', '-')}", metavar=shown, help=f"{told}; kept in card.yaml of DATASET")
    card.add_argument("--strict", action="store_true", help="fail where something is UNKNOWN, and say how to tell it")
    card.add_argument("--overwrite", action="store_true", help="replace a card that was edited by hand")
    add_import_option(card)
    card.set_defaults(run=_card)


def _card(arguments: argparse.Namespace) -> None:
    from pathlib import Path

    from pcdata.build import write_card

    given = {name: getattr(arguments, name) for name in _ANSWERS}
    missing = write_card(arguments.dataset, given, strict=arguments.strict, overwrite=arguments.overwrite)
    print(f"card     {Path(arguments.dataset) / 'README.md'}")
    if missing:
        print("UNKNOWN  until you say it:", *missing, sep="\n")
