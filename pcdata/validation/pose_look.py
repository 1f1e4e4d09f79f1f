"""A look at a few captures for poses that lead elsewhere."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence

from pcdata.errors import PcdataError
from pcdata.io.sources.capture_source import CaptureSource
from pcdata.structures import DepthFrame, PointCloud
from pcdata.threads import torch_on_one_thread
from pcdata.validation import checks as _checks  # noqa: F401  # registers them
from pcdata.validation.capture_check import CHECKS
from pcdata.validation.capture_limits import CaptureLimits
from pcdata.validation.checks.pose_direction import NAME
from pcdata.verdicts import Finding, Verdict

_PLACES = (0, 1, 2, 4, 8, 16, 32, 64)  # of captures in order: near enough to see alike, far enough to have moved


@torch_on_one_thread()
def wrong_poses(captures: Iterable[DepthFrame | PointCloud]) -> Finding | None:
    """Return the check that fails where another convention than the stated one makes views agree; None = none does.

    Looks at the first capture of several views, or at captures of one in their order. What cannot be read or measured
    says nothing here: whoever uses it is told then.
    """
    limits = CaptureLimits()
    checks = [(check, check.memory()) for check in CHECKS.values() if NAME in check.findings]
    found: list[Finding] = []
    try:
        for capture in captures:
            if not isinstance(capture, DepthFrame) or capture.world_from_camera is None:
                return None
            for check, memory in checks:
                found += check.judge(capture, limits, (), *memory)
            if capture.num_views > 1:
                break
        for check, memory in checks:
            found += check.whole(*memory, limits) if check.whole is not None else []
    except PcdataError:
        return None
    # What is said of all captures together is surer than what is said of one.
    return next((one for one in reversed(found) if one.name == NAME and one.verdict is Verdict.FAIL), None)


def pose_warning(source: CaptureSource, ids: Sequence[str], path: str) -> str | None:
    """Say in words what :func:`wrong_poses` finds in a few captures of these, and what judges all of the source."""
    finding = wrong_poses(source.load(ids[place]) for place in _PLACES if place < len(ids))
    if finding is None:
        return None
    judge = f"pcdata validate {shlex.quote(path)} judges all captures"
    return f"the poses look wrong: {finding.found}; {finding.advice} ({judge})"
