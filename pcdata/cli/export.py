"""The command that writes what other projects' loaders open: export."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from pcdata.cli.argument_types import name_and_value, positive
from pcdata.cli.choices import given_preset
from pcdata.cli.known_names import MODELS, TARGETS
from pcdata.cli.options import add_capture_options, given_flags, open_captures
from pcdata.cli.progress_bar import ProgressBar

if TYPE_CHECKING:
    from pcdata.models import Preset


def add_to(commands: Any) -> None:
    """Add the command to the parser."""
    export = commands.add_parser("export", help="write a dataset or captures in the layout of a model's own loader")
    export.add_argument(
        "path", metavar="PATH", help="dataset that 'pcdata build' wrote; or captures, for image targets or with --model"
    )
    export.add_argument("--to", required=True, metavar="NAME", help=f"target: {', '.join(TARGETS)}")
    export.add_argument("--out", required=True, metavar="DIR", help="folder of the export")
    export.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="OPTION=VALUE",
        type=name_and_value,
        help="option of the target; repeatable: " + "; ".join(_options_in_words()),
    )
    export.add_argument(
        "--model",
        metavar="NAME",
        help="make clouds of captures as this model takes them, without a dataset between; its choices are --set too: "
        f"{', '.join(MODELS)}",
    )
    add_capture_options(export)
    export.add_argument("--seed", type=int, metavar="N", help="of the random end of a built dataset's pipeline (0)")
    export.add_argument("--epoch", type=int, metavar="N", help="which epoch's draws (0)")
    export.add_argument(
        "--copies", type=positive, metavar="K", help="every sample so often, each time with other random draws (1)"
    )
    export.add_argument(
        "--as-stored", action="store_true", help="leave out the random end: the clouds as the build stored them"
    )
    export.add_argument("--split", metavar="NAME", help="only one split of a built dataset, such as train")
    export.add_argument(
        "--skip-bad",
        action="store_true",
        help="leave out samples that do not fit, and what goes with them, and say which and why",
    )
    export.add_argument("--limit", type=positive, metavar="N", help="only the first N captures")
    again = export.add_mutually_exclusive_group()
    again.add_argument(
        "--continue",
        dest="resume",
        action="store_true",
        help="keep what is finished, and go on where a run was stopped",
    )
    again.add_argument("--overwrite", action="store_true", help="replace the export that is in DIR")
    export.set_defaults(run=_export)


def _options_in_words() -> list[str]:
    alike: dict[tuple[str, ...], list[str]] = {}
    for target, options in TARGETS.items():
        alike.setdefault(options, []).append(target)
    return [f"{', '.join(targets)}: {', '.join(options)}" for options, targets in alike.items()]


def _export(arguments: argparse.Namespace) -> None:
    from pcdata.datasets import CachedCloudDataset, CloudDataset
    from pcdata.errors import ConfigError
    from pcdata.exports import export_dataset
    from pcdata.exports.export_record import FILE_NAME
    from pcdata.exports.export_source import is_built
    from pcdata.exports.targets import target_named
    from pcdata.files.sample_names import counted
    from pcdata.report.inspection_text import skipped_text

    options: dict[str, Any] = dict(arguments.set)
    draws = {name: getattr(arguments, name) for name in ("seed", "epoch", "copies")}
    if len(options) != len(arguments.set):
        raise ConfigError("export: an option is set twice; set it once")
    preset = None
    if arguments.model is not None:
        preset, options = _for_model(arguments.model, arguments.to, arguments.set)
    target_named(arguments.to, options)  # a wrong name must not wait for a folder to be listed
    source: Any = arguments.path
    if not is_built(source):
        if arguments.as_stored:
            raise ConfigError(f"export: --as-stored is for a built dataset, and {source} is none; leave it out")
        if arguments.split is not None:
            raise ConfigError(f"export: --split is for a built dataset, and {source} is none; leave it out")
        source = open_captures(source, arguments, limit=arguments.limit)
        source = source if preset is None else CloudDataset(source, preset.pipeline)
    elif preset is not None:
        raise ConfigError(f"export: {source} is a built dataset, whose clouds are made; --model is for captures")
    elif given := given_flags(arguments, "--limit"):
        flags = ", ".join(given)
        raise ConfigError(f"export: {source} is a built dataset, which {flags} cannot change; leave that out")
    elif arguments.as_stored:
        if drawn := [name for name, value in draws.items() if value is not None]:
            raise ConfigError(
                f"export: --as-stored draws nothing, so --{', --'.join(drawn)} say nothing; leave one out"
            )
        source = CachedCloudDataset(source, augment=None, split=arguments.split)
    elif arguments.split is not None:
        source = CachedCloudDataset(source, split=arguments.split)
    with ProgressBar("export") as progress:
        report = export_dataset(
            source,
            arguments.to,
            arguments.out,
            **draws,
            skip_bad=arguments.skip_bad,
            overwrite=arguments.overwrite,
            resume=arguments.resume,
            progress=progress,
            **options,
        )
    kept = f", {report.kept} were there" if report.kept else ""
    print(f"export  {report.folder}  ({report.target}: {counted(report.written, 'sample')} written{kept})")
    if report.left_out:
        print(skipped_text(report.left_out, "sample", FILE_NAME))
    for note in report.notes:
        print(f"note    {note}")


def _for_model(model: str, to: str, pairs: list[tuple[str, str]]) -> tuple[Preset, dict[str, Any]]:
    """Return the preset, and the options of the target: what is said of both, such as the frame, is said once.

    Raises:
        ConfigError: no such model, target, choice or option, or the target is of captures.
    """
    from dataclasses import fields

    from pcdata.errors import ConfigError
    from pcdata.exports.export_source import options_for_model
    from pcdata.exports.targets import TARGETS as KNOWN
    from pcdata.models import contract
    from pcdata.models.catalog import possible_choices

    kind = KNOWN.named("export", to)
    if kind.takes == "captures":
        raise ConfigError(f"export: {to} is written from depth images, of which --model makes clouds; leave it out")
    choices = possible_choices(contract(model))
    own = {field.name for field in fields(kind)}
    preset = given_preset(model, [(name, text) for name, text in pairs if name in choices])
    options = {name: text for name, text in pairs if name in own or name not in choices}
    return preset, {**options_for_model(model, preset.plain_choices(), kind), **options}
