"""A look at a few captures for a wrong unit of depth, and for poses that lead elsewhere."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence

from pcdata.errors import PcdataError
from pcdata.io.sources.capture_source import CaptureSource
from pcdata.structures import DepthFrame, PointCloud
from pcdata.threads import torch_on_one_thread
from pcdata.validation import checks as _checks  # noqa: F401  # registers them
from pcdata.validation.capture_check import CHECKS, Check
from pcdata.validation.capture_limits import CaptureLimits
from pcdata.validation.checks.depth_unit import NAME as UNIT
from pcdata.validation.checks.pose_direction import NAME as POSES
from pcdata.verdicts import Finding, Verdict

_PLACES = (0, 1, 2, 4, 8, 16, 32, 64)  # of captures in order: near enough to see alike, far enough to have moved
_SUBJECTS = {UNIT: "the unit of depth looks", POSES: "the poses look"}


@torch_on_one_thread()
def first_fault(captures: Iterable[DepthFrame | PointCloud], *, by_pose: bool = True) -> Finding | None:
    """Return the check of the unit, or else of the poses, that fails for captures in their order; None = neither does.

    The unit is that of the first capture. Poses are judged within it, where it has several views, or else from capture
    to capture. What cannot be read or measured says nothing here: whoever uses it is told then.
    """
    limits, found = CaptureLimits(), list[Finding]()
    of_poses = [(check, check.memory()) for check in _named(POSES)]
    try:
        for number, capture in enumerate(captures):
            if not isinstance(capture, DepthFrame):
                return None
            for check in _named(UNIT) if number == 0 else ():
                judged = check.judge(capture, limits, (), *check.memory())
                if fault := _failed(UNIT, judged):
                    return fault  # of depth that is known to be wrong no pose can be told
            if not by_pose or capture.world_from_camera is None:
                return None
            for check, memory in of_poses:
                found += check.judge(capture, limits, (), *memory)
            if capture.num_views > 1:
                break
        for check, memory in of_poses:
            found += check.whole(*memory, limits) if check.whole is not None else []
    except PcdataError:
        return None
    return _failed(POSES, found[::-1])  # what is said of all captures together is surer than what is said of one


def first_look(source: CaptureSource, ids: Sequence[str], path: str, *, by_pose: bool = True) -> str | None:
    """Say in words what :func:`first_fault` finds in a few captures of these, and what judges all of the source."""
    some = (source.load(ids[place]) for place in _PLACES if place < len(ids))
    finding = first_fault(some, by_pose=by_pose)
    if finding is None:
        return None
    judge = f"pcdata validate {shlex.quote(path)} judges all captures"
    return f"{_SUBJECTS[finding.name]} wrong: {finding.found}; {finding.advice} ({judge})"


def _named(name: str) -> list[Check]:
    return [check for check in CHECKS.values() if name in check.findings and DepthFrame in check.of]


def _failed(name: str, found: Sequence[Finding]) -> Finding | None:
    return next((one for one in found if one.name == name and one.verdict is Verdict.FAIL), None)
