"""RLBench's cameras: ``CAMERA_depth/N.png`` in 24 bits between the clipping planes, cameras in ``meta_data.json``.

Source: RLBench, ``backend/utils.py`` and ``observation.py``; PyRep, ``VisionSensor``: focal lengths are negative, which
is a camera that looks along z with x to the left and y up, so its pose is turned by half about z to OpenCV's axes;
pixel (u, v) is the direction ((u - cx) / fx, (v - cy) / fy).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pcdata.errors import CaptureError, IntrinsicsError
from pcdata.files.opening import read_text
from pcdata.files.sample_names import in_order
from pcdata.files.strict_json import json_object
from pcdata.io.calibration.foreign_cameras import matrix_of, pinhole_of_matrix
from pcdata.io.images.coded_depth import read_ranged_depth, read_rgb_ids
from pcdata.io.sources.listed import ListedSource, Size, StoredView, checked_folder, files_by_id, one_of, unread_cameras
from pcdata.io.sources.listing import LinkTargets, entries, has_file, is_file, is_folder, link_targets
from pcdata.io.sources.registry import register_layout
from pcdata.io.sources.rlbench_records import PICKLES, read_rlbench_pickle, rlbench_signals
from pcdata.io.sources.source import check_partners

_META = "meta_data.json"
_IMAGES = r"(?P<id>\d+)\.png"
_FOLDERS = {"depth": "{}_depth", "color": "{}_rgb", "labels": "{}_mask"}
_MAX_BYTES = 1 << 27


@register_layout
class _RlbenchSource(ListedSource):
    """One step of an episode a sample, a view of every camera; labels are the simulator's handles of objects.

    Where nothing was hit there is no reading.
    """

    kind = "rlbench"
    is_one_recording = True
    needs = (
        "CAMERA_depth/N.png (RGB) for one or more cameras and meta_data.json (or meta_data.pkl, low_dim_obs.pkl) "
        "with CAMERA_camera_extrinsics, _intrinsics, _near and _far; optional CAMERA_rgb/ and CAMERA_mask/"
    )

    def __init__(
        self,
        path: Path,
        *,
        camera: str | None = None,
        signals: Mapping[str, Any] | None = None,
        frame_id: str = "world",
        links_to: LinkTargets = (),
    ) -> None:
        """Read the file names and the cameras.

        Args:
            path: the folder of one episode.
            camera: read this one alone; None = all, as views of one sample.
            signals: kinds of what is recorded of the robot by name, see :func:`stated_kinds`; None leaves one out.
            frame_id: the frame that the poses lead to.
            links_to: folders outside that links in the capture may lead to.

        Raises:
            CaptureError: a part of the layout is missing, the metadata are a pickle of more than arrays, a camera
                lacks steps that others have, or numbers cannot be right.
            IntrinsicsError: one focal length is negative and the other is not: the image is mirrored.
        """
        path = checked_folder(self.kind, path, self.needs)
        where = f"{self.kind} source {path}"
        names = _cameras(path)
        if not names:
            raise CaptureError(f"{where}: has no folder CAMERA_depth; this layout needs {self.needs}")
        chosen = names if camera is None else [one_of(where, "camera", camera, names)]
        said = _meta(where, path, [path, *link_targets(links_to)])
        by_camera = {name: _views(path, name, said) for name in chosen}
        first = by_camera[chosen[0]]
        check_partners(where, first, {name: views for name, views in by_camera.items() if views is not first})
        recorded = rlbench_signals(where, said, [*map(int, first)], signals, frame_id)
        views: dict[str, dict[str, StoredView]] = {}
        for step in first:
            views[step] = {name: by_camera[name][step] for name in chosen}
            views[step][chosen[0]] = replace(views[step][chosen[0]], signals=recorded[int(step)])
        read = [
            *(path / name for name in (_META, *PICKLES)),
            *(path / form.format(name) for name in names for form in _FOLDERS.values()),
        ]
        told = unread_cameras(names, chosen)
        super().__init__(path, views, frame_id=frame_id, read=read, unread=told, links_to=links_to)

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        """Folders of depth with their camera's name, and metadata."""
        return any(is_file(path / name) for name in (_META, *PICKLES)) and bool(_cameras(path))


def _cameras(path: Path) -> list[str]:
    try:
        found = [entry.name for entry in entries(path) if entry.name.endswith("_depth") and is_folder(entry)]
    except CaptureError:
        return []
    return in_order(name.removesuffix("_depth") for name in found)


def _meta(where: str, path: Path, allowed: list[Path]) -> Mapping[str, Any]:
    if has_file(path / _META):
        text = read_text("rlbench source", path / _META, max_bytes=_MAX_BYTES, inside=allowed)
        return json_object(str(path / _META), text, error=CaptureError)
    for name in PICKLES:
        if has_file(path / name):
            return read_rlbench_pickle(path / name, allowed)
    raise CaptureError(f"{where}: has no {_META}; this layout needs {_RlbenchSource.needs}")


def _views(path: Path, camera: str, said: Mapping[str, Any]) -> dict[str, StoredView]:
    where = f"{path}: {camera}_camera"
    kinds = {role: path / form.format(camera) for role, form in _FOLDERS.items()}
    found = {role: files_by_id(folder, _IMAGES) for role, folder in kinds.items() if is_folder(folder)}
    check_partners(str(path), found["depth"], {role: files for role, files in found.items() if role != "depth"})
    near, far = (_length(where, said, f"{camera}_camera_{end}") for end in ("near", "far"))
    matrix, turn = _upright(where, said.get(f"{camera}_camera_intrinsics"))
    poses = said.get(f"{camera}_camera_extrinsics")
    if not isinstance(poses, list) or not poses:
        raise CaptureError(f"{where}_extrinsics must be a list with a 4x4 matrix for each step, got {poses!r:.80}")
    most = max(map(int, found["depth"]), default=0)
    if len(poses) <= most:
        raise CaptureError(f"{where}_extrinsics has {len(poses)} poses, but there is depth of step {most}")
    return {
        step: StoredView(
            files={role: files[step] for role, files in found.items()},
            read=partial(read_ranged_depth, near=near, far=far),
            camera=pinhole_of_matrix(f"{where}_intrinsics", matrix),
            pose=_pose(f"{where}_extrinsics: step {int(step)}", poses[int(step)]) @ turn,
            readers={"labels": partial(_ids, file=found["labels"][step])} if "labels" in found else {},
            facts={
                "depth_encoding": "rgb24_near_far",
                "near_far": [near, far],
                "metres_per_unit": 1.0,
                "unit_is_recorded": True,
            },
        )
        for step in found["depth"]
    }


def _length(where: str, said: Mapping[str, Any], key: str) -> float:
    value = said.get(key)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise CaptureError(f"{where}: {key} must be metres, got {value!r:.80}")
    return float(value)


def _upright(where: str, matrix: Any) -> tuple[list[list[float]], Tensor]:
    """Return the intrinsics with positive focal lengths, and the turn that this is of the camera's axes."""
    try:
        rows = [[float(value) for value in row] for row in matrix]
        fx, fy = rows[0][0], rows[1][1]
    except (TypeError, ValueError, IndexError, OverflowError) as error:
        raise CaptureError(f"{where}_intrinsics must be a 3x3 matrix, got {matrix!r:.120}") from error
    if (fx < 0) != (fy < 0):
        raise IntrinsicsError(
            f"{where}_intrinsics: one focal length is negative, the other is not ({fx:g}, {fy:g}): a mirrored image; "
            "flip it when exporting"
        )
    sign = -1.0 if fx < 0 else 1.0
    rows[0][0], rows[1][1] = abs(fx), abs(fy)
    return rows, torch.diag(torch.tensor([sign, sign, 1.0, 1.0], dtype=torch.float64, device="cpu"))


def _pose(where: str, matrix: Any) -> Tensor:  # (4, 4) float64
    if not isinstance(matrix, list) or not all(isinstance(row, list) for row in matrix):
        raise CaptureError(f"{where}: must be a 4x4 matrix, got {matrix!r:.80}")
    return matrix_of(where, [value for row in matrix for value in row])


def _ids(size: Size, *, file: Path) -> Tensor:
    return read_rgb_ids(file)
