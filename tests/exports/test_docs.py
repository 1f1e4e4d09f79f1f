"""docs/exports.md names every target and every option."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path

import pytest

from pcdata.exports import TARGETS

TEXT = (Path(__file__).parents[2] / "docs" / "exports.md").read_text(encoding="utf-8")
LAYOUTS, OPTIONS = TEXT.split("## Options and traps")


@pytest.mark.parametrize("name", TARGETS)
def test_every_target_and_option_is_explained(name):
    assert f"| `{name}`, " in LAYOUTS
    (row,) = re.findall(rf"^\| `{name}` \|(.*?)\|", OPTIONS, re.MULTILINE)
    for other in re.findall(r"as `(\w+)`", row):
        row += re.findall(rf"^\| `{other}` \|(.*?)\|", OPTIONS, re.MULTILINE)[0]
    named = set(re.findall(r"`(\w+)`", row)) - set(TARGETS)
    assert named == {field.name for field in fields(TARGETS[name])}


@pytest.mark.parametrize("name", TARGETS)
def test_the_page_says_whose_rules_hold_and_which_are_left_to_the_loader(name):
    target = TARGETS[name]
    rules = TEXT.split("## Whose rules, and what ran")[1].split("## Options and traps")[0]
    (contract, left) = re.findall(rf"^\| `{name}` \|([^|]*)\|([^|]*)\|", rules, re.MULTILINE)[0]
    assert contract.strip() == ", ".join(f"[{model}](models/{model}.md)" for model in target.models())
    said = set() if left.strip().startswith("nothing") else {word.strip() for word in left.split(",")}
    assert said == target.left_to_loader
