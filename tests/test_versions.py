"""The oldest versions that are tested are the lower bounds that pyproject.toml states, all of them."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def stated() -> tuple[list[str], list[str]]:
    tomllib = pytest.importorskip("tomllib", reason="Python 3.10 has no reader of TOML")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return project["dependencies"], [line for extra in project["optional-dependencies"].values() for line in extra]


def oldest() -> dict[str, str]:
    text = (ROOT / "constraints-oldest.txt").read_text()
    return dict(re.findall(r"^([\w.-]+)==(\S+)$", text, re.MULTILINE))


def numbers(version: str) -> tuple[int, ...]:
    """1.26 and 1.26.0 are one version."""
    parts = [int(part) for part in version.split(".")]
    while parts and parts[-1] == 0:
        parts.pop()
    return tuple(parts)


def test_what_is_tested_as_oldest_is_what_is_stated():
    needed, extras = stated()
    bounds = dict(match.groups() for line in [*needed, *extras] if (match := re.match(r"([\w.-]+)>=([\w.]+)", line)))
    tested = {name: numbers(version) for name, version in oldest().items()}
    assert tested == {name: numbers(bounds[name]) for name in tested}


def test_every_needed_package_is_tested_at_its_oldest():
    needed, _ = stated()
    assert {re.split(r"[>=<]", line)[0] for line in needed} <= oldest().keys()


def test_the_tests_that_ci_names_are_there():
    named = [
        path for script in (ROOT / ".ci").iterdir() for path in re.findall(r"tests/[\w/]+\.py", script.read_text())
    ]
    assert len(named) >= 10
    assert [path for path in named if not (ROOT / path).exists()] == []
