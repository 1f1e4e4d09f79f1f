"""Better extrinsics for recordings of DROID, as its authors publish them: a JSON file by episode and camera serial.

Source: KarlP/droid on the Hugging Face hub, ``cam2base_extrinsics.json`` and ``cam2base_extrinsic_superset.json``: six
numbers for each serial, x y z in metres and Euler angles about the fixed axes x, y, z in radians, base from camera; the
cameras have OpenCV's axes.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from pcdata.errors import CaptureError, locates_path, near_matches
from pcdata.files.opening import read_text
from pcdata.files.strict_json import json_object
from pcdata.geometry.rigid import from_rotation_translation, rotation_about_axis
from pcdata.io.calibration.foreign_cameras import matrix_of
from pcdata.structures.calibration import Calibration, FramePair

_MAX_BYTES = 1 << 28


@locates_path
def with_droid_extrinsics(
    calibration: Calibration, path: str | os.PathLike[str], *, episode: str | None = None, frame_id: str = "base"
) -> Calibration:
    """Return a calibration whose cameras stand where a file of extrinsics says, by their names, which are serials.

    The transforms ``FRAME_from_SERIAL`` are replaced or added; cameras that the file does not have stay as they were.

    Args:
        calibration: with cameras that are named by their serials.
        path: the file: serials to six numbers or a 4x4 matrix; or episodes to such objects, as DROID's.
        episode: which, of a file with several.
        frame_id: the frame that the extrinsics lead to.

    Raises:
        CaptureError: the file is none, has no such episode, or has none of the cameras.
        PoseError: a matrix is not rigid.
    """
    where = f"with_droid_extrinsics: {path}"
    stored = json_object(where, read_text(where, path, max_bytes=_MAX_BYTES), error=CaptureError)
    said = _of_episode(where, stored, episode)
    transforms = dict(calibration.transforms)
    found = [serial for serial in calibration.cameras if serial in said]
    if not found:
        known = [name for name in said if name.isdecimal()]
        raise CaptureError(
            f"{where}: has none of the cameras {', '.join(calibration.cameras)}; it has "
            f"{', '.join(known[:20]) or 'no serial'}. Name the cameras of the calibration by their serials"
        )
    for serial in found:
        name = FramePair(frame_id, serial).name
        transforms = {key: value for key, value in transforms.items() if not _joins(key, frame_id, serial)}
        transforms[name] = _pose(f"{where}: {serial}", said[serial])
    kept_names = {*transforms, *calibration.cameras}
    kept = {name: told for name, told in calibration.evidence.items() if name in kept_names}
    return replace(calibration, transforms=transforms, evidence=kept)


def read_droid_extrinsics(
    where: str, path: str | os.PathLike[str], episodes: Sequence[str], *, is_stated: bool
) -> dict[str | None, dict[str, Tensor]]:
    """Return the poses, (4, 4) float64, of the cameras of some episodes: by episode, then by serial.

    By None stand those that are of every episode: of a file of one, or of the one that was stated.

    Raises:
        CaptureError: the file is none, or has none of the episodes.
        PoseError: a matrix is not rigid.
    """
    stored = json_object(where, read_text(where, path, max_bytes=_MAX_BYTES), error=CaptureError)
    if is_stated:
        return {None: _poses(where, _of_episode(where, stored, episodes[0]))}
    if not stored or not all(isinstance(one, Mapping) for one in stored.values()):
        return {None: _poses(where, stored)}
    found: dict[str | None, dict[str, Tensor]] = {
        name: _poses(f"{where}: {name}", stored[name]) for name in episodes if name in stored
    }
    if not found:
        own = f"none of the captures' ({', '.join(episodes[:3])})" if episodes else "and the captures are of no episode"
        raise CaptureError(
            f"{where}: has {len(stored)} episodes, {own}; say whose poses: episode={next(iter(stored))!r:.200} "
            f"(--option posed.episode={next(iter(stored))})"
        )
    return found


def _poses(where: str, said: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return what is a pose of all that is said; names, scores and the like stand beside them."""
    return {name: _pose(f"{where}: {name}", value) for name, value in said.items() if isinstance(value, list)}


def _of_episode(where: str, said: Mapping[str, Any], episode: str | None) -> Mapping[str, Any]:
    if episode is None:
        if all(isinstance(one, Mapping) for one in said.values()) and said:
            raise CaptureError(
                f"{where}: has {len(said)} episodes; say which: episode={next(iter(said))!r:.200} (--episode)"
            )
        return said
    if not isinstance(said.get(episode), Mapping):
        hint = near_matches(episode, list(said)[:10_000])
        raise CaptureError(f"{where}: has no episode {episode!r:.200}{hint}")
    found: Mapping[str, Any] = said[episode]
    return found


def _joins(name: str, one: str, other: str) -> bool:
    pair = FramePair.parse(name)
    return {pair.to, pair.from_} == {one, other}


def _pose(where: str, values: Any) -> Tensor:  # (4, 4) float64
    if isinstance(values, list) and values and all(isinstance(row, list) for row in values):
        return matrix_of(where, [value for row in values for value in row])
    if not isinstance(values, list) or len(values) != 6:
        raise CaptureError(f"{where}: must be x y z and three Euler angles, or a 4x4 matrix, got {values!r:.100}")
    try:
        numbers = torch.tensor([float(value) for value in values], dtype=torch.float64, device="cpu")
    except (TypeError, ValueError, OverflowError) as error:
        raise CaptureError(f"{where}: must be numbers, got {values!r:.100}") from error
    if not bool(torch.isfinite(numbers).all()):
        raise CaptureError(f"{where}: must be finite numbers, got {values!r:.100}")
    axes = torch.eye(3, dtype=torch.float64, device="cpu")
    x, y, z = (rotation_about_axis(axis, angle) for axis, angle in zip(axes, numbers[3:]))
    return from_rotation_translation(z @ y @ x, numbers[:3])
