"""Objects: ClusterObjects labels them, SplitObjects makes a cloud of each."""

from __future__ import annotations

import warnings
from typing import Any, Literal

import torch
from torch import Tensor

from pcdata.errors import ConfigError, DTypeError, TooFewPointsError
from pcdata.functional.clusters import dbscan
from pcdata.functional.rows import ptr_after_mask
from pcdata.rng import Streams
from pcdata.structures import PointCloud
from pcdata.transforms.base import Params, Transform, sample_name
from pcdata.transforms.families import DropLimit, LeftOutWarning
from pcdata.transforms.field_types import Count, Metres


class ClusterObjects(DropLimit):
    """Label density clusters (DBSCAN) as objects and keep those of a plausible size.

    Labels become 0..K-1 per cloud in the order of their lowest core point; any labels the cloud had are replaced.
    ``meta["objects"]`` lists label and point count; ``meta["no_objects"]`` what is no object: the points of ``noise``,
    and of every cluster that is ``too_small`` or ``too_large``. The history counts them.

    Warns:
        LeftOutWarning: a cluster is larger than ``max_size``.

    Args:
        eps: points closer than this are neighbors.
        min_points: neighbors, the point itself included, that make a core point.
        min_size: smaller clusters are not objects.
        max_size: larger clusters are not objects.
        keep: "all": keep the whole scene, with -1 where no object is.
    """

    runs_statistics = True
    version = 2

    eps: Metres = 0.02
    min_points: Count = 50
    min_size: Count = 100
    max_size: Count = 50_000
    keep: Literal["objects", "all"] = "objects"

    def check_fields(self) -> None:
        """Require min_size <= max_size."""
        if self.min_size > self.max_size:
            raise ConfigError(f"ClusterObjects: min_size {self.min_size} exceeds max_size {self.max_size}")

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Cluster, then renumber the clusters of plausible size."""
        raw = dbscan(data.points, data.ptr, eps=self.eps, min_points=self.min_points, grid=data.image_grid())
        parts = [self._numbered(part) for part in torch.tensor_split(raw, data.ptr[1:-1].cpu())]
        sizes = [other.tolist() for _, other in parts]  # per cloud: noise, then every cluster that is no object
        left_out = {
            "noise": [noise for noise, *_ in sizes],
            "too_small": [sum(one for one in clusters if one < self.min_size) for _, *clusters in sizes],
            "too_large": [sum(one for one in clusters if one > self.max_size) for _, *clusters in sizes],
        }
        for b, (_, *clusters) in enumerate(sizes):
            if clusters and max(clusters) > self.max_size:
                warnings.warn(
                    f"ClusterObjects: cloud {b}{sample_name(data, b)}: a cluster of {max(clusters)} points, more than "
                    f"max_size={self.max_size}, is left out; raise max_size if it is an object or a heap of them, or "
                    "put RemovePlane or CropWorkspace before it if it is the table or a wall",
                    LeftOutWarning,
                    stacklevel=2,
                )
        counts = {name: torch.tensor(values, dtype=torch.int64, device="cpu") for name, values in left_out.items()}
        return {"labels": torch.cat([labels for labels, _ in parts]), **counts}

    def _numbered(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        """Number the clusters of plausible size in one cloud by 0, 1, ... and call all else -1; return what is else.

        The second result is the number of points of noise, then those of every cluster that is no object.
        """
        size = torch.bincount(raw + 1, minlength=1)  # noise first
        accepted = (size >= self.min_size) & (size <= self.max_size)
        accepted[:1] = False
        number = torch.where(accepted, accepted.cumsum(0) - 1, -1)
        return number[raw + 1], size[~accepted]

    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Write the labels and drop the rest unless the whole scene is kept."""
        labels = params["labels"]
        counted = {name: params[name].tolist() for name in ("noise", "too_small", "too_large")}
        others = [{"no_objects": {name: counted[name][b] for name in counted}} for b in range(data.num_clouds)]
        labeled = data.with_fields(labels=labels).with_meta(_objects(labels, data)).with_meta(others)
        if self.keep == "all":
            return labeled
        member = labels >= 0
        return labeled.select(member, ptr_after_mask(member, data.ptr))


class SplitObjects(Transform):
    """Make one cloud of every label >= 0, in order of cloud and label; points without a label are dropped.

    ``meta["object"]`` keeps the label, ``meta["unlabeled"]`` the number of points dropped from the whole cloud.
    """

    keeps_clouds = False

    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Split each cloud by its labels."""
        if data.labels is None:
            raise DTypeError("SplitObjects: the cloud has no labels; put ClusterObjects before it")
        parts = []
        for b, cloud in enumerate(data.unbatch()):
            assert cloud.labels is not None
            found = torch.unique(cloud.labels[cloud.labels >= 0]).tolist()
            if not found:
                raise TooFewPointsError(
                    f"SplitObjects: cloud {b}{sample_name(data, b)} has no labeled point among its "
                    f"{cloud.num_points}; check the fields of ClusterObjects"
                )
            unlabeled = int((cloud.labels < 0).sum())
            for label in found:
                rows = torch.nonzero(cloud.labels == label).squeeze(1)
                ptr = torch.tensor([0, len(rows)], dtype=torch.int64, device=cloud.device)
                parts.append(cloud.select(rows, ptr).with_meta([{"object": label, "unlabeled": unlabeled}]))
        return PointCloud.cat(parts)


def _objects(labels: Tensor, data: PointCloud) -> list[dict[str, Any]]:
    entries = []
    for own in torch.tensor_split(labels, data.ptr[1:-1].cpu()):
        sizes = torch.bincount(own + 1)[1:].tolist()
        entries.append({"objects": [{"label": label, "points": count} for label, count in enumerate(sizes)]})
    return entries
