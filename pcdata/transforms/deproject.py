"""From depth images to points: MaskDepth, Deproject."""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Sequence
from typing import Annotated, Any

import torch
from torch import Tensor

from pcdata.contracts.asked_later import is_set
from pcdata.contracts.known import FINITE, note
from pcdata.contracts.on_host import on_host, uploaded
from pcdata.errors import CaptureError, ConfigError
from pcdata.functional.depth.deproject import Deprojected, deproject_images, pixel_rays
from pcdata.functional.fixed_rows import FixedRows, move_kept
from pcdata.functional.rows import ptr_from_counts
from pcdata.rng import Streams
from pcdata.structures import CAMERA_FRAME, METRE, Camera, DepthFrame, ImageLayout, Kind, PointCloud
from pcdata.structures.image_layout import pixels_of_views
from pcdata.structures.structure import made, with_tensors
from pcdata.transforms.base import Params, Transform
from pcdata.transforms.families import MaskTransform
from pcdata.transforms.field_types import ConfidenceName, FromSensor, Metres, confidence_named


class MaskDepth(MaskTransform):
    """Set depth to "no reading" outside a range, outside the frame's mask, on unwanted labels or below a confidence.

    Args:
        near: metres; nearer readings go. None = no bound.
        far: metres; readings beyond go. None = no bound.
        use_mask: drop pixels outside frame.mask where the capture has one.
        require_mask: refuse a capture without a mask.
        drop_labels: drop pixels with these labels.
        min_confidence: drop pixels that are less to be trusted.
    """

    # Readings closer than near or beyond far are dropped.
    near: Annotated[Metres | None, FromSensor(lambda sensor, _: sensor.range[0])] = None
    far: Annotated[Metres | None, FromSensor(lambda sensor, _: sensor.range[1])] = None
    use_mask: bool = True
    require_mask: bool = False
    drop_labels: Sequence[int] = ()
    min_confidence: ConfidenceName | None = None

    def check_fields(self) -> None:
        """Require near < far."""
        if self.near is not None and self.far is not None and self.near >= self.far:
            raise ConfigError(f"MaskDepth: near must be below far, got near={self.near}, far={self.far}")

    def transform(self, data: DepthFrame, params: Params) -> DepthFrame:
        """Return the frame with the dropped pixels at 0."""
        return data.masked(near=self.near, far=self.far, mask=self.mask_of(data))

    def mask_of(self, data: DepthFrame) -> Tensor | None:
        """Return the (V, H, W) bool mask that the capture's mask, labels and confidence make; None without any."""
        if data.mask is None and self.require_mask:
            raise CaptureError(f"MaskDepth: capture {data.sample_id!r} has no mask; add one or set require_mask: false")
        mask = data.mask if self.use_mask else None
        if self.drop_labels:
            if data.labels is None:
                raise CaptureError(f"MaskDepth: drop_labels is set but the capture {data.sample_id!r} has no labels")
            unwanted = torch.isin(
                data.labels, torch.tensor(list(self.drop_labels), dtype=torch.int64, device=data.device)
            )
            mask = ~unwanted if mask is None else mask & ~unwanted
        if self.min_confidence is not None:
            if data.confidence is None:
                raise CaptureError(
                    f"MaskDepth: min_confidence is set but the capture {data.sample_id!r} has no confidence; put "
                    "MarkUnreliableDepth or CompleteDepth before it"
                )
            trusted = data.confidence >= confidence_named(self.min_confidence)
            mask = trusted if mask is None else mask & trusted
        return mask

    def fixed_work(self, like: DepthFrame) -> Callable[[DepthFrame], DepthFrame] | None:
        """Blank on the device; a limit to what goes, or labels that do, need the host."""
        if self.max_drop is not None or self.drop_labels:
            return None
        return lambda frame: self.transform(frame, {})


class Deproject(Transform):
    """Turn every depth reading into a point: one cloud per view, each in its own camera's frame.

    Colors become float RGB in [0, 1]; labels and confidence follow; ``source_index`` is the flat pixel index over all
    views, and the viewpoint is the camera center. Poses of the capture are kept in ``frames`` for ``ToFrame``.
    """

    takes = DepthFrame
    gives = PointCloud

    def frame_given(self) -> str:
        """Deprojected points are in the camera's frame."""
        return CAMERA_FRAME

    def make_params(self, data: DepthFrame, streams: Streams) -> Params:
        """Nothing to decide."""
        return {}

    def transform(self, data: DepthFrame, params: Params) -> PointCloud:
        """Deproject all views in one call."""
        own = deproject_images(data.depth, *self.cameras_of(data), data.colors, self.images_of(data))
        return self.cloud_of(data, own)

    def fixed_work(self, like: DepthFrame) -> Callable[[DepthFrame], FixedRows]:
        """Make a point of every pixel, and move those with a reading together."""
        views, height, width = like.depth.shape
        rays = pixel_rays(*self.cameras_of(like)[:1], (height, width), self.cameras_of(like)[1]).float().flatten(0, 2)
        pixel = torch.arange(len(rays), dtype=torch.int64, device=like.device)
        every = ptr_from_counts([height * width] * views, device=like.device)
        viewpoint = torch.zeros(views, 3, dtype=torch.float32, device=like.device)

        def work(frame: DepthFrame) -> FixedRows:
            z = frame.depth.reshape(-1, 1)
            has_reading = z[:, 0] > 0
            points = torch.cat([rays * z, z], dim=1)
            # No ray, or a point too far out: what is to be said of them is said elsewhere.
            is_set((has_reading & ~points.isfinite().all(1)).any().reshape(1))
            return FixedRows(*move_kept(points, pixel, every, has_reading), viewpoint, has_reading)

        return work

    def cameras_of(self, data: DepthFrame) -> tuple[Tensor, Tensor | None]:
        """Return the intrinsics (V, 3, 3) and distortion (V, D) where the depth lies."""
        lens = data.camera.distortion
        return data.camera.intrinsics.to(data.device), None if lens is None else lens.to(data.device)

    def images_of(self, data: DepthFrame) -> dict[str, Tensor]:
        """Return the images that become per-point fields as they are."""
        images = {"labels": data.labels, "confidence": data.confidence}
        return {name: image for name, image in images.items() if image is not None}

    def kinds_of(self, images: Collection[str]) -> dict[str, Kind]:
        """Return the kinds of the extra fields that images become."""
        return {name: Kind.MINIMUM for name in images if name != "labels"}

    def cloud_of(self, data: DepthFrame, own: Deprojected) -> PointCloud:
        """Return the points with all that the capture, which is checked, knows about them."""
        intrinsics, distortion = self.cameras_of(data)
        identity = _identities(data.num_views)
        frames = {CAMERA_FRAME: uploaded(identity.clone(), data.device)}
        if data.world_from_camera is not None and data.frame_id is not None:
            frames[data.frame_id] = data.world_from_camera
        history = tuple(data.provenance.get("history", ()))
        extra = {name: rows for name, rows in own.rows.items() if name != "labels"}
        note(pixels_of_views(data.size), own.source_index, own.ptr)
        viewpoint = uploaded(torch.zeros(data.num_views, 3, dtype=torch.float32, device="cpu"), data.device)
        note(FINITE, viewpoint)
        return made(
            PointCloud,
            points=own.points,
            ptr=own.ptr,
            frame_id=CAMERA_FRAME,
            unit=METRE,
            colors=own.colors,
            normals=None,
            labels=own.rows.get("labels"),
            source_index=own.source_index,
            extra=extra,
            kinds=self.kinds_of(extra),
            layout=None if distortion is not None else ImageLayout(size=data.size, intrinsics=intrinsics),
            viewpoint=viewpoint,
            source_from_cloud=uploaded(identity.clone(), data.device),
            source_frame=CAMERA_FRAME,
            frames=frames,
            meta=_metas(data),
            history=(history,) * data.num_views,
            recorded_signals={name: signal.repeated(data.num_views) for name, signal in data.recorded_signals.items()},
        )


@functools.lru_cache(maxsize=16)
def _identities(count: int) -> Tensor:
    """Return (count, 4, 4) float64, to be copied."""
    return torch.eye(4, dtype=torch.float64, device="cpu").repeat(count, 1, 1)


def _metas(frame: DepthFrame) -> tuple[dict[str, Any], ...]:
    """Keep what is needed to trace each view's cloud to its capture and to deproject it again."""
    cameras: Camera = frame.camera if frame.device.type == "cpu" else with_tensors(frame.camera, on_host)
    poses = None if frame.world_from_camera is None else on_host(frame.world_from_camera).tolist()
    provenance = {name: value for name, value in frame.provenance.items() if name != "history"}
    metas = []
    for view in range(frame.num_views):
        pose = {"world_from_camera": None if poses is None else poses[view], "world_frame": frame.frame_id}
        metas.append(
            {
                "sample_id": frame.sample_id,
                "capture_index": frame.capture_index,
                "cameras": [
                    {**(cameras if frame.num_views == 1 else cameras.view(view)).to_dict(), "view": view, **pose}
                ],
                "provenance": {**provenance},
            }
        )
    return tuple(metas)
