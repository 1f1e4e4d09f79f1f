"""Samples, the worst first: what is wrong with each, its pictures, and the way to its clouds."""

from __future__ import annotations

from collections.abc import Mapping

from pcdata.report.html.gathering import Gathered, Looked
from pcdata.report.html.page import Section
from pcdata.report.html.pictures import png_uri
from pcdata.report.html.text import shown
from pcdata.validation.grading import Grading
from pcdata.verdicts import Verdict

_OPEN = 2  # samples whose pictures are seen at once
_MOST_FAULTS = 6  # named of one sample
_MOST_UNREAD = 3  # lines


def samples_panel(gathered: Gathered, scenes: Mapping[str, int]) -> Section:
    """Return the samples that are shown; ``scenes``: sample id -> its number in the viewer."""
    grading = gathered.grading
    places = {sample_id: place for place, sample_id in enumerate(grading.ids)}
    parts = [
        _sample(grading, one, places[one.sample_id], scenes.get(one.sample_id), is_open=number < _OPEN)
        for number, one in enumerate(gathered.looked)
    ]
    part, total = len(gathered.looked), len(grading.ids)
    note = "Of the only capture." if total == 1 else f"{part} of {total:,} captures are shown, the worst first."
    if part == total > 1:
        note = f"All {total} captures are shown, the worst first."
    unread = "".join(f'<p class="dim">Not read: {shown(line, 300)}.</p>' for line in gathered.unread[:_MOST_UNREAD])
    return Section("Samples", f'<p class="dim">{note}</p>{unread}{"".join(parts)}')


def _sample(grading: Grading, one: Looked, place: int, scene: int | None, *, is_open: bool) -> str:
    severity = int(grading.sample_verdicts[place])
    verdict = list(Verdict)[severity] if severity >= 0 else Verdict.UNKNOWN
    link = "" if scene is None else f'<button class="link" data-sample="{scene}">in three dimensions</button>'
    problem = f'<p class="fail">{shown(one.problem)}</p>' if one.problem else ""
    figures = "".join(
        f'<figure><img src="{uri}" alt="{told}"><figcaption>{told}</figcaption></figure>'
        for told, uri in ((shown(picture.caption), png_uri(picture.png)) for picture in one.pictures)
    )
    head = (
        f'<b>{shown(one.sample_id, 200)}</b> <span class="{verdict}">{verdict}</span> {_faults(grading, place)} '
        f'<span class="dim">{_counted(one)}</span> {link}'
    )
    if not figures:
        return f'<p class="row">{head}</p>{problem}'
    opened = " open" if is_open else ""
    return f'<details{opened}><summary>{head}</summary>{problem}<div class="pictures">{figures}</div></details>'


def _counted(one: Looked) -> str:
    """How many points and objects a sample has in the end."""
    if one.scene is None:
        return ""
    points = one.scene.stages[-1].cloud.said["total"]
    objects = "" if one.objects is None else f", {len(one.objects)} object{'s' * (len(one.objects) != 1)}"
    return f"{points:,} point{'s' * (points != 1)}{objects}"


def _faults(grading: Grading, place: int) -> str:
    """Name the checks that fail or warn of one sample, the worst first."""
    named = grading.faults_at(place)
    told = ", ".join(shown(name, 80) for name in named[:_MOST_FAULTS])
    return f"{told} and {len(named) - _MOST_FAULTS} more" if len(named) > _MOST_FAULTS else told
