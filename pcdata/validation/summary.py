"""The outcome for one capture, and for all of them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from pcdata.verdicts import Finding, Verdict, worst

WHOLE = "*"  # the sample id of a report on all captures of a recording; of one of several, after its name: NAME/*
_EXAMPLES = 5  # samples named for every message
_MESSAGES = 10  # kept for every check, so that memory stays constant
_NUMBER = re.compile(r"\d[\d.,]*(e[+-]?\d+)?")


@dataclass(frozen=True)
class SampleReport:
    """All checks on one sample, or on all samples of one recording together."""

    sample_id: str
    findings: tuple[Finding, ...]
    whole: bool = False  # it is about a recording; its id is WHOLE, or ends so
    views: tuple[str, ...] = ()  # what its views are called; () = it has none, or was not read
    refused: bool = False  # it could not be read

    @property
    def verdict(self) -> Verdict:
        """The worst verdict of all checks."""
        return worst(finding.verdict for finding in self.findings)

    def to_json(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        checks = [finding.to_json() for finding in self.findings]
        return {"sample_id": self.sample_id, "whole": self.whole, "verdict": self.verdict.value, "checks": checks}


@dataclass
class _Message:
    """What one check said of some samples, in the same words but for numbers."""

    check: Finding  # the first that said so
    count: int = 0
    examples: list[str] = field(default_factory=list)  # the first samples

    def add(self, sample_id: str) -> None:
        """Count one more sample."""
        self.count += 1
        if len(self.examples) < _EXAMPLES:
            self.examples.append(sample_id)


@dataclass
class _Counted:
    """One check on one view, over all samples."""

    counts: Counter[Verdict] = field(default_factory=Counter)
    worst: Finding | None = None  # the first one of the worst verdict
    examples: list[str] = field(default_factory=list)  # the first samples of the worst verdict
    messages: dict[str, _Message] = field(default_factory=dict)  # of the worst verdict, by their words
    untold: int = 0  # samples of the worst verdict whose message is one too many to keep

    def add(self, sample_id: str, check: Finding) -> None:
        """Count one more check."""
        self.counts[check.verdict] += 1
        if self.worst is None or check.verdict.severity > self.worst.verdict.severity:
            self.worst, self.examples, self.messages, self.untold = check, [], {}, 0
        if check.verdict is not self.worst.verdict:
            return
        if len(self.examples) < _EXAMPLES:
            self.examples.append(sample_id)
        words = _words(f"{check.found}\n{check.advice}", sample_id)
        if words in self.messages or len(self.messages) < _MESSAGES:
            self.messages.setdefault(words, _Message(check)).add(sample_id)
        else:
            self.untold += 1


class Summary:
    """Counts verdicts over any number of samples in constant memory."""

    def __init__(self, reports: Iterable[SampleReport] = ()) -> None:
        self.samples: Counter[Verdict] = Counter()
        self.checks: dict[tuple[str, int | None], _Counted] = {}  # by name and view, in order of appearance
        for report in reports:
            self.add(report)

    def add(self, report: SampleReport) -> None:
        """Count the checks of one more sample."""
        if not report.whole:
            self.samples[report.verdict] += 1
        for check in report.findings:
            key = (f"{check.name} (all captures)" if report.whole else check.name, check.view)
            self.checks.setdefault(key, _Counted()).add(report.sample_id, check)

    @property
    def verdict(self) -> Verdict:
        """The worst verdict of all checks on all samples."""
        return worst(entry.worst.verdict for entry in self.checks.values() if entry.worst is not None)

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


def _words(text: str, sample_id: str) -> str:
    """Return a text without its numbers, and without the sample that it names."""
    if sample_id in text and not sample_id.isdecimal():  # "12" is a number, and a part of 512, which is not the sample
        text = re.sub(rf"(?<!\w){re.escape(sample_id)}(?!\w)", "#", text)
    return _NUMBER.sub("#", text)
