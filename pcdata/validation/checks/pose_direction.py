"""Do the poses of several views lead where they say? Under the right convention alone do they see one surface."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch

from pcdata.structures import DepthFrame
from pcdata.validation.capture_check import register_check, views_failing
from pcdata.validation.capture_limits import CaptureLimits
from pcdata.validation.measures.pose_conventions import (
    AGREE,
    CONVENTIONS,
    LEAST_COMPARED,
    Agreement,
    advice_of,
    agreement,
    agreements,
    as_given,
    explains_more,
    pose_of,
    posed_views,
    share,
    total,
)
from pcdata.verdicts import Finding, Verdict

NAME = "pose_direction"
FINDINGS = {
    NAME: (
        "readings of one view that another one confirms / readings both can see",
        f"{AGREE:.0%}",
        "when another convention agrees better by 10 points and resolves half of what contradicts",
        "tries the inverse, transposed rotations, axes of OpenGL, CoppeliaSim and bodies, millimetres and centimetres, "
        "depth along the rays and rows from the bottom, for all views together and for each alone, and names the one "
        "that agrees, the view, and the option that reads it",
    )
}
_SURE = 0.9  # when so many agree, no other convention can agree much better
_CLOSE = 0.1  # difference of mean shares below which two explanations are as good as each other
_FAR = 100.0  # metres from every other camera: no rig of depth cameras is so large
_SHARE = "let more of what one view sees lie in another one: without that no pose can be told from its inverse"

Pair = tuple[int, int]


class _Explanation(NamedTuple):
    """Views whose poses, read by one convention, make the views agree."""

    convention: str
    views: tuple[int, ...]
    share: float  # of their readings that would agree, mean over these views
    score: float  # mean of the same over all views


@register_check("Do the poses of several views lead where they say?", findings=FINDINGS)
def pose_direction(frame: DepthFrame, limits: CaptureLimits, before: Sequence[Finding]) -> list[Finding]:
    """Judge the views together and each alone, but for those whose depth is known to be wrong: they tell no pose."""
    doubtful = views_failing(before, "repeated_depth", "depth_unit")
    views = {number: view for number, view in enumerate(posed_views(frame)) if number not in doubtful}
    given = agreements(views)
    if not given:
        return []
    shares = _shares(given)
    best = _best(_explanations(views, given)) if min(shares.values()) < _SURE else []
    return [_explained(best, given) if best else _unexplained(views, given)]


def _explained(best: list[_Explanation], given: dict[Pair, Agreement]) -> Finding:
    """Fail the poses of all views, or name the one whose pose alone is read wrongly; or those it may be."""
    name, blamed = best[0].convention, sorted({number for one in best for number in one.views})
    of_blamed = total(found for pair, found in given.items() if set(pair) & set(blamed))
    subject = CONVENTIONS[name].subject
    would = f"{100 * best[0].share:.0f} % would"
    if len(best[0].views) > 1:
        found = f"{_in_words('the views agree', of_blamed)}; {would} if {subject} were {name}"
        advice = advice_of(name)
    else:
        whose = " or ".join(f"view {number}" for number in blamed)
        one = "pose" if subject == "the poses" else "depth"
        found = f"{_in_words(f'{whose} and the others agree', of_blamed)}; {would} if this {one} alone were {name}"
        advice = f"the {one} of {whose} looks like {name}, the others do not: " + (
            "convert this one to world_from_camera with OpenCV axes, in metres"
            if one == "pose"
            else "write this one as z in metres, the top row first"
        )
    return direction_check(Verdict.FAIL, of_blamed, found, advice, blamed[0] if len(blamed) == 1 else None)


def _unexplained(views: dict[int, DepthFrame], given: dict[Pair, Agreement]) -> Finding:
    all_pairs = total(given.values())
    found = _in_words("the views agree", all_pairs)
    if far := _far_away(views):
        found += "; " + ", ".join(f"view {number} stands {metres:.0f} m from the others" for number, metres in far)
        advice = "are these translations in metres? Compare them with those of the other views"
        return direction_check(Verdict.WARN, all_pairs, found, advice, far[0][0] if len(far) == 1 else None)
    return judged_as_given(all_pairs, found, "the views")


def _in_words(who: str, found: Agreement) -> str:
    return f"{who} at {100 * share(found):.0f} % of {found[1]:,} readings that both can see"


def judged_as_given(given: Agreement, found: str, who: str) -> Finding:
    """Judge agreement where no other convention explains what contradicts."""
    if given[1] < LEAST_COMPARED:
        return direction_check(Verdict.UNKNOWN, given, f"not measurable: {who} see hardly anything in common", _SHARE)
    if share(given) < AGREE:
        advice = f"{who} agree under no convention: is the calibration old, the scene moving, the unit wrong?"
        return direction_check(Verdict.WARN, given, found, advice)
    return direction_check(Verdict.PASS, given, found, "")


def direction_check(verdict: Verdict, given: Agreement, found: str, advice: str, view: int | None = None) -> Finding:
    """Make the check: its number is the share that agrees with the poses as given."""
    return Finding(
        name=NAME,
        verdict=verdict,
        found=found,
        value=share(given) if given[1] >= LEAST_COMPARED else None,
        threshold=AGREE,
        fails_at=AGREE,
        at_least=True,
        advice=advice,
        view=view,
    )


def _explanations(views: dict[int, DepthFrame], given: dict[Pair, Agreement]) -> Iterable[_Explanation]:
    """Every convention for all views together, and for each alone, that explains clearly more than the poses given."""
    before = _shares(given)
    choices = [tuple(before), *((number,) for number in before if len(before) > 1)]
    for (convention, said), turned in itertools.product(CONVENTIONS.items(), choices):
        reads = {number: said.read if number in turned else as_given for number in views}
        after = _shares(
            {
                (i, j): agreement(views[i], views[j], reads[i], reads[j]) if i in turned or j in turned else found
                for (i, j), found in given.items()
            }
        )
        of_turned, score = _mean(after[number] for number in turned), _mean(after.values())
        if explains_more(of_turned, _mean(before[number] for number in turned)) and score > _mean(before.values()):
            yield _Explanation(convention, turned, of_turned, score)


def _best(explanations: Iterable[_Explanation]) -> list[_Explanation]:
    """Return the best, first, and of the same convention those for another view that are as good."""
    ranked = sorted(explanations, key=lambda one: -one.score)
    return [
        one
        for one in ranked
        if one.score > ranked[0].score - _CLOSE
        and one.convention == ranked[0].convention
        and len(one.views) == len(ranked[0].views)
    ]


def _far_away(views: dict[int, DepthFrame]) -> list[tuple[int, float]]:
    """Return the views that stand far from every other camera, where others do not, and how far."""
    centers = torch.stack([pose_of(view)[:3, 3] for view in views.values()])
    apart = torch.cdist(centers, centers).fill_diagonal_(torch.inf)
    nearest = dict(zip(views, apart.amin(1).tolist()))
    far = [(number, metres) for number, metres in nearest.items() if metres > _FAR]
    return far if len(far) < len(views) or len(views) == 2 else []


def _shares(found: dict[Pair, Agreement]) -> dict[int, float]:
    """Return for every view that was compared the share of its readings that agree, over all its pairs."""
    numbers = sorted({number for pair in found for number in pair})
    return {number: share(total(one for pair, one in found.items() if number in pair)) for number in numbers}


def _mean(values: Iterable[float]) -> float:
    parts = list(values)
    return sum(parts) / len(parts)
