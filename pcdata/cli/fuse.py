"""The command that averages the views of captures into one surface: fuse."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

from pcdata.cli.argument_types import positive
from pcdata.cli.known_names import CARVINGS, WEIGHTINGS
from pcdata.cli.options import add_capture_options, open_captures
from pcdata.cli.progress_bar import ProgressBar


def add_to(commands: Any) -> None:
    """Add the command to the parser."""
    fuse = commands.add_parser("fuse", help="average the views of captures into one cloud, mesh or volume")
    fuse.add_argument("path", metavar="PATH", help="folder of captures with poses, or of several cameras' folders")
    fuse.add_argument(
        "--out", required=True, metavar="FILE", help=".ply: a cloud, or a mesh with --mesh; .npz: the volume itself"
    )
    fuse.add_argument("--mesh", action="store_true", help="write triangles instead of points")
    fuse.add_argument("--voxel-size", type=float, default=0.002, metavar="M", help="metres (default 0.002)")
    fuse.add_argument(
        "--truncation", type=float, metavar="M", help="metres on either side of a surface (default: 5 voxels)"
    )
    fuse.add_argument(
        "--weighting", choices=WEIGHTINGS, default="constant", help="how much a reading counts (default: constant)"
    )
    fuse.add_argument(
        "--carve", choices=CARVINGS, default="near", help="where views wear away what they see through (default: near)"
    )
    fuse.add_argument(
        "--min-weight", type=float, metavar="N", help="leave out points of less weight, such as seen by fewer views"
    )
    fuse.add_argument(
        "--max-megabytes", type=positive, default=4096, metavar="N", help="refuse to take more memory (default 4096)"
    )
    add_capture_options(fuse)
    fuse.add_argument("--limit", type=positive, metavar="N", help="only the first N captures")
    fuse.add_argument("--overwrite", action="store_true", help="replace FILE")
    fuse.set_defaults(run=_fuse)


def _fuse(arguments: argparse.Namespace) -> None:
    out = _checked_target(arguments)  # before the work, not after
    from pcdata.files.sample_names import counted
    from pcdata.io import write_ply, write_volume
    from pcdata.io.sources.capture_source import check_apart
    from pcdata.structures import TSDFVolume
    from pcdata.validation.first_look import FirstLook, judge_of_all

    volume = TSDFVolume(
        voxel_size=arguments.voxel_size,
        truncation=arguments.truncation,
        weighting=arguments.weighting,
        carve=arguments.carve,
        max_bytes=arguments.max_megabytes << 20,
    )
    source = open_captures(arguments.path, arguments, limit=arguments.limit)
    check_apart("fuse: --out", out, source)
    with ProgressBar("fuse") as progress:
        look = FirstLook()
        for done, sample_id in enumerate(source.ids, 1):
            capture = source.load(sample_id)
            told = look.see(capture)
            if told := told or (look.end() if done == len(source) else None):
                progress.note(f"{told} {judge_of_all(source, arguments.path)}")
            volume.integrate(capture)
            progress(done, len(source), sample_id)
    least = arguments.min_weight or 0.0
    if out.suffix == ".npz":
        write_volume(out, volume)
        what = f"volume of {volume.num_blocks:,} blocks, {volume.num_bytes / 2**20:.0f} MiB"
    elif arguments.mesh:
        mesh = volume.extract_mesh(min_weight=least)
        _require_surface(mesh.vertices.num_points, arguments)
        write_ply(out, mesh)
        what = f"mesh of {mesh.vertices.num_points:,} points, {len(mesh.triangles):,} triangles"
    else:
        cloud = volume.extract_points(min_weight=least)
        _require_surface(cloud.num_points, arguments)
        write_ply(out, cloud)
        what = f"cloud of {cloud.num_points:,} points"
    views = f"{counted(volume.num_views, 'view')} of {counted(len(source), 'capture')}"
    print(f"fuse  {out}  ({what} in frame {volume.frame_id!r}, from {views})")


def _require_surface(num_points: int, arguments: argparse.Namespace) -> None:
    """Require that something was found, before a file without a point is written.

    Raises:
        TooFewPointsError: no point of a surface.
    """
    from pcdata.errors import TooFewPointsError

    if num_points == 0:
        weight = "" if arguments.min_weight is None else f", or less than --min-weight {arguments.min_weight:g}"
        raise TooFewPointsError(
            f"fuse: no surface was found at voxels of {arguments.voxel_size:g} m: use smaller ones (--voxel-size 0.005)"
            f"{weight}; nothing is written"
        )


def _checked_target(arguments: argparse.Namespace) -> Path:
    """Return where the result goes.

    Raises:
        ConfigError: its name does not say what it is, an option does not fit it, or it cannot go there.
    """
    from pcdata.errors import ConfigError

    out = Path(arguments.out).expanduser()
    if out.suffix not in (".ply", ".npz"):
        raise ConfigError(f"fuse: --out must end in .ply (a cloud, or --mesh) or .npz (the volume), got {out.name!r}")
    if out.suffix == ".npz" and (arguments.mesh or arguments.min_weight is not None):
        flag = "--mesh" if arguments.mesh else "--min-weight"
        raise ConfigError(f"fuse: an .npz holds the whole volume, which {flag} cannot change; write a .ply, or drop it")
    if not out.parent.is_dir():
        raise ConfigError(f"fuse: there is no folder {out.parent} to write into; make it, or choose another")
    if not os.access(out.parent, os.W_OK):  # told before all captures are read
        raise ConfigError(f"fuse: there is no permission to write into {out.parent}; choose another folder")
    if out.is_dir():
        raise ConfigError(f"fuse: {out} is a folder; name a file")
    if out.exists() and not arguments.overwrite:
        raise ConfigError(f"fuse: {out} exists; choose another file, or replace it (--overwrite)")
    return out
