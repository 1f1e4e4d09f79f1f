"""What a check of captures is, and the registry that all of them hang in.

To write one, subclass :class:`Check`, say its ``question`` and its ``findings``, and write ``frame`` (or ``cloud``,
``files``, ``whole``); :func:`register_check` makes it known to :func:`validate_source` and ``pcdata validate``, the
docs page and the laws in the tests.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import ClassVar, NamedTuple

from pcdata.errors import ConfigError
from pcdata.registry import Registry
from pcdata.structures import DepthFrame, PointCloud
from pcdata.validation.capture_limits import CaptureLimits
from pcdata.verdicts import Finding, Verdict


class Explained(NamedTuple):
    """One number of a check, as the docs page tells it; ``{0.name}`` stands for a field of the limits."""

    number: str  # what is measured
    passes: str
    fails: str
    why: str  # there, and no lower or higher


class Check:
    """One question about captures; an instance judges one series of them, in order, and may remember what it saw.

    Every method returns findings, none where the capture does not have what the question is about. A method that raises
    a :class:`~pcdata.errors.PcdataError` could not measure: its verdict is then unknown, with the error's words.
    """

    question: ClassVar[str]
    findings: ClassVar[Mapping[str, Explained]]  # by the names of the findings
    compares: ClassVar[bool] = False  # with captures before: says nothing of one capture alone

    def __init__(self, limits: CaptureLimits) -> None:
        self.limits = limits

    def files(self, depth: Sequence[Path]) -> list[Finding]:
        """Judge the depth files of a capture, one per view, as they are stored."""
        return []

    def frame(self, frame: DepthFrame, before: Sequence[Finding]) -> list[Finding]:
        """Judge a capture of depth images; ``before`` is what the checks before this one found on it."""
        return []

    def cloud(self, cloud: PointCloud, before: Sequence[Finding]) -> list[Finding]:
        """Judge a capture that is a cloud."""
        return []

    def whole(self) -> list[Finding]:
        """Judge what all captures tell together, after the last one."""
        return []


CHECKS: Registry[type[Check]] = Registry("check")

_ASKED = ("files", "frame", "cloud", "whole")


def register_check(check: type[Check]) -> type[Check]:
    """Make a check known by its class name, to :func:`validate_source` and ``pcdata validate``; a decorator.

    It runs after those that were registered before it.

    Raises:
        ConfigError: it is no :class:`Check`, does not say its question and findings, judges nothing, or its name is
            taken.
    """
    where = "register_check"
    if not (isinstance(check, type) and issubclass(check, Check)):
        raise ConfigError(f"{where}: must be a subclass of pcdata.validation.Check, got {check!r:.100}")
    if not isinstance(getattr(check, "question", None), str) or not check.question:
        raise ConfigError(f"{where}: {check.__name__}.question must be a text: what does it ask of a capture?")
    said = getattr(check, "findings", None)
    if not isinstance(said, Mapping) or not said or not all(isinstance(one, Explained) for one in said.values()):
        raise ConfigError(
            f"{where}: {check.__name__}.findings must be a mapping from the name of each finding to "
            "Explained(number, passes, fails, why)"
        )
    if all(inspect.getattr_static(check, name) is inspect.getattr_static(Check, name) for name in _ASKED):
        raise ConfigError(f"{where}: {check.__name__} judges nothing; write one of its methods {', '.join(_ASKED)}")
    CHECKS.add(check.__name__, check)
    return check


def views_failing(findings: Iterable[Finding], *names: str) -> set[int]:
    """Return the views of which a finding of one of these names failed."""
    failed = (one for one in findings if one.name in names and one.verdict is Verdict.FAIL)
    return {one.view for one in failed if one.view is not None}
