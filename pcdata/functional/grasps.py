"""Grasps of parallel-jaw grippers against a table and against points: angle of approach, clearance, collisions."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner
from pcdata.contracts.tensors import check_tensors
from pcdata.errors import ConfigError, PoseError, ShapeError
from pcdata.geometry.rigid import check_rigid
from pcdata.threads import at_once

Axis = Literal["x", "y", "z"]
_AXES = ("x", "y", "z")
LONGEST = 2.0  # metres of any part of a gripper, and from its origin to its tips
_EXTENTS, _FARTHEST = 10.0, 10.0  # of the points, metres: a grasp farther from all of them is of another unit or frame
_TOGETHER = 16  # grasps at a time: their offsets from 20,000 points stay in a cache


@dataclass(frozen=True, kw_only=True)
class ParallelJaw:
    """A gripper of two fingers and a palm, each a box, and the axes that grasps are written in; metres.

    Grasps are 4x4: the columns of the rotation are the axes of the gripper, the translation its origin. ``tip`` says
    where that origin is: the tips of the fingers are this far from it along the approach.

    Args:
        opening: between the open fingers; that of every grasp where none are given.
        finger_length: from the palm to the tips.
        finger_thickness: along the closing direction.
        finger_width: across both.
        palm_length: of the palm and what is behind it, along the approach.
        palm_span: of the palm along the closing direction; None = what the open fingers span.
        palm_width: across both; None = as the fingers.
        tip: from the origin of a grasp to the tips.
        approach: the axis that points from the palm to the tips.
        closing: the axis that the fingers move along.

    Raises:
        ConfigError: a length that is not positive or above 2, or one axis for both.
    """

    opening: float
    finger_length: float
    finger_thickness: float
    finger_width: float
    palm_length: float
    palm_span: float | None = None
    palm_width: float | None = None
    tip: float
    approach: Axis = "z"
    closing: Axis = "x"

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name in ("approach", "closing"):
                if value not in _AXES:
                    raise ConfigError(f"ParallelJaw: {field.name} must be one of {_AXES}, got {value!r}")
            elif value is not None and not (isinstance(value, (int, float)) and math.isfinite(value)):
                raise ConfigError(f"ParallelJaw: {field.name} must be a finite number of metres, got {value!r}")
            elif value is not None and field.name != "tip" and value <= 0:
                raise ConfigError(f"ParallelJaw: {field.name} must be more than 0, got {value!r}")
            elif value is not None and abs(value) > LONGEST:
                raise ConfigError(
                    f"ParallelJaw: {field.name} must be in metres, at most {LONGEST:g}, got {value!r}; is it in "
                    f"millimetres? Those are {value / 1000:g} m"
                )
        if self.approach == self.closing:
            raise ConfigError(f"ParallelJaw: approach and closing must be two axes, both are {self.approach!r}")

    def boxes(self, openings: Tensor, tips: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the lower and upper corners (4, G, 3) float64 of palm, two fingers and the room between them.

        The coordinates are along approach, closing direction and across both, from the origin of a grasp.

        Args:
            openings: (G,) metres.
            tips: (G,) metres from the origins to the tips; None = the gripper's own.
        """
        half = openings.double() / 2
        outer = half + self.finger_thickness
        tip = torch.full_like(half, self.tip) if tips is None else tips.double()
        start, across = tip - self.finger_length, torch.full_like(half, self.finger_width / 2)
        palm = outer if self.palm_span is None else torch.full_like(half, self.palm_span / 2)
        palm_across = across if self.palm_width is None else torch.full_like(half, self.palm_width / 2)
        lower = [
            torch.stack([start - self.palm_length, -palm, -palm_across], 1),
            torch.stack([start, -outer, -across], 1),
            torch.stack([start, half, -across], 1),
            torch.stack([start, -half, -across], 1),
        ]
        upper = [
            torch.stack([start, palm, palm_across], 1),
            torch.stack([tip, -half, across], 1),
            torch.stack([tip, outer, across], 1),
            torch.stack([tip, half, across], 1),
        ]
        return torch.stack(lower), torch.stack(upper)

    def axes(self, grasps: Tensor) -> Tensor:
        """Return (G, 3, 3) float64, in whose rows approach, closing direction and the one across both stand."""
        columns = grasps[:, :3, :3].double().mT
        approach, closing = columns[:, _AXES.index(self.approach)], columns[:, _AXES.index(self.closing)]
        return torch.stack([approach, closing, torch.linalg.cross(approach, closing)], 1)


class GraspChecks(NamedTuple):
    """What :func:`check_grasps` found of G grasps."""

    angle: (
        Tensor | None
    )  # (G,) float64 radians between the approach and straight down to the table; over pi/2: from below
    clearance: (
        Tensor | None
    )  # (G,) float64 metres from the table to the nearest corner of the gripper; negative = in it
    hits: Tensor  # (G,) int64 points inside palm or fingers
    held: Tensor  # (G,) int64 points between the fingers


def _check_near(where: str, points: Tensor, grasps: Tensor) -> None:
    """Require that one grasp lies within ten times the points' own extent of them, or within 10 m."""
    if not len(points) or not len(grasps):
        return
    lower, upper = (corner.double() for corner in points.aminmax(dim=0))
    origins = grasps[:, :3, 3].double()
    nearest = float(torch.linalg.vector_norm(origins - origins.clamp(lower, upper), dim=1).min())
    extent = float(torch.linalg.vector_norm(upper - lower))
    if nearest > max(_EXTENTS * extent, _FARTHEST):
        raise PoseError(
            f"{where}: the nearest of {len(grasps)} grasps lies {nearest:.0f} m from the points, which extend over "
            f"{extent:.2g} m; translations are metres in the frame of the points: are these millimetres?"
        )


def check_grasps(
    points: Tensor,  # (N, 3) float32
    *,
    grasps: Tensor,  # (G, 4, 4) float, frame_from_gripper in the coordinates of the points
    gripper: ParallelJaw,
    openings: Tensor | None = None,  # (G,) float, metres
    tips: Tensor | None = None,  # (G,) float, metres
    plane: Tensor | None = None,  # (4,) float64
) -> GraspChecks:
    """Check grasps against a table and against points, all in one frame and in metres.

    Points on the faces of the gripper's boxes are inside, in float64. The table is the whole plane, also
    beyond its edges.

    Args:
        points: what the gripper must not hit, and what it is to hold.
        grasps: rigid poses of the gripper, approaching along its own axis.
        gripper: its dimensions and axes.
        openings: between the fingers; None = the gripper's own. What exceeds that is refused.
        tips: from the origins of the grasps to the tips of the fingers, as GraspNet's depths; None = the gripper's own.
        plane: unit normal, away from the table, and offset; None = no table.

    Raises:
        PoseError: a grasp is not rigid; or all lie so far from the points that they are of another unit or frame.
        ConfigError: an opening that is not positive, or more than the gripper's; tips farther than 2 from the origin.
        ShapeError, DTypeError, NonFiniteError: an argument breaks the contract above.
    """
    where = "check_grasps"
    given = {"points": points, "grasps": grasps, "openings": openings, "tips": tips, "plane": plane}
    specs = {"points": "N 3", "grasps": "G 4 4 : float", "plane": "P : float64"}
    specs |= {"openings": "G : float", "tips": "G : float"}
    check_tensors(where, given, specs)
    if plane is not None and plane.shape != (4,):
        raise ShapeError(f"{where}: plane must be (4,), got {tuple(plane.shape)}")
    check_rigid(f"{where}: grasps", grasps)
    _check_near(where, points, grasps)
    wide = torch.full((len(grasps),), gripper.opening, dtype=torch.float64, device=grasps.device)
    if openings is not None:
        wide = openings.double()
        if bool(((wide <= 0) | (wide > gripper.opening * (1 + 1e-6))).any()):
            raise ConfigError(f"{where}: openings must be above 0 and at most the gripper's {gripper.opening:g}")
    if tips is not None and bool((tips.abs() > LONGEST).any()):
        raise ConfigError(f"{where}: tips must be in metres, at most {LONGEST:g}; are they in millimetres?")
    lower, upper = gripper.boxes(wide, tips)
    axes, origin = gripper.axes(grasps), grasps[:, :3, 3].double()
    angle = clearance = None
    if plane is not None:
        down = (axes @ plane[:3]).clamp(-1, 1)  # (G, 3): of each axis along the normal
        angle = torch.acos(-down[:, 0])
        # The corner of a box that is lowest along the normal takes, on each axis, the side that goes down.
        lowest = torch.minimum(lower * down, upper * down).sum(-1)[:3].amin(0)
        clearance = origin @ plane[:3] + plane[3] + lowest
    hits, held = points_in_grippers(points, axes, origin, lower, upper)
    return GraspChecks(angle, clearance, hits, held)


@inner
def points_in_grippers(
    points: Tensor,  # (N, 3) float32
    axes: Tensor,  # (G, 3, 3) float64
    origin: Tensor,  # (G, 3) float64
    lower: Tensor,  # (4, G, 3) float64, as ParallelJaw.boxes
    upper: Tensor,
    *,
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:  # (G,), (G,) int64
    """Count the points in palm or fingers, and between the fingers, of each gripper.

    Boxes hold their faces; fingers and the room between them do not hold the one at the palm, so none counts twice.
    """
    hits = torch.zeros(len(axes), dtype=torch.int64, device=points.device)
    held = torch.zeros_like(hits)
    wide = points.double()
    # Most points are near no gripper, which one product in float32 shows; the others are judged in float64.
    low, high = lower.amin(0), upper.amax(0)
    middle, half = (low + high) / 2, (high - low) / 2
    shift = (axes * origin[:, None]).sum(-1) + middle
    scale = float(wide.abs().max() if len(wide) else 0) + float(shift.abs().max() if len(shift) else 0)
    reach = (half + 1e-5 * (1 + scale)).float()
    columns = points.T.contiguous()
    for some in torch.arange(len(axes), dtype=torch.int64, device=points.device).split(
        at_once(points.device, _TOGETHER)
    ):
        rough = torch.matmul(axes[some].float(), columns).sub_(shift[some].float()[..., None]).abs_()
        gripper, row = (rough <= reach[some][..., None]).all(1).nonzero(as_tuple=True)
        one = some[gripper]
        dx, dy, dz = (wide[row] - origin[one]).unbind(1)
        place = [(dx * ax + dy * ay) + dz * az for ax, ay, az in (axis[one].unbind(1) for axis in axes.unbind(1))]
        for box in range(len(lower)):
            start, stop = lower[box, one].unbind(1), upper[box, one].unbind(1)
            inside = place[0] > start[0] if box else place[0] >= start[0]
            for along, begin, end in zip(place, start, stop):
                inside = inside & (along >= begin) & (along <= end)
            counts = torch.bincount(gripper[inside], minlength=len(some))
            (held if box == len(lower) - 1 else hits)[some] += counts
    return hits, held
