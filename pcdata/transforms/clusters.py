"""Objects: ClusterObjects labels them, SplitObjects makes a cloud of each."""

from __future__ import annotations

from typing import Any, Literal

import torch
from torch import Tensor

from pcdata.errors import ConfigError, DTypeError, TooFewPointsError
from pcdata.functional.clusters import dbscan
from pcdata.functional.ragged import ptr_after_mask
from pcdata.rng import Streams
from pcdata.structures import PointCloud
from pcdata.transforms.base import Params, Transform, rows_of_mask, sample_name
from pcdata.transforms.fields import Count, Metres


class ClusterObjects(Transform):
    """Label density clusters (DBSCAN) as objects and keep those of a plausible size.

    Labels become 0..K-1 per cloud in the order of their lowest core point; any labels the cloud had are replaced.
    ``meta["objects"]`` lists label and point count.
    """

    runs_statistics = True

    eps: Metres = 0.02  # points closer than this are neighbours
    min_points: Count = 50  # neighbours, the point itself included, that make a core point
    min_size: Count = 100  # smaller clusters are not objects
    max_size: Count = 50_000  # larger clusters are not objects
    keep: Literal["objects", "all"] = "objects"  # "all": keep the whole scene, with -1 where no object is

    def check_fields(self) -> None:
        """Require min_size <= max_size."""
        if self.min_size > self.max_size:
            raise ConfigError(f"ClusterObjects: min_size {self.min_size} exceeds max_size {self.max_size}")

    def make_params(self, data: PointCloud, streams: Streams | None) -> Params:
        """Cluster, then renumber the clusters of plausible size."""
        raw = dbscan(data.points, data.ptr, eps=self.eps, min_points=self.min_points, grid=data.image_grid())
        parts = torch.tensor_split(raw, data.ptr[1:-1].cpu())
        return {"labels": torch.cat([self._numbered(part) for part in parts])}

    def _numbered(self, raw: Tensor) -> Tensor:
        """Number the clusters of plausible size in one cloud by 0, 1, ... and call all else -1."""
        size = torch.bincount(raw + 1)  # noise first
        accepted = (size >= self.min_size) & (size <= self.max_size)
        accepted[:1] = False
        number = torch.where(accepted, accepted.cumsum(0) - 1, -1)
        return number[raw + 1]

    def apply(self, data: PointCloud, params: Params) -> PointCloud:
        """Write the labels and drop the rest unless the whole scene is kept."""
        labels = params["labels"]
        labelled = data.with_fields(labels=labels).with_meta(_objects(labels, data))
        if self.keep == "all":
            return labelled
        member = labels >= 0
        return labelled.select(member, ptr_after_mask(member, data.ptr))


class SplitObjects(Transform):
    """Make one cloud of every label >= 0, in order of cloud and label; points without a label are dropped."""

    keeps_clouds = False

    def apply(self, data: PointCloud, params: Params) -> PointCloud:
        """Split each cloud by its labels; ``meta["object"]`` keeps the label."""
        if data.labels is None:
            raise DTypeError("SplitObjects: the cloud has no labels; put ClusterObjects before it")
        parts = []
        for b, cloud in enumerate(data.unbatch()):
            assert cloud.labels is not None
            found = torch.unique(cloud.labels[cloud.labels >= 0]).tolist()
            if not found:
                raise TooFewPointsError(
                    f"SplitObjects: cloud {b}{sample_name(data, b)} has no labelled point among its "
                    f"{cloud.num_points}; check the fields of ClusterObjects"
                )
            for label in found:
                rows = rows_of_mask(cloud.labels == label)
                ptr = torch.tensor([0, len(rows)], dtype=torch.int64, device=cloud.device)
                parts.append(cloud.select(rows, ptr).with_meta([{"object": label}]))
        return PointCloud.cat(parts)


def _objects(labels: Tensor, data: PointCloud) -> list[dict[str, Any]]:
    entries = []
    for own in torch.tensor_split(labels, data.ptr[1:-1].cpu()):
        sizes = torch.bincount(own + 1)[1:].tolist()
        entries.append({"objects": [{"label": label, "points": count} for label, count in enumerate(sizes)]})
    return entries
