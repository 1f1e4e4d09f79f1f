"""The outcome for one capture, and for all of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from pcdata.validation.check import Check, Verdict, worst

WHOLE = "*"  # the sample id of checks on the capture as a whole
_EXAMPLES = 5  # samples named for every check that did not pass


@dataclass(frozen=True)
class SampleReport:
    """All checks on one sample."""

    sample_id: str  # WHOLE = all samples together
    checks: tuple[Check, ...]

    @property
    def verdict(self) -> Verdict:
        """The worst verdict of all checks."""
        return worst(self.checks)

    def to_json(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        checks = [check.to_json() for check in self.checks]
        return {"sample_id": self.sample_id, "verdict": self.verdict.value, "checks": checks}


@dataclass
class CheckSummary:
    """One check on one view, over all samples."""

    counts: Counter[Verdict] = field(default_factory=Counter)
    worst: Check | None = None  # the first one of the worst verdict
    examples: list[str] = field(default_factory=list)  # the first samples of the worst verdict

    def add(self, sample_id: str, check: Check) -> None:
        """Count one more check."""
        self.counts[check.verdict] += 1
        if self.worst is None or check.verdict.severity > self.worst.verdict.severity:
            self.worst, self.examples = check, []
        if check.verdict is self.worst.verdict and len(self.examples) < _EXAMPLES:
            self.examples.append(sample_id)


class Summary:
    """Counts verdicts over any number of samples in constant memory."""

    def __init__(self, reports: Iterable[SampleReport] = ()) -> None:
        self.samples: Counter[Verdict] = Counter()
        self.checks: dict[tuple[str, int | None], CheckSummary] = {}  # by name and view, in order of appearance
        for report in reports:
            self.add(report)

    def add(self, report: SampleReport) -> None:
        """Count the checks of one more sample."""
        if report.sample_id != WHOLE:
            self.samples[report.verdict] += 1
        for check in report.checks:
            key = (f"{check.name} (all captures)" if report.sample_id == WHOLE else check.name, check.view)
            self.checks.setdefault(key, CheckSummary()).add(report.sample_id, check)

    @property
    def verdict(self) -> Verdict:
        """The worst verdict of all checks on all samples."""
        return worst(entry.worst for entry in self.checks.values() if entry.worst is not None)

    def to_json(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "verdict": self.verdict.value,
            "samples": {verdict.value: self.samples[verdict] for verdict in Verdict},
            "checks": [
                {
                    "name": name,
                    "view": view,
                    **{verdict.value: entry.counts[verdict] for verdict in Verdict},
                    "examples": entry.examples,
                }
                for (name, view), entry in self.checks.items()
            ],
        }
