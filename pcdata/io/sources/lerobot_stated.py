"""What a camera of a LeRobot dataset needs, from the dataset or else from options: a unit, intrinsics, a pose."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from pcdata.contracts.lengths import check_metres_per_unit, ways
from pcdata.errors import ConfigError, IntrinsicsError, UnitError
from pcdata.functional.depth.unit_fit import likely_fits, units_in_words
from pcdata.io.sources.lerobot_cameras import DepthStream
from pcdata.io.sources.lerobot_index import LeRobotIndex
from pcdata.io.sources.lerobot_sidecars import intrinsics_beside
from pcdata.io.sources.lerobot_views import Lens, Pose, lens_of_column, lens_of_numbers
from pcdata.io.sources.option_checks import check_pinhole


def with_unit(where: str, stream: DepthStream, units: Any, first_image: Callable[[], NDArray[Any]]) -> DepthStream:
    """Return the depth of a camera with the unit that the dataset or the option states.

    Args:
        where: for messages.
        stream: the depth.
        units: metres of a stored unit, or of several cameras by name; None = the dataset states it.
        first_image: reads the first image as it is stored, to name the units that it fits.

    Raises:
        UnitError: both state it, or neither does.
    """
    unit = units.get(stream.camera) if isinstance(units, Mapping) else units
    if unit is not None:
        unit = check_metres_per_unit(where, unit)
        if stream.quantized is not None or stream.metres_per_unit not in (None, unit):
            raise UnitError(
                f"{where}: the dataset states the unit of camera {stream.camera!r}; leave out metres_per_unit"
            )
        stream = replace(stream, metres_per_unit=unit)
    if stream.metres_per_unit is None and stream.quantized is None:
        raise _no_unit(where, stream, first_image())
    return stream


def _no_unit(where: str, stream: DepthStream, stored: NDArray[Any]) -> UnitError:
    """Name the units that an image fits."""
    fits = likely_fits(stored)
    told = f"by its numbers it may be {units_in_words(fits)}" if fits else ways(float(stored.max(initial=0)))
    example = f"{fits[0].unit.metres:.10g}" if fits else "0.001"
    return UnitError(
        f"{where}: nothing states the unit of depth of camera {stream.camera!r} ({stream.key}); {told}. Say "
        f"metres_per_unit={example} (--metres-per-unit {example}), of one camera alone "
        f"metres_per_unit={{{stream.camera!r}: {example}}}"
    )


def lens_of(
    where: str,
    path: Path,
    inside: Sequence[Path],
    index: LeRobotIndex,
    stream: DepthStream,
    given: Any,
    *,
    is_only: bool,
) -> Lens:
    """Return the intrinsics of a camera: of the option, else of a column, else of the file beside the dataset.

    Args:
        where: for messages.
        path: the dataset.
        inside: folders that its files must be in.
        index: of the dataset.
        stream: the depth of the camera.
        given: fx, fy, cx, cy in pixels, or of several cameras by name; None = the dataset has them.
        is_only: whether the dataset has no other camera with depth.

    Raises:
        IntrinsicsError: nothing states them.
        ConfigError: the option is no four numbers, or does not say of which camera it is.
    """
    if isinstance(given, Mapping):
        given = given.get(stream.camera)
    elif given is not None and not is_only:
        raise ConfigError(
            f"{where}: intrinsics must say of which camera they are, such as "
            f"intrinsics={{{stream.camera!r}: (fx, fy, cx, cy)}}"
        )
    if given is not None:
        return lens_of_numbers(check_pinhole(where, given))
    if stream.intrinsics is not None:
        return lens_of_column(stream, index.features[stream.intrinsics])
    beside = intrinsics_beside(where, path, inside, stream)
    if beside is not None:
        return lens_of_numbers(*beside)
    of_it = f"--option 'intrinsics={{{json.dumps(stream.camera)}: [FX, FY, CX, CY]}}'"
    raise IntrinsicsError(
        f"{where}: nothing states the intrinsics of camera {stream.camera!r}; say intrinsics={{{stream.camera!r}: "
        f"(fx, fy, cx, cy)}} in pixels ({'--intrinsics FX FY CX CY' if is_only else of_it})"
    )


def pose_of(stream: DepthStream, direction: str | None) -> Pose | None:
    """Return the column with the poses of a camera; None = it has none, or nothing says where its matrices lead."""
    leads = stream.direction or direction
    if stream.extrinsics is None or leads is None:
        return None
    return Pose(stream.extrinsics, leads == "frame_to_camera")


def unsaid_of(stream: DepthStream, direction: str | None) -> list[str]:
    """Name what the dataset does not say of a camera, and what follows from that."""
    told = []
    if stream.quantized is not None and not stream.facts.get("codec_is_lossless"):
        told.append(
            f"what its codec took of the depth of camera {stream.camera!r}: the dataset does not say that it was coded "
            "without loss, so its error has no bound"
        )
    if stream.extrinsics is not None and (stream.direction or direction) is None:
        told.append(
            f"column {stream.extrinsics}, whose name does not say where it leads; extrinsics=camera_to_frame or "
            "frame_to_camera (--extrinsics) reads it"
        )
    return told
