"""Groups of an image's points, region by region, with what is asked of them: size, plane, extent, what lies between."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from pcdata.functional.touching.contacts import Contacts
from pcdata.functional.touching.limits import RAMP, Limits
from pcdata.functional.touching.windows import PixelCamera

_SAMPLE = 150  # points of a face that distances are taken between
_FITTED = 4000  # points that a plane is fitted to
# Fitted anew twice without what is off by more than twice the RMS, as 5 % of noise are; few points stay as they are.
_FAR, _ROUNDS, _FEWEST = 2.0, 2, 50
_LINES = 16  # lines of sight between two faces
_ALONG = 11  # points on each


@dataclass(frozen=True, eq=False)
class Scene:
    """What is known of an image whose regions become objects; small tensors live on the CPU."""

    inverse: Tensor  # (H, W) float64, 1/z in 1/m, 0 = no reading
    label: Tensor  # (H, W) int64 region, -1 = none
    normals: Tensor  # (H, W, 3)
    height: Tensor | None  # (H, W) metres above the table
    contacts: Contacts
    camera: PixelCamera
    noise: float
    limits: Limits

    @cached_property
    def num_regions(self) -> int:
        """How many regions there are."""
        return int(self.label.max()) + 1 if self.label.numel() else 0

    @cached_property
    def pixels(self) -> list[Tensor]:
        """The pixels of every region, rising."""
        flat = self.label.flatten()
        order = torch.argsort(flat, stable=True)
        counts = torch.bincount(flat + 1, minlength=self.num_regions + 1).tolist()
        return list(order.split(counts)[1:])

    @cached_property
    def points(self) -> Tensor:
        """(H * W, 3) float64 points; 0 where there is no reading."""
        height, width = self.inverse.shape
        depth = torch.where(self.inverse > 0, 1 / torch.where(self.inverse > 0, self.inverse, 1.0), 0.0)
        x = (torch.arange(width, dtype=torch.float64, device=depth.device) - self.camera.cx) / self.camera.fx
        y = (torch.arange(height, dtype=torch.float64, device=depth.device) - self.camera.cy) / self.camera.fy
        return torch.stack([x[None] * depth, y[:, None] * depth, depth], dim=-1).reshape(-1, 3)

    def face(self, regions: Sequence[int]) -> Face:
        """Return the points of some regions together."""
        pixels = self.pixels[regions[0]] if len(regions) == 1 else torch.cat([self.pixels[r] for r in regions])
        return Face(self, pixels)

    def sides(self, region: int) -> list[int]:
        """Return how many sides of a region's pixels lie at no region, at region 0, 1, ..."""
        width = self.label.shape[1] + 2
        label = torch.nn.functional.pad(self.label, (1, 1, 1, 1), value=-1).flatten()
        pixels = self.pixels[region]
        place = (pixels // (width - 2) + 1) * width + pixels % (width - 2) + 1
        beside = torch.cat([label[place + step] for step in (-width, -1, 1, width)])
        return torch.bincount(beside[beside != region] + 1, minlength=self.num_regions + 1).tolist()

    def highest_up_ramps(self, pixels: Tensor) -> Tensor:
        """Return the largest height in their regions that ramps lead to from pixels (n,): the pixels' own, or more.

        A ramp comes nearer to the camera faster than any surface that is followed, over a dozen pixels at most. Of
        every so many-th pixel where there are many; only where the scene has heights.
        """
        assert self.height is not None
        pixels = pixels[:: max(1, len(pixels) // _SAMPLE)].to(self.label.device)
        height, width = self.label.shape
        offset = torch.arange(-RAMP, RAMP + 1, dtype=torch.int64, device=pixels.device)
        row, column = (pixels // width)[:, None, None] + offset[:, None], (pixels % width)[:, None, None] + offset
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        near = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
        label, inverse = self.label.flatten(), self.inverse.flatten()
        apart = (offset[:, None] ** 2 + offset**2).double().sqrt() * inverse[near] / self.camera.fx
        rise = inverse[near] - inverse[pixels][:, None, None]
        steep = rise > self.limits.jump * self.noise + self.limits.slope * apart
        steep[:, RAMP, RAMP] = True  # the pixel itself
        same = inside & (label[near] == label[pixels][:, None, None])
        return torch.where(same & steep, self.height.flatten()[near], -math.inf).flatten(1).amax(1)

    def seen_between(self, points: Tensor) -> tuple[float, float, float, float]:
        """Return which parts of points (K, 3) lie behind what is seen, on it, in front of it, and where nothing is."""
        height, width = self.inverse.shape
        z = points[:, 2]
        u = (points[:, 0] / z * self.camera.fx + self.camera.cx).round().to(torch.int64)
        v = (points[:, 1] / z * self.camera.fy + self.camera.cy).round().to(torch.int64)
        inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        found = torch.where(inside, self.inverse[v.clamp(0, height - 1), u.clamp(0, width - 1)], 0.0)
        seen = found > 0
        apart = torch.where(seen, 1 / torch.where(seen, found, 1.0) - z, 0.0)
        limit = max(0.008, 3 * self.noise * float(z.mean()) ** 2)  # metres; of single readings
        hidden, free = apart < -limit, apart > limit
        on = seen & ~hidden & ~free
        count = max(len(z), 1)
        return tuple(int(one.sum()) / count for one in (hidden, on, free, ~seen))  # type: ignore[return-value]


@dataclass(frozen=True, eq=False)
class Face:
    """Some points of a scene, and the plane through them."""

    scene: Scene
    pixels: Tensor

    @cached_property
    def points(self) -> Tensor:
        """(n, 3) float64."""
        return self.scene.points[self.pixels]

    @cached_property
    def sample(self) -> Tensor:
        """About 150 of them, evenly over the rows."""
        return self.points[:: max(1, len(self.points) // _SAMPLE)]

    @cached_property
    def area(self) -> float:
        """Square metres, each pixel as if it faced the camera."""
        depth = self.points[:, 2]
        return float((depth * depth).sum()) / (self.scene.camera.fx * self.scene.camera.fy)

    @cached_property
    def moments(self) -> tuple[int, Tensor, Tensor]:
        """Number, sum and sum of products of points evenly over the rows, without those far from the plane.

        At its border a sensor smears a face toward what is behind; those pixels would turn its plane.
        """
        points = self.points[:: max(1, len(self.points) // _FITTED)]
        moments = _moments(points)
        for _ in range(_ROUNDS):
            values, vectors = torch.linalg.eigh(_covariance(moments))
            apart = ((points - moments[1] / moments[0]) @ vectors[:, 0]).abs()
            near = apart <= _FAR * values[0].clamp(min=0).sqrt()
            if int(near.sum()) < _FEWEST:
                break
            moments = _moments(points[near])
        return moments

    @cached_property
    def center(self) -> Tensor:
        """(3,) mean point."""
        return self.moments[1] / self.moments[0]

    @cached_property
    def _axes(self) -> tuple[Tensor, Tensor]:
        values, vectors = torch.linalg.eigh(_covariance(self.moments))
        return values, vectors

    @cached_property
    def rms(self) -> float:
        """Root mean square distance from the plane, metres."""
        return math.sqrt(max(float(self._axes[0][0]), 0.0))

    @cached_property
    def normal(self) -> Tensor:
        """(3,) of the plane, toward the camera."""
        normal = self._axes[1][:, 0]
        return -normal if float(normal @ self.center) > 0 else normal

    @cached_property
    def heights(self) -> Tensor:
        """(n,) metres above the table; only where the scene has them."""
        assert self.scene.height is not None
        return self.scene.height.flatten()[self.pixels]

    @cached_property
    def top(self) -> float:
        """Height that 97 % of the points are below."""
        return float(self.heights.double().quantile(0.97))

    @cached_property
    def bottom(self) -> float:
        """Height that 97 % of the points are above."""
        return float(self.heights.double().quantile(0.03))

    @cached_property
    def hollow(self) -> tuple[float, float]:
        """Return how far the points rise over each other's tangent planes: mean sine, and the part that rises at all.

        Positive of a surface that is concave as a whole: the inside of a bowl, seen from above. Without the points
        whose surface leans more than any that is followed: there a sensor smears a rim toward what is behind it.
        """
        normals, points = self.scene.normals.reshape(-1, 3)[self.pixels], self.points
        faces = -(normals * points).sum(1) > math.cos(math.atan(self.scene.limits.slope)) * points.norm(dim=1)
        normals, points = normals[faces], points[faces]
        count = len(points)
        if count == 0:
            return 0.0, 0.0
        turn = torch.arange(1500, dtype=torch.int64, device=points.device)
        # Two strides that are prime: pairs from all over the face, the same on every device.
        one, other = turn * 7919 % count, (turn * 104729 + count // 2) % count
        way = points[other] - points[one]
        length = way.norm(dim=1)
        usable = length > 0.01
        if int(usable.sum()) < 100:
            return 0.0, 0.0
        rise = ((normals[one] * way).sum(1) / length.clamp(min=1e-9))[usable]
        return float(rise.mean()), float((rise > 0).double().mean())

    def joint_rms(self, other: Face) -> float:
        """Return the RMS distance from the plane through both."""
        (n, total, products), (m, other_total, other_products) = self.moments, other.moments
        values = torch.linalg.eigvalsh(_covariance((n + m, total + other_total, products + other_products)))
        return math.sqrt(max(float(values[0]), 0.0))

    def way_to(self, other: Face) -> tuple[float, Tensor]:
        """Return how near the two come, and points (K, 3) on lines between those parts that are nearest."""
        apart = torch.cdist(self.sample, other.sample)
        ends = []
        for distances, near, far, turned in (
            (apart, self.sample, other.sample, False),
            (apart.T, other.sample, self.sample, True),
        ):
            least, partner = distances.min(1)
            nearest = least.argsort(stable=True)[: max(4, len(near) // 6)]
            for i in nearest[:: max(1, len(nearest) // (_LINES // 2))].tolist():
                pair = (near[i], far[partner[i]])
                ends.append(torch.stack(pair[::-1] if turned else pair))
        lines = torch.stack(ends)
        part = torch.linspace(0.08, 0.92, _ALONG, dtype=torch.float64, device=lines.device)[None, :, None]
        between = lines[:, :1] + part * (lines[:, 1:] - lines[:, :1])
        return float(apart.min()), between.reshape(-1, 3)

    def overlap_across(self, other: Face) -> float:
        """Return which part of the narrower one lies beside the other, across the way from one to the other."""
        normal = self.normal + other.normal
        normal = normal / normal.norm()
        way = other.center - self.center
        way = way - normal * (normal @ way)
        across = torch.linalg.cross(normal, way / way.norm().clamp(min=1e-9))
        ends = torch.tensor([0.03, 0.97], dtype=torch.float64, device=across.device)
        a, b = ((face.sample @ across).quantile(ends).tolist() for face in (self, other))
        return (min(a[1], b[1]) - max(a[0], b[0])) / max(min(a[1] - a[0], b[1] - b[0]), 1e-9)


def _moments(points: Tensor) -> tuple[int, Tensor, Tensor]:
    return len(points), points.sum(0), points.T @ points


def _covariance(moments: tuple[int, Tensor, Tensor]) -> Tensor:
    count, total, products = moments
    mean = total / count
    return products / count - torch.outer(mean, mean)
