"""Captures and what a chain makes of them for Rerun's viewer, on a time line of captures.

Source: Rerun, https://rerun.io; entities are named by frame, camera and step, as its viewer lists them.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pcdata import extras
from pcdata.errors import PcdataError
from pcdata.files.opening import replacing
from pcdata.files.pipes import piped
from pcdata.geometry.rotations import quaternion_from_rotation
from pcdata.io.sources.capture_source import CaptureSource
from pcdata.io.sources.source import Source
from pcdata.progress import Progress
from pcdata.report.html.scene import MOST_POINTS, surroundings
from pcdata.structures import DepthFrame, PointCloud
from pcdata.structures.kinds import CAMERA_FRAME
from pcdata.transforms import Compose, Transform, describe_objects
from pcdata.validation.view_names import view_names

_NO_CLASS = 65535  # of Rerun, for points without a label
_LARGEST_CLASS = 65534


def save_rerun(
    path: str | Path,
    source: CaptureSource,
    *,
    pipeline: Compose | None = None,
    max_points: int = MOST_POINTS,
    progress: Progress | None = None,
) -> int:
    """Write captures as a recording that Rerun opens (``.rrd``); return how many could be read.

    Args:
        path: the file, which is replaced.
        source: anything with ``ids`` and ``load``.
        pipeline: its steps' clouds are logged too, its random steps left out; None = captures as they are.
        max_points: logged of a cloud; of more every k-th is.
        progress: told (captures logged, all, which).

    Raises:
        MissingExtraError: rerun is not installed.
        WriteError: the file cannot be written whole, or the system (Windows) has no named pipes.
    """
    rerun = extras.require("rerun")
    with replacing("save_rerun", path) as temporary, open(temporary, "wb") as file:
        stream = rerun.RecordingStream("pcdata")
        # Rerun's own writer keeps to itself that a disk is full, and may then wait for ever.
        with piped("save_rerun", file) as pipe:
            stream.save(str(pipe))
            try:
                logged = log_to_rerun(stream, source, pipeline=pipeline, max_points=max_points, progress=progress)
            finally:
                stream.disconnect()
    return logged


def log_to_rerun(
    stream: Any,
    source: CaptureSource,
    *,
    pipeline: Compose | None = None,
    max_points: int = MOST_POINTS,
    progress: Progress | None = None,
) -> int:
    """Log captures to a ``rerun.RecordingStream``, one after another; return how many could be read.

    Of each view depth in metres, color, labels and confidence below its camera, which stands where its pose says; of
    each step the cloud, in its frame, with boxes of objects, planes and the workspace. The time line ``capture`` counts
    captures; ``time`` is in seconds since the first, where the source knows times. What cannot be read is told on
    stderr and in the log ``problems``.

    Raises:
        MissingExtraError: rerun is not installed.
    """
    rerun = extras.require("rerun")
    log = _Log(rerun, stream, max_points)
    steps = None if pipeline is None else pipeline.split()[0]
    times = source.times() if isinstance(source, Source) else {}
    logged = 0
    for place, sample_id in enumerate(source.ids):
        stream.set_time("capture", sequence=place)
        if sample_id in times:
            stream.set_time("time", duration=times[sample_id] - min(times.values()))
        try:
            log.sample(source.load(sample_id), steps)
            logged += 1
        except PcdataError as error:
            print(f"left out {sample_id}: {error}", file=sys.stderr)
            log.problem(f"{sample_id}: {error}")
        if progress is not None:
            progress(place + 1, len(source.ids), sample_id)
    return logged


class _Log:
    """Logs data to one stream."""

    def __init__(self, rerun: Any, stream: Any, max_points: int) -> None:
        self._rerun, self._stream, self._max_points = rerun, stream, max_points
        self._roots: set[str] = set()
        self._views: list[list[str]] = []  # the entities of the cameras of the capture

    def sample(self, data: DepthFrame | PointCloud, steps: Compose | None) -> None:
        self._views = []
        if isinstance(data, DepthFrame):
            self._frame(data)
        elif steps is None:
            self._clouds("capture", data, None)
        if steps is not None:
            for place, (step, made) in enumerate(steps.step_through(data), 1):
                if isinstance(made, PointCloud):
                    self._clouds(f"{place} {type(step).__name__}", made, step)

    def problem(self, text: str) -> None:
        self._stream.log(["problems"], self._rerun.TextLog(text, level="ERROR"))

    def _frame(self, frame: DepthFrame) -> None:
        rerun, stream = self._rerun, self._stream
        root = self._root(frame.frame_id if frame.world_from_camera is not None else None)
        height, width = frame.size
        for view, name in enumerate(view_names(frame.provenance, frame.num_views)):
            self._views.append([root, name])
            if frame.world_from_camera is not None:
                pose = frame.world_from_camera[view].cpu().double().numpy()
                stream.log([root, name], rerun.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
            camera = [root, name, "image"]  # below it all is flat
            k = frame.camera.intrinsics[view].cpu().double().numpy()
            size = [width, height]
            stream.log(
                camera, rerun.Pinhole(image_from_camera=k, resolution=size, camera_xyz=rerun.ViewCoordinates.RDF)
            )
            stream.log([*camera, "depth"], rerun.DepthImage(frame.depth[view].cpu().numpy(), meter=1.0))
            if frame.colors is not None:
                stream.log([*camera, "color"], rerun.Image(frame.colors[view].cpu().numpy()))
            if frame.labels is not None:
                stream.log([*camera, "labels"], rerun.SegmentationImage(_classes(frame.labels[view])))
            if frame.confidence is not None:
                stream.log([*camera, "confidence"], rerun.Image(_gray(frame.confidence[view].cpu().numpy())))

    def _clouds(self, name: str, cloud: PointCloud, step: Transform | None) -> None:
        """Log a cloud in its frame; clouds in the frames of cameras stand where those do."""
        in_cameras = cloud.frame_id == CAMERA_FRAME and len(self._views) == cloud.num_clouds
        if not in_cameras:
            self._cloud([self._root(cloud.frame_id), name], cloud, step)
            return
        for own, camera in zip(cloud.unbatch(), self._views):
            self._cloud([*camera, name], own, step)

    def _cloud(self, entity: list[str], cloud: PointCloud, step: Transform | None) -> None:
        rerun, stream = self._rerun, self._stream
        stride = max(1, -(-cloud.num_points // self._max_points))
        fields: dict[str, Any] = {}
        if cloud.colors is not None:
            fields["colors"] = (cloud.colors[::stride].cpu() * 255).round().clamp(0, 255).to(torch.uint8).numpy()
        if cloud.labels is not None:
            fields["class_ids"] = _classes(cloud.labels[::stride])
        stream.log(entity, rerun.Points3D(cloud.points[::stride].cpu().numpy(), **fields))
        # What an earlier capture had and this one has not goes.
        stream.log([*entity, "around"], rerun.Clear(recursive=True))
        for lines in surroundings(cloud, step):
            strips = rerun.LineStrips3D(lines.segments.reshape(-1, 2, 3), colors=[_rgb(lines.color)])
            stream.log([*entity, "around", lines.name], strips)
        if cloud.labels is not None and len(cloud.meta) == 1 and "objects" in cloud.meta[0]:
            self._boxes([*entity, "around", "objects"], cloud)

    def _boxes(self, entity: list[str], cloud: PointCloud) -> None:
        try:
            objects = describe_objects(cloud)
        except PcdataError:  # no plane was found: boxes would stand on nothing
            return
        if not objects:
            return
        poses = torch.stack([one.box for one in objects]).cpu()
        boxes = self._rerun.Boxes3D(
            centers=poses[:, :3, 3].numpy(),
            half_sizes=torch.stack([one.size for one in objects]).cpu().numpy() / 2,
            quaternions=quaternion_from_rotation(poses[:, :3, :3])[:, [1, 2, 3, 0]].numpy(),
            labels=[str(one.label) for one in objects],
            class_ids=_classes(torch.tensor([one.label for one in objects], dtype=torch.int64, device="cpu")),
        )
        self._stream.log(entity, boxes)

    def _root(self, frame_id: str | None) -> str:
        """Name the space of a frame; say once where up is in it."""
        root = frame_id or CAMERA_FRAME
        if root not in self._roots:
            self._roots.add(root)
            axes = self._rerun.ViewCoordinates
            up = axes.RDF if root.startswith(CAMERA_FRAME) else axes.RIGHT_HAND_Z_UP
            self._stream.log([root], up, static=True)
        return root


def _classes(labels: torch.Tensor) -> NDArray[np.uint16]:
    """Return labels as Rerun's classes, which have 16 bits; larger ones share colors."""
    values = labels.cpu().to(torch.int64)
    return torch.where(values < 0, _NO_CLASS, values % (_LARGEST_CLASS + 1)).numpy().astype(np.uint16)


def _gray(values: NDArray[Any]) -> NDArray[np.uint8]:
    """Return numbers from 0 to their largest as 8 bits."""
    numbers = values.astype(np.float64)
    return (255 * numbers / max(float(numbers.max(initial=0)), 1e-9)).clip(0, 255).round().astype(np.uint8)


def _rgb(color: str) -> tuple[int, ...]:
    return tuple(int(color[place : place + 2], 16) for place in (1, 3, 5))
