"""From frames of one moment to a frame of all their views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from pcdata.errors import ShapeError
from pcdata.files.sample_names import name_some
from pcdata.geometry.lens_models import same_width
from pcdata.structures import Camera, DepthFrame
from pcdata.structures.signal_joining import agreed_signals


def join_views(frames: Sequence[DepthFrame], provenance: Mapping[str, Any]) -> DepthFrame:
    """Return the views of all frames as one frame, in their order, with the sample id of the first.

    A signal of the moment that one frame has is that of all; those that several have must agree.

    Lenses with fewer coefficients than others get zeros for the rest, which bend nothing.

    Raises:
        ShapeError: sizes differ, or not all frames have an image or a pose that one of them has.
        CaptureError: their signals disagree.
        FrameError: a signal in "camera", of which there are several then.
    """
    first = frames[0]
    names = [str(name) for name in provenance.get("cameras", range(len(frames)))]
    for role in ("colors", "labels", "confidence", "mask", "world_from_camera"):
        lacking = [name for name, frame in zip(names, frames) if getattr(frame, role) is None]
        if lacking and len(lacking) < len(frames):
            having = name_some(set(names) - set(lacking))
            raise ShapeError(
                f"join_views: cameras {name_some(lacking)} have no {role}, {having} have, and "
                f"all views of a sample have the same: read one camera, or leave {role} out"
            )
    return DepthFrame(
        depth=torch.cat([frame.depth for frame in frames]),
        camera=_join_cameras([frame.camera for frame in frames]),
        colors=_join([frame.colors for frame in frames]),
        labels=_join([frame.labels for frame in frames]),
        confidence=_join([frame.confidence for frame in frames]),
        mask=_join([frame.mask for frame in frames]),
        world_from_camera=_join([frame.world_from_camera for frame in frames]),
        frame_id=first.frame_id,
        capture_index=first.capture_index,
        sample_id=first.sample_id,
        provenance=provenance,
        recorded_signals=agreed_signals("join_views", [frame.recorded_signals for frame in frames]),
    )


def _join(images: Sequence[Tensor | None]) -> Tensor | None:
    present = [image for image in images if image is not None]
    return torch.cat(present) if present else None


def _join_cameras(cameras: Sequence[Camera]) -> Camera:
    return Camera(
        intrinsics=torch.cat([camera.intrinsics for camera in cameras]),
        size=cameras[0].size,
        distortion=same_width([camera.distortion for camera in cameras], [camera.num_views for camera in cameras]),
        is_window=any(camera.is_window for camera in cameras),
    )
