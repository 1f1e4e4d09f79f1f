"""The command that hashes a built dataset again: verify."""

from __future__ import annotations

import argparse
from typing import Any

from pcdata.cli.argument_types import positive
from pcdata.cli.progress_bar import ProgressBar


def add_to(commands: Any) -> None:
    """Add the command to the parser."""
    verify = commands.add_parser(
        "verify", help="hash every file of a dataset again: names what is damaged, missing or foreign, and the samples"
    )
    verify.add_argument("dataset", metavar="DATASET", help="folder of a built dataset")
    verify.add_argument("--workers", type=positive, default=1, metavar="N", help="files hashed at a time (default: 1)")
    verify.set_defaults(run=_verify)


def _verify(arguments: argparse.Namespace) -> int:
    from pcdata.build import verify_dataset
    from pcdata.report.verification_text import verification_text

    with ProgressBar("verify", unit="shard") as progress:
        verdict = verify_dataset(arguments.dataset, workers=arguments.workers, progress=progress)
    print(verification_text(verdict))
    return int(bool(verdict.faults))
