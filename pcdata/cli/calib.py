"""Commands about calibration: calib check, calib intrinsics, calib hand-eye; others: see calib_rig and calib_droid."""

from __future__ import annotations

import argparse
import functools
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pcdata.cli import calib_droid, calib_rig
from pcdata.cli.argument_types import positive
from pcdata.cli.known_names import SENSORS
from pcdata.cli.options import add_capture_options, open_captures

if TYPE_CHECKING:
    from pcdata.calibration import Board, Calibration, PlaneResult, RobotPoses
    from pcdata.structures import DepthFrame
    from pcdata.verdicts import Finding, Verdict

FAILED = 1  # exit code of a step whose limits do not hold


def add_to(commands: Any) -> None:
    """Add the command, and under it one command per step."""
    calib = commands.add_parser("calib", help="check a depth camera, or calibrate it to its lens and to the robot")
    steps = calib.add_subparsers(required=True, metavar="STEP")
    for add_step in (_add_check, _add_intrinsics, _add_hand_eye, calib_rig.add_steps, calib_droid.add_step):
        add_step(steps)
    for step in steps.choices.values():
        step.add_argument("--debug", action="store_true", default=argparse.SUPPRESS, help=argparse.SUPPRESS)


def _add_check(steps: Any) -> None:
    check = steps.add_parser("check", help="measure noise, bias and holes on captures of a wall or an empty table")
    check.add_argument("path", metavar="PATH", help="folder of captures")
    add_capture_options(check)
    check.add_argument("--distance", type=float, metavar="METRES", help="known distance of the surface: bias is told")
    check.add_argument(
        "--along",
        choices=("axis", "normal"),
        default="axis",
        help="how it was measured: along the optical axis (default), or normal to the surface (the shortest way)",
    )
    check.add_argument("--roi", type=float, default=0.5, metavar="PART", help="central part of the image (default 0.5)")
    check.add_argument("--sensor", metavar="NAME", help=f"hold noise to this sensor's profile: {', '.join(SENSORS)}")
    check.add_argument("--limit", type=positive, metavar="N", help="only the first N captures")
    check.set_defaults(run=_check)


def _add_intrinsics(steps: Any) -> None:
    intrinsics = steps.add_parser("intrinsics", help="focal length, principal point and distortion from a board")
    intrinsics.add_argument("images", nargs="+", metavar="IMAGES", help="image files, or folders of them")
    intrinsics.add_argument(
        "--board",
        required=True,
        type=_board,
        help="chessboard:COLSxROWS:SQUARE (inner corners) or charuco:COLSxROWS:SQUARE:MARKER:DICT (squares); metres",
    )
    intrinsics.add_argument(
        "--coefficients",
        type=int,
        choices=(0, 4, 5, 8),
        default=5,
        help="of the lens model (default 5: k1 k2 p1 p2 k3)",
    )
    intrinsics.add_argument("--camera", default="camera", metavar="NAME", help="the camera's name (default: camera)")
    _add_file_options(intrinsics)
    intrinsics.set_defaults(run=_intrinsics)


def _add_hand_eye(steps: Any) -> None:
    hand_eye = steps.add_parser("hand-eye", help="where the camera sits on the robot, or beside it")
    hand_eye.add_argument(
        "poses", metavar="POSES", help="file of robot and target poses, or a folder that ViSP or robot_cal_tools saved"
    )
    hand_eye.add_argument(
        "--setup",
        choices=("eye-in-hand", "eye-to-hand"),
        help="camera on the gripper, or beside the robot with the target on the gripper (default: what fits the poses)",
    )
    hand_eye.add_argument("--camera", default="camera", metavar="NAME", help="the camera's name (default: camera)")
    hand_eye.add_argument(
        "--gripper", default="gripper", metavar="FRAME", help="the gripper's frame (default: gripper)"
    )
    hand_eye.add_argument("--base", default="base", metavar="FRAME", help="the robot's base frame (default: base)")
    hand_eye.add_argument(
        "--board", type=_board, help="of the images: charuco:..., chessboard:... or tag:DICT:SIDE; metres"
    )
    hand_eye.add_argument("--calibration", metavar="FILE", help="calibration file with the camera that took the images")
    _add_file_options(hand_eye)
    hand_eye.set_defaults(run=_hand_eye)


def _add_file_options(step: argparse.ArgumentParser) -> None:
    step.add_argument("--out", metavar="FILE", help="calibration file to write; what else an existing one has is kept")
    step.add_argument("--date", metavar="DATE", help="recorded in the file as given (default: none)")


def _board(text: str) -> Board:
    from pcdata.calibration import parse_board
    from pcdata.errors import ConfigError

    try:
        return parse_board(text)
    except ConfigError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _check(arguments: argparse.Namespace) -> int:
    from pcdata.errors import CaptureError
    from pcdata.structures import DepthFrame
    from pcdata.verdicts import Verdict

    source = open_captures(arguments.path, arguments, limit=arguments.limit)
    checks: dict[str, PlaneResult] = {}
    for sample_id in source.ids:
        frame = source.load(sample_id)
        if not isinstance(frame, DepthFrame):
            raise CaptureError(f"{source}: holds clouds; calib check needs depth images")
        for view in range(frame.num_views):
            name = sample_id if frame.num_views == 1 else f"{sample_id} view {view}"
            checks[name] = _check_view(frame.view(view), arguments)
    print(_check_table(checks))
    failed = {name: check for name, check in checks.items() if check.verdict is Verdict.FAIL}
    for name, check in failed.items():
        for line in _failures(check.findings):
            print(f"{name}: {line}")
    print(f"\nverdict  {'FAIL' if failed else 'pass'}: {len(checks) - len(failed)} of {len(checks)} captures in order")
    return FAILED if failed else 0


def _check_view(frame: DepthFrame, arguments: argparse.Namespace) -> PlaneResult:
    from pcdata.calibration import check_plane

    noise = None
    if arguments.sensor is not None:
        noise = _noise_of(arguments.sensor, float(frame.camera.intrinsics[0, 0, 0]))
    return check_plane(frame, roi=arguments.roi, distance=arguments.distance, along=arguments.along, noise=noise)


def _noise_of(sensor: str, focal: float) -> Callable[[float], float]:
    """Return the sensor's noise, with the rounding of its depth image, for a focal length in pixels."""
    from pcdata.sensors import sensor_profile

    profile = sensor_profile(sensor)
    rounding = profile.depth_step / math.sqrt(12)  # of a uniform distribution
    return lambda depth: math.hypot(profile.noise_at(depth, focal=focal), rounding)


def _check_table(checks: dict[str, PlaneResult]) -> str:
    from pcdata.report.plain_table import text_table

    header = ["capture", "axis m", "normal m", "tilt deg", "fill %", "on plane %", "plane RMS mm", "depth RMS mm"]
    any_check = next(iter(checks.values()))
    header += ["expected mm"] if any_check.expected_noise is not None else []
    header += ["bias mm"] if any_check.bias is not None else []
    header += ["warp mm"]
    rows = []
    for name, check in checks.items():
        row = [name, f"{check.axis_distance:.4f}", f"{check.normal_distance:.4f}", f"{math.degrees(check.tilt):.1f}"]
        row += [f"{100 * check.fill:.1f}", f"{100 * check.inlier_share:.1f}"]
        row += [f"{1000 * check.plane_rms:.2f}", f"{1000 * check.depth_rms:.2f}"]
        row += [f"{1000 * check.expected_noise:.2f}"] if check.expected_noise is not None else []
        row += [f"{1000 * check.bias:+.2f}"] if check.bias is not None else []
        row += [f"{1000 * check.warp:.2f}"]
        rows.append([*row, _shown(check.verdict)])
    return text_table([*header, "verdict"], rows)


def _intrinsics(arguments: argparse.Namespace) -> int:
    from pcdata.calibration import calibrate_intrinsics, find_board, read_board_images
    from pcdata.report.plain_table import text_table

    images = read_board_images(arguments.images)
    views, size = find_board(images, arguments.board)
    unseen = tuple(name for name in images if name not in views)
    result = calibrate_intrinsics(
        views, size=size, board=str(arguments.board), num_coefficients=arguments.coefficients, unseen=unseen
    )
    print(text_table(["view", "RMS px"], [[name, f"{rms:.3f}"] for name, rms in result.view_rms.items()]))
    if unseen:
        print(f"\nno board in {', '.join(unseen)}")
    if result.poor_views:
        print(f"\nmore than twice the median error: {', '.join(result.poor_views)}; leave out what is blurred")
    (fx, _, cx), (_, fy, cy), _ = result.camera.intrinsics[0].tolist()
    numbers = [
        [name, f"{value:.3f}", f"{result.uncertainty[name]:.3f}"]
        for name, value in (("fx", fx), ("fy", fy), ("cx", cx), ("cy", cy))
    ]
    print("\n" + text_table(["pixels", "value", "standard deviation"], numbers))
    if result.camera.distortion is not None:
        print(f"distortion  {', '.join(f'{value:.5f}' for value in result.camera.distortion[0].tolist())}")
    print("\n" + _findings_table(result.findings))
    return _conclude(
        arguments,
        result.verdict,
        lambda known: known.with_camera(arguments.camera, result.camera, result.evidence(arguments.date)),
    )


def _hand_eye(arguments: argparse.Namespace) -> int:
    from pcdata.calibration import calibrate_hand_eye
    from pcdata.report.plain_table import text_table

    poses = _read_poses(arguments)
    for line in poses.read_from:
        print(line)
    result = calibrate_hand_eye(poses, setup=arguments.setup)
    if arguments.setup is None:
        print(f"setup: {result.setup}, which of the two fits the poses")
    pixels = dict(zip(poses.names, poses.reprojection_rms))
    rows = [
        [
            name,
            f"{1000 * millimetres:.2f}",
            f"{math.degrees(result.rotation_residuals[name]):.3f}",
            *(["" if (rms := pixels[name]) is None else f"{rms:.3f}"] if pixels else []),
            "OUTLIER" if name in result.outliers else "",
        ]
        for name, millimetres in result.translation_residuals.items()
    ]
    print(text_table(["pose", "mm", "degrees", *(["image RMS px"] if pixels else []), ""], rows))
    solvers = [
        [name, *(f"{value:.5f}" for value in solution[:3, 3].tolist())] for name, solution in result.solutions.items()
    ]
    print("\n" + text_table(["solver", "x m", "y m", "z m"], solvers))
    print("\n" + _findings_table(result.findings))
    if result.outliers:
        print(f"\nlook at {', '.join(result.outliers)}: more than six times the median residual")
    mount = {"gripper": arguments.gripper, "base": arguments.base}[result.mount]
    name = f"{mount}_from_{arguments.camera}"
    print(f"\n{name}\n" + "\n".join("  ".join(f"{v:10.6f}" for v in row) for row in result.mount_from_camera.tolist()))
    return _conclude(
        arguments,
        result.verdict,
        lambda known: known.with_transform(name, result.mount_from_camera, result.evidence(arguments.date)),
    )


def _read_poses(arguments: argparse.Namespace) -> RobotPoses:
    """Read the poses; images are looked at with the board and the camera of the options, or of a folder's files."""
    from pcdata.calibration import read_robot_poses
    from pcdata.errors import ConfigError
    from pcdata.io import read_calibration

    board, file = arguments.board, arguments.calibration
    camera = None if file is None else read_calibration(file).camera(arguments.camera)
    if Path(arguments.poses).is_dir():
        return read_robot_poses(arguments.poses, board=board, camera=camera)
    if (board is None) != (camera is None):
        raise ConfigError("calib hand-eye: --board and --calibration go together: both locate the board in images")
    locate = None if board is None else functools.partial(_locate, board=board, camera=camera)
    return read_robot_poses(arguments.poses, locate=locate)


def _locate(path: Path, board: Board, camera: Any) -> Any:
    from pcdata.calibration.board_images import read_gray
    from pcdata.calibration.hand_eye_set import locate_in_image
    from pcdata.errors import CaptureError

    located = locate_in_image(str(path), read_gray(path), board, camera)
    if located is None:
        raise CaptureError(f"{path}: {board} is not in this image; leave its pose out")
    return located[0]


def _findings_table(findings: Sequence[Finding]) -> str:
    from pcdata.report.plain_table import text_table

    rows = [[f.name, f.found, "" if f.threshold is None else _shown(f.verdict)] for f in findings]
    table = text_table(["measure", "found", "verdict"], rows)
    return "\n\n".join([table, *_failures(findings)])


def _failures(findings: Sequence[Finding]) -> list[str]:
    """Return a line for each finding that does not pass: what was found, and what to do."""
    return [f"{one.name} is {one.found}: {one.advice}" for one in findings if one.advice]


def _shown(verdict: Verdict) -> str:
    return "FAIL" if verdict == "fail" else str(verdict)


def _conclude(arguments: argparse.Namespace, verdict: Verdict, add: Callable[[Calibration], Calibration]) -> int:
    """Say the verdict; write the file only when it is a pass."""
    from pcdata.io import read_calibration, write_calibration
    from pcdata.structures import Calibration
    from pcdata.verdicts import Verdict

    failed = verdict is Verdict.FAIL
    print(f"\nverdict  {'FAIL: nothing is written' if failed else verdict}")
    if failed:
        return FAILED
    if arguments.out is not None:
        known = read_calibration(arguments.out) if Path(arguments.out).exists() else Calibration()
        write_calibration(arguments.out, add(known))
        print(f"written  {arguments.out}")
    return 0
