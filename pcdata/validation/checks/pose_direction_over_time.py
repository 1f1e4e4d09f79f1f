"""Do the poses of a moving camera lead where they say? What it sees now agrees with what it saw before."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from pcdata.structures import DepthFrame
from pcdata.validation.capture_check import register_check, views_failing
from pcdata.validation.capture_limits import CaptureLimits
from pcdata.validation.checks.pose_direction import FINDINGS, direction_check, judged_as_given
from pcdata.validation.measures.pose_conventions import (
    CONVENTIONS,
    Agreement,
    advice_of,
    agreement,
    explains_more,
    has_moved,
    posed_views,
    share,
    total,
)
from pcdata.verdicts import Finding, Verdict

_PAIRS = 2  # pairs of captures that must speak for a convention: one may be an accident
_OUTNUMBERED = 3  # times as many must speak for it as against it


@dataclass
class _Pairs:
    """What pairs of captures of one camera said so far; of the captures the last one alone is kept."""

    earlier: DepthFrame | None = None
    compared: int = 0
    agreement: Agreement = (0, 0)  # of all pairs, as given
    votes_for: Counter[str] = field(default_factory=Counter)  # pairs that a convention explains clearly better
    votes_against: Counter[str] = field(default_factory=Counter)  # pairs that it explains clearly worse

    def add(self, given: Agreement, shares: dict[str, float]) -> list[str]:
        """Add the votes of one pair; return the conventions that explain it better."""
        own = share(given)
        better = [name for name, read in shares.items() if explains_more(read, own)]
        self.votes_for.update(better)
        self.votes_against.update(name for name, read in shares.items() if explains_more(own, read))
        self.compared += 1
        self.agreement = total((self.agreement, given))
        return better

    def establish(self, name: str, needed: int) -> bool:
        """Say whether so many pairs speak for a convention, and few against it."""
        return self.votes_for[name] >= max(needed, _OUTNUMBERED * self.votes_against[name])


def _judged_together(pairs: _Pairs, limits: CaptureLimits) -> list[Finding]:
    """Judge what all pairs of captures tell together; a recording of two captures has one pair alone."""
    if not pairs.compared:
        return []
    who = "captures and those before them"
    found = f"{who} agree at {100 * share(pairs.agreement):.0f} % of the readings that both can see"
    needed = min(_PAIRS, pairs.compared)
    name = max(pairs.votes_for, key=lambda one: pairs.votes_for[one], default="")
    if name and pairs.establish(name, needed):
        count = f"{pairs.votes_for[name]} of {pairs.compared} pairs of captures"
        return [_fails(pairs.agreement, f"{found}; {count} fit clearly better if {_were(name)}", name)]
    return [judged_as_given(pairs.agreement, found, who)]


@register_check(
    "Do the poses of a moving camera lead where they say?",
    findings=FINDINGS,
    compares=True,
    remembers=_Pairs,
    whole=_judged_together,
)
def pose_direction_over_time(
    frame: DepthFrame, limits: CaptureLimits, before: Sequence[Finding], pairs: _Pairs
) -> list[Finding]:
    """Compare a capture of a moving camera with an earlier one; says nothing until the camera has moved.

    A convention is named once two pairs of captures speak for it, and three times as many as against it. Depth of
    another moment or another unit contradicts right poses: it neither accuses them nor is kept.
    """
    if views_failing(before, "repeated_depth", "depth_unit"):
        return []
    views = posed_views(frame)
    if len(views) != 1:
        return []
    earlier, now = pairs.earlier, views[0]
    if earlier is not None and not has_moved(earlier, now):
        return []
    pairs.earlier = now
    if earlier is None:
        return []
    given = agreement(earlier, now)
    shares = {name: share(agreement(earlier, now, said.read, said.read)) for name, said in CONVENTIONS.items()}
    better = pairs.add(given, shares)
    who = f"{earlier.sample_id!r} and this capture"
    found = f"{who} agree at {100 * share(given):.0f} % of {given[1]:,} readings that both can see"
    name = max(better, key=lambda one: shares[one], default="")
    if name and pairs.establish(name, _PAIRS):
        return [_fails(given, f"{found}; {100 * shares[name]:.0f} % would if {_were(name)}", name)]
    if name:
        found += "; they fit another convention better, but the other captures do not say so"
        advice = "see pose_direction (all captures); in one capture alone: was its depth, or its pose, of another time?"
        return [direction_check(Verdict.WARN, given, found, advice)]
    return [judged_as_given(given, found, who)]


def _fails(given: Agreement, found: str, name: str) -> Finding:
    return direction_check(Verdict.FAIL, given, found, advice_of(name))


def _were(name: str) -> str:
    return f"{CONVENTIONS[name].subject} were {name}"
