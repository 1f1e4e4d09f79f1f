"""Commands about several cameras: calib overlap, calib refine."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pcdata.cli.argument_types import positive
from pcdata.cli.known_names import REFINERS
from pcdata.cli.options import (
    RIG_OPTIONS,
    add_combinator_options,
    add_layout_options,
    add_skip_options,
    given_options,
    skip_list,
    tell_skipped,
)  # fmt: skip
from pcdata.cli.outputs import text_files

if TYPE_CHECKING:
    from pcdata.structures import Calibration

FAILED = 1  # exit code of a step whose limits do not hold


def add_steps(steps: Any) -> None:
    """Add both steps under ``pcdata calib``."""
    overlap = steps.add_parser("overlap", help="do several cameras agree, and if not, which one is wrong")
    _add_rig_options(overlap, needs_calibration=False)
    overlap.add_argument("--json", metavar="FILE", help="write every number there")
    overlap.add_argument("--figure", metavar="PNG", help="draw the cameras' points over each other there")
    overlap.set_defaults(run=_overlap)

    refine = steps.add_parser("refine", help="propose better poses for several cameras, into a new file")
    _add_rig_options(refine, needs_calibration=True)
    refine.add_argument("--out", required=True, metavar="NEW", help="calibration file to write; must not exist")
    refine.add_argument("--fixed", metavar="NAME", help="camera that stays (default: the one that agrees best)")
    refine.add_argument("--method", default="pcdata", choices=REFINERS, help=f"{', '.join(REFINERS)} (default: pcdata)")
    refine.add_argument("--max-shift", type=float, default=0.02, metavar="METRES", help="refuse more (default 0.02)")
    refine.add_argument(
        "--max-rotation", type=float, default=2.0, metavar="DEGREES", help="refuse more (default 2 degrees)"
    )
    refine.set_defaults(run=_refine)


def _add_rig_options(command: argparse.ArgumentParser, *, needs_calibration: bool) -> None:
    command.add_argument("source", metavar="SOURCE", help="folder with one folder of captures per camera, by its name")
    command.add_argument(
        "--calibration", required=needs_calibration, metavar="FILE", help="calibration with the cameras and poses"
    )
    command.add_argument(
        "--frame", metavar="NAME", help="frame they meet in (default: base with a calibration, else the captures' own)"
    )
    add_layout_options(command, RIG_OPTIONS)
    add_combinator_options(command)
    add_skip_options(command)
    command.add_argument("--limit", type=positive, default=5, metavar="N", help="only the first N captures (default 5)")


def _overlap(arguments: argparse.Namespace) -> int | None:
    from pcdata.files.strict_json import json_text
    from pcdata.report.overlap_figure import save_overlap_figure
    from pcdata.validation import verify_overlap
    from pcdata.verdicts import Verdict

    rig = _open(arguments, arguments.calibration)
    with text_files("overlap", json=arguments.json) as write:
        captures = [rig.load(sample_id) for sample_id in rig.ids[: arguments.limit]]
        result = verify_overlap(*captures, names=captures[0].provenance["cameras"])
        write("json", json_text(result.to_json(), indent=2) + "\n")
    print(result.text())
    if arguments.figure:
        save_overlap_figure(arguments.figure, captures[0], result)
    return FAILED if result.verdict is Verdict.FAIL else None


def _refine(arguments: argparse.Namespace) -> None:
    from pcdata.calibration import refine_extrinsics
    from pcdata.errors import ConfigError
    from pcdata.io import read_calibration, write_calibration

    if Path(arguments.out).exists():
        raise ConfigError(f"calib refine: {arguments.out} exists; name a new file, a refinement replaces none")
    calibration = read_calibration(arguments.calibration)
    rig = _open(arguments, calibration)
    captures = [rig.load(sample_id) for sample_id in rig.ids[: arguments.limit]]
    refinement = refine_extrinsics(
        captures,
        names=captures[0].provenance["cameras"],
        fixed=arguments.fixed,
        method=arguments.method,
        max_shift=arguments.max_shift,
        max_rotation_degrees=arguments.max_rotation,
    )
    write_calibration(arguments.out, refinement.applied_to(calibration))
    print(refinement.text())
    print(f"\nwritten to {arguments.out}; {arguments.calibration} is unchanged")


def _open(arguments: argparse.Namespace, calibration: Calibration | str | None) -> Any:
    from pcdata.io import open_source

    options = given_options(arguments)
    options["frame_id"] = arguments.frame or (None if calibration is None else "base")
    options["calibration"] = calibration
    source = open_source(
        arguments.source,
        kind="rig",
        only=arguments.only or (),
        limit=arguments.limit,
        skip=skip_list(arguments),
        skip_refused=bool(arguments.skip_refused),
        **options,
    )
    tell_skipped(source.skipped)
    return source
