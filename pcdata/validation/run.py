"""Run the checks: on one frame, or on every capture of a source, one at a time."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator

from pcdata.errors import DTypeError, IntrinsicsError, NoReadingError, PcdataError, PoseError, UnitError
from pcdata.io.sources.capture_source import CaptureSource, checked_ids
from pcdata.io.sources.source import stored_captures
from pcdata.structures import DepthFrame, PointCloud
from pcdata.threads import torch_on_one_thread
from pcdata.validation.checks.cameras import intrinsics_checks, pose_checks
from pcdata.validation.checks.clouds import cloud_checks
from pcdata.validation.checks.color_registration import frame_votes, registration_check
from pcdata.validation.checks.coverage import coverage_checks
from pcdata.validation.checks.pose_direction import direction_checks
from pcdata.validation.checks.pose_direction_over_time import PoseDirectionOverTime
from pcdata.validation.checks.readings import reading_checks
from pcdata.validation.checks.sequence import ClockChecks, RepeatChecks
from pcdata.validation.checks.stored_files import raw_value_checks
from pcdata.validation.checks.view_overlap import overlap_checks
from pcdata.validation.limits import CaptureLimits
from pcdata.validation.measures.edge_offset import EdgeVotes
from pcdata.validation.report import WHOLE, SampleReport
from pcdata.verdicts import Finding, Verdict, worst

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
    """Check every view of one capture on its own, then the views against each other.

    Args:
        frame: the capture as it was read, before any filter.
        limits: thresholds; None = the defaults, for a camera above a table.

    Raises:
        DTypeError: it is no frame.
    """
    if not isinstance(frame, DepthFrame):
        raise DTypeError(
            f"validate_frame: frame must be a DepthFrame, got {type(frame).__name__}; source.load(id) makes one, and "
            "validate_source judges a source with all its captures"
        )
    return _frame_checks(frame, frame_votes(frame), limits or CaptureLimits())


def validate_source(source: CaptureSource, *, limits: CaptureLimits | None = None) -> Iterator[SampleReport]:
    """Check every capture of a source, in order, and compare each with those before it; yields one report for each.

    One capture is held at a time, so memory does not grow with their number. A capture that cannot be read gives a
    report with a failed check, and the others follow. After a recording a last report, with the sample id
    :data:`WHOLE`, judges over all captures together what single ones tell less surely: the registration of colour and
    depth, and the direction of the poses.

    Args:
        source: anything with ``ids`` and ``load``; captures on disk also have their files looked at.
        limits: thresholds; None = the defaults, for a camera above a table.

    Raises:
        DTypeError: it is no source.
        CaptureError: it has no captures, or two with one id.
    """
    return _reports(source, checked_ids("validate_source", source), limits or CaptureLimits())


def _reports(source: CaptureSource, ids: list[str], limits: CaptureLimits) -> Iterator[SampleReport]:
    series = _Series(limits)
    for sample_id in ids:
        yield SampleReport(sample_id, tuple(series.check(source, sample_id)))
    if whole := series.whole():
        yield SampleReport(WHOLE, tuple(whole))


def check_of_error(error: PcdataError) -> Finding:
    """Turn what a reader refused into the failed check that its type names."""
    names = (name for kind, name in _CHECK_OF_ERROR.items() if isinstance(error, kind))
    return Finding(
        name=next(names, READABLE),
        verdict=Verdict.FAIL,
        found=str(error),
        advice="see the message; refused wherever it is read: leave it out of a build with --skip ID, or all such ones "
        "with --skip-refused",
    )


class _Series:
    """Checks captures one after another and remembers what the next ones are compared with."""

    def __init__(self, limits: CaptureLimits) -> None:
        self._limits = limits
        self._repeats = RepeatChecks()
        self._clock = ClockChecks(limits)
        self._poses = PoseDirectionOverTime()
        self._votes: list[EdgeVotes] = []  # by view, summed over the captures
        self._voted = 0

    @torch_on_one_thread()
    def check(self, source: CaptureSource, sample_id: str) -> list[Finding]:
        checks: list[Finding] = []
        try:
            stored = stored_captures(source, sample_id)
            for layout, own in stored:
                layout.check_links(own)
            checks += raw_value_checks([file for layout, own in stored for file in layout.depth_files(own)])
            capture = source.load(sample_id)
        except PcdataError as error:
            return [*checks, check_of_error(error)]
        if isinstance(capture, PointCloud):
            return [*checks, *cloud_checks(capture, self._limits)]
        votes = frame_votes(capture)
        repeats = self._repeats.check(capture)
        found = _frame_checks(capture, votes, self._limits, _views_failing(repeats, "repeated_depth"))
        self._add(votes)
        checks += [*found, *repeats, *self._clock.check(capture)]
        # Depth of another moment or another unit contradicts right poses: it neither accuses them nor is kept.
        if not _views_failing(checks, "repeated_depth", "depth_unit"):
            checks += self._poses.check(capture)
        return checks

    @torch_on_one_thread()
    def whole(self) -> list[Finding]:
        """Judge what all captures tell together."""
        checks = self._poses.whole()
        if self._voted >= 2:
            checks += [registration_check(votes, self._limits, view) for view, votes in enumerate(self._votes)]
        return checks

    def _add(self, votes: list[EdgeVotes]) -> None:
        """Add up the votes, of captures with equal numbers of views and resolution."""
        if not votes:
            return
        if not self._votes:
            self._votes = votes
        elif [one.scale for one in votes] == [one.scale for one in self._votes]:
            self._votes = [total + one for total, one in zip(self._votes, votes)]
        else:
            return
        self._voted += 1


def _frame_checks(
    frame: DepthFrame, votes: Iterable[EdgeVotes], limits: CaptureLimits, repeated: Collection[int] = ()
) -> list[Finding]:
    checks = []
    for view, depth in enumerate(frame.depth):
        checks += coverage_checks(depth > 0, limits, view)
        focal = float(frame.camera.intrinsics[view, 0, 0])
        checks += reading_checks(depth, limits, facts=frame.provenance, focal=focal, view=view)
    checks += intrinsics_checks(frame.camera, limits)
    checks += pose_checks(frame)
    direction = direction_checks(frame, {*repeated, *_views_failing(checks, "depth_unit")})
    checks += direction
    if (
        worst(one.verdict for one in direction) is not Verdict.FAIL
    ):  # views carried the wrong way have no gap worth a number
        checks += overlap_checks(frame)
    checks += [registration_check(one, limits, view) for view, one in enumerate(votes)]
    return checks


def _views_failing(checks: Iterable[Finding], *names: str) -> set[int]:
    failed = (check for check in checks if check.name in names and check.verdict is Verdict.FAIL)
    return {check.view for check in failed if check.view is not None}
