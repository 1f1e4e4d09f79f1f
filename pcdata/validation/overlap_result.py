"""What the overlap of several cameras says: numbers, verdicts, advice."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

from pcdata.errors import ConfigError, told_apart
from pcdata.verdicts import Limits, Verdict, finite_json, worst

# Intrinsics of another resolution or another unit of depth move surfaces as a bent mount does.
_FIRST = "make sure that its intrinsics are those of these images (size, fx) and its unit of depth is right"


@dataclass(frozen=True, kw_only=True)
class OverlapLimits(Limits):
    """What cameras that agree keep.

    0.25 and 0.4 degrees move a point at 0.7 m, the reach of a table-top workspace, by 3 and 5 mm.
    """

    residual: tuple[float, float] = (0.003, 0.005)  # metres, median gap of a pair
    shift: tuple[float, float] = (0.003, 0.005)  # metres, of a camera at the scene
    rotation_degrees: tuple[float, float] = (0.25, 0.4)  # of a camera
    max_shift_sigma: float = 0.001  # metres; half the distance between pass and fail
    max_rotation_sigma_degrees: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, value in vars(self).items():
            if 0 in (value if isinstance(value, tuple) else (value,)):  # no surface is met so well
                raise ConfigError(f"OverlapLimits: {name} must be more than 0, got {value}")


@dataclass(frozen=True, kw_only=True)
class PairOverlap:
    """The gap between the surfaces of two cameras, as calibrated; metres."""

    first: str
    second: str
    overlap: float  # share of both cameras' samples that have a partner, 0..1
    meeting: float | None  # of the samples that the other camera could see, the share with a partner; None = unknown
    num_samples: int  # that have a partner
    median: float  # of the absolute distances; NaN = too few samples
    p90: float  # of the absolute distances
    mean: float  # signed, of the central 80 per cent: positive where ``first`` lies nearer to the cameras
    verdict: Verdict
    histogram: tuple[int, ...]  # 60 bins of the signed distances from -15 to +15 mm


@dataclass(frozen=True, kw_only=True)
class CameraOverlap:
    """How far one camera is out of place, against the reference camera, along the directions that are measurable."""

    name: str
    shift: float  # metres, at ``center``; inf = too far off to be measured, and so are its vector and rotation_degrees
    shift_vector: tuple[float, ...]  # metres, in the common frame: what would bring it back
    shift_sigma: float  # metres, standard deviation along the worst direction; inf = not determined
    measured_shift_sigma: float  # metres, standard deviation of ``shift`` itself, whatever is not determined
    rotation_degrees: float
    rotation_sigma_degrees: float  # about the worst axis; inf = not determined
    measured_rotation_sigma_degrees: float  # of ``rotation_degrees`` itself
    center: tuple[float, ...]  # the middle of what it shares with others, in the common frame
    correction: list[list[float]]  # 4x4 in the common frame: better_pose = correction @ world_from_camera
    unmeasurable: tuple[str, ...]  # directions about which the scene says too little
    verdict: Verdict


@dataclass(frozen=True, kw_only=True)
class OverlapResult:
    """Whether the cameras agree, with everything that this was told from."""

    pairs: tuple[PairOverlap, ...]
    cameras: tuple[CameraOverlap, ...]
    wrong: tuple[str, ...]  # the cameras whose removal makes the others agree
    candidates: tuple[str, ...]  # where no one camera can be named: one or more of these
    reference: str  # the camera that the others are compared with
    limits: OverlapLimits

    @property
    def verdict(self) -> Verdict:
        """The worst of all pairs that overlap and of all cameras."""
        found = [camera.verdict for camera in self.cameras]
        found += [pair.verdict for pair in self.pairs if pair.verdict is not Verdict.UNKNOWN]
        return worst(found)

    @property
    def advice(self) -> tuple[str, ...]:
        """What to do, most urgent first; empty when everything passes."""
        return tuple(self._advice())

    def advice_about(self, camera: CameraOverlap) -> str:
        """Return what to do about one camera: of one that is known to be wrong what concerns it alone, else all."""
        return _recalibrate(camera) if camera.name in self.wrong else "; ".join(self.advice)

    def _advice(self) -> Iterable[str]:
        yield from (_recalibrate(camera) for camera in self.cameras if camera.name in self.wrong)
        if self.candidates:
            yield (
                f"{' and '.join(self.candidates)} contradict each other and the views cannot tell which is wrong; "
                f"first {_FIRST}, then check the mounts, add a third camera, or recalibrate them"
            )
        for pair in self.pairs:
            if pair.verdict is Verdict.FAIL:
                yield f"{pair.first} and {pair.second}: {self._why_failed(pair)}"
            elif pair.verdict is Verdict.WARN:
                apart, passes = told_apart(1e3 * pair.median, 1e3 * self.limits.residual[0])
                yield (
                    f"{pair.first} and {pair.second}: their surfaces lie {apart} mm apart, up to {passes} pass; give "
                    "more captures to be sure, or let pcdata calib refine propose poses"
                )
        for camera in self.cameras:
            if camera.verdict is Verdict.WARN and camera.name not in self.candidates:
                yield (
                    f"{camera.name}: off by {1e3 * camera.shift:.1f} mm and {camera.rotation_degrees:.2f} degrees, "
                    "more than passes; give more captures to be sure, or let pcdata calib refine propose its pose"
                )
            if not any(pair.num_samples for pair in self.pairs if camera.name in (pair.first, pair.second)):
                yield (
                    f"{camera.name}: shares no surface with another camera; if it should, check its pose: that it is "
                    "world_from_camera, in metres and its own; else let the cameras see one place together"
                )
            elif camera.unmeasurable:
                yield (
                    f"{camera.name}: not measurable here: {'; '.join(camera.unmeasurable)}; put objects with upright "
                    "sides where the cameras overlap, or give several captures"
                )

    def _why_failed(self, pair: PairOverlap) -> str:
        if pair.median > self.limits.residual[1]:
            apart, most = told_apart(1e3 * pair.median, 1e3 * self.limits.residual[1])
            return f"their surfaces lie {apart} mm apart, at most {most} may be"
        assert pair.meeting is not None  # otherwise nothing else fails a pair
        return (
            f"only {100 * pair.meeting:.0f} % of what both could see lies within reach of the other's surface; check "
            "that the poses are world_from_camera, in metres, that the intrinsics and the unit of depth are right, and "
            "that nothing moved between the views"
        )

    def to_json(self) -> dict[str, Any]:
        """Return plain values for JSON; numbers that are not finite become None."""
        plain = {"verdict": self.verdict, "advice": list(self.advice), **asdict(self)}
        return finite_json(plain)

    def text(self) -> str:
        """Return the numbers as lines for a terminal."""
        lines = [f"overlap: {self.verdict}"]
        for pair in self.pairs:
            if math.isnan(pair.median):
                shared = f"overlap {100 * pair.overlap:.0f} %, too little to measure"
                lines.append(f"  {pair.first} - {pair.second}: {shared}: {pair.verdict}")
                continue
            lines.append(
                f"  {pair.first} - {pair.second}: median {1e3 * pair.median:.1f} mm, 90 % below {1e3 * pair.p90:.1f} "
                f"mm, mean {1e3 * pair.mean:+.1f} mm, overlap {100 * pair.overlap:.0f} %: {pair.verdict}"
            )
        for camera in self.cameras:
            lines.append(
                f"  {camera.name}: off by {1e3 * camera.shift:.1f} +- {1e3 * camera.shift_sigma:.1f} mm, "
                f"{camera.rotation_degrees:.2f} +- {camera.rotation_sigma_degrees:.2f} degrees: {camera.verdict}"
            )
        return "\n".join([*lines, *(f"  -> {line}" for line in self.advice)])


def _recalibrate(camera: CameraOverlap) -> str:
    if math.isinf(camera.shift):
        return (
            f"recalibrate {camera.name}: the others agree without it, and it is too far off to be measured; first "
            f"{_FIRST}"
        )
    return (
        f"recalibrate {camera.name}: the others agree without it, and it is off by {1e3 * camera.shift:.1f} mm and "
        f"{camera.rotation_degrees:.2f} degrees; pcdata calib refine can propose its pose; first {_FIRST}"
    )
