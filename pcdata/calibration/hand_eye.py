"""Where a camera sits on a robot, from robot poses and what the camera saw of a target in each."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.calibration.hand_eye_opencv import opencv_solutions
from pcdata.calibration.hand_eye_refine import mean_pose, refine
from pcdata.calibration.limits import CalibrationLimits
from pcdata.calibration.motions import Poses, check_motions, inverse, motions_between, rotation_vectors
from pcdata.calibration.park_martin import park_martin
from pcdata.calibration.robot_poses import RobotPoses
from pcdata.errors import CalibrationError, ConfigError
from pcdata.structures.calibration import Evidence
from pcdata.verdicts import Finding, Verdict, at_most, worst

Setup = Literal["eye-in-hand", "eye-to-hand"]

SETUPS: tuple[Setup, Setup] = ("eye-in-hand", "eye-to-hand")
FINAL = "least squares over all poses"

# Times the median residual. A board seen head-on is located several times worse than one that is tilted, so less would
# name good poses; an error that matters (a pose of another moment, a slipped board) is far larger.
_OUTLIER = 6.0
_SMALLEST_OUTLIER = (0.0005, math.radians(0.5))  # metres, radians; a pose nearer than this is not worth leaving out
_DISAGREE = "look at the poses with the largest residuals: was the robot at rest, did the target or the camera slip?"
_UNDETERMINED = "add poses that turn the gripper by 30 to 60 degrees about different axes"
_CLEARLY_BETTER = 0.2  # of the residual; poses read the right way round fit many times better


@dataclass(frozen=True, eq=False, kw_only=True)
class _HandEyeResult:
    """The camera on its mount, and how well the poses agree. Lengths in metres, angles in radians."""

    setup: Setup
    mount_from_camera: Tensor  # (4, 4) float64: gripper_from_camera (eye-in-hand) or base_from_camera (eye-to-hand)
    holder_from_target: Tensor  # (4, 4) float64: base_from_target or gripper_from_target
    translation_residuals: Mapping[str, float]  # per pose: where it puts the target, against all poses together
    rotation_residuals: Mapping[str, float]
    outliers: tuple[str, ...]  # poses more than six times off the median
    solutions: Mapping[str, Tensor]  # by solver; the last is the answer
    translation_spread: float  # largest distance between two solvers' cameras
    rotation_spread: float
    translation_sigma: float  # standard deviation of the answer, all axes together
    rotation_sigma: float
    findings: tuple[Finding, ...]

    @property
    def verdict(self) -> Verdict:
        """Whether every limit held."""
        return worst(finding.verdict for finding in self.findings)

    @property
    def mount(self) -> str:
        """The frame that bears the camera: "gripper" or "base"."""
        return "gripper" if self.setup == "eye-in-hand" else "base"

    def evidence(self, date: str | None = None) -> Evidence:
        """Return what a calibration file keeps of this result."""
        return Evidence(
            method=f"hand-eye, {self.setup}, {FINAL}; compared with {', '.join(list(self.solutions)[:-1])}",
            num_observations=len(self.translation_residuals),
            residuals={
                "translation_rms_m": _rms(self.translation_residuals),
                "rotation_rms_degrees": math.degrees(_rms(self.rotation_residuals)),
                "translation_standard_deviation_m": self.translation_sigma,
                "rotation_standard_deviation_degrees": math.degrees(self.rotation_sigma),
                "solver_spread_m": self.translation_spread,
                "solver_spread_degrees": math.degrees(self.rotation_spread),
            },
            date=date,
        )


def calibrate_hand_eye(
    poses: RobotPoses, *, setup: Setup | None = None, limits: CalibrationLimits | None = None
) -> _HandEyeResult:
    """Solve for the camera on the gripper (eye-in-hand) or beside the robot (eye-to-hand).

    In both, ``holder_from_mount @ mount_from_camera @ camera_from_target`` is one and the same for all poses, where the
    mount bears the camera and the holder the target: gripper and base for eye-in-hand, base and gripper for
    eye-to-hand. So the robot's pose enters as it is in the first case and inverted in the second.

    The answer is a robust least-squares fit to all poses, started from Park & Martin's closed form; OpenCV's five
    solvers are compared where OpenCV is installed.

    Args:
        poses: robot and target poses; see :func:`read_robot_poses`.
        setup: ``eye-in-hand`` (camera on the gripper, target fixed) or ``eye-to-hand`` (camera fixed, target on the
            gripper). None = the one that fits the poses far better than the other.
        limits: None = those of :class:`CalibrationLimits`.

    Raises:
        CalibrationError: the poses cannot determine the answer, or which setup it is, and what to do.
        ConfigError: the setup is not known.
    """
    if setup is not None and setup not in SETUPS:
        raise ConfigError(f"calibrate_hand_eye: setup must be {' or '.join(SETUPS)}, got {setup!r}")
    robot, target = poses.base_from_gripper.numpy(), poses.camera_from_target.numpy()
    if setup is None:
        setup = _setup_of(robot, target)
    holder_from_mount = robot if setup == "eye-in-hand" else inverse(robot)
    motions = motions_between(holder_from_mount, target)
    check_motions(*motions, len(robot))
    closed = park_martin(*motions)
    best, placement, rotation_sigma, translation_sigma = refine(holder_from_mount, target, closed)
    solutions = {"Park-Martin": closed, **opencv_solutions(holder_from_mount, target), FINAL: best}
    placed = holder_from_mount @ best @ target
    translation, rotation = _distances(placed, placement)
    outliers = _outliers(translation, _SMALLEST_OUTLIER[0]) | _outliers(rotation, _SMALLEST_OUTLIER[1])
    translation_spread, rotation_spread = _spread(list(solutions.values()))
    limits = limits or CalibrationLimits()
    translation_rms = _root_mean_square(translation)
    findings = [
        _length("translation RMS", translation_rms, limits.max_translation_rms, _DISAGREE),
        _angle("rotation RMS", _root_mean_square(rotation), limits.max_rotation_rms, _DISAGREE),
        _length("solvers apart, position", translation_spread, limits.max_translation_spread, _UNDETERMINED),
        _angle("solvers apart, rotation", rotation_spread, limits.max_rotation_spread, _UNDETERMINED),
        Finding(
            name="standard deviation of the position",
            found=f"{1000 * translation_sigma:.2g} mm",
            value=translation_sigma,
            unit="m",
        ),
        Finding(
            name="standard deviation of the rotation",
            found=f"{math.degrees(rotation_sigma):.2g} degrees",
            value=rotation_sigma,
            unit="rad",
        ),
    ]
    failed = any(finding.verdict is Verdict.FAIL for finding in findings)
    if failed and (other := _other_reading(robot, target, setup, translation_rms)):
        findings = [replace(one, advice=other) if one.verdict is Verdict.FAIL else one for one in findings]
    return _HandEyeResult(
        setup=setup,
        mount_from_camera=torch.from_numpy(best),
        holder_from_target=torch.from_numpy(placement),
        translation_residuals=dict(zip(poses.names, translation.tolist())),
        rotation_residuals=dict(zip(poses.names, rotation.tolist())),
        outliers=tuple(name for name, out in zip(poses.names, outliers) if out),
        solutions={name: torch.from_numpy(solution) for name, solution in solutions.items()},
        translation_spread=translation_spread,
        rotation_spread=rotation_spread,
        translation_sigma=translation_sigma,
        rotation_sigma=rotation_sigma,
        findings=tuple(findings),
    )


def _distances(poses: Poses, reference: Poses) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return distance and angle of (N, 4, 4) poses from one."""
    apart = inverse(reference) @ poses
    return np.linalg.norm(apart[:, :3, 3], axis=1), np.linalg.norm(rotation_vectors(apart), axis=1)


def _spread(solutions: list[Poses]) -> tuple[float, float]:
    apart = [_distances(a[None], b) for a, b in itertools.combinations(solutions, 2)]
    return max(float(distance[0]) for distance, _ in apart), max(float(angle[0]) for _, angle in apart)


def _outliers(residuals: NDArray[np.float64], smallest: float) -> NDArray[np.bool_]:
    return residuals > max(_OUTLIER * float(np.median(residuals)), smallest)


def _other_reading(robot: Poses, target: Poses, setup: Setup, residual: float) -> str | None:
    """Say which other reading of the same numbers fits far better, if one does."""
    other: Setup = "eye-to-hand" if setup == "eye-in-hand" else "eye-in-hand"
    readings = {
        f"the poses fit as {other}: check --setup, or whether the robot's poses are gripper_from_base": (other, False),
        "the poses fit with the target's inverted: they are target_from_camera, give camera_from_target": (setup, True),
        f"the poses fit as {other} with the target's inverted: check both directions": (other, True),
    }
    found = {}
    for advice, (reading, inverted) in readings.items():
        found[advice] = _residual(robot, inverse(target) if inverted else target, reading)
    best = min(found, key=lambda advice: found[advice])
    return f"{best} (residual {1000 * found[best]:.2g} mm)" if found[best] < _CLEARLY_BETTER * residual else None


def _setup_of(robot: Poses, target: Poses) -> Setup:
    """Return the setup that fits far better than the other."""
    check_motions(*motions_between(robot, target), len(robot))
    found: dict[Setup, float] = {setup: _residual(robot, target, setup) for setup in SETUPS}
    best, other = sorted(found, key=lambda setup: found[setup])
    if found[best] >= _CLEARLY_BETTER * found[other]:
        raise CalibrationError(
            "hand-eye: the poses do not tell whether the camera is on the gripper or beside the robot (residual "
            f"{1000 * found[best]:.2g} mm as {best}, {1000 * found[other]:.2g} mm as {other}); say "
            f"--setup {' or '.join(SETUPS)}"
        )
    return best


def _residual(robot: Poses, target: Poses, setup: Setup) -> float:
    """Return how far apart, RMS in metres, the closed form leaves the target under a reading of the poses."""
    mount = robot if setup == "eye-in-hand" else inverse(robot)
    placed = mount @ park_martin(*motions_between(mount, target)) @ target
    return _root_mean_square(_distances(placed, mean_pose(placed))[0])


def _length(name: str, value: float, limit: float, advice: str) -> Finding:
    return at_most(name, value, limit, advice, unit="m", shown=("mm", 1000.0))


def _angle(name: str, value: float, limit: float, advice: str) -> Finding:
    return at_most(name, value, limit, advice, unit="rad", shown=("degrees", 180 / math.pi))


def _root_mean_square(values: NDArray[np.float64]) -> float:
    return float(np.sqrt((values**2).mean()))


def _rms(residuals: Mapping[str, float]) -> float:
    return _root_mean_square(np.array(list(residuals.values())))
