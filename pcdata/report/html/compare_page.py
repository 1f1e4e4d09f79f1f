"""The page on a comparison: the differences with what closes them, then every number of both sources."""

from __future__ import annotations

import json

import numpy as np

from pcdata.report.html.charts import bars
from pcdata.report.html.page import Section, page_of
from pcdata.report.html.text import shown
from pcdata.validation.comparison import Comparison, Difference, Measured
from pcdata.validation.comparison.distances import NUM_CLASSES, in_words
from pcdata.validation.comparison.quantities import quantity_of, title_of

_CHARTS = {"noise": "Noise by distance", "holes": "Without a reading, by distance", "density": "Points by distance"}


def compare_page(result: Comparison, title: str = "") -> str:
    """Return a self-contained page.

    Args:
        result: what was found.
        title: of the page; "" = the names of both sources.
    """
    sections = [
        Section("Verdict", _head(result) + "".join(map(_difference, result.differences))),
        *_by_distance(result),
        Section("Every number", _table(result)),
    ]
    if result.not_compared:
        told = "".join(f"<li>{shown(one)}</li>" for one in result.not_compared)
        sections.append(Section("Not compared", f"<ul>{told}</ul>"))
    return page_of(title or f"{result.names[0]} and {result.names[1]}", sections, [])


def _head(result: Comparison) -> str:
    rows = "".join(
        f"<tr><td><b>{letter}</b></td><td>{shown(name, 300)}</td><td>{count:,} of {total:,} captures</td>"
        f"<td>{f'{len(refused):,} could not be read' if refused else ''}</td></tr>"
        for letter, name, count, total, refused in zip("AB", result.names, result.captures, result.of, result.refused)
    )
    same = "" if result.differences else f"<p>No difference in {len(result.measured) - result.unjudged:,} numbers.</p>"
    if result.unjudged:
        same += f"<p>Too few captures to judge {result.unjudged:,} numbers.</p>"
    return f'<p><b class="{result.verdict}">{result.verdict.value.upper()}</b></p><table>{rows}</table>{same}'


def _difference(one: Difference) -> str:
    tried = {True: "Tried: the difference was gone.", False: "Tried: a part of the difference was left."}
    advice = f'<p class="advice">What to do: {shown(one.advice)}</p>' if one.advice else ""
    step = ""
    if one.step:
        told = f"{tried.get(one.closed, '') if one.closed is not None else ''}"
        step = f"<p>{told} For {shown(one.on)}:</p><pre>{shown(json.dumps(one.step))}</pre>"
    explains = f'<p class="dim">Explains: {shown("; ".join(one.explains))}</p>' if one.explains else ""
    return (
        f'<div class="finding {one.verdict}"><p><b class="{one.verdict}">{one.verdict.value.upper()}</b>'
        f"<b>{shown(one.name)}</b> {shown(one.found)}</p>{advice}{step}{explains}</div>"
    )


def _by_distance(result: Comparison) -> list[Section]:
    """Both sources beside each other, for every class of distances."""
    drawn = []
    for name, title in _CHARTS.items():
        own = {
            (one.view, int(one.name.partition("@")[2])): one
            for one in result.measured
            if one.name.startswith(f"{name}@")
        }
        for view in sorted({view for view, _ in own}, key=lambda one: -1 if one is None else one):
            rows = [(k, own[view, k]) for k in range(NUM_CLASSES) if (view, k) in own]
            lines = []
            for k, one in rows:
                row = quantity_of(one.name)
                for letter, value in (("A", one.a), ("B", one.b)):
                    if np.isfinite(value):
                        lines.append((f"{letter}, {in_words(k)}", abs(value), row.text(value)))
            drawn.append(f"<h3>{title}{'' if view is None else f', view {view}'}</h3>{bars(lines)}")
    return [Section("By distance", "".join(drawn))] if drawn else []


def _table(result: Comparison) -> str:
    rows = "".join(map(_row, sorted(result.measured, key=lambda one: -one.verdict.severity)))
    return (
        "<table><tr><th>number</th><th>A</th><th>B</th><th>passes up to</th><th>smallest that would show</th>"
        f"<th>verdict</th><th>after the steps</th></tr>{rows}</table>"
        "<p class='dim'>A and B: means of the middle 60 % of the captures. A difference is one where it is larger than "
        "what passes, and more than captures of one source differ by.</p>"
    )


def _row(one: Measured) -> str:
    row = quantity_of(one.name)
    name = title_of(one.name) + ("" if one.view is None else f", view {one.view}")
    numbers = (one.a, one.b, one.passes, one.seen_from)
    cells = "".join(f"<td>{shown(row.text(value)) if np.isfinite(value) else ''}</td>" for value in numbers)
    return (
        f'<tr><td>{shown(name)}</td>{cells}<td class="{one.verdict}">{one.verdict}</td>'
        f'<td class="{one.left}">{one.left if one.left is not one.verdict else ""}</td></tr>'
    )
