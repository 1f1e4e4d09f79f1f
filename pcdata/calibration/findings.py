"""What a calibration step found: a number, the limit it is held to, and whether it holds."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from pcdata.errors import told_apart


@dataclass(frozen=True)
class Finding:
    """One number and its verdict."""

    name: str
    value: str  # as shown, with its unit
    limit: str = ""  # as shown; empty = told for information only
    passed: bool = True


def at_most(name: str, value: float, limit: float, unit: str, *, factor: float = 1.0, digits: int = 3) -> Finding:
    """Judge a number that must not exceed a limit; both are shown multiplied by ``factor``."""
    shown, most = told_apart(value * factor, limit * factor, digits)
    # A NaN fails: written so that it is not "not greater".
    return Finding(name, f"{shown} {unit}".strip(), f"<= {most} {unit}".strip(), value <= limit)


def at_least(name: str, value: float, limit: float, unit: str, *, factor: float = 1.0, digits: int = 3) -> Finding:
    """Judge a number that must reach a limit; both are shown multiplied by ``factor``."""
    shown, least = told_apart(value * factor, limit * factor, digits)
    return Finding(name, f"{shown} {unit}".strip(), f">= {least} {unit}".strip(), value >= limit)


def all_passed(findings: Iterable[Finding]) -> bool:
    """Say whether nothing failed."""
    return all(finding.passed for finding in findings)
