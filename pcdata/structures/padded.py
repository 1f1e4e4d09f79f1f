"""Clouds as rectangular tensors, the shape most networks take."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from pcdata.structures.joining import joined_frames
from pcdata.structures.kinds import CORE_KINDS

if TYPE_CHECKING:
    from pcdata.structures.point_cloud import PointCloud


@dataclass(frozen=True, eq=False, kw_only=True)
class PaddedClouds:
    """B clouds padded to one length M; ``mask`` says which rows are real. Made by :meth:`PointCloud.padded`."""

    points: Tensor  # (B, M, 3) float32, 0 where padded
    mask: Tensor  # (B, M) bool, True = a real point
    colors: Tensor | None = None  # (B, M, 3) float32
    normals: Tensor | None = None  # (B, M, 3) float32
    labels: Tensor | None = None  # (B, M) int64, -1 where padded
    source_index: Tensor | None = None  # (B, M) int64, -1 where padded
    extra: Mapping[str, Tensor] = field(default_factory=dict)  # name -> (B, M, ...)
    frame_id: str
    unit: str
    source_frame: str = ""  # the frame that source_from_cloud leads to
    source_from_cloud: Tensor  # (B, 4, 4) float64
    frames: Mapping[str, Tensor] = field(default_factory=dict)  # frame name -> (B, 4, 4) frame_from_source
    meta: Sequence[Mapping[str, Any]] = ()

    def to(self, device: torch.device | str, *, non_blocking: bool = False) -> PaddedClouds:
        """Move all tensors to a device."""
        return self._map(lambda tensor: tensor.to(device, non_blocking=non_blocking))

    def pin_memory(self) -> PaddedClouds:
        """Copy all tensors to page-locked memory; a DataLoader with ``pin_memory=True`` calls this."""
        return self._map(lambda tensor: tensor.pin_memory())

    def _map(self, move: Callable[[Tensor], Tensor]) -> PaddedClouds:
        names = ("points", "mask", "colors", "normals", "labels", "source_index", "source_from_cloud")
        moved = {name: move(value) for name in names if (value := getattr(self, name)) is not None}
        extra, frames = ({name: move(one) for name, one in held.items()} for held in (self.extra, self.frames))
        return replace(self, **moved, extra=extra, frames=frames)  # type: ignore[arg-type]

    def __repr__(self) -> str:
        batch, width = self.mask.shape
        return f"PaddedClouds({batch} x {width} in {self.frame_id!r} [{self.unit}])"


def padded_clouds(clouds: Sequence[PointCloud], rows: Mapping[str, Tensor], counts: Sequence[int]) -> PaddedClouds:
    """Put together fields (B, M, ...) and what the clouds know about themselves."""
    device, width = rows["points"].device, rows["points"].shape[1]
    return PaddedClouds(
        mask=torch.arange(width, dtype=torch.int64, device=device)
        < torch.tensor(counts, dtype=torch.int64, device=device)[:, None],
        frame_id=clouds[0].frame_id,
        unit=clouds[0].unit,
        source_frame=clouds[0].source_frame,
        source_from_cloud=torch.cat([cloud.source_from_cloud for cloud in clouds]),
        frames=joined_frames(clouds),
        meta=tuple(entry for cloud in clouds for entry in cloud.meta),
        **{name: rows[name] for name in CORE_KINDS if name in rows},
        extra={name: value for name, value in rows.items() if name not in CORE_KINDS},
    )
