"""Objects: ClusterObjects labels them, SplitObjects makes a cloud of each."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import torch
from torch import Tensor

from pcdata.errors import ConfigError, DTypeError, ReplayError, TooFewPointsError
from pcdata.functional.clusters import dbscan
from pcdata.functional.image_grid import ImageGrid
from pcdata.functional.rows import ptr_after_mask, ptr_from_counts
from pcdata.functional.touching import (
    REASONS,
    Separation,
    View,
    in_order_of_rows,
    separate_objects,
    separate_views,
)
from pcdata.rng import Streams
from pcdata.structures import PointCloud
from pcdata.threads import torch_on_one_thread
from pcdata.transforms.base import Params, sample_name
from pcdata.transforms.decisions import Decision, Decisions
from pcdata.transforms.families import DropLimit, LeftOutWarning
from pcdata.transforms.field_types import Count, Metres
from pcdata.transforms.found_planes import planes_in_cloud
from pcdata.transforms.merged_views import merged_views


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
        split_touching: part clusters where objects touch, by the shape of their surfaces, and join what an object in
            front keeps apart; needs the depth image that the cloud lies on, or those that MergeViews merged: the
            evidence of all views is added up. Labels then follow the lowest row of each object, and
            ``meta["touching"]`` tells the noise, every ``cut`` between two objects with its strength (0 to 1; in one
            image above 0.35) and length in pixels, and every join with its reason. What shows no evidence stays the
            cluster it was. A RemovePlane before it tells heights, without which bowls and cups may come apart.

    Raises:
        ConfigError: ``split_touching`` and the cloud no longer lies on its depth images.
    """

    runs_statistics = True
    version = 2

    eps: Metres = 0.02
    min_points: Count = 50
    min_size: Count = 100
    max_size: Count = 50_000
    keep: Literal["objects", "all"] = "objects"
    split_touching: bool = False

    def check_fields(self) -> None:
        """Require min_size <= max_size."""
        if self.min_size > self.max_size:
            raise ConfigError(f"ClusterObjects: min_size {self.min_size} exceeds max_size {self.max_size}")

    @torch_on_one_thread()
    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Cluster, then renumber the clusters of plausible size."""
        grid = data.image_grid()
        raw = dbscan(data.points, data.ptr, eps=self.eps, min_points=self.min_points, grid=grid)
        clusters_of = list(torch.tensor_split(raw, data.ptr[1:-1].cpu()))
        separations: list[Separation] = []
        before: list[Tensor] = []
        if self.split_touching:
            for b, part in enumerate(clusters_of):
                images = merged_views(data, b) if grid is None else grid
                if images is None:
                    raise ConfigError(
                        "ClusterObjects: split_touching needs the depth images that the points lie on, but the cloud "
                        "was downsampled, averaged or moved off its pixels, or merged of images of a lens that bends, "
                        "or was never one; put ClusterObjects before those steps, or split_touching: false"
                    )
                found, separation = self._separated(data, images, b, part)
                before.append(found)
                separations.append(separation)
            clusters_of = [in_order_of_rows(part)[0] for part in before]
        parts = [self._numbered(part) for part in clusters_of]
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
        evidence = _evidence(separations, before, [labels for labels, _ in parts]) if self.split_touching else {}
        return {"labels": torch.cat([labels for labels, _ in parts]), **counts, **evidence}

    def _separated(
        self, data: PointCloud, images: ImageGrid | list[View], b: int, clusters: Tensor
    ) -> tuple[Tensor, Separation]:
        """Part the clusters (n,) of cloud ``b`` that are large enough; return their new numbers, and what was found."""
        start, stop = int(data.ptr[b]), int(data.ptr[b + 1])
        size = torch.bincount(clusters + 1, minlength=1)
        size[:1] = 0
        rows = (size[clusters + 1] >= self.min_size).nonzero().squeeze(1)
        points = data.points[start:stop][rows]
        planes, height = planes_in_cloud(data, b), None
        if len(planes):
            plane = planes[-1].to(points.device)
            height = points.double() @ plane[:3] + plane[3]
            if len(height) and float(height.median()) < 0:
                height = -height  # where no `up` was given, what stands on the plane says which side is above
        noise = data.meta[b].get("planes", [{}])[-1].get("disparity_noise")
        noise = noise if isinstance(noise, float) and math.isfinite(noise) and noise > 0 else None
        if isinstance(images, ImageGrid):
            motion = None if images.camera_from_points is None else images.camera_from_points[b : b + 1]
            pixel = images.pixel_index[start:stop][rows]
            own = ImageGrid(pixel, images.size, images.intrinsics[b : b + 1], motion)
            separation = separate_objects(points, own, height=height, noise=noise)
        else:
            separation = separate_views(points, _picked(images, rows, stop - start), height=height, noise=noise)
        found = torch.full_like(clusters, -1)
        found[rows] = _with_clusters(separation.label, clusters[rows])
        # Clusters that are too small keep numbers of their own, to be counted as such.
        small = (clusters >= 0) & (size[clusters + 1] < self.min_size)
        found[small] = clusters[small] + (int(found.max()) + 1 if len(found) else 0)
        return found, separation

    def _numbered(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        """Number the clusters of plausible size in one cloud by 0, 1, ... and call all else -1; return what is else.

        The second result is the number of points of noise, then those of every cluster that is no object.
        """
        size = torch.bincount(raw + 1, minlength=1)  # noise first
        accepted = (size >= self.min_size) & (size <= self.max_size)
        accepted[:1] = False
        number = torch.where(accepted, accepted.cumsum(0) - 1, -1)
        return number[raw + 1], size[~accepted]

    @torch_on_one_thread()
    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Write the labels and drop the rest unless the whole scene is kept."""
        labels = params["labels"]
        counted = {name: params[name].tolist() for name in ("noise", "too_small", "too_large")}
        others = [{"no_objects": {name: counted[name][b] for name in counted}} for b in range(data.num_clouds)]
        labeled = data.with_fields(labels=labels).with_meta(_objects(labels, data)).with_meta(others)
        if self.split_touching:
            labeled = labeled.with_meta([{"touching": _touching(params, b)} for b in range(data.num_clouds)])
        if self.keep == "all":
            return labeled
        member = labels >= 0
        return labeled.select(member, ptr_after_mask(member, data.ptr))


def _picked(views: list[View], rows: Tensor, count: int) -> list[View]:
    """Return what views saw of some rows of a cloud of ``count``, numbered as those."""
    number = torch.full((count,), -1, dtype=torch.int64, device=rows.device)
    number[rows] = torch.arange(len(rows), dtype=torch.int64, device=rows.device)
    picked = []
    for seen, grid in views:
        own = number[seen]
        kept = own >= 0
        picked.append(View(own[kept], replace(grid, pixel_index=grid.pixel_index[kept])))
    return picked


def _with_clusters(label: Tensor, cluster: Tensor) -> Tensor:
    """Number objects by their lowest rows, where rows without one (label -1) take that of their cluster.

    A cluster without any is an object of its own; of one with several nobody knows whose such rows are.
    """
    num_clusters = int(cluster.max()) + 1 if len(cluster) else 0
    none = int(label.max()) + 1 if len(label) else 0
    has = label >= 0
    lowest = torch.full((num_clusters,), none, dtype=torch.int64, device=label.device)
    lowest.scatter_reduce_(0, cluster[has], label[has], "amin")
    highest = torch.full_like(lowest, -1).scatter_reduce_(0, cluster[has], label[has], "amax")
    own = torch.where(lowest == highest, lowest, -1)
    own = torch.where(highest < 0, none + torch.arange(num_clusters, dtype=torch.int64, device=label.device), own)
    return torch.where(has, label, own[cluster])


def _evidence(found: list[Separation], before: list[Tensor], after: list[Tensor]) -> Params:
    """Lay what was found out as tensors, with the labels that objects have at last; what is no object is left out."""
    cuts: list[tuple[float, ...]] = []
    joins: list[tuple[int, ...]] = []
    for b, separation in enumerate(found):
        new_of = torch.full((int(before[b].max()) + 2 if len(before[b]) else 1,), -1, dtype=torch.int64, device="cpu")
        new_of[before[b].cpu() + 1] = after[b].cpu()  # all rows of an object have one new label
        name = {old: new for old, new in enumerate(new_of[1:].tolist()) if new >= 0}
        for cut in separation.cuts:
            if all(one in name for one in cut.objects):
                cuts.append((b, *sorted(name[one] for one in cut.objects), cut.strength, cut.num_pixels))
        joins += [(b, name[join.object], REASONS.index(join.why)) for join in separation.joins if join.object in name]
    return {
        "depth_noise": torch.tensor([one.noise for one in found], dtype=torch.float64, device="cpu"),
        "cuts": torch.tensor(sorted(cuts), dtype=torch.float64, device="cpu").reshape(-1, 5),
        "joins": torch.tensor(sorted(joins), dtype=torch.int64, device="cpu").reshape(-1, 3),
    }


def _touching(params: Params, b: int) -> dict[str, Any]:
    """Tell what parted and joined the objects of cloud ``b``."""
    return {
        "noise": float(params["depth_noise"][b]),
        "cuts": [
            {"objects": [int(one), int(other)], "strength": round(strength, 3), "pixels": int(pixels)}
            for cloud, one, other, strength, pixels in params["cuts"].tolist()
            if cloud == b
        ],
        "joins": [
            {"object": label, "why": REASONS[why]} for cloud, label, why in params["joins"].tolist() if cloud == b
        ],
    }


class SplitObjects(DropLimit):
    """Make one cloud of every label >= 0, in order of cloud and label; points without a label are dropped.

    ``meta["object"]`` keeps the label, ``meta["unlabeled"]`` the number of points dropped from the whole cloud.
    """

    keeps_clouds = False

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Find the labels of every cloud: ``label`` (K,), its ``rank`` in its cloud, and the ``ptr`` (B+1,) of them."""
        if data.labels is None:
            raise DTypeError("SplitObjects: the cloud has no labels; put ClusterObjects before it")
        found = [torch.unique(own[own >= 0]).cpu() for own in torch.tensor_split(data.labels, data.ptr[1:-1].cpu())]
        for b, labels in enumerate(found):
            if not len(labels):
                raise TooFewPointsError(
                    f"SplitObjects: cloud {b}{sample_name(data, b)} has no labeled point among its "
                    f"{int(data.counts[b])}; check the fields of ClusterObjects"
                )
        member = torch.nn.functional.pad((data.labels >= 0).cumsum(0), (1, 0))
        self.check_drop(
            data.counts.tolist(),
            member[data.ptr].diff().tolist(),
            lambda b: f"points of cloud {b}{sample_name(data, b)}",
        )
        ranks = [torch.arange(len(labels), dtype=torch.int64, device="cpu") for labels in found]
        return {
            "label": torch.cat(found),
            "rank": torch.cat(ranks),
            "ptr": ptr_from_counts([len(labels) for labels in found]),
        }

    def repeat(self, data: PointCloud, decided: Decisions) -> Params:
        """The objects with the labels that the history tells."""
        like = torch.empty(0, dtype=torch.int64, device="cpu")
        starts = [number for number, _ in self.origins(decided.of_clouds)]
        if data.labels is None or len(starts) != data.num_clouds:
            raise ReplayError(
                f"SplitObjects: the histories tell of objects of {len(starts)} clouds, and there are {data.num_clouds}"
                f"{' without labels' if data.labels is None else ''}; give clouds with the same labels"
            )
        ptr = torch.tensor([*starts, len(decided)], dtype=torch.int64, device="cpu")
        return {"label": decided.values("label", like=like), "rank": decided.values("rank", like=like), "ptr": ptr}

    def origins(self, decisions: Sequence[Decision]) -> list[tuple[int, int | None]]:
        """A cloud's objects come in the order of their ranks."""
        ranks = Decisions("SplitObjects", decisions).values("rank").tolist()
        return [(k, None) for k, rank in enumerate(ranks) if k == 0 or rank <= ranks[k - 1]]

    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Split each cloud by its labels."""
        bounds = params["ptr"].tolist()
        parts = []
        for b, cloud in enumerate(data.unbatch()):
            assert cloud.labels is not None  # make_params
            unlabeled = int((cloud.labels < 0).sum())
            for label in params["label"][bounds[b] : bounds[b + 1]].tolist():
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
