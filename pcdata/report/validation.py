"""The outcome of the checks in words."""

from __future__ import annotations

from pcdata.report.table import text_table
from pcdata.validation import Check, Summary, Verdict


def validation_text(summary: Summary) -> str:
    """Return a table of all checks, then what was found and what to do for each that did not always pass."""
    rows: list[list[object]] = []
    notes = []
    for (name, view), entry in summary.checks.items():
        if entry.worst is None:
            continue
        counts = [entry.counts[verdict] for verdict in Verdict]
        rows.append([name, "" if view is None else view, *counts, _value(entry.worst), _limit(entry.worst)])
        if entry.worst.verdict is not Verdict.PASS:
            where = ", ".join(entry.examples) + (", ..." if counts[entry.worst.verdict.severity] > 5 else "")
            of_view = "" if view is None else f", view {view}"
            notes.append(f"{entry.worst.verdict.value.upper()} {name}{of_view} ({where}): {entry.worst.found}")
            if entry.worst.advice:
                notes[-1] += f"\n     -> {entry.worst.advice}"
    table = text_table(["check", "view", "pass", "warn", "fail", "worst", "passes"], rows)
    shares = ", ".join(f"{summary.samples[verdict]} {verdict.value}" for verdict in Verdict)
    end = f"{summary.verdict.value.upper()}: of {sum(summary.samples.values())} captures {shares}"
    return "\n\n".join(part for part in (table, "\n".join(notes), end) if part)


def _value(check: Check) -> str:
    return "-" if check.value is None else f"{check.value:.3g} {check.unit}".strip()


def _limit(check: Check) -> str:
    return "" if check.threshold is None else f"{check.threshold:.3g} {check.unit}".strip()
