"""Commands about several cameras: calib overlap, calib refine."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pcdata.cli.argument_types import positive
from pcdata.cli.known_names import REFINERS
from pcdata.cli.options import add_capture_options, given_options, skip_list, tell_skipped
from pcdata.cli.outputs import text_files

if TYPE_CHECKING:
    from pcdata.structures import Calibration, DepthFrame

FAILED = 1  # exit code of a step whose limits do not hold


def add_steps(steps: Any) -> None:
    """Add both steps under ``pcdata calib``."""
    overlap = steps.add_parser("overlap", help="do several cameras agree, and if not, which one is wrong")
    _add_rig_options(overlap)
    overlap.add_argument("--json", metavar="FILE", help="write every number there")
    overlap.add_argument("--figure", metavar="PNG", help="draw the cameras' points over each other there")
    overlap.set_defaults(run=_overlap)

    refine = steps.add_parser("refine", help="propose better poses for several cameras, into a new file")
    _add_rig_options(refine)
    refine.add_argument("--out", required=True, metavar="NEW", help="calibration file to write; must not exist")
    refine.add_argument("--fixed", metavar="NAME", help="camera that stays (default: the one that agrees best)")
    refine.add_argument("--method", default="pcdata", choices=REFINERS, help=f"{', '.join(REFINERS)} (default: pcdata)")
    refine.add_argument("--max-shift", type=float, default=0.02, metavar="METRES", help="refuse more (default 0.02)")
    refine.add_argument(
        "--max-rotation", type=float, default=2.0, metavar="DEGREES", help="refuse more (default 2 degrees)"
    )
    refine.set_defaults(run=_refine)


def _add_rig_options(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "source",
        metavar="SOURCE",
        help="captures of several posed views: a folder with one folder per camera, by its name, or a recording",
    )
    add_capture_options(command)
    command.add_argument("--limit", type=positive, default=5, metavar="N", help="only the first N captures (default 5)")


def _overlap(arguments: argparse.Namespace) -> int | None:
    from pcdata.files.strict_json import json_text
    from pcdata.report.overlap_figure import save_overlap_figure
    from pcdata.validation import verify_overlap
    from pcdata.validation.first_look import first_fault
    from pcdata.verdicts import Verdict, worst

    captures = _load("calib overlap", arguments, arguments.calibration)
    with text_files("overlap", json=arguments.json) as write:
        stands = _stands(captures)
        results = [verify_overlap(*stand, names=_names(stand[0])) for stand in stands]
        faults = [first_fault(stand[:1]) for stand in stands]
        verdict = worst([*(result.verdict for result in results), *(one.verdict for one in faults if one)])
        told = [
            {
                "captures": [capture.sample_id for capture in stand],
                **result.to_json(),
                "fault": None if fault is None else fault.to_json(),
            }
            for stand, result, fault in zip(stands, results, faults)
        ]
        write("json", json_text({"verdict": verdict, "stands": told}, indent=2) + "\n")
    for stand, result, fault in zip(stands, results, faults):
        if len(stands) > 1:
            print(f"capture {', '.join(str(capture.sample_id) for capture in stand)}")
        print(result.text())
        if fault is not None:
            print(f"  {fault.name}: {fault.found}: {fault.verdict}\n  -> {fault.advice}")
    if len(stands) > 1:
        print(
            f"overlap: {verdict}, the worst of {len(stands)} stands: cameras moved in between, so each is judged alone"
        )
    if arguments.figure:
        drawn = max(range(len(results)), key=lambda place: results[place].verdict.severity)
        save_overlap_figure(arguments.figure, stands[drawn][0], results[drawn])
    return FAILED if verdict is Verdict.FAIL else None


def _stands(captures: list[DepthFrame]) -> list[list[DepthFrame]]:
    """Group the captures by where their cameras stood, in the order of the first of each."""
    stands: list[list[DepthFrame]] = []
    for capture in captures:
        stand = next((stand for stand in stands if _stood_alike(stand[0], capture)), None)
        if stand is None:
            stands.append([capture])
        else:
            stand.append(capture)
    return stands


def _stood_alike(one: DepthFrame, other: DepthFrame) -> bool:
    import torch

    here, there = one.world_from_camera, other.world_from_camera
    return here is not None and there is not None and torch.equal(here, there) and _names(one) == _names(other)


def _names(capture: DepthFrame) -> list[str] | None:
    """Return what the views' cameras are called, where the captures say it."""
    said: Any = capture.provenance.get("cameras", ())
    return [str(name) for name in said] if len(said) == capture.num_views else None


def _refine(arguments: argparse.Namespace) -> None:
    from pcdata.calibration import refine_extrinsics
    from pcdata.errors import ConfigError
    from pcdata.io import read_calibration, write_calibration

    if Path(arguments.out).exists():
        raise ConfigError(f"calib refine: {arguments.out} exists; name a new file, a refinement replaces none")
    if arguments.calibration is None:
        raise ConfigError("calib refine: say which calibration to refine, with --calibration FILE")
    calibration = read_calibration(arguments.calibration)
    captures = _load("calib refine", arguments, calibration)
    if (names := _names(captures[0])) is None:
        raise ConfigError(
            f"calib refine: {arguments.source} does not say which camera of the calibration each view is; store one "
            "folder per camera, named as the calibration names it"
        )
    refinement = refine_extrinsics(
        captures,
        names=names,
        fixed=arguments.fixed,
        method=arguments.method,
        max_shift=arguments.max_shift,
        max_rotation_degrees=arguments.max_rotation,
    )
    write_calibration(arguments.out, refinement.applied_to(calibration))
    print(refinement.text())
    print(f"\nwritten to {arguments.out}; {arguments.calibration} is unchanged")


def _load(where: str, arguments: argparse.Namespace, calibration: Calibration | str | None) -> list[DepthFrame]:
    """Load the captures; the poses of a calibration go around those of a layout that takes none by itself."""
    from pcdata.errors import DTypeError, ShapeError
    from pcdata.io import open_source
    from pcdata.structures import DepthFrame

    options = given_options(arguments)
    if calibration is not None:
        options["frame_id"] = arguments.frame or "base"
        if _takes_calibration(arguments):
            options["calibration"] = calibration
        else:
            options["posed"] = {"file": options.pop("calibration"), "frame_id": options.pop("frame_id")}
    source = open_source(
        arguments.source,
        kind=arguments.kind,
        only=arguments.only or (),
        limit=arguments.limit,
        skip=skip_list(arguments),
        skip_refused=bool(arguments.skip_refused),
        **options,
    )
    tell_skipped(source.skipped)
    captures: list[DepthFrame] = []
    for capture in map(source.load, source.ids):
        if not isinstance(capture, DepthFrame):
            raise DTypeError(f"{where}: {arguments.source} holds clouds; give the depth images of the cameras")
        if capture.num_views < 2:
            raise ShapeError(
                f"{where}: compares the views of a capture, two or more, but {capture.sample_id!r} of "
                f"{arguments.source} has one; give a folder with one folder per camera (docs/multi_view.md), or judge "
                "the poses of one moving camera with pcdata validate"
            )
        captures.append(capture)
    return captures


def _takes_calibration(arguments: argparse.Namespace) -> bool:
    from pcdata.io.sources.detect import detect_layout
    from pcdata.io.sources.registry import layout_named, options_of

    path = Path(arguments.source).expanduser()
    if arguments.kind is None and not path.exists():  # a pattern, or a mistake that opening tells
        return True
    layout = detect_layout(path) if arguments.kind is None else layout_named("calib", arguments.kind)
    return "calibration" in options_of(layout)
