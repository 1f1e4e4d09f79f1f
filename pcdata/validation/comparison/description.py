"""One capture as the numbers that sources are compared by, and many of them in memory of some bytes a number."""

from __future__ import annotations

from array import array
from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.structures import CAMERA_FRAME, METRE, DepthFrame, PointCloud
from pcdata.transforms import Deproject, ToFrame
from pcdata.validation.comparison.clouds import measure_points
from pcdata.validation.comparison.colors import measure_colors
from pcdata.validation.comparison.depth_images import measure_depth
from pcdata.validation.comparison.scenes import Table, measure_scene

Key = tuple[str, int | None]  # what is measured, and of which view; None = of the whole

_UPRIGHT = (0.0, -1.0, -0.3)  # up, as a camera that is held upright and looks down a little has it
_Z_UP = (0.0, 0.0, 1.0)
_MOST_SCENE = 100_000  # points that tell the table and what is on it


@dataclass
class Description:
    """What one capture says."""

    facts: dict[str, str] = field(default_factory=dict)  # that hold or do not
    numbers: dict[Key, float] = field(default_factory=dict)
    tables: dict[int | None, Table] = field(default_factory=dict)  # in the frame of the poses, or of the cloud
    poses: dict[int | None, Tensor] = field(default_factory=dict)  # (4, 4) world_from_camera

    def add(self, numbers: dict[str, float], view: int | None) -> None:
        """Take numbers of a view."""
        self.numbers |= {(name, view): value for name, value in numbers.items()}


def describe(capture: DepthFrame | PointCloud) -> Description:
    """Measure one capture."""
    return _of_frame(capture) if isinstance(capture, DepthFrame) else _of_cloud(capture)


def as_cloud(frame: DepthFrame) -> PointCloud:
    """Return the points of all views, in the frame of their poses where they have some."""
    cloud = Deproject()(frame)
    return cloud if frame.frame_id is None else ToFrame(frame=frame.frame_id)(cloud)


def _of_frame(frame: DepthFrame) -> Description:
    told = Description(
        facts={
            "kind": "depth images",
            "views": str(frame.num_views),
            "size": f"{frame.size[1]} x {frame.size[0]}",
            "frame": frame.frame_id or CAMERA_FRAME,
            "colors": "no" if frame.colors is None else "yes",
        }
    )
    for view in range(frame.num_views):
        _add_view(told, frame.view(view), view)
    return told


def _add_view(told: Description, frame: DepthFrame, view: int) -> None:
    (fx, _, cx), (_, fy, cy), _ = frame.camera.intrinsics[0].tolist()
    height, width = frame.size
    depth = frame.depth[0].cpu().numpy()
    numbers = measure_depth(depth, abs(fx))
    numbers |= {
        "fov_x": float(np.degrees(2 * np.arctan(width / 2 / abs(fx)))),
        "fov_y": float(np.degrees(2 * np.arctan(height / 2 / abs(fy)))),
        "center_x": (cx + 0.5) / width,
        "center_y": (cy + 0.5) / height,
        "density": abs(fx * fy),
    }
    if frame.colors is not None:
        numbers |= measure_colors(frame.colors[0].reshape(-1, 3).cpu())
    told.add(numbers, view)
    if "median" not in numbers:
        return
    points = Deproject()(replace(frame, colors=None, labels=None, recorded_signals={})).points.cpu()
    points = points[:: max(1, len(points) // _MOST_SCENE)].contiguous()
    pose = None if frame.world_from_camera is None else frame.world_from_camera[0].cpu()
    up = _UPRIGHT if pose is None else tuple(pose[2, :3].tolist())
    table, things = measure_scene(points, likely_up=up, viewpoint=_origin(), distance=numbers["median"])
    told.add(things, view)
    if table is not None:
        told.add(_over_table(table), view)
        told.tables[view] = table if pose is None else _moved(table, pose)
    if pose is not None:
        told.poses[view] = pose


def _origin() -> Tensor:
    return torch.zeros(3, dtype=torch.float32, device="cpu")


def _over_table(table: Table) -> dict[str, float]:
    """Return where a camera at the origin stands over the table, and how it looks at it."""
    tilt = float(np.degrees(np.arccos(min(1.0, abs(float(table.plane[2]))))))
    return {"camera_height": abs(float(table.plane[3])), "camera_tilt": tilt}


def _moved(table: Table, pose: Tensor) -> Table:
    normal = pose[:3, :3] @ table.plane[:3]
    plane = torch.cat([normal, (table.plane[3] - normal @ pose[:3, 3])[None]])
    return Table(plane, pose[:3, :3] @ table.center + pose[:3, 3])


def _of_cloud(cloud: PointCloud) -> Description:
    told = Description(
        facts={
            "kind": "point clouds",
            "frame": cloud.frame_id,
            "unit": cloud.unit,
            "colors": "no" if cloud.colors is None else "yes",
        }
    )
    points = cloud.points.detach().cpu()
    points = points[torch.isfinite(points).all(1)]
    viewpoint = None
    if cloud.viewpoint is not None and len(cloud.viewpoint) == 1:
        viewpoint = cloud.viewpoint[0].detach().cpu()
    told.add(measure_points(points, viewpoint), None)
    if cloud.colors is not None:
        told.add(measure_colors(cloud.colors.detach().cpu()), None)
    if cloud.unit != METRE or not len(points):
        return told
    points = points[:: max(1, len(points) // _MOST_SCENE)].contiguous()
    in_camera = cloud.frame_id.startswith(CAMERA_FRAME)
    distance = told.numbers.get(("median", None), float((points - points.mean(0)).norm(dim=1).median()))
    table, things = measure_scene(
        points,
        likely_up=_UPRIGHT if in_camera else _Z_UP,
        viewpoint=viewpoint if not in_camera else _origin(),
        distance=distance,
    )
    told.add(things, None)
    if table is not None:
        told.tables[None] = table
        if in_camera:
            told.add(_over_table(table), None)
    return told


class Series:
    """The numbers of many captures, in their order."""

    def __init__(self) -> None:
        self.count = 0
        self.facts: dict[str, Counter[str]] = {}
        self._numbers: dict[Key, array[float]] = {}

    def add(self, told: Description) -> None:
        """Take one capture more."""
        for name, said in told.facts.items():
            self.facts.setdefault(name, Counter())[said] += 1
        rows: dict[Key, float] = dict(told.numbers)
        for view, table in told.tables.items():
            rows |= {(f"_plane_{k}", view): value for k, value in enumerate(table.plane.tolist())}
            rows |= {(f"_center_{k}", view): value for k, value in enumerate(table.center.tolist())}
        for view, pose in told.poses.items():
            rows |= {(f"_pose_{k}", view): value for k, value in enumerate(pose[:3].flatten().tolist())}
        for key, value in rows.items():
            column = self._numbers.setdefault(key, array("d"))
            column.extend([np.nan] * (self.count - len(column)))
            column.append(value)
        self.count += 1

    @property
    def keys(self) -> list[Key]:
        """What was measured, but for what others are made of."""
        return [key for key in self._numbers if not key[0].startswith("_")]

    def values(self, name: str, view: int | None) -> NDArray[np.float64]:
        """Return (captures,) values; NaN where a capture had none."""
        column = np.full(self.count, np.nan)
        given = self._numbers.get((name, view), ())
        column[: len(given)] = given
        return column

    def columns(self, name: str, count: int, view: int | None) -> NDArray[np.float64]:
        """Return (captures, count) of what has several numbers."""
        return np.stack([self.values(f"_{name}_{k}", view) for k in range(count)], 1)

    def set(self, name: str, view: int | None, values: NDArray[np.float64]) -> None:
        """Put what was derived from others."""
        if np.isfinite(values).any():
            self._numbers[name, view] = array("d", values.tolist())
