"""Clouds as rectangular tensors, the shape most networks take."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from pcdata.structures.cloud_batch import CloudBatch, joined_facts
from pcdata.structures.kinds import METRE, attributes, moved, present_fields
from pcdata.structures.signals import told_signals
from pcdata.structures.structure import derived


@dataclass(frozen=True, eq=False, kw_only=True)
class PaddedClouds(CloudBatch):
    """B clouds padded to one length M; ``mask`` says which rows are real. Made by :meth:`PointCloud.padded`.

    They know all that the packed clouds did: :meth:`PointCloud.from_padded` gives those back.

    Args:
        points: (B, M, 3) float32, 0 where padded.
        mask: (B, M) bool, True = a real point.
        colors: (B, M, 3) float32.
        normals: (B, M, 3) float32.
        labels: (B, M) int64, -1 where padded.
        source_index: (B, M) int64, -1 where padded.
        extra: name -> (B, M, ...).
    """

    points: Tensor
    mask: Tensor
    colors: Tensor | None = None
    normals: Tensor | None = None
    labels: Tensor | None = None
    source_index: Tensor | None = None
    extra: Mapping[str, Tensor] = field(default_factory=dict)

    @property
    def counts(self) -> Tensor:
        """(B,) int64 real points per cloud."""
        return self.mask.sum(dim=1)

    @property
    def device(self) -> torch.device:
        """Where the points lie."""
        return self.points.device

    def fields(self) -> dict[str, Tensor]:
        """Return every per-point field that is present, (B, M, ...), by name; extra fields included."""
        return present_fields(self)

    def to_frame(self, frame: str) -> PaddedClouds:
        """Return the clouds in another frame that they know, in metres; padding stays as it is.

        Raises:
            FrameError: the clouds do not know the frame.
        """
        matrix = self.frame_from_cloud(frame)
        batch, width = self.mask.shape
        flat = {name: value.flatten(0, 1) for name, value in self.fields().items()}
        ptr = torch.arange(batch + 1, dtype=torch.int64, device=self.device) * width
        rows = moved(flat, self.kinds, ptr, matrix)
        for name, value in rows.items():
            real = self.mask.reshape(-1, *[1] * (value.ndim - 1))
            rows[name] = torch.where(real, value, flat[name]).unflatten(0, (batch, width))
        return derived(self, **attributes(rows), **self._facts_moved(matrix[None], frame, METRE))

    def __getitem__(self, which: int | slice) -> PaddedClouds:
        """Return one cloud, or a slice of the batch, at the same length; the memory is shared."""
        clouds = self._which(which)
        rows = {name: value[clouds] for name, value in self.fields().items()}
        return derived(self, **attributes(rows), mask=self.mask[clouds], **self._facts_of(clouds))

    def __iter__(self) -> Iterator[PaddedClouds]:
        return (self[b] for b in range(self.num_clouds))

    def __repr__(self) -> str:
        batch, width = self.mask.shape
        return (
            f"PaddedClouds({batch} x {width} in {self.frame_id!r} [{self.unit}]{told_signals(self.recorded_signals)})"
        )


def padded_clouds(clouds: Sequence[CloudBatch], rows: Mapping[str, Tensor], counts: Sequence[int]) -> PaddedClouds:
    """Put together fields (B, M, ...) and what the clouds know about themselves."""
    device, (batch, width) = rows["points"].device, rows["points"].shape[:2]
    first = clouds[0]
    if min(counts) == width:
        mask = torch.ones((batch, width), dtype=torch.bool, device=device)
    else:
        ends = torch.tensor(counts, dtype=torch.int64, device=device)[:, None]
        mask = torch.arange(width, dtype=torch.int64, device=device) < ends
    return PaddedClouds(
        mask=mask,
        frame_id=first.frame_id,
        unit=first.unit,
        source_frame=first.source_frame,
        kinds=first.kinds,
        **attributes(rows),
        **(first._facts_of(slice(0, batch)) if len(clouds) == 1 else joined_facts(clouds)),
    )
