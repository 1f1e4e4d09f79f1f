"""The command calib droid: published extrinsics in place of recorded ones."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any


def add_step(steps: Any) -> None:
    """Add the step under ``pcdata calib``."""
    droid = steps.add_parser(
        "droid", help="put extrinsics that DROID's authors publish in place of a calibration's own"
    )
    droid.add_argument(
        "calibration", metavar="CALIBRATION", help="calibration whose cameras are called by serial number"
    )
    droid.add_argument(
        "extrinsics", metavar="JSON", help="cam2base_extrinsics.json or the like: poses by episode, serial"
    )
    droid.add_argument("--episode", metavar="NAME", help="which, of a file with several")
    droid.add_argument("--frame", default="base", metavar="NAME", help="frame that they lead to (default: base)")
    droid.add_argument("--out", required=True, metavar="NEW", help="calibration file to write; must not exist")
    droid.set_defaults(run=_droid)


def _droid(arguments: argparse.Namespace) -> None:
    from pcdata.errors import ConfigError
    from pcdata.io import read_calibration, with_droid_extrinsics, write_calibration

    if Path(arguments.out).exists():
        raise ConfigError(f"calib droid: {arguments.out} exists; name a new file, this replaces none")
    before = read_calibration(arguments.calibration)
    after = with_droid_extrinsics(before, arguments.extrinsics, episode=arguments.episode, frame_id=arguments.frame)
    write_calibration(arguments.out, after)
    posed = [name for name in after.transforms if after.transforms[name] is not before.transforms.get(name)]
    kept = [name for name in after.cameras if not any(name in one for one in posed)]
    print(f"from the file: {', '.join(posed)}")
    if kept:
        print(f"not in the file, as they were: {', '.join(kept)}")
    print(f"written to {arguments.out}; {arguments.calibration} is unchanged")
    print(f"use it: --calibration {arguments.out} --camera SERIAL --frame {arguments.frame}")
