"""The table of checks in docs/validation.md, made of the checks alone, so that it cannot say anything else."""

from __future__ import annotations

import re

from pcdata.validation.capture_check import CHECKS
from pcdata.validation.capture_limits import CaptureLimits

_PERCENT = re.compile(r"(\d)%")


def checks_table() -> str:
    """Return what every check measures, where it passes and fails, and why there, as Markdown."""
    rows: dict[tuple[str, ...], list[str]] = {}
    for check in CHECKS.values():
        for name, said in check.findings.items():
            cells = tuple(_PERCENT.sub(r"\1 %", text.format(CaptureLimits())) for text in said)
            names = rows.setdefault(cells, [])
            if f"`{name}`" not in names:
                names.append(f"`{name}`")
    lines = [f"| {', '.join(names)} | {' | '.join(cells)} |" for cells, names in rows.items()]
    return "\n".join(["| check | the number | passes | fails | why there |", "|---|---|---|---|---|", *lines])
