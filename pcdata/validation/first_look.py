"""A look at a few captures, while they are read, for wrong units and intrinsics, and for poses that lead elsewhere."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence
from typing import Any

from pcdata.structures import DepthFrame, PointCloud
from pcdata.threads import torch_on_one_thread
from pcdata.validation import checks as _checks  # noqa: F401  # registers them
from pcdata.validation.capture_check import CHECKS, Check
from pcdata.validation.capture_limits import CaptureLimits
from pcdata.validation.checks.depth_unit import NAME as UNIT
from pcdata.validation.checks.focal_length import NAME as FOCAL
from pcdata.validation.checks.pose_direction import NAME as POSES
from pcdata.verdicts import Finding, Verdict

_PLACES = (0, 1, 2, 4, 8, 16, 32, 64)  # of captures in order: near enough to see alike, far enough to have moved
_OF_IMAGE = ("principal_point", "field_of_view")  # what intrinsics alone tell
_SUBJECTS = {
    UNIT: "the unit of depth looks",
    POSES: "the poses look",
    **dict.fromkeys((*_OF_IMAGE, FOCAL), "the intrinsics look"),
}


class FirstLook:
    """A look at some of the captures that somebody reads anyway, in their order; none is read for it, one is kept.

    Unit and intrinsics are those of the first capture. Poses, and focal lengths by them, are judged within it, where it
    has several views, or else from capture to capture: up to the 65th, or the last where there are fewer. What cannot
    be measured says nothing here.
    """

    def __init__(self, *, by_pose: bool = True) -> None:
        """Begin; ``by_pose``: whether poses decide where anything goes."""
        self._look = _Look(by_pose)
        self._number = 0
        self._latest: DepthFrame | PointCloud | None = None  # the last one, where it was not looked at

    def see(self, capture: DepthFrame | PointCloud) -> str | None:
        """Take the next capture; return what is wrong, in words, as soon as that is certain, and once."""
        number, self._number = self._number, self._number + 1
        if self._look.is_done:
            return None
        self._latest = capture
        if number in _PLACES:
            self._latest = None
            self._look.at(capture)
        return self.end() if number == _PLACES[-1] or self._look.is_done else None

    def end(self) -> str | None:
        """Take that there are no more captures; return what is wrong, unless it was told before."""
        if self._latest is not None and not self._look.is_done:
            self._look.at(self._latest)
        self._latest = None
        finding = self._look.concluded()
        return None if finding is None else _in_words(finding)


def judge_of_all(source: object, path: str = "") -> str:
    """Say what judges all captures of a source, to be put behind what a look at a few of them tells."""
    place = path or str(getattr(source, "path", ""))
    return f"({' '.join(filter(None, ['pcdata validate', place and shlex.quote(place)]))} judges all captures)"


def look_at_refused(capture: DepthFrame | PointCloud) -> str | None:
    """Say what is wrong with the unit or the intrinsics of a capture that a step has refused."""
    finding = first_fault([capture], by_pose=False)
    return None if finding is None else _in_words(finding)


def first_fault(captures: Iterable[DepthFrame | PointCloud], *, by_pose: bool = True) -> Finding | None:
    """Return the check of unit, intrinsics or poses that fails for captures in their order; None = none of them."""
    look = _Look(by_pose)
    for capture in captures:
        look.at(capture)
        if look.is_done:
            break
    return look.concluded()


class _Look:
    """What the checks of the unit, the intrinsics and the poses find, capture after capture."""

    def __init__(self, by_pose: bool) -> None:
        self.is_done = False
        self._by_pose = by_pose
        self._limits = CaptureLimits()
        self._checks: list[tuple[Check, tuple[Any, ...]]] = [
            (check, check.memory()) for check in (*_named(FOCAL), *_named(POSES))
        ]
        self._is_first = True
        self._fault: Finding | None = None
        self._found: list[Finding] = []

    @torch_on_one_thread()
    def at(self, capture: DepthFrame | PointCloud) -> None:
        try:
            self.is_done = self._judge(capture)
        except Exception:  # of whatever kind: a look must not stop those who read the captures
            self.is_done = self._without_poses()

    def _judge(self, capture: DepthFrame | PointCloud) -> bool:
        """Judge a capture; say whether no other one is needed."""
        is_first, self._is_first = self._is_first, False
        if not isinstance(capture, DepthFrame):
            return self._without_poses()
        for names in (UNIT,), _OF_IMAGE:
            for check in _named(names[0]) if is_first else ():
                judged = check.judge(capture, self._limits, (), *check.memory())
                if fault := _failed(judged, *names):
                    self._fault = fault
                    return self._without_poses()  # of depth or a camera known to be wrong no pose can be told
        if not self._by_pose or capture.world_from_camera is None:
            return self._without_poses()
        for check, memory in self._checks:
            self._found += check.judge(capture, self._limits, (), *memory)
        return capture.num_views > 1

    def _without_poses(self) -> bool:
        self._found, self._checks = [], []
        return True

    @torch_on_one_thread()
    def concluded(self) -> Finding | None:
        """Return the fault, once; of poses what all captures together tell is surer than what one of them does."""
        found, checks = self._found, self._checks
        fault, self._fault, self._found, self._checks, self.is_done = self._fault, None, [], [], True
        try:
            for check, memory in checks:
                found += check.whole(*memory, self._limits) if check.whole is not None else []
        except Exception:
            return fault
        return fault or _failed(found[::-1], FOCAL) or _failed(found[::-1], POSES)


def _in_words(finding: Finding) -> str:
    return f"{_SUBJECTS[finding.name]} wrong: {finding.found}; {finding.advice}"


def _named(name: str) -> list[Check]:
    return [check for check in CHECKS.values() if name in check.findings and DepthFrame in check.of]


def _failed(found: Sequence[Finding], *names: str) -> Finding | None:
    return next((one for one in found if one.name in names and one.verdict is Verdict.FAIL), None)
