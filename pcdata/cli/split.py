"""The command that says what is for training and what is held out: split."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from pcdata.cli.known_names import PUBLISHED_SPLITS, SPLIT_RULES
from pcdata.cli.options import add_import_option
from pcdata.cli.progress_bar import ProgressBar

if TYPE_CHECKING:
    from pcdata.datasets import Splits


def add_to(commands: Any) -> None:
    """Add the command to the parser."""
    split = commands.add_parser("split", help="say which samples of a dataset are for training and which are held out")
    split.add_argument("dataset", metavar="DATASET", help="folder that 'pcdata build' wrote")
    split.add_argument(
        "--parts",
        type=_parts,
        metavar="NAME=HOW_MUCH,...",
        help="shares, numbers of groups, or rest (default: train=0.8,val=0.1,test=0.1)",
    )
    split.add_argument(
        "--by",
        metavar="RULE",
        help=f"what stays together: {', '.join(SPLIT_RULES)} (default: episode where there are any, else sample)",
    )
    split.add_argument(
        "--named-by",
        metavar="NAME",
        help=f"draw nothing: the splits of a published data set ({', '.join(PUBLISHED_SPLITS)}), or a RULE that names "
        "each sample's, such as column:split",
    )
    split.add_argument(
        "--stratify",
        action="append",
        metavar="RULE",
        help="an attribute that all splits get in like shares, such as column:object_set; repeatable",
    )
    split.add_argument("--table", metavar="FILE", help="CSV with the column sample, or JSON from id to values: columns")
    split.add_argument("--seed", type=int, metavar="N", help="of the draw (default: 0)")
    split.add_argument("--file", metavar="FILE", help="write the splits there (default: splits.json in DATASET)")
    split.add_argument("--fresh", action="store_true", help="draw all anew (default: what has a split keeps it)")
    check = split.add_mutually_exclusive_group()
    check.add_argument("--check", action="store_true", help="draw nothing; look for leaks in the splits that are there")
    check.add_argument("--no-check", action="store_true", help="do not look for near duplicates across the splits")
    add_import_option(split)
    split.set_defaults(run=_split)


def _parts(text: str) -> dict[str, float | int | None]:
    parts: dict[str, float | int | None] = {}
    for entry in text.split(","):
        name, sign, value = entry.partition("=")
        try:
            number = None if value == "rest" else float(value) if "." in value else int(value)
        except ValueError:
            sign = ""
        if not sign or not name or name in parts:
            raise argparse.ArgumentTypeError(
                f"must be NAME=SHARE,NAME=COUNT,NAME=rest with every name once, such as train=rest,val=0.1,test=20, "
                f"got {entry!r}"
            )
        parts[name] = number
    return parts


def _split(arguments: argparse.Namespace) -> int:
    from pcdata.datasets import Splits
    from pcdata.datasets.leak_check import check_leaks
    from pcdata.errors import ConfigError
    from pcdata.report.split_text import leaks_text, splits_text

    drawing = ("parts", "by", "named_by", "stratify", "seed", "table", "fresh")
    if arguments.check:
        if given := [
            f"--{name.replace('_', '-')}" for name in drawing if getattr(arguments, name) not in (None, False)
        ]:
            raise ConfigError(
                f"split: --check only looks at the splits that are there, and {', '.join(given)} would draw some; "
                "leave out --check to draw them, which looks for leaks too"
            )
        print(splits_text(Splits.read(arguments.file or arguments.dataset)))
    else:
        print(splits_text(_drawn(arguments)))
        if arguments.file is None:
            _write_card(arguments.dataset)
    if arguments.no_check:
        return 0
    with ProgressBar("leaks") as progress, ProgressBar("compare", unit="pair") as comparing:
        report = check_leaks(arguments.dataset, path=arguments.file, progress=progress, comparing=comparing)
    print(f"\n{leaks_text(report)}")
    return int(not report.is_clean)


def _write_card(dataset: str) -> None:
    """Let the card tell of the new splits, unless somebody edited it."""
    from pcdata.build import write_card
    from pcdata.errors import ConfigError

    try:
        write_card(dataset)
    except ConfigError as error:
        print(f"note: the card does not tell of these splits: {error}")


def _drawn(arguments: argparse.Namespace) -> Splits:
    from pcdata.datasets import split_dataset

    return split_dataset(
        arguments.dataset,
        arguments.parts,
        by=arguments.by,
        named_by=arguments.named_by,
        stratify=arguments.stratify,
        seed=arguments.seed,
        table=arguments.table,
        path=arguments.file,
        fresh=arguments.fresh,
    )
