"""Commands about models: check a data set against a model's contract, print a model's preset."""

from __future__ import annotations

import argparse
from typing import Any

from pcdata.cli.argument_types import positive
from pcdata.cli.choices import add_model_options, given_choices
from pcdata.cli.options import add_import_option
from pcdata.cli.outputs import text_files


def add_to(commands: Any) -> None:
    """Add the commands to the parser."""
    check = commands.add_parser("check", help="check a data set against what a model takes")
    check.add_argument(
        "path", metavar="PATH", help="a built data set, an export, or an npz, HDF5 or zarr v2 file of anyone's"
    )
    add_model_options(check, required=True, help="the model")
    check.add_argument("--keys", metavar="POINTS=NAME,...", help="which array of a foreign file is what")
    check.add_argument("--frame", metavar="NAME", help="frame that you train in; of a foreign file also its frame")
    check.add_argument("--unit", choices=["m", "normalized"], help="unit of a foreign file")
    check.add_argument("--num-points", type=positive, metavar="N", help="count, where the model is used with several")
    check.add_argument("--limit", type=positive, metavar="N", help="only the first N samples")
    check.add_argument("--json", metavar="FILE", help="write the outcome to a new file")
    add_import_option(check)
    check.set_defaults(run=_check)
    models = commands.add_parser("models", help="list the models with a contract, or show one")
    models.add_argument("name", nargs="?", metavar="NAME", help="show this one")
    models.set_defaults(run=_models)


def _check(arguments: argparse.Namespace) -> int:
    from pcdata.exports import is_export
    from pcdata.files.strict_json import json_text
    from pcdata.io.store.manifest import FILE_NAME
    from pcdata.report.validation_text import validation_text
    from pcdata.verdicts import Verdict

    with text_files("check", json=arguments.json) as write:
        if arguments.keys:
            summary = _check_foreign(arguments)
        elif _holds(arguments.path, FILE_NAME):
            summary = _check_cache(arguments)
        else:
            summary = _check_export(arguments) if is_export(arguments.path) else _check_foreign(arguments)
        told = {"schema": "pcdata.check/1", "model": arguments.model, **summary.to_json()}
        write("json", json_text(told, indent=1))
    print(validation_text(summary))
    return int(summary.verdict is Verdict.FAIL)


def _holds(path: str, name: str) -> bool:
    from pathlib import Path

    return (Path(path) / name).exists()


def _choices(arguments: argparse.Namespace) -> dict[str, Any]:
    from pcdata.models import contract

    is_open = not contract(arguments.model).frame  # else the frame says what a foreign file is in
    frame = arguments.frame if is_open else None
    return given_choices(arguments.model, arguments.set, num_points=arguments.num_points, frame=frame)


def _check_cache(arguments: argparse.Namespace) -> Any:
    from pcdata.datasets import CachedCloudDataset
    from pcdata.models import check

    choices = _choices(arguments)
    return check(CachedCloudDataset(arguments.path), arguments.model, limit=arguments.limit, **choices)


def _check_export(arguments: argparse.Namespace) -> Any:
    from pcdata.exports import check_export

    return check_export(
        arguments.path,
        arguments.model,
        frame_id=arguments.frame or "",
        unit=arguments.unit or "",
        limit=arguments.limit,
        **_choices(arguments),
    )


def _check_foreign(arguments: argparse.Namespace) -> Any:
    from pcdata.errors import ConfigError
    from pcdata.models import check_files, contract

    keys = {}
    for pair in (arguments.keys or "").split(",") if arguments.keys else []:
        name, equals, stored = pair.partition("=")
        if not equals:
            raise ConfigError(f"--keys: {pair!r} must be NAME=ARRAY, such as points=data/point_cloud")
        keys[name.strip()] = stored.strip()
    choices = _choices(arguments)
    made = contract(arguments.model, **choices)
    return check_files(
        arguments.path,
        made.name,
        keys,
        frame_id=arguments.frame or "",
        unit=arguments.unit or "",
        limit=arguments.limit,
        **choices,
    )


def _models(arguments: argparse.Namespace) -> int:
    from pcdata.models import CONTRACTS, contract
    from pcdata.models.pages import contract_page
    from pcdata.report.plain_table import text_table

    if arguments.name:
        print(contract_page(contract(arguments.name)))
        return 0
    rows = []
    for one in CONTRACTS.values():
        count = "any" if one.count is None else str(one.count)
        rows.append([one.name, one.frame or "to choose", count, ", ".join(spec.key for spec in one.tensors)])
    print(text_table(["model", "frame", "points", "tensors"], rows))
    return 0
