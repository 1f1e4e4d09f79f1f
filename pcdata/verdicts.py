"""Is it right? One form for every answer: a verdict, the number, its limits, and what to do.

Captures, calibrations, overlaps and batches for a model are all judged in it, so that a program reads one form.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields
from enum import Enum
from typing import Any

from pcdata.errors import ConfigError, told_apart


class Verdict(str, Enum):
    """From best to worst."""

    PASS = "pass"  # as it should be
    UNKNOWN = "unknown"  # nothing was found wrong, but it could not be measured here
    WARN = "warn"  # unusual: look at it
    FAIL = "fail"  # do not use it before it is mended

    @property
    def severity(self) -> int:
        """0 for the best to 3 for the worst."""
        return list(Verdict).index(self)

    def __str__(self) -> str:
        return self.value


@dataclass(frozen=True, kw_only=True)
class Finding:
    """What one check, rule or measurement has to say, of one view or of the whole."""

    name: str  # of the check; the same for everything that is judged
    verdict: Verdict = Verdict.PASS
    found: str = ""  # what was measured, in words
    value: float | None = None  # None = nothing could be measured, or the answer is no number
    threshold: float | None = None  # the last value that passes; None = the number is told for information only
    fails_at: float | None = None  # the last value that does not fail; None = it never fails, or threshold decides
    at_least: bool = False  # True = the larger the better: the limits are the smallest values
    unit: str = ""  # of the three numbers; "" = a plain ratio or count
    advice: str = ""  # what to do; empty where it passes
    view: int | None = None  # None = the whole

    def to_json(self) -> dict[str, Any]:
        """Return plain values for JSON; numbers that are not finite become None."""
        return finite_json({**vars(self), "verdict": self.verdict.value})


def in_figures(value: float) -> str:
    """Write a number as a reader does: four figures of small ones, large ones whole with commas, no exponent."""
    if abs(value) >= 1000:
        return f"{value:,.0f}"
    return f"{value:.4g}" if abs(value) >= 1e-4 else f"{value:.7f}".rstrip("0").rstrip(".")


def judged(value: float, passes: float, fails: float | None, *, at_least: bool = False) -> Verdict:
    """Judge a number: it passes up to the first limit, warns beyond it and fails beyond the second (None = never).

    With ``at_least`` it passes down to the first, and so on. NaN never passes.
    """
    sign = -1.0 if at_least else 1.0
    if sign * value <= sign * passes:
        return Verdict.PASS
    return Verdict.WARN if fails is None or sign * value <= sign * fails else Verdict.FAIL


def graded(
    name: str,
    value: float,
    limits: tuple[float, float | None],  # last value that passes, last value that does not fail
    *,
    found: str,
    advice: str,
    unit: str = "",
    view: int | None = None,
    at_least: bool = False,
) -> Finding:
    """Return what a number means: its verdict as of :func:`judged`, the advice only where it does not pass."""
    verdict = judged(value, *limits, at_least=at_least)
    return Finding(
        name=name,
        verdict=verdict,
        found=found,
        value=value,
        threshold=limits[0],
        fails_at=limits[1],
        at_least=at_least,
        unit=unit,
        advice="" if verdict is Verdict.PASS else advice,
        view=view,
    )


def at_most(
    name: str, value: float, limit: float, advice: str, *, unit: str = "", shown: tuple[str, float] = ("", 1.0)
) -> Finding:
    """Judge a number that fails beyond one limit, with words that show both; ``shown``: unit there, and factor."""
    return _held(name, value, limit, advice, unit, shown, at_least=False)


def at_least(
    name: str, value: float, limit: float, advice: str, *, unit: str = "", shown: tuple[str, float] = ("", 1.0)
) -> Finding:
    """Judge a number that fails below one limit; otherwise as :func:`at_most`."""
    return _held(name, value, limit, advice, unit, shown, at_least=True)


def _held(
    name: str, value: float, limit: float, advice: str, unit: str, shown: tuple[str, float], *, at_least: bool
) -> Finding:
    word, factor = shown
    number, bound = (f"{one} {word}".strip() for one in told_apart(value * factor, limit * factor))
    found = f"{number}, {'at least' if at_least else 'at most'} {bound}"
    return graded(name, value, (limit, limit), found=found, advice=advice, unit=unit, at_least=at_least)


def worst(verdicts: Iterable[Verdict]) -> Verdict:
    """Return the worst verdict; of none, pass."""
    return max(verdicts, key=lambda verdict: verdict.severity, default=Verdict.PASS)


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Base of the tables of limits, one for each thing that is judged; every field says its unit and its reason.

    A number is where it starts to fail (``min_...``, ``max_...``); a pair is (last value that passes, last value that
    does not fail), in between it warns. All are finite and not negative, and a pair is in the order of its default.

    Raises:
        ConfigError: a field is not so.
    """

    def __post_init__(self) -> None:
        for field in fields(self):
            given = getattr(self, field.name)
            if given is None and field.default is None:
                continue  # nobody has stated it
            numbers = given if isinstance(given, tuple) else (given,)
            if not all(isinstance(n, (int, float)) and 0 <= n < math.inf for n in numbers):
                raise ConfigError(f"{type(self).__name__}: {field.name} must be finite and not negative, got {given}")
            if isinstance(field.default, tuple) and len(field.default) == 2:
                rises = field.default[0] <= field.default[1]
                if len(numbers) != 2 or (numbers[0] > numbers[1] if rises else numbers[0] < numbers[1]):
                    order = "<=" if rises else ">="
                    raise ConfigError(
                        f"{type(self).__name__}: {field.name} must be two numbers (first, second) with first {order} "
                        f"second, got {given}"
                    )


def finite_json(value: Any) -> Any:
    """Return nested lists and dicts for JSON, with None for numbers that are not finite and texts for verdicts."""
    if isinstance(value, dict):
        return {key: finite_json(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite_json(entry) for entry in value]
    if isinstance(value, Verdict):
        return value.value
    return None if isinstance(value, float) and not math.isfinite(value) else value
