"""What the page's viewer shows of one sample: its cloud after each step, and lines around it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pcdata.errors import PcdataError
from pcdata.report.html.packing import PackedCloud, pack_cloud
from pcdata.structures import METRE, DepthFrame, PointCloud
from pcdata.transforms import CropWorkspace, Transform, describe_objects
from pcdata.transforms.found_planes import plane_hulls_in_cloud

MOST_POINTS = 200_000  # of one cloud: what a laptop's graphics turn without a stutter
# Corners of a box, low before high along each axis, and the pairs of them that an edge joins.
_CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float64)
_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if (_CORNERS[a] != _CORNERS[b]).sum() == 1]
_LEAST_NEAR = 0.1  # of the points on either side of a gap
_TWO_CLASSES = 0.8  # of the variance that two classes explain: 0.75 of points spread evenly
_AXES = {"x": "#e5484d", "y": "#30a46c", "z": "#3e63dd"}


@dataclass(frozen=True)
class Lines:
    """Segments of one thing that is drawn around the points and can be switched off."""

    name: str
    color: str
    segments: NDArray[np.float64]  # (2 S, 3) ends, two for a segment


@dataclass(frozen=True)
class Stage:
    """The cloud after one step."""

    caption: str
    cloud: PackedCloud
    lines: tuple[Lines, ...]


@dataclass(frozen=True)
class SampleScene:
    """One sample: the stages of its way through a pipeline, in order."""

    name: str
    stages: tuple[Stage, ...]


def stage_of(
    caption: str,
    cloud: PointCloud,
    *,
    step: Transform | None = None,
    grasps: torch.Tensor | None = None,
    most_points: int = MOST_POINTS,
    total: int | None = None,
) -> Stage:
    """Return a cloud with all that is known of where it lies.

    Args:
        caption: what the page calls it.
        cloud: one cloud, or a batch in one frame.
        step: what made it; of a crop the box is drawn.
        grasps: (G, 4, 4) poses in the cloud's frame, x between the fingers and z toward the object; drawn as forks.
        most_points: drawn of it.
        total: how many points it had before it was thinned; None = as many as it has.
    """
    packed = pack_cloud(cloud, most_points=most_points)
    packed.said["total"] = cloud.num_points if total is None else total
    low, high = _bounds(cloud)
    extent = float(np.linalg.norm(high - low)) or 1.0
    lines = [*_axes(extent), *_frusta(cloud, extent), *_objects(cloud), *surroundings(cloud, step)]
    if grasps is not None and len(grasps):
        lines.append(_forks(grasps.detach().cpu().double().numpy()))
    packed.said["up"] = _up(cloud)
    packed.said["view"] = _view(cloud, low, high)
    return Stage(caption, packed, tuple(lines))


def surroundings(cloud: PointCloud, step: Transform | None = None) -> list[Lines]:
    """Return the outlines of the planes that were found in a cloud, and the box of the crop that made it."""
    lines = _planes(cloud)
    if isinstance(step, CropWorkspace) and step.frame == cloud.frame_id:
        lines.append(_box("workspace", "#8e4ec6", np.array(step.lower), np.array(step.upper)))
    return lines


def stages_of(
    clouds: Sequence[tuple[Transform, PointCloud]], *, most_points: int = MOST_POINTS
) -> tuple[Stage, ...]:  # of Compose.step_through
    """Return the clouds that a chain left after its steps, of each at most so many points."""
    return tuple(
        stage_of(f"{place}. {type(step).__name__}", cloud, step=step, most_points=most_points)
        for place, (step, cloud) in enumerate(clouds, 1)
    )


def raw_cloud(frame: DepthFrame) -> PointCloud:
    """Return what a capture shows in space, all views in one frame where their poses are known."""
    from pcdata.transforms import Deproject, ToFrame

    cloud = Deproject()(frame)
    if frame.frame_id is not None and frame.world_from_camera is not None:
        cloud = ToFrame(frame=frame.frame_id)(cloud)
    return cloud


def _bounds(cloud: PointCloud) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where most points are: neither strays nor a floor and walls far behind make the rest small."""
    points = cloud.points.detach().cpu()
    if not len(points):
        return -np.ones(3), np.ones(3)
    stride = max(1, len(points) // 20_000)
    some = points[::stride].double().numpy()
    if (seen_from := cloud.viewpoint_per_point()) is not None:
        some = some[_foreground(np.linalg.norm(some - seen_from[::stride].detach().cpu().double().numpy(), axis=1))]
    low, high = np.quantile(some, [0.1, 0.9], axis=0)
    low, high = low - 0.25 * (high - low), high + 0.25 * (high - low)
    all_low, all_high = (end.double().numpy() for end in points.aminmax(dim=0))
    low, high = np.maximum(low, all_low), np.minimum(high, all_high)
    reaches_farther = np.linalg.norm(all_high - all_low) > 1.5 * np.linalg.norm(high - low)
    return (low, high) if reaches_farther else (all_low, all_high)


def _foreground(distance: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return what is near, where the distances from the cameras fall into near and far; else all.

    Source: Otsu, A threshold selection method from gray-level histograms, IEEE Trans. SMC 9(1), 1979.
    """
    everything = np.ones(len(distance), dtype=bool)
    logs = np.log(np.maximum(distance, 1e-9))
    counts, edges = np.histogram(logs, bins=64)
    share = counts.cumsum() / len(logs)
    middles = (edges[1:] + edges[:-1]) / 2
    total = float((counts * middles).sum() / len(logs))
    below = (counts * middles).cumsum() / len(logs)
    with np.errstate(divide="ignore", invalid="ignore"):
        between = (total * share - below) ** 2 / (share * (1 - share))
    between[(share < _LEAST_NEAR) | (share > 1 - _LEAST_NEAR)] = 0.0
    place = int(between.argmax())
    if between[place] <= _TWO_CLASSES * logs.var():
        return everything
    return np.asarray(logs <= edges[place + 1])


def _is_camera(cloud: PointCloud) -> bool:
    return cloud.frame_id.startswith("camera")


def _up(cloud: PointCloud) -> list[float]:
    return [0.0, -1.0, 0.0] if _is_camera(cloud) else [0.0, 0.0, 1.0]


def _view(cloud: PointCloud, low: NDArray[np.float64], high: NDArray[np.float64]) -> dict[str, list[float]]:
    # From the lens, a little aside and above, so that depth is seen; else obliquely from above.
    toward = [0.25, -0.35, -1.0] if _is_camera(cloud) else [0.6, -1.0, 0.8]
    return {"lower": low.tolist(), "upper": high.tolist(), "up": _up(cloud), "toward": toward}


def _axes(extent: float) -> list[Lines]:
    length = 0.15 * extent
    return [
        Lines(f"{name} axis", color, np.array([np.zeros(3), length * np.eye(3)[a]]))
        for a, (name, color) in enumerate(_AXES.items())
    ]


def _box(name: str, color: str, low: NDArray[np.float64], high: NDArray[np.float64]) -> Lines:
    corners = low + _CORNERS * (high - low)
    return Lines(name, color, corners[np.array(_EDGES).reshape(-1)])


def _frusta(cloud: PointCloud, extent: float) -> list[Lines]:
    """The cameras that the cloud was seen by, as far as their poses lead into its frame."""
    segments = []
    for b, meta in enumerate(cloud.meta):
        cloud_from_source = np.linalg.inv(cloud.source_from_cloud[b].cpu().numpy())
        for camera in meta.get("cameras") or ():
            if cloud.unit != METRE or not camera.get("size"):
                continue
            pose = camera.get("world_from_camera")
            if cloud.source_frame.startswith("camera") and len(meta["cameras"]) == 1:
                frame_from_camera = cloud_from_source  # the source frame is this camera's
            elif pose is not None and camera.get("world_frame") == cloud.frame_id:
                frame_from_camera = np.array(pose, dtype=np.float64).reshape(4, 4)
            else:
                continue
            segments.append(_frustum(camera, frame_from_camera, 0.08 * extent))
    return [Lines("cameras", "#978365", np.concatenate(segments))] if segments else []


def _frustum(camera: dict[str, Any], frame_from_camera: NDArray[np.float64], far: float) -> NDArray[np.float64]:
    height, width = camera["size"]
    inverse = np.linalg.inv(np.array(camera["intrinsics"], dtype=np.float64).reshape(-1, 3, 3)[0])
    pixels = np.array(
        [[-0.5, -0.5, 1], [width - 0.5, -0.5, 1], [width - 0.5, height - 0.5, 1], [-0.5, height - 0.5, 1]]
    )
    corners = far * pixels @ inverse.T
    ends = [point for a in range(4) for point in (np.zeros(3), corners[a], corners[a], corners[(a + 1) % 4])]
    return np.array(ends) @ frame_from_camera[:3, :3].T + frame_from_camera[:3, 3]


def _planes(cloud: PointCloud) -> list[Lines]:
    lines = []
    for b in range(len(cloud.meta)):
        for number, hull in enumerate(plane_hulls_in_cloud(cloud, b)):
            ring = hull.numpy()
            if len(ring) > 2:
                ends = np.stack([ring, np.roll(ring, -1, axis=0)], axis=1).reshape(-1, 3)
                lines.append(Lines(f"plane {number}", "#e2a336", ends))
    return lines


def _objects(cloud: PointCloud) -> list[Lines]:
    """Boxes that stand on the table, where objects were told apart on one."""
    if cloud.labels is None or len(cloud.meta) != 1 or "objects" not in cloud.meta[0]:
        return []
    try:
        objects = describe_objects(cloud)
    except PcdataError:  # no plane was found: boxes would stand on nothing
        return []
    segments = []
    for one in objects:
        box, size = one.box.numpy(), one.size.numpy()
        corners = (_CORNERS - 0.5) * size @ box[:3, :3].T + box[:3, 3]
        segments.append(corners[np.array(_EDGES).reshape(-1)])
    return [Lines("objects", "#d6409f", np.concatenate(segments))] if segments else []


def _forks(poses: NDArray[np.float64], width: float = 0.08, depth: float = 0.06) -> Lines:
    half = width / 2
    fork = np.array([[-half, 0, depth], [-half, 0, 0], [-half, 0, 0], [half, 0, 0], [half, 0, 0], [half, 0, depth]])
    fork = np.concatenate([fork, [[0, 0, 0], [0, 0, -depth]]])
    ends = np.einsum("gij,kj->gki", poses[:, :3, :3], fork) + poses[:, None, :3, 3]
    return Lines("grasps", "#12a594", ends.reshape(-1, 3))
