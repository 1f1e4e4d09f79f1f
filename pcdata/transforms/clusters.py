"""ClusterObjects: label what lies together, or looks like one thing, as objects."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from typing import Any, Literal

import torch
from torch import Tensor

from pcdata.errors import ConfigError, DTypeError, TooFewPointsError
from pcdata.functional.areas import seen_areas
from pcdata.functional.clusters import dbscan
from pcdata.functional.image_clusters import image_clusters
from pcdata.functional.image_grid import ImageGrid, is_lined
from pcdata.functional.rows import ptr_after_mask
from pcdata.functional.touching import (
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
from pcdata.transforms.families import DropLimit, LeftOutWarning
from pcdata.transforms.field_types import Count, Metres, SquareMetres
from pcdata.transforms.found_planes import planes_in_cloud
from pcdata.transforms.merged_views import merged_views
from pcdata.transforms.touching_evidence import evidence_params, evidence_told

_FEWEST, _MOST = 100, 50_000  # points of an object where no limit is given


class ClusterObjects(DropLimit):
    """Label clusters of points as objects and keep those of a plausible size.

    Labels become 0..K-1 per cloud in the order of their lowest core point; any labels the cloud had are replaced.
    ``meta["objects"]`` lists label and point count (and the area, where a limit is one); ``meta["no_objects"]`` what is
    no object: the points of ``noise``, and of every cluster that is ``too_small`` or ``too_large``. The history counts
    them.

    Warns:
        LeftOutWarning: a cluster is larger than ``max_size`` or ``max_area``.

    Args:
        eps: points closer than this are neighbors.
        min_points: neighbors, the point itself included, that make a core point; of no matter by image.
        by: "density": clusters are those of DBSCAN. "image": connected parts of the depth image that the cloud lies on,
            faster: points on neighboring pixels that are closer than ``eps`` are linked, all count as core points, and
            what something in front parts are two; see :func:`pcdata.functional.image_clusters`. Where lines of missing
            pixels run through the image, as after depth was moved to the color camera, one pixel is bridged.
        min_size: clusters of fewer points are not objects; None = 100, or no limit where ``min_area`` is given.
        max_size: clusters of more points are not objects; None = 50,000, or no limit where ``max_area`` is given.
        min_area: clusters of which less is seen, in square metres, are not objects. Unlike counts areas do not change
            with the resolution or the distance.
        max_area: clusters of which more is seen are not objects.
        keep: "all": keep the whole scene, with -1 where no object is.
        split_touching: part clusters where objects touch, by the shape of their surfaces, and join what an object in
            front keeps apart; needs the depth image that the cloud lies on, or those that MergeViews merged: the
            evidence of all views is added up. Labels then follow the lowest row of each object, and
            ``meta["touching"]`` tells the noise, every ``cut`` between two objects with its strength (0 to 1; in one
            image above 0.35) and length in pixels, and every join with its reason. What shows no evidence stays the
            cluster it was. A RemovePlane before it tells heights, without which bowls and cups may come apart.
        use_color: with ``split_touching``, make contacts stronger where colors differ and weaker where they do not. On
            the real scenes that the method was made on that is no gain, see docs/segmentation.md.

    Raises:
        ConfigError: ``by: image`` or ``split_touching``, and the cloud no longer lies on its depth images.
        DTypeError: ``use_color``, and the cloud has no colors.
    """

    runs_statistics = True
    version = 5

    eps: Metres = 0.02
    min_points: Count = 50
    by: Literal["density", "image"] = "density"
    min_size: Count | None = None
    max_size: Count | None = None
    min_area: SquareMetres | None = None
    max_area: SquareMetres | None = None
    keep: Literal["objects", "all"] = "objects"
    split_touching: bool = False
    use_color: bool = False

    def check_fields(self) -> None:
        """Require limits in order, and touching objects for colors."""
        if self.use_color and not self.split_touching:
            raise ConfigError("ClusterObjects: use_color is about objects that touch; say split_touching: true")
        fewest, most = self._counts()
        if fewest > most:
            raise ConfigError(f"ClusterObjects: min_size {fewest} exceeds max_size {most:g}")
        if self.min_area is not None and self.max_area is not None and self.min_area > self.max_area:
            raise ConfigError(f"ClusterObjects: min_area {self.min_area:g} exceeds max_area {self.max_area:g}")

    def _counts(self) -> tuple[int, float]:
        """Return the limits of points that hold."""
        fewest = self.min_size or (1 if self.min_area is not None else _FEWEST)
        most = self.max_size or (math.inf if self.max_area is not None else _MOST)
        return fewest, most

    @torch_on_one_thread()
    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Cluster, then renumber the clusters of plausible size."""
        if self.use_color and data.colors is None:
            raise DTypeError(
                "ClusterObjects: use_color is on but the cloud has no colors; load captures with them, or say "
                "use_color: false"
            )
        grid = data.image_grid()
        clusters_of = list(torch.tensor_split(self._clusters(data, grid), data.ptr[1:-1].cpu()))
        separations: list[Separation] = []
        before: list[Tensor] = []
        if self.split_touching:
            for b, part in enumerate(clusters_of):
                images = merged_views(data, b) if grid is None else _own_grid(data, grid, b)
                if images is None:
                    raise ConfigError(
                        "ClusterObjects: split_touching needs the depth images that the points lie on, but the cloud "
                        "was downsampled, averaged or moved off its pixels, or merged of images of a lens that bends, "
                        "or was never one; put ClusterObjects before those steps, or split_touching: false"
                    )
                found, separation = self._separated(data, images, b, part, _own_grid(data, grid, b))
                before.append(found)
                separations.append(separation)
            clusters_of = [in_order_of_rows(part)[0] for part in before]
        parts = [self._numbered(data, b, raw, _own_grid(data, grid, b)) for b, raw in enumerate(clusters_of)]
        names = ("noise", "too_small", "too_large")
        counts = torch.tensor([counted for _, counted, _ in parts], dtype=torch.int64, device="cpu").reshape(-1, 3)
        found_params = dict(zip(names, counts.unbind(1)))
        if self.min_area is not None or self.max_area is not None:
            listed = [(b, label, area) for b, (*_, areas) in enumerate(parts) for label, area in enumerate(areas)]
            found_params["areas"] = torch.tensor(listed, dtype=torch.float64, device="cpu").reshape(-1, 3)
        evidence = evidence_params(separations, before, [labels for labels, *_ in parts]) if self.split_touching else {}
        labels = parts[0][0] if len(parts) == 1 else torch.cat([labels for labels, *_ in parts])
        return {"labels": labels, **found_params, **evidence}

    def _clusters(self, data: PointCloud, grid: ImageGrid | None) -> Tensor:
        """Return the cluster (N,) of every point, -1 = noise."""
        if self.by == "density":
            return dbscan(data.points, data.ptr, eps=self.eps, min_points=self.min_points, grid=grid)
        if grid is None:
            raise ConfigError(
                "ClusterObjects: by='image' links neighboring pixels, but the cloud lies on no depth image: it was "
                "downsampled, merged or moved off its pixels, or was never one; put ClusterObjects before those steps, "
                "or say by: density"
            )
        pixel, size = grid.pixel_index, grid.size
        lined = any(is_lined(own, size) for own in torch.tensor_split(pixel, data.ptr[1:-1].cpu()))
        reach = 2 if lined else 1
        return image_clusters(data.points, data.ptr, pixel_index=pixel, size=size, eps=self.eps, reach=reach)

    def _sizes(
        self, data: PointCloud, b: int, raw: Tensor, grid: ImageGrid | None, place: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return points and area (K,) of every cluster of cloud ``b``; no areas where none is asked for.

        ``place`` is one more than ``raw``, if that is at hand.
        """
        size = torch.bincount(raw + 1 if place is None else place, minlength=1)[1:]
        if self.min_area is None and self.max_area is None:
            return size, torch.zeros_like(size, dtype=torch.float64)
        points = data.points[int(data.ptr[b]) : int(data.ptr[b + 1])]
        return size, seen_areas(points, raw, len(size), grid)

    def _separated(
        self, data: PointCloud, images: ImageGrid | list[View], b: int, clusters: Tensor, grid: ImageGrid | None
    ) -> tuple[Tensor, Separation]:
        """Part the clusters (n,) of cloud ``b`` that are large enough; return their new numbers, and what was found."""
        start, stop = int(data.ptr[b]), int(data.ptr[b + 1])
        size, area = self._sizes(data, b, clusters, grid)
        large = torch.cat([size.new_zeros(1, dtype=torch.bool), self._large_enough(size, area)])  # noise first
        rows = large[clusters + 1].nonzero().squeeze(1)
        points = data.points[start:stop].detach()[rows]
        planes, height = planes_in_cloud(data, b), None
        if len(planes):
            plane = planes[-1].to(points.device)
            height = points.double() @ plane[:3] + plane[3]
            if len(height) and float(height.median()) < 0:
                height = -height  # where no `up` was given, what stands on the plane says which side is above
        noise = data.meta[b].get("planes", [{}])[-1].get("disparity_noise")
        noise = noise if isinstance(noise, float) and math.isfinite(noise) and noise > 0 else None
        colors = data.colors[start:stop][rows] if self.use_color and data.colors is not None else None
        told: dict[str, Any] = {"height": height, "noise": noise, "colors": colors}
        if isinstance(images, ImageGrid):
            own = replace(images, pixel_index=images.pixel_index[rows])
            separation = separate_objects(points, own, **told)
        else:
            separation = separate_views(points, _picked(images, rows, stop - start), **told)
        found = torch.full_like(clusters, -1)
        found[rows] = _with_clusters(separation.label, clusters[rows])
        # Clusters that are too small keep numbers of their own, to be counted as such.
        small = (clusters >= 0) & ~large[clusters + 1]
        found[small] = clusters[small] + (int(found.max()) + 1 if len(found) else 0)
        return found, separation

    def _large_enough(self, size: Tensor, area: Tensor) -> Tensor:
        return (size >= self._counts()[0]) & (area >= (self.min_area or 0.0))

    def _numbered(
        self, data: PointCloud, b: int, raw: Tensor, grid: ImageGrid | None
    ) -> tuple[Tensor, list[int], list[float]]:
        """Number the clusters of plausible size in one cloud by 0, 1, ... and call all else -1; return what is else.

        The second result are the points of noise and of clusters that are too small and too large, the third the areas
        of the objects.
        """
        place = raw + 1  # of noise and clusters in a list of both
        size, area = self._sizes(data, b, raw, grid, place)
        small = ~self._large_enough(size, area)
        many, wide = size > self._counts()[1], area > (self.max_area or math.inf)
        large = (many | wide) & ~small
        if bool(large.any()):
            self._warn_of_large(data, b, size[large & many], area[large & wide])
        accepted = torch.nn.functional.pad(~small & ~large, (1, 0))  # noise first
        number = torch.where(accepted, accepted.cumsum(0) - 1, -1)
        counted = [len(raw) - int(size.sum()), int(size[small].sum()), int(size[large].sum())]
        return number.index_select(0, place), counted, area[~small & ~large].tolist()

    def _warn_of_large(self, data: PointCloud, b: int, size: Tensor, area: Tensor) -> None:
        """Say that what may be wanted is left out."""
        if len(size):
            found, limit = f"{int(size.max())} points", f"max_size={self._counts()[1]:g}"
        else:
            found, limit = f"{float(area.max()):.3g} m^2", f"max_area={self.max_area:g}"
        split = "" if self.split_touching else ", or split_touching: true if it is several that touch"
        warnings.warn(
            f"ClusterObjects: cloud {b}{sample_name(data, b)}: a cluster of {found}, more than {limit}, is left out; "
            f"raise {limit.split('=')[0]} if it is an object or a heap of them{split}; or put RemovePlane or "
            "CropWorkspace before it if it is the table or a wall",
            LeftOutWarning,
            stacklevel=2,
        )

    @torch_on_one_thread()
    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Write the labels and drop the rest unless the whole scene is kept."""
        labels = params["labels"]
        counted = {name: params[name].tolist() for name in ("noise", "too_small", "too_large")}
        others = [{"no_objects": {name: counted[name][b] for name in counted}} for b in range(data.num_clouds)]
        listed = _objects(labels, data, params.get("areas"))
        labeled = data.with_fields(labels=labels).with_meta(listed).with_meta(others)
        if self.split_touching:
            labeled = labeled.with_meta([{"touching": evidence_told(params, b)} for b in range(data.num_clouds)])
        if self.keep == "all":
            return labeled
        member = labels >= 0
        for b, one in enumerate(listed):
            if not one["objects"] and any(lost[b] for lost in counted.values()):
                raise self._no_object(data, b, {name: lost[b] for name, lost in counted.items()})
        return labeled.select(member, ptr_after_mask(member, data.ptr))

    def _no_object(self, data: PointCloud, b: int, counted: dict[str, int]) -> TooFewPointsError:
        """Say what became of the points of a cloud without objects, and what to do about the most of them."""
        advice = {
            "noise": "use a larger eps or fewer min_points; are the points in metres?",
            "too_small": "lower min_size or min_area",
            "too_large": "put RemovePlane or CropWorkspace before it, or raise max_size or max_area",
        }
        return TooFewPointsError(
            f"ClusterObjects: cloud {b}{sample_name(data, b)} has no object: of {sum(counted.values())} points "
            f"{counted['noise']} are noise, {counted['too_small']} in clusters that are too small and "
            f"{counted['too_large']} in ones that are too large; {advice[max(counted, key=lambda one: counted[one])]}; "
            "or keep: all"
        )


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


def _own_grid(data: PointCloud, grid: ImageGrid | None, b: int) -> ImageGrid | None:
    """Return the part of a batch's grid that is cloud ``b``'s."""
    if grid is None:
        return None
    motion = None if grid.camera_from_points is None else grid.camera_from_points[b : b + 1]
    pixel = grid.pixel_index[int(data.ptr[b]) : int(data.ptr[b + 1])]
    return ImageGrid(pixel, grid.size, grid.intrinsics[b : b + 1], motion)


def _objects(labels: Tensor, data: PointCloud, areas: Tensor | None) -> list[dict[str, Any]]:
    entries: list[dict[str, Any]] = []
    for own in torch.tensor_split(labels, data.ptr[1:-1].cpu()):
        sizes = torch.bincount(own + 1)[1:].tolist()
        entries.append({"objects": [{"label": label, "points": count} for label, count in enumerate(sizes)]})
    for b, label, area in [] if areas is None else areas.tolist():
        entries[int(b)]["objects"][int(label)]["area"] = area
    return entries
