"""Coordinate frames: ToFrame, MergeViews."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from pcdata.contracts.on_host import bounds_of, counts_of
from pcdata.errors import ConfigError, FrameError, PcdataError, ReplayError, near_matches
from pcdata.functional.rows import cloud_of_rows, ptr_from_counts
from pcdata.functional.voxel_averages import voxel_majority
from pcdata.functional.voxels import voxel_downsample
from pcdata.geometry import rigid
from pcdata.rng import Streams
from pcdata.structures import CAMERA_FRAME, METRE, Kind, PointCloud, Signal
from pcdata.structures.signal_joining import agreed_signals
from pcdata.structures.signals import cloud_from_frame
from pcdata.transforms.base import Params, Transform
from pcdata.transforms.decisions import OF_VIEW, PER_VIEW, Decision, Decisions
from pcdata.transforms.families import SpatialTransform
from pcdata.transforms.field_types import Matrix4, Metres, Name

_SAME_FRAME = 1e-6  # metres and radians that one frame may lie elsewhere for two views of a capture


class ToFrame(SpatialTransform):
    """Bring clouds into a named coordinate frame, by the capture's own poses or by a matrix from a calibration.

    Clouds that are in the frame already stay as they are; a matrix refuses them, since it would be applied twice.

    Args:
        frame: the frame to go to.
        matrix: rigid frame_from_start, rows of 4; None = the pose that came with the capture.
        start: the frame that the matrix starts from; given with it.
    """

    needs_metres = True

    frame: Name
    matrix: Matrix4 | None = None
    start: Name | None = None

    def check_fields(self) -> None:
        """Require matrix and start together, and a rigid matrix."""
        if (self.matrix is None) != (self.start is None):
            raise ConfigError("ToFrame: give matrix and the frame it starts from (start) together, or neither")
        if self.matrix is not None:
            try:
                rigid.check_rigid("ToFrame.matrix", torch.tensor(self.matrix, dtype=torch.float64, device="cpu"))
            except PcdataError as error:
                raise ConfigError(str(error)) from error

    def frame_needed(self) -> str | None:
        """With a matrix, the frame it starts from."""
        return self.start

    def frame_given(self) -> str:
        """The frame to go to."""
        return self.frame

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Find the matrix from the cloud's frame to the wanted one."""
        if self.matrix is not None:
            return {
                "matrix": torch.tensor(self.matrix, dtype=torch.float64, device="cpu").repeat(data.num_clouds, 1, 1)
            }
        if self.frame == data.frame_id:
            return {"matrix": torch.eye(4, dtype=torch.float64, device="cpu").repeat(data.num_clouds, 1, 1)}
        frames = _known_frames(data)
        for name in (self.frame, data.frame_id):
            if name not in frames:
                others = sorted(set(frames) - {data.frame_id, self.frame})
                named = f"name one of them, such as frame: {others[0]}, everywhere; or " if others else ""
                hint = near_matches(name, frames)
                raise FrameError(
                    f"ToFrame: no pose leads from {data.frame_id!r} to {self.frame!r}: the cloud knows the frames "
                    f"{sorted(frames)}{hint}; {named}give the capture poses (world_from_camera= of arrays; "
                    "poses/NAME.txt of a plain folder, with --frame; --calibration FILE; a recording's tf by --frame), "
                    "or ToFrame a matrix and its start"
                )
        return {"matrix": frames[self.frame] @ torch.linalg.inv(frames[data.frame_id])}

    def repeat(self, data: PointCloud, decided: Decisions) -> Params:
        """The frame: another camera's cloud comes to it by that camera's own pose."""
        return self.make_params(data, self.no_streams)

    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Move the cloud and remember where the new frame lies."""
        moved = super().transform(data, params)
        # A calibration given here replaces the capture's own pose of that frame.
        frames = _known_frames(data)
        if self.matrix is None or data.frame_id not in frames:
            return moved
        learned = params["matrix"].to(data.device) @ frames[data.frame_id]
        return replace(moved, frames={**data.frames, self.frame: learned})


def _known_frames(cloud: PointCloud) -> Mapping[str, Tensor]:
    """Return the frames that a cloud knows; that of the source, which everything starts from, need not be listed."""
    eye = torch.eye(4, dtype=torch.float64, device=cloud.device).repeat(cloud.num_clouds, 1, 1)
    return {cloud.source_frame: eye, **cloud.frames}


class MergeViews(Transform):
    """Join the views of each capture, which ToFrame brought into one frame, into one cloud.

    Neighboring clouds of the batch with the same sample id and capture index are one capture, as long as their view
    numbers rise. The frame they share becomes the source frame; every point keeps its ``view`` and the ``viewpoint`` it
    was seen from, and normals are turned to face it.

    Where views overlap the surface is there several times. With a voxel size, each voxel keeps the points of one view
    alone: of the view that put most points into it, the first of equals; so its points stay readings, none is averaged.

    Args:
        voxel_size: edge of the voxels in which views compete; None = keep every point.
        face_cameras: turn normals toward the camera that saw the point.
    """

    needs_metres = True
    keeps_clouds = False
    version = 2

    voxel_size: Metres | None = None
    face_cameras: bool = True

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Decide which clouds belong together: cloud ``group_ptr[g]:group_ptr[g+1]`` are the views of capture g."""
        starts = [b for b in range(data.num_clouds) if b == 0 or not _same_capture(data.meta[b - 1], data.meta[b])]
        group_ptr = torch.tensor([*starts, data.num_clouds], dtype=torch.int64, device="cpu")
        return {"group_ptr": group_ptr, "views": torch.diff(group_ptr)}

    def repeat(self, data: PointCloud, decided: Decisions) -> Params:
        """The views of the data, as many of each capture as there were."""
        params = self.make_params(data, self.no_streams)
        views = decided.values("views", like=params["views"])
        if not torch.equal(views, params["views"]):
            raise ReplayError(
                f"MergeViews: merged {views.tolist()} views of the captures, and these data have "
                f"{params['views'].tolist()}; give the same views"
            )
        return params

    def origins(self, decisions: Sequence[Decision]) -> list[tuple[int, int | None]]:
        """Each view is told of by its part of the merged history."""
        views = Decisions("MergeViews", decisions).values("views").long().tolist()
        return [(number, view) for number, count in enumerate(views) for view in range(count)]

    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Drop the boundaries between the views of a capture."""
        bounds = bounds_of(params["group_ptr"])
        views = params["views"]
        if data.frame_id == CAMERA_FRAME and int(views.max()) > 1:
            raise FrameError(
                f"MergeViews: the views are still in {CAMERA_FRAME!r}, each in its own camera's frame; "
                "add ToFrame(frame=...) before it"
            )
        # Found view by view, and in a source frame that ends here.
        for found, step in (("planes", "RemovePlane"), ("objects", "ClusterObjects")):
            if any(entry.get(found) for entry in data.meta):
                raise FrameError(f"MergeViews: {found} were found view by view; put {step} after MergeViews")
        device = data.device
        view_of_cloud = torch.cat([torch.arange(int(size), dtype=torch.int64, device=device) for size in views])
        seen_from = data.viewpoint_per_point()
        merged = data.with_extra("view", view_of_cloud[cloud_of_rows(data.ptr)], Kind.INVARIANT)
        if seen_from is not None:
            merged = merged.with_extra("viewpoint", seen_from, Kind.POSITION)
        merged = self._facing(merged, seen_from)
        groups = len(views)
        signals, frames = _merged_signals(data, bounds) if data.recorded_signals else ({}, {})
        identity = torch.eye(4, dtype=torch.float64, device=device).repeat(groups, 1, 1)
        joined = replace(
            merged,
            layout=None,
            ptr=data.ptr[params["group_ptr"].to(device)],
            viewpoint=None,
            source_from_cloud=identity,
            source_frame=data.frame_id,
            frames={data.frame_id: identity, **frames},
            unit=METRE,
            meta=[_merged_meta(data, start, stop) for start, stop in itertools.pairwise(bounds)],
            history=[_merged_history(data, start, stop) for start, stop in itertools.pairwise(bounds)],
            recorded_signals=signals,
        )
        return joined if self.voxel_size is None else _one_view_per_voxel(joined, self.voxel_size)

    def _facing(self, cloud: PointCloud, seen_from: Tensor | None) -> PointCloud:
        """Turn the normals that point away from where their point was seen."""
        if not self.face_cameras or cloud.normals is None or seen_from is None:
            return cloud
        away = ((seen_from - cloud.points) * cloud.normals).sum(1) < 0
        return cloud.with_fields(normals=torch.where(away[:, None], -cloud.normals, cloud.normals))


def _one_view_per_voxel(cloud: PointCloud, voxel_size: float) -> PointCloud:
    """Keep, in every voxel, the points of the view that has most there."""
    _, _, voxel = voxel_downsample(cloud.points, cloud.ptr, voxel_size=voxel_size)
    num_voxels = int(voxel.max()) + 1 if len(voxel) else 0
    keep = cloud.extra["view"] == voxel_majority(cloud.extra["view"], voxel, num_voxels)[voxel]
    counts = torch.stack([part.sum() for part in torch.tensor_split(keep, cloud.ptr[1:-1].cpu())])
    return cloud.select(keep, ptr_from_counts(counts))


def _same_capture(before: Mapping[str, Any], after: Mapping[str, Any]) -> bool:
    """Whether two neighboring clouds are views of one capture.

    Raises:
        ConfigError: nothing says which capture a cloud is from.
    """
    views = [[camera["view"] for camera in entry.get("cameras", [])] for entry in (before, after)]
    if not after.get("sample_id") and not views[1]:
        raise ConfigError(
            "MergeViews: nothing says which clouds are views of one capture; give them a meta entry sample_id"
        )
    keys = [(entry.get("sample_id"), entry.get("capture_index")) for entry in (before, after)]
    is_later_view = not views[0] or not views[1] or views[0][-1] < views[1][0]
    return keys[0] == keys[1] and is_later_view


def _merged_meta(data: PointCloud, start: int, stop: int) -> dict[str, Any]:
    counts = counts_of(data.ptr)
    cameras = [camera for entry in data.meta[start:stop] for camera in entry.get("cameras", [])]
    merged = {**data.meta[start], "points_per_view": counts[start:stop]}
    return {**merged, "cameras": cameras} if cameras else merged


def _merged_signals(data: PointCloud, bounds: Sequence[int]) -> tuple[dict[str, Signal], dict[str, Tensor]]:
    """Return each signal once per capture, as it was recorded, and where the frames lie that they were recorded in."""
    recorded = data.recorded_signals
    for start, stop in itertools.pairwise(bounds):
        views = [{name: signal.rows(slice(b, b + 1)) for name, signal in recorded.items()} for b in range(start, stop)]
        agreed_signals("MergeViews", views)
    one_each = torch.tensor(bounds[:-1], dtype=torch.int64, device=data.device)
    signals = {name: signal.rows(one_each) for name, signal in recorded.items()}
    clouds = torch.arange(data.num_clouds, dtype=torch.int64, device=data.device)
    of_capture = torch.bucketize(clouds, one_each, right=True) - 1
    frames = {}
    for frame in {signal.frame for signal in recorded.values() if signal.frame is not None}:
        names = [name for name, signal in recorded.items() if signal.frame == frame]
        motion = cloud_from_frame(data, frame)
        if not torch.allclose(motion, motion[one_each][of_capture], rtol=0.0, atol=_SAME_FRAME):
            raise FrameError(
                f"MergeViews: {frame!r}, which the signals {names} are in, lies elsewhere for each view of a capture; "
                f"attach them in {data.frame_id!r}, and put random motions after MergeViews"
            )
        if frame != data.frame_id:
            frames[frame] = torch.linalg.inv(motion[one_each])
            continue
        for name in names:  # the frame of that name is where the clouds are now, wherever they were turned before
            signals[name] = Signal(signals[name].moved(motion[one_each]), recorded[name].kind, frame)
    return signals, frames


def _merged_history(data: PointCloud, start: int, stop: int) -> list[dict[str, Any]]:
    """Join the views' histories step by step: points are added up, params that differ are listed per view.

    Views that went different ways keep the first one's history, which says so.
    """
    histories = data.history[start:stop]
    if len({tuple(step.get("step") for step in steps) for steps in histories}) > 1:
        return [{**step, OF_VIEW: 0} for step in histories[0]]
    merged = []
    for steps in zip(*histories):
        counts = {
            name: sum(step[name] for step in steps)
            for name in ("points_before", "points")
            if all(name in step for step in steps)
        }
        joined = {}
        for name in ("params", "stream", "rows"):
            told = [step.get(name) for step in steps]
            if any(one != told[0] for one in told):
                joined[name] = {PER_VIEW: told}
        merged.append({**steps[0], **joined, **counts})
    return merged
