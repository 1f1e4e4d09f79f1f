"""Do the focal lengths fit what several views see? Under the right ones alone do they see one surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from pcdata.structures import DepthFrame
from pcdata.validation.capture_check import register_check, views_failing
from pcdata.validation.capture_limits import CaptureLimits
from pcdata.validation.measures.focal_ratios import LEAST_TOLD, RATIOS, best_ratio, explains_clearly, scaled
from pcdata.validation.measures.pose_conventions import (
    AGREE,
    CONVENTIONS,
    Agreement,
    agreement,
    agreements,
    explains_more,
    has_moved,
    posed_views,
    share,
    total,
)
from pcdata.verdicts import Finding, Verdict

NAME = "focal_length"
FINDINGS = {
    NAME: (
        "readings of one view that another one confirms / readings both can see",
        f"{AGREE:.0%}",
        "when half to twice the focal length agrees better by 10 points, resolves half of what contradicts, and no "
        "convention of poses does as well",
        "tries eight focal lengths, for all views together and for each alone; of a recording the first 16 pairs. Says "
        "nothing of cameras that hardly moved: they agree under every focal length",
    )
}
_SURE = 0.9  # when so many agree, no other focal length can agree much better
_MOST_PAIRS = 16  # of captures, of one recording: enough to tell, and the rest is not slowed down
_CLEARLY_MORE = 1.05  # times what agrees under half and under double the focal length
_PAIRS = 2  # that must speak for a ratio: one may be an accident
_OUTNUMBERED = 3  # times as many must speak for it as against it
_ADVICE = (
    "take the intrinsics of this sensor at this resolution: those given are of another; 'pcdata calib intrinsics' "
    "measures them with a board"
)


@dataclass
class _Pairs:
    """What pairs of captures of one moving camera said so far; of the captures the last one alone is kept."""

    earlier: DepthFrame | None = None
    given: list[Agreement] = field(default_factory=list)
    read: list[dict[float, Agreement]] = field(default_factory=list)
    conventions: list[float] = field(default_factory=list)  # the share under the best one, where a ratio explains more
    fx: float = 0.0

    def add(self, a: DepthFrame, b: DepthFrame) -> None:
        """Add a pair of captures."""
        given = agreement(a, b)
        read = {ratio: agreement(a, b, scaled(ratio), scaled(ratio)) for ratio in RATIOS}
        is_doubtful = any(explains_more(share(one), share(given)) for one in read.values())
        others = CONVENTIONS.values() if is_doubtful else ()
        self.conventions.append(max((share(agreement(a, b, one.read, one.read)) for one in others), default=0.0))
        self.given.append(given)
        self.read.append(read)
        self.fx = float(b.camera.intrinsics[0, 0, 0])


def _judged_together(pairs: _Pairs, limits: CaptureLimits) -> list[Finding]:
    """Judge what all pairs of captures tell together; a recording of two captures has one pair alone."""
    given = total(pairs.given)
    if given[1] < LEAST_TOLD:
        return []
    whole = {ratio: total(read[ratio] for read in pairs.read) for ratio in RATIOS}
    ratio = max(whole, key=lambda one: share(whole[one]))
    both = [(read[ratio], own) for read, own in zip(pairs.read, pairs.given)]
    votes = sum(explains_clearly(*one, [other]) for one, other in zip(both, pairs.conventions))
    against = sum(explains_more(share(own), share(read)) for read, own in both)
    who = f"captures and those before them agree at {100 * share(given):.0f} % of the readings that both can see"
    needed = max(min(_PAIRS, len(both)), _OUTNUMBERED * against)
    if explains_clearly(whole[ratio], given, ()) and votes >= needed:
        return [_fails(given, f"{who}; {100 * share(whole[ratio]):.0f} % would if {_were(ratio, pairs.fx)}")]
    if share(given) < max(_SURE, *(_CLEARLY_MORE * share(whole[end]) for end in (RATIOS[0], RATIOS[-1]))):
        return []  # as well, or as badly, under any focal length: nothing is known
    return [_finding(Verdict.PASS, given, who, "")]


@register_check("Do the focal lengths fit what the views of a capture see?", findings=FINDINGS)
def focal_length(frame: DepthFrame, limits: CaptureLimits, before: Sequence[Finding]) -> list[Finding]:
    """Judge the views together and each alone; says nothing unless other focal lengths explain what contradicts."""
    doubtful = views_failing(before, "repeated_depth", "depth_unit")
    views = {number: view for number, view in enumerate(posed_views(frame)) if number not in doubtful}
    given = agreements(views)
    numbers = {number for pair in given for number in pair}
    shares = [share(total(one for pair, one in given.items() if number in pair)) for number in numbers]
    if not shares or min(shares) >= _SURE:
        return []
    best = best_ratio(views, given)
    if best is None:
        return []
    of_best = total(one for pair, one in given.items() if set(pair) & set(best.views))
    view = best.views[0] if len(best.views) == 1 else None
    who = "the views agree" if view is None else f"view {view} and the others agree"
    found = f"{who} at {100 * share(of_best):.0f} % of {of_best[1]:,} readings that both can see"
    fx = float(views[best.views[0]].camera.intrinsics[0, 0, 0])
    return [_fails(of_best, f"{found}; {100 * best.share:.0f} % would if {_were(best.ratio, fx)}", view)]


@register_check(
    "Do the focal lengths fit what a moving camera sees?",
    findings=FINDINGS,
    compares=True,
    remembers=_Pairs,
    whole=_judged_together,
)
def focal_length_over_time(
    frame: DepthFrame, limits: CaptureLimits, before: Sequence[Finding], pairs: _Pairs
) -> list[Finding]:
    """Note what a capture of a moving camera and an earlier one tell; all are judged together, at the end."""
    if len(pairs.given) >= _MOST_PAIRS or views_failing(before, "repeated_depth", "depth_unit"):
        return []
    views = posed_views(frame)
    if len(views) != 1:
        return []
    earlier, now = pairs.earlier, views[0]
    if earlier is not None and not has_moved(earlier, now):
        return []
    pairs.earlier = now
    if earlier is not None:
        pairs.add(earlier, now)
    return []


def _were(ratio: float, fx: float) -> str:
    return f"the focal lengths were about {ratio:.2g} times as long: fx some {fx * ratio:.0f} in place of {fx:.1f}"


def _fails(given: Agreement, found: str, view: int | None = None) -> Finding:
    return _finding(Verdict.FAIL, given, found, _ADVICE, view)


def _finding(verdict: Verdict, given: Agreement, found: str, advice: str, view: int | None = None) -> Finding:
    return Finding(
        name=NAME,
        verdict=verdict,
        found=found,
        value=share(given),
        threshold=AGREE,
        fails_at=AGREE,
        at_least=True,
        advice=advice,
        view=view,
    )
