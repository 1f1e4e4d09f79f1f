"""What is wrong, in which camera or episode, since when, and what to do: the first thing on the page."""

from __future__ import annotations

from collections.abc import Mapping

from pcdata.report.html.gathering import Gathered
from pcdata.report.html.page import Section
from pcdata.report.html.text import shown
from pcdata.validation.grading import Grading, Trend
from pcdata.verdicts import Finding, Verdict


def verdict_panel(gathered: Gathered, scenes: Mapping[str, int]) -> Section:
    """Return the grade and what keeps it from an A, worst first; ``scenes``: sample id -> its number in the viewer."""
    grading = gathered.grading
    grade = grading.grade()
    head = (
        f'<p class="head"><span class="grade {grade.letter}">{grade.letter}</span><span>'
        f"{shown(_sentence(grading.standing()))}.</span></p>"
    )
    found = [
        (finding, _told(finding, grading.name_of(finding.view), f"all captures of {name}"))
        for name, finding in grading.together
        if finding.verdict.severity >= Verdict.WARN.severity
    ]
    for trend in grading.faults():
        where = f"{shown(grading.since_text(trend))}{_link(trend, grading, scenes)}"
        found.append((trend.worst, _told(trend.worst, grading.name_of(trend.view), where, is_html=True)))
    found.sort(key=lambda one: -one[0].verdict.severity)  # keeps the order of as bad ones
    body = "".join(told for _, told in found) or "<p>Nothing that these checks look for is wrong.</p>"
    return Section("Verdict", head + body + _unknown(grading))


def _link(trend: Trend, grading: Grading, scenes: Mapping[str, int]) -> str:
    """A link to the first capture with this fault that is shown."""
    for place in trend.where_worst().tolist():
        if grading.ids[place] in scenes:
            number = scenes[grading.ids[place]]
            return f' <button class="link" data-sample="{number}">show {shown(grading.ids[place], 60)}</button>'
    return ""


def _told(finding: Finding, view: str, where: str, *, is_html: bool = False) -> str:
    about = " ".join(filter(None, [finding.name, view]))
    advice = f'<p class="advice">What to do: {shown(finding.advice)}</p>' if finding.advice else ""
    return (
        f'<div class="finding {finding.verdict}"><p><b class="{finding.verdict}">{finding.verdict.value.upper()}</b>'
        f"<b>{shown(about)}</b> {where if is_html else shown(where)}</p><p>{shown(finding.found)}</p>{advice}</div>"
    )


def _unknown(grading: Grading) -> str:
    names = sorted({trend.name for trend in grading.trends.values() if trend.verdict is Verdict.UNKNOWN})
    return f'<p class="dim">Could not be measured in some captures: {shown(", ".join(names))}.</p>' if names else ""


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]
