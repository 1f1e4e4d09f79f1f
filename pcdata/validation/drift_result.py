"""What drift says: where every camera was over a recording, what became of it, and what to do."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from pcdata.validation.overlap_result import OverlapLimits
from pcdata.verdicts import Limits, Verdict, finite_json, worst

STILL, STEP, RAMP, MOVING, UNKNOWN = "still", "step", "ramp", "moving", "unknown"


@dataclass(frozen=True, kw_only=True)
class DriftLimits(Limits):
    """How far a camera may be from where it was. At 0.7 m, 0.15 degrees move a point by 1.8 mm."""

    shift: tuple[float, float] = (0.001, 0.0015)  # metres, at what the camera sees
    rotation_degrees: tuple[float, float] = (0.1, 0.15)

    def overlap(self) -> OverlapLimits:
        """The limits for one alignment."""
        return OverlapLimits(
            shift=self.shift,
            rotation_degrees=self.rotation_degrees,
            max_shift_sigma=self.shift[0] / 2,
            max_rotation_sigma_degrees=self.rotation_degrees[0] / 2,
        )


@dataclass(frozen=True, kw_only=True)
class DriftPoint:
    """Where a camera was during some captures in a row, against where it was first.

    Args:
        first: the id of the first of the captures.
        last: of the last.
        shift: metres that what the camera sees is displaced; NaN = could not be aligned.
        shift_sigma: its standard deviation.
        rotation_degrees: of the camera.
        rotation_sigma_degrees: its standard deviation.
        camera_shift: (3,) metres, where the camera is now, in the frame that it had first.
        meeting: share of the samples that met the first surface.
        verdict: by the limits.
    """

    first: str
    last: str
    shift: float
    shift_sigma: float
    rotation_degrees: float
    rotation_sigma_degrees: float
    camera_shift: tuple[float, ...]
    meeting: float
    verdict: Verdict


@dataclass(frozen=True, kw_only=True)
class CameraDrift:
    """What became of one camera.

    Args:
        name: of the camera.
        kind: "still", "step" (moved at once), "ramp" (slowly), "moving" (carried by a hand or a robot), or "unknown".
        shift: metres at the end of what was measured: the median of the last third after a step, else the largest.
        rotation_degrees: likewise.
        since: id of the first capture from which on it is out of place; "" where it is not.
        unmeasurable: directions about which the scene said too little at the end.
        points: over the recording.
        verdict: the worst that holds until the end or for two windows in a row; UNKNOWN of a moving camera.
    """

    name: str
    kind: str
    shift: float
    rotation_degrees: float
    since: str
    unmeasurable: tuple[str, ...]
    points: tuple[DriftPoint, ...]
    verdict: Verdict

    @property
    def told(self) -> str:
        """The answer in words."""
        if self.kind == MOVING:
            return "moving: carried by a hand or a robot, so drift says nothing"
        if self.kind == UNKNOWN:
            return "could not be measured: the scene has too little shape, or changes as a whole"
        size = f"{1e3 * self.shift:.1f} mm and {self.rotation_degrees:.2f} degrees"
        if self.kind == STILL:
            return f"still: within {size}"
        return f"moved by {size} {'at once' if self.kind == STEP else 'slowly'}, since {self.since!r}"


@dataclass(frozen=True, kw_only=True)
class DriftResult:
    """What became of every camera of a recording."""

    cameras: tuple[CameraDrift, ...]
    limits: DriftLimits

    @property
    def verdict(self) -> Verdict:
        """The worst of all cameras."""
        return worst(camera.verdict for camera in self.cameras)

    @property
    def advice(self) -> str:
        """What to do; empty where nothing moved."""
        bad = [camera for camera in self.cameras if camera.verdict.severity >= Verdict.WARN.severity]
        if not bad:
            return ""
        first = ", ".join(f"{camera.name} since {camera.since!r}" for camera in bad)
        return (
            f"tighten the mount and calibrate again ({first}); what was recorded before keeps the old calibration, and "
            "what came after needs a new one: pcdata calib refine proposes it"
        )

    def to_json(self) -> dict[str, Any]:
        """Return plain values for JSON; numbers that are not finite become None."""
        told = {"schema": "pcdata.drift/1", "verdict": self.verdict, "advice": self.advice, **asdict(self)}
        return finite_json(told)

    def text(self) -> str:
        """Return the answers as lines for a terminal."""
        lines = [f"drift: {self.verdict}"]
        for camera in self.cameras:
            lines.append(f"  {camera.name}: {camera.told}: {camera.verdict}")
            lines += [f"    not measurable: {one}" for one in camera.unmeasurable if camera.kind != MOVING]
        return "\n".join([*lines, *([f"  -> {self.advice}"] if self.advice else [])])
