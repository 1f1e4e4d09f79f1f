"""The outcome of the checks in words."""

from __future__ import annotations

from pcdata.errors import told_apart
from pcdata.files.sample_names import counted
from pcdata.report.plain_table import text_table
from pcdata.validation import WHOLE, Summary
from pcdata.verdicts import Finding, Verdict


def validation_text(summary: Summary) -> str:
    """Return a table of all checks, then what was found and what to do for each that did not always pass.

    One line for every distinct message of the worst verdict, with the captures it is about; numbers are of the first.
    """
    rows: list[list[object]] = []
    notes = []
    for (name, view), entry in summary.checks.items():
        if entry.worst is None:
            continue
        counts = [entry.counts[verdict] for verdict in Verdict]
        rows.append([name, "" if view is None else view, *counts, *_value_and_limit(entry.worst)])
        if entry.worst.verdict is not Verdict.PASS:
            of_view = "" if view is None else f", view {view}"
            notes += [_note(f"{name}{of_view}", one.check, one.count, one.examples) for one in entry.messages.values()]
            if entry.untold:
                notes.append(f"     {name}{of_view}: other words in {entry.untold} captures more")
    table = text_table(["check", "view", *map(str, Verdict), "worst", "passes"], rows)
    count = sum(summary.samples.values())
    shares = ", ".join(f"{summary.samples[verdict]} {verdict.value}" for verdict in Verdict)
    end = f"{summary.verdict.value.upper()}: " + (
        f"of {counted(count, 'capture')} {shares}" if count else "no capture was read"
    )
    return "\n\n".join(part for part in (table, "\n".join(notes), end) if part)


def _note(name: str, check: Finding, count: int, samples: list[str]) -> str:
    where = ", ".join(samples) + (", ..." if count > len(samples) else "")
    advice = f"\n     -> {check.advice}" if check.advice else ""
    return f"{check.verdict.value.upper()} {name}{'' if where == WHOLE else f' ({where})'}: {check.found}{advice}"


def _value_and_limit(check: Finding) -> tuple[str, str]:
    """Return the number and its limit with digits that show which is larger."""
    value, limit = check.value, check.threshold
    if value is not None and limit is not None:
        shown = told_apart(value, limit)
    else:
        shown = ("-" if value is None else f"{value:.3g}", "" if limit is None else f"{limit:.3g}")
    return tuple(f"{one} {check.unit}".strip() if one not in ("", "-") else one for one in shown)  # type: ignore[return-value]
