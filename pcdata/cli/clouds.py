"""The command that writes clouds as files of other programs: clouds."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from pcdata.cli.argument_types import positive
from pcdata.cli.options import add_capture_options, given_flags, open_captures
from pcdata.cli.progress_bar import ProgressBar


def add_to(commands: Any) -> None:
    """Add the command to the parser."""
    clouds = commands.add_parser(
        "clouds", help="write the clouds of captures or of a dataset as PLY or PCD for CloudCompare, MeshLab, PCL"
    )
    clouds.add_argument(
        "path",
        metavar="PATH",
        help="captures, whose views are merged where poses are known; cloud files; or a dataset that a build wrote, "
        "whose clouds are written as they are stored",
    )
    clouds.add_argument("--out", required=True, metavar="DIR", help="a new folder, one file a sample")
    clouds.add_argument("--to", choices=("ply", "pcd"), default="ply", help="format of the files (default: ply)")
    clouds.add_argument(
        "--encoding",
        metavar="NAME",
        default="binary",
        help="binary or ascii; of PLY also binary_big_endian, of PCD binary_compressed (default: binary)",
    )
    clouds.add_argument(
        "--scalar-names",
        action="store_true",
        help="call fields scalar_NAME, which CloudCompare loads without asking; of PLY",
    )
    clouds.add_argument(
        "--quality",
        metavar="FIELD",
        help="write this field, such as labels, once more as the one scalar that MeshLab reads; of PLY",
    )
    add_capture_options(clouds)
    clouds.add_argument("--limit", type=positive, metavar="N", help="only the first N captures")
    clouds.set_defaults(run=_clouds)


def _clouds(arguments: argparse.Namespace) -> None:
    from pcdata.datasets import CachedCloudDataset
    from pcdata.errors import ConfigError
    from pcdata.exports.cloud_files import write_clouds
    from pcdata.files.sample_names import counted
    from pcdata.io.store.manifest import Manifest

    source: Any
    if Manifest.is_one(Path(arguments.path)):
        if given := given_flags(arguments, "--limit"):
            raise ConfigError(
                f"clouds: {', '.join(given)} say how captures are read, and {arguments.path} is a dataset"
            )
        source = CachedCloudDataset(arguments.path, augment=None)
    else:
        source = open_captures(arguments.path, arguments, limit=arguments.limit)
    with ProgressBar("clouds") as progress:
        written = write_clouds(
            source,
            arguments.out,
            to=arguments.to,
            encoding=arguments.encoding,
            scalar_names=arguments.scalar_names,
            quality=arguments.quality,
            progress=progress,
        )
    print(f"clouds   {arguments.out}  ({counted(written, 'file')}, {arguments.to})")
