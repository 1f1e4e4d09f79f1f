"""What one check has to say: a number, its threshold, a verdict, and what to do."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from typing import Any


class Verdict(str, Enum):
    """Pass: as it should be. Warn: unusual, or not measurable here. Fail: do not train on it before it is mended."""

    PASS = "pass"
    WARN = "warn"
    FAIL = "fail"

    @property
    def severity(self) -> int:
        """0, 1 or 2."""
        return list(Verdict).index(self)


@dataclass(frozen=True, kw_only=True)
class Check:
    """The outcome of one check on one view of one capture."""

    name: str  # snake_case; the same for every capture
    verdict: Verdict
    found: str  # what was measured, in words
    value: float | None = None  # None = nothing could be measured
    threshold: float | None = None  # the last value that passes
    fails_at: float | None = None  # the last value that does not fail; None = it never fails, or threshold decides
    unit: str = ""  # of the three numbers; "" = a plain ratio or count
    advice: str = ""  # what to do; empty where it passes
    view: int | None = None  # None = the capture as a whole

    def to_json(self) -> dict[str, Any]:
        """Return plain values for JSON; numbers that are not finite become None."""
        plain = {**vars(self), "verdict": self.verdict.value}
        return {name: None if _not_finite(value) else value for name, value in plain.items()}


def graded(
    name: str,
    value: float,
    *,
    threshold: float,
    fails_at: float | None,
    found: str,
    advice: str,
    unit: str = "",
    view: int | None = None,
    higher_is_better: bool = False,
) -> Check:
    """Judge a number: it passes up to the threshold, warns beyond it and fails beyond ``fails_at`` (None = never)."""
    sign = -1.0 if higher_is_better else 1.0
    if sign * value <= sign * threshold:
        verdict = Verdict.PASS
    elif fails_at is None or sign * value <= sign * fails_at:
        verdict = Verdict.WARN
    else:
        verdict = Verdict.FAIL
    return Check(
        name=name,
        verdict=verdict,
        found=found,
        value=value,
        threshold=threshold,
        fails_at=fails_at,
        unit=unit,
        advice="" if verdict is Verdict.PASS else advice,
        view=view,
    )


def worst(checks: Iterable[Check]) -> Verdict:
    """Return the worst verdict; of no checks, pass."""
    return max((check.verdict for check in checks), key=lambda verdict: verdict.severity, default=Verdict.PASS)


def _not_finite(value: Any) -> bool:
    return isinstance(value, float) and not math.isfinite(value)
