"""Which of the planes of a cloud things stand on, and which is the table where nothing stands on any."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pcdata.functional.clusters import dbscan
from pcdata.functional.selection import over_hull, plane_axes

# A plane that leans away from up by 90 degrees or more counts a tenth of a level one.
_LEAST_LEAN = 0.1
# Of the distance: what makers of depth cameras allow theirs. A far floor is as thick as this.
_WORST_NOISE = 0.02
_LEVEL = 0.5  # cosine of a plane and a rough up
_NOTHING = 1e-3  # of a floor's area: a few stray voxels; a cube of 5 cm on 2 x 2 m is more
_PARALLEL = math.cos(math.radians(10))  # small planes are found to a few degrees
_LEAST_VIEW = 0.5  # of that of the floor; the top of a large box on a table reaches a third
# A table 3 m away fills a tenth of the image, and the floor the rest. A board over a desk stays below.
_LEAST_VIEW_OF_OPEN = 1 / 8
_OPEN = 0.1  # of a table's area: how much floor is seen beneath it


def chosen_plane(
    voxels: Tensor,  # (n, 3) means of the cloud's voxels, of edge 2 distance
    label: Tensor,  # (n,) int64 their planes, -1 = none
    planes: Tensor,  # (P, 4) float64 on the CPU, normals turned to the upper side
    up: Tensor | None,  # (3,) float64 on the CPU
    eye: Tensor | None,  # (3,) float64 on the CPU: where the sensor stood
    distance: float,
    backend: str,
) -> int:
    """Return the number of the plane that :func:`supporting_plane` describes."""
    if len(planes) == 1:
        return 0
    part = torch.zeros(0, dtype=torch.int64, device=voxels.device)
    rest = voxels[label < 0]
    if len(rest):  # two edges of a voxel: neighbors over a corner
        part = dbscan(rest, eps=4 * distance, min_points=1, backend=backend)
    backs = _backs(planes, up, eye)
    planes = planes.to(voxels.device)
    best = int(_scores(voxels, label, planes, up, backs, part, distance).argmax())
    return _higher(best, voxels, label, planes, None if eye is None else eye.to(voxels.device), part, distance)


def _backs(planes: Tensor, up: Tensor | None, eye: Tensor | None) -> list[bool]:
    """Say which planes are seen from below, as the front of a box by a steep camera: it only leans as up is rough.

    None where no level plane is seen from above, and none parallel to the most level of those: then the eye is wrong.
    """
    if up is None or eye is None:
        return [False] * len(planes)
    level, below = planes[:, :3] @ up, _heights(eye, planes.T) < 0
    best = int(torch.where(below, -math.inf, level).argmax())
    if bool(below[best]) or float(level[best]) < _LEVEL:
        return [False] * len(planes)
    return (below & (planes[:, :3] @ planes[best, :3] < _PARALLEL)).tolist()


def _scores(
    voxels: Tensor,
    label: Tensor,
    planes: Tensor,
    up: Tensor | None,
    backs: list[bool],
    part: Tensor,
    distance: float,
) -> Tensor:  # (P,) float64 on the CPU
    """Score planes by their area, by what stands on them and by how level they are; their backs bear nothing."""
    rest = voxels[label < 0]
    scores = []
    for number, (plane, is_back) in enumerate(zip(planes, backs)):
        own = voxels[label == number]
        standing = 0
        if len(rest) and not is_back:
            height = _heights(rest, plane)
            over = over_hull(rest, own, plane, 2 * distance)
            # What is no higher than 3 distances may be noise of the plane.
            standing = _standing(height, over, part, 3 * distance, 4 * distance)
        level = 1.0 if up is None else _LEAST_LEAN + (0.0 if is_back else max(0.0, float(plane[:3].cpu() @ up)))
        scores.append(len(own) * (1 + standing) * level)
    return torch.tensor(scores, dtype=torch.float64, device="cpu")


def _higher(
    best: int, voxels: Tensor, label: Tensor, planes: Tensor, eye: Tensor | None, part: Tensor, distance: float
) -> int:
    """Return the highest plane over the best one that is a table while nothing stands on the best; else the best."""
    floor, height = planes[best], _heights(voxels, planes[best])
    noise = torch.full_like(height, 3 * distance)
    if eye is not None:
        noise = torch.maximum(noise, _WORST_NOISE * (voxels.double() - eye).norm(dim=1))
    level, higher = label == best, []
    for number in range(len(planes)):
        own = label == number
        if number == best or float(planes[number, :3] @ floor[:3]) < _PARALLEL:
            continue
        rise, least = float(height[own].median()), float(noise[own].median()) + distance
        if abs(rise) <= least:
            level |= own  # a noisy floor is several planes
        elif rise > 0 and (eye is None or _heights(eye, planes[number]) > 0):
            higher.append((rise, number))
    ground = voxels[level]
    tables = [
        (rise, number)
        for rise, number in higher
        if _is_table(voxels[label == number], ground, planes[number], floor, eye, distance)
    ]
    if not tables:
        return best
    rest, free = voxels[label < 0], label < 0
    if len(rest):
        over = over_hull(rest, ground, floor, 2 * distance)
        for _, number in tables:  # what is beneath them bears them
            beneath = over_hull(rest, voxels[label == number], planes[number], 2 * distance)
            over &= ~(beneath & (_heights(rest, planes[number]) < 0))
        if _standing(height[free], over, part, noise[free], noise[free] + distance) > _NOTHING * len(ground):
            return best
    return max(tables)[1]


def _is_table(
    own: Tensor, ground: Tensor, plane: Tensor, floor: Tensor, eye: Tensor | None, distance: float
) -> bool:  # of a plane above another
    """Say whether a plane is large enough in the view, beside the plane below it, to be no top of a thing on that."""
    share = _view(own, plane, eye, distance) / _view(ground, floor, eye, distance)
    if share >= _LEAST_VIEW:
        return True
    if share < _LEAST_VIEW_OF_OPEN:
        return False
    return _beneath(ground, own, plane, 4 * distance) >= _OPEN * len(own)


def _beneath(ground: Tensor, own: Tensor, plane: Tensor, edge: float) -> int:
    """Count the voxels of the ground that lie under others of a plane, and not at the rim of those.

    Those are under cells that the plane fills with all cells around them: a frame has none, and hides nothing.
    """
    axes = plane_axes(plane)
    flat, flat_ground = own.double() @ axes, ground.double() @ axes
    low, high = flat.amin(0), flat.amax(0)
    flat_ground = flat_ground[((flat_ground >= low) & (flat_ground <= high)).all(1)]
    rows, columns = (int(cells) + 1 for cells in ((high - low) / edge).tolist())
    cells = torch.zeros(rows, columns, dtype=torch.float32, device=own.device)
    place = ((flat - low) / edge).long()
    cells[place[:, 0], place[:, 1]] = 1
    outside = torch.nn.functional.pad(cells, (1, 1, 1, 1))
    inner = torch.nn.functional.avg_pool2d(outside[None, None], 3, stride=1)[0, 0] > 0.99
    place = ((flat_ground - low) / edge).long()
    return int(inner[place[:, 0], place[:, 1]].sum())


def _view(own: Tensor, plane: Tensor, eye: Tensor | None, distance: float) -> float:
    """Return how much of the view voxels of a plane fill, up to a factor: solid angle, or area without an eye."""
    if eye is None:
        return float(len(own))
    reach = (own.double() - eye).norm(dim=1).clamp(min=2 * distance)
    return float((_heights(eye, plane).abs() / reach**3).sum())


def _heights(points: Tensor, plane: Tensor) -> Tensor:
    return points.double() @ plane[:3] + plane[3]


def _standing(height: Tensor, over: Tensor, part: Tensor, rise: Tensor | float, foot: Tensor | float) -> int:
    """Count the voxels that stand on a plane, less those below it: noise lies on both sides, nothing stands below."""
    return max(0, _rising(height, over, part, rise, foot) - _rising(-height, over, part, rise, foot))


def _rising(height: Tensor, over: Tensor, part: Tensor, rise: Tensor | float, foot: Tensor | float) -> int:
    """Count the voxels above a plane, over its hull, of parts that reach down to it and rise from it."""
    above = over & (height > 0)
    nothing = torch.zeros(int(part.max()) + 1, dtype=torch.bool, device=height.device)
    rises = nothing.index_put((part[above & (height > rise)],), nothing.new_ones(()))
    touches = nothing.index_put((part[above & (height < foot)],), nothing.new_ones(()))
    return int((above & (rises & touches)[part]).sum())
