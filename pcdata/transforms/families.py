"""The two families that carry most steps: those that move clouds, and those that choose rows."""

from __future__ import annotations

from torch import Tensor

from pcdata.rng import Streams
from pcdata.structures import PointCloud
from pcdata.transforms.base import Params, Transform


class SpatialTransform(Transform, abstract=True):
    """A step that moves every cloud by one 4x4: write ``make_params`` returning ``{"matrix": (B, 4, 4)}``."""

    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Move the cloud; the frame and the unit follow :meth:`frame_after` and :meth:`unit_given`."""
        return data.transformed(params["matrix"], frame_id=self.frame_after(data.frame_id), unit=self.unit_given())


class SelectTransform(Transform, abstract=True):
    """A step that keeps some rows, possibly repeated or reordered within their cloud: write ``pick``."""

    def pick(self, cloud: PointCloud, streams: Streams) -> tuple[Tensor, Tensor]:
        """Return ``index`` (M,) int64, or a (N,) bool mask, of the rows to keep, and the result's ``ptr`` (B+1,)."""
        raise NotImplementedError(f"{type(self).__name__}: write the method pick(self, cloud, streams)")

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Decide which rows stay."""
        index, ptr = self.pick(data, streams)
        return {"index": index, "ptr": ptr}

    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Pick the rows of every field."""
        return data.select(params["index"], params["ptr"])
