"""What a model leaves open, given on the command line: ``--model NAME --set CHOICE=VALUE``."""

from __future__ import annotations

import argparse
import shlex
from typing import TYPE_CHECKING, Any

from pcdata.cli.argument_types import name_and_value, value_of
from pcdata.cli.known_names import CHOICES, MODELS

if TYPE_CHECKING:
    from pcdata.models import Preset


def add_model_options(command: argparse.ArgumentParser, *, required: bool, help: str, also: str = "") -> None:
    """Add ``--model`` and ``--set``; ``also`` says what else may be set."""
    command.add_argument("--model", required=required, metavar="NAME", help=f"{help}: {', '.join(MODELS)}")
    command.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="CHOICE=VALUE",
        type=name_and_value,
        help=f"a choice that the model leaves open, of {', '.join(CHOICES)} ('pcdata models NAME' tells){also}; "
        "repeatable",
    )


def given_choices(model: str, pairs: list[tuple[str, str]], **flags: Any) -> dict[str, Any]:
    """Return the choices for a model as it takes them, with those that flags of their own gave.

    Raises:
        ConfigError: an unknown model or choice, one that is given twice, or a value that the model does not allow.
    """
    from pcdata.errors import ConfigError
    from pcdata.models import contract

    choices = {name: value for name, value in flags.items() if value is not None}
    for name, text in pairs:
        if name in choices:
            raise ConfigError(f"--set {name}: is given twice; give it once")
        # Names are texts whatever they look like; a list of them is written with commas.
        choices[name] = text if name == "frame" else text.split(",") if name == "channels" else value_of(text)
    contract(model, **choices)
    return choices


def given_preset(model: str, pairs: list[tuple[str, str]]) -> Preset:
    """Return the preset of a model.

    Raises:
        ConfigError: as :func:`given_choices`; a choice that must be made was not, with words to type.
    """
    from pcdata.errors import ConfigError
    from pcdata.models import contract, preset
    from pcdata.models.catalog import CHOICES, example

    choices = given_choices(model, pairs)
    made = contract(model, **choices)
    left = made.required_choices
    if left:
        lines = [
            f"  --set {shlex.quote(f'{name}={example(made, name)}'.replace(', ', ','))}  {CHOICES[name]}"
            for name in left
        ]
        raise ConfigError(f"{model} leaves open what only you can know; give it, such as\n" + "\n".join(lines))
    return preset(model, **choices)
