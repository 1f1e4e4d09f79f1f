"""docs/steps.md: every step of a pipeline in one line, with its fields; made from here.

``python -m tests.transforms.test_steps_page > docs/steps.md`` writes the page anew.
"""

from __future__ import annotations

import dataclasses
import inspect
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pcdata
from pcdata.structures import DepthFrame, PointCloud
from pcdata.transforms import Transform
from pcdata.transforms.base import REGISTRY

ROOT = Path(__file__).parents[2]
OF_MANY = ("max_drop", "drop_alarm")  # told once, above the tables
GROUPS: dict[str, Callable[[type[Transform]], bool]] = {
    "Depth images": lambda step: not step.is_random and step.gives is DepthFrame,
    "From depth to points": lambda step: step.takes is DepthFrame and step.gives is PointCloud,
    "Clouds": lambda step: not step.is_random and step.takes is PointCloud,
    "Random": lambda step: step.is_random,
}


def steps() -> dict[str, type[Transform]]:
    """The steps of pcdata by name, without the chain itself."""
    own = {name: step for name, step in REGISTRY.items() if step.__module__.startswith("pcdata.")}
    return {name: own[name] for name in sorted(own) if name != "Compose"}


def fields(step: type[Transform]) -> str:
    """The fields as they are written in Python; those without a value must be given."""
    return ", ".join(f"`{_field(field)}`" for field in dataclasses.fields(step) if field.name not in OF_MANY)


def _field(field: dataclasses.Field[Any]) -> str:
    if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
        return field.name
    value = field.default_factory() if field.default is dataclasses.MISSING else field.default
    return f"{field.name}={value:.4g}" if isinstance(value, float) else f"{field.name}={value!r}"


def does(step: type[Transform]) -> str:
    """The first paragraph of the docstring, on one line."""
    text = " ".join((inspect.getdoc(step) or "").split("\n\n")[0].split())
    return text.replace("``", "`").replace("|", "\\|")


def page() -> str:
    found = steps()
    lines = [
        "# Steps: what a pipeline is made of",
        "",
        "Made by `tests/transforms/test_steps_page.py` from the steps themselves. A step is `pcdata.NAME(field=value)` "
        "in Python and `- NAME: {field: value}` in a configuration, where depth images go through the section `depth`, "
        "clouds through `cloud`, and what is drawn anew for every epoch through `augment`. Fields without a value must "
        "be given. Lengths are metres, angles radians, but where a field says otherwise; `help(pcdata.NAME)` tells "
        "what each field means.",
        "",
        "Steps that drop points or readings also take `max_drop`, the largest part of one cloud that they may drop, "
        'and `drop_alarm`, what happens beyond it: `"error"` or `"warn"`.',
    ]
    for title, belongs in GROUPS.items():
        lines += ["", f"## {title}", "", "| step | does | fields |", "|---|---|---|"]
        lines += [f"| `{name}` | {does(step)} | {fields(step)} |" for name, step in found.items() if belongs(step)]
    lines += [
        "",
        "A step of your own is a class: [examples/04](../examples/04_steps_and_readers_of_your_own.py). Which calls of "
        "other libraries a step stands for: [coming_from.md](coming_from.md).",
    ]
    return "\n".join(lines) + "\n"


def test_the_page_is_made_from_the_steps():
    assert (ROOT / "docs" / "steps.md").read_text(encoding="utf-8") == page()


def test_every_step_is_on_the_page_once_and_is_called_as_it_says():
    for name, step in steps().items():
        assert page().count(f"| `{name}` |") == 1
        assert getattr(pcdata, name) is step


if __name__ == "__main__":
    sys.stdout.write(page())
