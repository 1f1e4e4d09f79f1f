"""RemovePlane: find the dominant plane, usually the table, and remove it."""

from __future__ import annotations

import itertools
import math
from typing import Annotated, Any, Literal

import annotated_types
import torch
from annotated_types import Ge, Interval
from torch import Tensor

from pcdata.contracts.host import negated
from pcdata.errors import ConfigError
from pcdata.functional.planes import ransac_plane
from pcdata.functional.rows import cloud_of_rows, counts_from_ptr, ptr_after_mask
from pcdata.functional.selection import convex_hull
from pcdata.geometry import rigid
from pcdata.geometry.plane_fit import through_origin
from pcdata.rng import Streams
from pcdata.structures import METRE, PointCloud
from pcdata.transforms.base import Params, sample_name
from pcdata.transforms.families import RemoveTransform
from pcdata.transforms.field_types import Count, Metres, Name, Vec3

# Radians: a plane that holds `up` to within 5 degrees has no upper side; a table's or a wall's own tilt reaches that.
_LEAST_RISE = math.radians(5)


class RemovePlane(RemoveTransform):
    """Remove the plane with the most inliers, found by RANSAC and refined by least squares.

    The plane joins ``meta["planes"]`` of every cloud, in the source frame, so later steps cannot make it stale;
    :func:`planes_in_cloud` gives it in the cloud's present coordinates. ``faces`` says what its normal was turned to:
    ``up``, the ``origin`` of the frame it was found in, or ``neither side`` of a plane through that origin.

    Args:
        distance: inliers are closer to the plane than this.
        num_hypotheses: planes tried through three points each.
        seed: of the hypotheses: the same cloud always gives the same plane.
        up: the normal's rough direction in `frame`; None = any, facing the origin of the frame.
        frame: the frame that `up` is given in; given with it.
        max_tilt: radians between normal and up at most.
        max_height: metres above the plane that are kept at most, with above and over.
        margin: metres beyond the hull that still are over the plane.

    Raises:
        ConfigError: ``keep`` asks for one side where the plane passes the origin and no ``up`` is given, or holds it.
    """

    runs_statistics = True
    version = 2

    distance: Metres = 0.01
    num_hypotheses: Count = 1000
    seed: int = 0
    # "above": also drop what lies beyond the plane, seen along its normal; then the plane must have an upper side.
    # "over": also drop what is not over the convex hull of the plane's points: what stands on the table.
    keep: Literal["both", "above", "over"] = "both"
    max_height: Metres | None = None
    margin: Annotated[float, Ge(0), annotated_types.Unit(METRE)] = 0.0
    up: Vec3 | None = None
    frame: Name | None = None
    max_tilt: Annotated[float, Interval(gt=0, le=math.pi / 2)] | None = None

    def check_fields(self) -> None:
        """Require up and frame together, up for max_tilt, and a side for heights and margins."""
        if self.keep == "both" and self.max_height is not None:
            raise ConfigError("RemovePlane: max_height is measured above the plane; say keep: above, or over")
        if self.keep != "over" and self.margin:
            raise ConfigError("RemovePlane: margin is that of the hull; say keep: over")
        if (self.up is None) != (self.frame is None):
            raise ConfigError("RemovePlane: give up and the frame it is in together, or neither")
        if self.max_tilt is not None and self.up is None:
            raise ConfigError("RemovePlane: max_tilt is measured from up; give up and frame too")

    def frame_needed(self) -> str | None:
        """The frame of ``up``."""
        return self.frame

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Find the plane of every cloud and the rows that stay."""
        planes, inlier = ransac_plane(
            data.points,
            data.ptr,
            distance=self.distance,
            num_hypotheses=self.num_hypotheses,
            seed=self.seed,
            up=self.up,
            max_tilt=self.max_tilt,
        )
        keep = negated(inlier)
        if self.keep != "both":
            for b, plane in enumerate(planes.cpu()):
                self._require_upper_side(data, b, plane)
            plane = planes.double()[cloud_of_rows(data.ptr)]
            height = (plane[:, :3] * data.points).sum(1) + plane[:, 3]
            keep &= height > 0
            if self.max_height is not None:
                keep &= height <= self.max_height
        if self.keep == "over":
            bounds = data.ptr.tolist()
            parts = [slice(*pair) for pair in itertools.pairwise(bounds)]
            keep &= torch.cat(
                [_over_hull(data.points[part], inlier[part], plane, self.margin) for part, plane in zip(parts, planes)]
            )
        return {
            "index": keep,
            "ptr": ptr_after_mask(keep, data.ptr),
            "planes": planes,
            "num_inliers": counts_from_ptr(ptr_after_mask(inlier, data.ptr)),
        }

    def _require_upper_side(self, data: PointCloud, b: int, plane: Tensor) -> None:
        """Refuse a plane whose normal noise could turn round: it decides which half of the scene is dropped."""
        where = f"RemovePlane: keep={self.keep!r} of cloud {b}{sample_name(data, b)} is open: the plane"
        if self.up is None and through_origin(plane, self.distance):
            raise ConfigError(
                f"{where} passes the origin of {data.frame_id!r} at {1000 * abs(float(plane[3])):.3g} mm, nearer than "
                f"distance={self.distance:g}, so the origin is on neither side; say which way is up: "
                f"up=(x, y, z), frame={data.frame_id!r}"
            )
        if self.up is not None:
            up = torch.tensor(self.up, dtype=torch.float64, device="cpu")
            rise = math.pi / 2 - float(rigid.angle_between(plane[:3], up))
            if abs(rise) < _LEAST_RISE:
                raise ConfigError(
                    f"{where} contains up to within {math.degrees(abs(rise)):.2g} degrees, so neither side is above; "
                    "give max_tilt to look for a level plane, or the up of this one"
                )

    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Keep the rows and store the planes in the source frame."""
        entries: list[dict[str, Any]] = []
        source_planes = _map_planes(params["planes"], torch.linalg.inv(data.source_from_cloud))
        for b, plane in enumerate(source_planes.tolist()):
            found: dict[str, Any] = {
                "normal": plane[:3],
                "offset": plane[3],
                "frame": data.source_frame,
                "num_inliers": int(params["num_inliers"][b]),
            }
            if self.up is None:
                found["faces"] = "neither side" if through_origin(params["planes"][b], self.distance) else "origin"
            if self.up is not None:
                found["faces"] = "up"
                up = torch.tensor(self.up, dtype=torch.float64, device="cpu")
                found["tilt"] = float(rigid.angle_between(params["planes"][b, :3].cpu(), up))
            entries.append({"planes": [*data.meta[b].get("planes", []), found]})
        return super().transform(data, params).with_meta(entries)


def _over_hull(points: Tensor, inlier: Tensor, plane: Tensor, margin: float) -> Tensor:
    """Mark the points (n, 3) that lie over the convex hull of the inliers, or within ``margin`` of its edges' lines."""
    normal = plane[:3].double()
    # Two directions in the plane: across the axis that the normal is least along.
    aside = torch.linalg.cross(normal, torch.eye(3, dtype=torch.float64, device=normal.device)[normal.abs().argmin()])
    aside = aside / aside.norm()
    flat = points.double() @ torch.stack([aside, torch.linalg.cross(normal, aside)], dim=1)
    corners = flat[inlier][convex_hull(flat[inlier])]
    if len(corners) < 3:
        return torch.zeros_like(inlier)
    edge = corners.roll(-1, 0) - corners
    outward = torch.stack([edge[:, 1], -edge[:, 0]], dim=1) / edge.norm(dim=1, keepdim=True)
    beyond = torch.full_like(flat[:, 0], -torch.inf)
    for corner, direction in zip(corners, outward):  # tens of them
        beyond = torch.maximum(beyond, (flat - corner) @ direction)
    return beyond <= margin


def planes_in_cloud(cloud: PointCloud, b: int = 0) -> Tensor:
    """Return (P, 4) float64 planes (unit normal, offset) found in cloud ``b``, in its present coordinates.

    A point p is on the plane where ``normal @ p + offset == 0``.
    """
    stored = [[*plane["normal"], plane["offset"]] for plane in cloud.meta[b].get("planes", [])]
    planes = torch.tensor(stored, dtype=torch.float64, device="cpu").reshape(-1, 4)
    matrix = cloud.source_from_cloud[b].cpu()
    return _map_planes(planes, matrix.expand(len(planes), 4, 4))


def _map_planes(planes: Tensor, old_from_new: Tensor) -> Tensor:
    """Rewrite (P, 4) planes in new coordinates: a plane is a row vector, so it moves by the inverse matrix."""
    moved = torch.einsum("pi,pij->pj", planes.double(), old_from_new)
    return moved / moved[:, :3].norm(dim=1, keepdim=True)


__all__ = ["RemovePlane", "planes_in_cloud"]
