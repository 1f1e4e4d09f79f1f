"""How two sources differ: each difference with its numbers, a verdict and what closes it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from pcdata.validation.comparison.quantities import quantity_of, title_of
from pcdata.verdicts import Verdict, finite_json, worst


@dataclass(frozen=True, kw_only=True)
class Measured:
    """One number of both sources.

    Args:
        name: of the number; ``name@k`` within a class of distances.
        view: of the captures; None = of the whole.
        family: the name of the difference that it belongs to.
        a: of the first source, the mean of the middle 60 % of its captures; NaN = none had it.
        b: of the second.
        passes: the largest difference that passes.
        fails_beyond: the largest that does not fail.
        seen_from: the smallest difference that so many captures would have told from none.
        chance: of such a difference between captures of one source; NaN = too few captures.
        verdict: on the sources as they are.
        left: what it was after the steps that close other differences.
    """

    name: str
    view: int | None
    family: str
    a: float
    b: float
    passes: float
    fails_beyond: float
    seen_from: float
    chance: float
    verdict: Verdict
    left: Verdict

    @property
    def differs(self) -> bool:
        """Whether it warns or fails."""
        return self.verdict.severity >= Verdict.WARN.severity

    @property
    def told(self) -> str:
        """The numbers in words."""
        row = quantity_of(self.name)
        view = "" if self.view is None else f" (view {self.view})"
        return f"{title_of(self.name)}{view}: {row.text(self.a)} in A, {row.text(self.b)} in B"


@dataclass(frozen=True, kw_only=True)
class Difference:
    """One way in which the sources differ.

    Args:
        name: such as "noise", "table" or "unit".
        verdict: the worst of its numbers.
        found: in words, with units.
        advice: what closes it.
        step: a step that does, ``{name: fields}``; empty where none can.
        on: which source the step is for, "A" or "B"; "" without one.
        closed: whether the difference was gone when the step was tried; None = none was.
        explains: other numbers that differed and do no more with the step.
    """

    name: str
    verdict: Verdict
    found: str
    advice: str
    step: Mapping[str, Any] = field(default_factory=dict)
    on: str = ""
    closed: bool | None = None
    explains: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """All that was compared.

    Args:
        names: of source A and source B.
        captures: of each that were measured.
        of: how many each has.
        differences: the worst first.
        measured: every number.
        not_compared: what only one of them has, or cannot be compared.
        refused: captures that could not be read, by source: id -> why.
    """

    names: tuple[str, str]
    captures: tuple[int, int]
    of: tuple[int, int]
    differences: tuple[Difference, ...]
    measured: tuple[Measured, ...]
    not_compared: tuple[str, ...]
    refused: tuple[Mapping[str, str], Mapping[str, str]] = ({}, {})

    @property
    def verdict(self) -> Verdict:
        """PASS where no difference was found; UNKNOWN where most numbers had too few captures to tell one."""
        if not self.differences and 2 * self.unjudged > len(self.measured):
            return Verdict.UNKNOWN
        return worst(one.verdict for one in self.differences)

    @property
    def unjudged(self) -> int:
        """How many numbers had too few captures that are independent of each other."""
        return sum(one.verdict is Verdict.UNKNOWN for one in self.measured)

    def to_json(self) -> dict[str, Any]:
        """Return plain values for JSON; numbers that are not finite become None."""
        return finite_json({"schema": "pcdata.compare/1", "verdict": self.verdict, **asdict(self)})

    def text(self) -> str:
        """Return the differences as lines for a terminal."""
        lines = [f"compare: {self.verdict}"]
        for letter, name, count, total, refused in zip("AB", self.names, self.captures, self.of, self.refused):
            more = f", {len(refused)} could not be read" if refused else ""
            lines.append(f"  {letter}: {name}: {count:,} of {total:,} captures{more}")
        for one in self.differences:
            lines.append(f"  {one.name}: {one.verdict}: {one.found}")
            lines += [f"    -> {one.advice}"] if one.advice else []
            lines += [f"    explains: {'; '.join(one.explains)}"] if one.explains else []
        if not self.differences:
            lines.append(f"  no difference in {len(self.measured) - self.unjudged} numbers")
        if self.unjudged:
            lines.append(f"  not judged: {self.unjudged} numbers, for too few captures that are unlike their neighbors")
        lines += [f"  not compared: {one}" for one in self.not_compared]
        return "\n".join(lines)
