"""Run the checks: on one frame, or on every capture of a source, one at a time."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from pcdata.errors import DTypeError, IntrinsicsError, NoReadingError, PcdataError, PoseError, UnitError
from pcdata.io.sources.capture_source import CaptureSource, checked_ids, recordings_of
from pcdata.io.sources.source import stored_captures
from pcdata.structures import DepthFrame, PointCloud
from pcdata.threads import torch_on_one_thread, while_reading
from pcdata.validation import checks as _checks  # noqa: F401  # registers them
from pcdata.validation.capture_check import CHECKS, Check
from pcdata.validation.capture_limits import CaptureLimits
from pcdata.validation.summary import WHOLE, SampleReport
from pcdata.validation.view_names import view_names
from pcdata.verdicts import Finding, Verdict

# What a reader refuses is the failure of a check too; of errors that fit none, it is of this one.
READABLE = "readable"
_CHECK_OF_ERROR: dict[type[PcdataError], str] = {
    IntrinsicsError: "intrinsics",
    NoReadingError: "valid_fraction",
    PoseError: "pose",
    UnitError: "depth_unit",
}


@torch_on_one_thread()
def validate_frame(frame: DepthFrame, *, limits: CaptureLimits | None = None) -> list[Finding]:
    """Run every check in :data:`CHECKS` on one capture, but for those that compare captures.

    Args:
        frame: the capture as it was read, before any filter.
        limits: thresholds; None = the defaults.

    Raises:
        DTypeError: it is no frame.
    """
    if not isinstance(frame, DepthFrame):
        raise DTypeError(
            f"validate_frame: frame must be a DepthFrame, got {type(frame).__name__}; source.load(id) makes one, and "
            "validate_source judges a source with all its captures"
        )
    limits = limits or CaptureLimits()
    found: list[Finding] = []
    for check in CHECKS.values():
        if DepthFrame in check.of and not check.compares:
            found += _asked(check, check.judge, frame, limits, found, *check.memory())
    return found


def validate_source(source: CaptureSource, *, limits: CaptureLimits | None = None) -> Iterator[SampleReport]:
    """Check every capture of a source, and compare it with those of its recording before it; yields a report for each.

    One capture is held while the next one is read, so memory does not grow with their number. A capture that cannot be
    read gives a report with a failed check, and the others follow. After a recording a last report (``whole``) judges
    over all its captures together what single ones tell less surely: the registration of color and depth, and the
    direction of the poses. Its sample id is :data:`WHOLE`; where sources were joined, ``NAME/*`` tells the recordings
    apart.

    Args:
        source: anything with ``ids`` and ``load``; captures on disk also have their files looked at.
        limits: thresholds; None = the defaults.

    Raises:
        DTypeError: it is no source.
        CaptureError: it has no captures, or two with one id.
    """
    checked_ids("validate_source", source)
    return _reports(source, limits or CaptureLimits())


def _reports(source: CaptureSource, limits: CaptureLimits) -> Iterator[SampleReport]:
    recordings = recordings_of(source)
    for ids, name in zip(recordings, _names_of(recordings)):
        series = _Series(limits)
        yield from while_reading(partial(_read, source), series.check, ids)
        if whole := series.whole():
            yield SampleReport(name, tuple(whole), whole=True)


def _names_of(recordings: list[list[str]]) -> list[str]:
    """Return the sample id of the report on each recording as a whole; all differ."""
    if len(recordings) == 1:
        return [WHOLE]
    folders = [_common_folder(ids) for ids in recordings]
    return [
        f"{folder if folder and folders.count(folder) == 1 else f'{ids[0]} to {ids[-1]}'}/{WHOLE}"
        for ids, folder in zip(recordings, folders)
    ]


def _common_folder(ids: list[str]) -> str:
    """Return what stands before all of the ids, up to a slash: the name under which a recording was joined."""
    levels = zip(*(sample_id.split("/")[:-1] for sample_id in ids))
    return "/".join(level[0] for level in itertools.takewhile(lambda level: len(set(level)) == 1, levels))


def check_of_error(error: PcdataError, *, whole: bool = False) -> Finding:
    """Turn what a reader refused into the failed check that its type names; ``whole``: nothing can be read with it."""
    names = (name for kind, name in _CHECK_OF_ERROR.items() if isinstance(error, kind))
    return Finding(
        name=next(names, READABLE),
        verdict=Verdict.FAIL,
        found=str(error),
        advice="mend what the message names, or give the folder that the captures are in; nothing can be read before "
        "that"
        if whole
        else "mend what the message names; until then it is refused wherever it is read: leave it out of a build with "
        "--skip ID, or all such ones with --skip-refused",
    )


@dataclass(frozen=True, eq=False)
class _Read:
    """A capture as it came from its source."""

    sample_id: str
    stored: list[Path]  # its depth files, where they may be looked at
    capture: DepthFrame | PointCloud | None
    refused: PcdataError | None


def _read(source: CaptureSource, sample_id: str) -> _Read:
    """Read a capture; the files that hold it, too, once it is known that no link leads out of the captures."""
    files: list[Path] = []
    try:
        stored = stored_captures(source, sample_id)
        for layout, own in stored:
            layout.check_links(own)
        files = [file for layout, own in stored for file in layout.depth_files(own)]
        capture = source.load(sample_id)
    except PcdataError as error:
        return _Read(sample_id, files, None, error)
    if not isinstance(capture, (DepthFrame, PointCloud)):
        raise DTypeError(
            f"validate_source: {source!r} gives a {type(capture).__name__} for {sample_id!r}; load must return a "
            "DepthFrame or a PointCloud"
        )
    return _Read(sample_id, files, capture, None)


class _Series:
    """Checks captures one after another; the checks remember what the next ones are compared with."""

    def __init__(self, limits: CaptureLimits) -> None:
        self._limits = limits
        self._checks = [(check, check.memory()) for check in CHECKS.values()]

    @torch_on_one_thread()
    def check(self, read: _Read) -> SampleReport:
        found: list[Finding] = []
        try:
            if read.stored:  # what a file refuses is told as what a reader refuses
                for check, memory in self._checks:
                    if Path in check.of:
                        found += check.judge(read.stored, self._limits, found, *memory)
            if read.refused is not None:
                raise read.refused
        except PcdataError as error:
            return SampleReport(read.sample_id, (*found, check_of_error(error)), refused=True)
        capture, views = read.capture, tuple[str, ...]()
        if isinstance(capture, DepthFrame):
            views = tuple(view_names(capture.provenance, capture.num_views))
        for check, memory in self._checks:
            if isinstance(capture, check.of):
                found += _asked(check, check.judge, capture, self._limits, found, *memory)
        return SampleReport(read.sample_id, tuple(found), views=views)

    @torch_on_one_thread()
    def whole(self) -> list[Finding]:
        """Judge what all captures tell together."""
        return [
            finding
            for check, memory in self._checks
            if check.whole is not None
            for finding in _asked(check, check.whole, *memory, self._limits)
        ]


def _asked(check: Check, judge: Callable[..., list[Finding]], *about: Any) -> list[Finding]:
    """Return what a check found; where it could not measure, that."""
    try:
        return judge(*about)
    except PcdataError as error:
        return [
            Finding(
                name=next(iter(check.findings)),
                verdict=Verdict.UNKNOWN,
                found=f"not measurable: {error}",
                advice="give captures that have what the message asks for, or do without this check",
            )
        ]
