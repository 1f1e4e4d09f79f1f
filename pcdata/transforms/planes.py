"""RemovePlane: find the table, or the dominant plane, and remove it."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from itertools import pairwise
from typing import Annotated, Any, Literal

import annotated_types
import torch
from annotated_types import Ge, Interval
from torch import Tensor

from pcdata.contracts.asked_later import is_set
from pcdata.contracts.dispatch import roomy_body
from pcdata.contracts.host import negated
from pcdata.contracts.known import UNSHARED, is_known
from pcdata.contracts.on_host import bounds_of, counts_of
from pcdata.errors import ConfigError
from pcdata.functional.fixed_rows import FixedRows, move_kept
from pcdata.functional.largest_planes import largest_planes
from pcdata.functional.plane_segments import supporting_plane
from pcdata.functional.plane_steps import near_planes
from pcdata.functional.plane_surfaces import plane_surfaces
from pcdata.functional.planes import ransac_plane
from pcdata.functional.row_draws import words_drawn
from pcdata.functional.rows import cloud_of_rows, count_per_cloud, kept_rows, ptr_after_mask
from pcdata.functional.selection import over_hull
from pcdata.functional.table_surface import table_surface
from pcdata.geometry import rigid
from pcdata.rng import Streams
from pcdata.structures import CAMERA_FRAME, METRE, PointCloud
from pcdata.structures.read_later import MadeWhenRead, OfClouds, put_off
from pcdata.threads import torch_on_one_thread
from pcdata.transforms.base import Params, sample_name
from pcdata.transforms.decisions import Decisions
from pcdata.transforms.families import GEOMETRY, RemoveTransform
from pcdata.transforms.field_types import Count, Metres, Name, Vec3
from pcdata.transforms.found_planes import Surfaces, guessed_planes, plane_facts, plane_guesses, surfaces_seen
from pcdata.transforms.plane_alarms import warn_of_no_table, warn_of_tilt

# Radians: a plane that holds `up` to within 5 degrees has no upper side; a table's or a wall's own tilt reaches that.
_LEAST_RISE = math.radians(5)
# Standard deviation of 1/z, in 1/m, that no depth camera at a table has: seven times a Kinect's, 2 cm at 1 m.
_WORST_SENSOR = 0.02
# Up, more or less, of a camera that is held upright, in its own axes (x right, y down, z forward): it looks level or
# down. A wall that faces it scores low whatever the angle.
_LIKELY_UP = (0.0, -1.0, -0.3)


class RemovePlane(RemoveTransform):
    """Remove a plane: the one with the most inliers, found by RANSAC and refined by least squares, or the table.

    The plane joins ``meta["planes"]`` of every cloud with its inlier share, RMS, tilt and hull, in the source frame, so
    later steps cannot make it stale; :func:`planes_in_cloud` and :func:`plane_hulls_in_cloud` give it in the cloud's
    present coordinates. ``faces`` says what its normal was turned to: ``up``, the ``sensor``, the ``origin`` of the
    frame it was found in, or ``neither side`` of a plane through that origin. RMS and hull are those of its surface,
    connected patches a tenth as large as the largest or more: walls that cross the plane are no part of it.

    Args:
        distance: inliers are closer to the plane than this.
        num_hypotheses: planes tried through three points each.
        seed: of the hypotheses: the same cloud always gives the same plane.
        which: the plane with the most inliers, or the one that things stand on.
        cut: drop a slab of ``distance`` on both sides, or what the plane's own bend and noise explain.
        probability: stop trying once a better plane is this unlikely to be missed, and score tries on 16,384 points;
            None = try all, on all.
        up: the normal's rough direction in `frame`; None = any, facing the sensor or the origin of the frame.
        frame: the frame that `up` is given in; given with it.
        max_tilt: radians between normal and up at most.
        tilt_alarm: radians between normal and up from which a warning is given; None = never.
        max_height: metres above the plane that are kept at most, with above and over.
        margin: metres beyond the hull that still are over the plane.

    Raises:
        ConfigError: ``keep`` asks for one side where the plane passes the origin and no ``up`` is given, or holds it.

    Warns:
        TiltedPlaneWarning: the plane leans away from up by more than ``tilt_alarm``.
        UnmeasuredTableWarning: what lies about the plane is no table that could be measured, so none of it goes;
            ``meta["planes"]`` and the history tell so.
    """

    runs_statistics = True
    decides_by = "point"  # but over the hull of the rows near the plane, and where their noise is measured
    version = 10

    distance: Metres = 0.01
    num_hypotheses: Count = 1000
    seed: int = 0
    probability: Annotated[float, Interval(gt=0, lt=1)] | None = None
    # "supporting": by area, by what stands on it and by how level it is: see functional.supporting_plane.
    which: Literal["largest", "supporting"] = "largest"
    # "slab": all that is closer than `distance` goes. "measured": what the plane's own bend and noise explain goes, so
    # the feet of objects stay and edges of the table do not: see functional.table_surface.
    cut: Literal["slab", "measured"] = "slab"
    # "above": also drop what lies beyond the plane, seen along its normal; then the plane must have an upper side.
    # "over": also drop what is not over the convex hull of the plane's points: what stands on the table.
    keep: Literal["both", "above", "over"] = "both"
    max_height: Metres | None = None
    margin: Annotated[float, Ge(0), annotated_types.Unit(METRE)] = 0.0
    up: Vec3 | None = None
    frame: Name | None = None
    max_tilt: Annotated[float, Interval(gt=0, le=math.pi / 2)] | None = None
    tilt_alarm: Annotated[float, Interval(gt=0, le=math.pi / 2)] | None = math.radians(5)

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
        if self.keep == "over" or self.cut == "measured":
            self.decides_by = "rows"  # type: ignore[misc, assignment]

    def looks_at(self) -> Collection[str]:
        """The points, the image, and where the sensor stood."""
        return GEOMETRY

    def frame_needed(self) -> str | None:
        """The frame of ``up``."""
        return self.frame

    @torch_on_one_thread()
    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Find the plane of every cloud and the rows that stay."""
        planes, own = self._found(data)
        if self.cut == "slab":
            return self._apart(data, planes, own)
        surface = table_surface(
            data.points,
            data.ptr,
            planes=planes,
            distance=self.distance,
            viewpoint=data.extra.get("viewpoint", data.viewpoint),
            max_noise=_WORST_SENSOR,
            grid=data.image_grid(),
        )
        names = ("noise", "disparity_noise", "believed")
        found = {name: getattr(surface, name) for name in names}
        gone = surface.table
        if self.keep != "both":
            gone = gone | surface.below
        return {**self._apart(data, surface.planes, surface.flat, gone, surface.height), **found}

    def _apart(
        self,
        data: PointCloud,
        planes: Tensor,
        own: Tensor,  # (N,) points of the plane itself
        gone: Tensor | None = None,  # (N,) what goes, with what is below if that must go; None = they alone
        height: Tensor | None = None,
    ) -> Params:
        """Say which rows stay beside the points of each cloud's plane, by their height above it."""
        if gone is None and self.keep == "both" and is_known(UNSHARED, data.points):
            keep, kept_ptr, _ = kept_rows(own, data.ptr, gone=True)
            return {"index": keep, "ptr": kept_ptr, "planes": planes, "num_inliers": (data.ptr - kept_ptr).diff()}
        keep, kept_ptr, _ = kept_rows(own if gone is None else gone, data.ptr, gone=True)
        if self.keep != "both":
            for b, plane in enumerate(planes.tolist()):
                self._require_upper_side(data, b, plane)
            if height is None:
                plane = planes.double()[cloud_of_rows(data.ptr)]
                height = (plane[:, :3] * data.points).sum(1) + plane[:, 3]
                keep &= height > 0
            if self.max_height is not None:
                keep &= height <= self.max_height
        points = data.points.detach()
        patch, corners, rms = plane_surfaces(points, data.ptr, own, planes.cpu(), self.distance)
        if self.keep == "over":
            for (start, stop), plane in zip(pairwise(bounds_of(data.ptr)), planes):
                mine, kept = points[start:stop], keep[start:stop]
                kept[kept.clone()] = over_hull(mine[kept], mine[patch[start:stop]], plane, self.margin)
        is_slab = gone is None and self.keep == "both"
        return {
            "index": keep,
            "ptr": kept_ptr if self.keep == "both" else ptr_after_mask(keep, data.ptr),
            "planes": planes,
            "num_inliers": (data.ptr - kept_ptr).diff() if is_slab else count_per_cloud(own, data.ptr),
            "per_point": patch,
            "corners": corners,
            "rms": rms,
        }

    def _found(self, data: PointCloud) -> tuple[Tensor, Tensor]:
        """Return each cloud's plane and its inliers."""
        search: dict[str, Any] = {
            "distance": self.distance,
            "num_hypotheses": self.num_hypotheses,
            "seed": self.seed,
            "up": self.up,
            "max_tilt": self.max_tilt,
            "probability": self.probability,
        }
        if self.which == "largest":
            if plane_guesses.get():
                search["guess"] = guessed_planes(data)
            return ransac_plane(data.points, data.ptr, **search)
        likely_up = None
        if self.up is None and data.source_frame == CAMERA_FRAME:
            likely_up = torch.linalg.solve(
                data.source_from_cloud[:, :3, :3].cpu(),
                torch.tensor(_LIKELY_UP, dtype=torch.float64, device="cpu").expand(data.num_clouds, 3),
            )
        return supporting_plane(data.points, data.ptr, **search, likely_up=likely_up, viewpoint=_viewpoints(data))

    def repeat(self, data: PointCloud, decided: Decisions) -> Params:
        """The planes that the history tells, and the rows near them."""
        if self.keep == "over" or self.cut == "measured":
            return super().repeat(data, decided)
        planes = decided.values("planes", like=torch.empty(0, 4, dtype=torch.float64, device="cpu")).to(data.device)
        return self._apart(data, planes, near_planes(data.points, data.ptr, planes.cpu(), self.distance))

    def _require_upper_side(self, data: PointCloud, b: int, plane: Sequence[float]) -> None:
        """Refuse a plane whose normal noise could turn round: it decides which half of the scene is dropped."""
        where = f"RemovePlane: keep={self.keep!r} of cloud {b}{sample_name(data, b)} is open: the plane"
        if self._faces(data, b, plane) == "neither side":
            raise ConfigError(
                f"{where} passes the origin of {data.frame_id!r} at {1000 * abs(plane[3]):.3g} mm, nearer than "
                f"distance={self.distance:g}, so the origin is on neither side; say which way is up: "
                f"up=(x, y, z), frame={data.frame_id!r}"
            )
        if self.up is not None:
            rise = math.pi / 2 - self._tilt(plane)
            if abs(rise) < _LEAST_RISE:
                raise ConfigError(
                    f"{where} contains up to within {math.degrees(abs(rise)):.2g} degrees, so neither side is above; "
                    "give max_tilt to look for a level plane, or the up of this one"
                )

    def _tilt(self, plane: Sequence[float]) -> float:
        normal, up = (torch.tensor(given, dtype=torch.float64, device="cpu") for given in (plane[:3], self.up))
        return float(rigid.angle_between(normal, up))

    def _faces(self, data: PointCloud, b: int, plane: Sequence[float]) -> str:
        """Say what a normal was turned to."""
        if self.up is not None:
            return "up"
        seen_from = _viewpoints(data) if self.which == "supporting" else None
        if seen_from is None:
            return "neither side" if abs(plane[3]) < self.distance else "origin"
        x, y, z = seen_from[b].tolist()
        side = ((x * plane[0] + y * plane[1]) + z * plane[2]) + plane[3]
        return "neither side" if abs(side) < self.distance else "sensor"

    def with_facts(self, result: PointCloud, data: PointCloud, params: Params) -> PointCloud:
        """Store the planes in the source frame."""
        return result.with_meta(self._entries(data, params))

    def fixed_work(self, like: FixedRows) -> Callable[[FixedRows], FixedRows] | None:
        """Find the plane with the most inliers and remove the slab about it; whatever else is asked needs the host."""
        device = like.points.device
        body = roomy_body(largest_planes.__name__, device)
        is_plain = (self.which, self.cut, self.keep, self.up) == ("largest", "slab", "both", None)
        if body is None or not is_plain or like.normals is not None:
            return None
        if words_drawn(self.seed, self.num_hypotheses, device) is None:
            return None

        def work(rows: FixedRows) -> FixedRows:
            fields = self.distance, self.num_hypotheses, self.seed, self.probability
            planes, near, failed = body(rows.points, rows.ptr, *fields)
            is_set(failed)
            keep = ~near
            kept = move_kept(rows.points, rows.source_index, rows.ptr, keep)
            return FixedRows(*kept, rows.viewpoint, keep, told=planes)

        return work

    def fixed_facts(self, before: PointCloud, params: Params, told: Tensor) -> tuple[Params, OfClouds]:
        """Tell the planes, and find out where their surfaces end when somebody reads it."""
        had, left = counts_of(before.ptr), counts_of(params["ptr"])
        inliers = torch.tensor([a - b for a, b in zip(had, left)], dtype=torch.int64, device="cpu")
        found = {**params, "planes": told, "num_inliers": inliers}

        def entries() -> list[dict[str, Any]]:
            return [*self._entries(before, self._apart(before, told, negated(params["index"])) | found)]

        return found, MadeWhenRead(len(had), entries)

    def _entries(self, data: PointCloud, params: Params) -> MadeWhenRead:
        """Return what the meta of each cloud is told of its plane; most of it is found out when somebody reads it."""
        planes = params["planes"].detach().cpu().numpy()
        facts = plane_facts(data, planes, params["num_inliers"], self._surfaces(data, params))
        more = [self._judged(data, params, b, plane) for b, plane in enumerate(planes.tolist())]
        before = [[*meta.get("planes", ())] for meta in data.meta]

        def entries() -> list[dict[str, Any]]:
            return [
                {"planes": [*had, {**found, **judged}]}
                for had, found, judged in zip(before, facts(), more, strict=True)
            ]

        made = MadeWhenRead(len(more), entries)
        return made if "rms" in params else put_off(made)

    def _surfaces(self, data: PointCloud, params: Params) -> Callable[[], Surfaces]:
        """Return what tells the surfaces of planes: found out when it is asked, where nobody changes the points."""
        points, ptr, kept = data.points.detach(), data.ptr, params["index"]
        if "rms" in params:
            found = surfaces_seen(points, params["corners"], params["rms"])
            return lambda: found
        planes = params["planes"].cpu()
        return lambda: surfaces_seen(points, *plane_surfaces(points, ptr, negated(kept), planes, self.distance)[1:])

    def _judged(self, data: PointCloud, params: Params, b: int, plane: Sequence[float]) -> dict[str, Any]:
        """Return what is told of a plane beside where it is, and warn of what is odd about it."""
        found: dict[str, Any] = {"faces": self._faces(data, b, plane)}
        for name in ("noise", "disparity_noise"):
            if name in params and math.isfinite(value := float(params[name][b])):
                found[name] = value
        if "believed" in params:
            found["cut"] = self.cut if bool(params["believed"][b]) else "nothing"
            if found["cut"] != self.cut:
                warn_of_no_table(data, b, self.distance)
        if self.up is not None:
            found["tilt"] = self._tilt(plane)
            if self.tilt_alarm is not None and found["tilt"] > self.tilt_alarm:
                warn_of_tilt(data, b, found["tilt"], self.up, self.frame)
        return found


def _viewpoints(data: PointCloud) -> Tensor | None:
    """Return one place (B, 3) for every cloud where its sensors stood, the mean of several, or None."""
    if "viewpoint" not in data.extra:
        return data.viewpoint
    places = [
        part.mean(0) if len(part) else part.new_zeros(3) for part in data.extra["viewpoint"].split(counts_of(data.ptr))
    ]
    return torch.stack(places)
