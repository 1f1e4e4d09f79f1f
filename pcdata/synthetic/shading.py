"""Colors for the picture: procedural materials, one soft sun, contact shade. Nothing measured depends on this file."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from pcdata.synthetic.raycast import Hits
from pcdata.synthetic.shapes import Shape
from pcdata.synthetic.viewpoints import GOLDEN_ANGLE

SUN = (-0.42, -0.30, 0.86)  # toward the light, base frame
SUN_SPREAD = 0.07  # half-width of the light, as the tangent of an angle: how soft the shadows are
SUN_SAMPLES = 8
RAYS_AT_ONCE = 8192
SUN_COLOR = (0.92, 0.87, 0.79)
SKY_LIGHT = (0.30, 0.33, 0.36)
SKY_COLOR = (0.62, 0.66, 0.72)  # where a ray meets nothing


def shade(shapes: Sequence[Shape], hits: Hits, eye: Tensor, directions: Tensor, focal: float) -> Tensor:
    """Return the (N, 3) uint8 sRGB color of what N rays from ``eye`` (1, 3) along ``directions`` (N, 3) met.

    ``focal`` in pixels says how wide a pixel is on a surface, so that thin lines fade with distance, not break up.
    """
    distance, facing, shape_index = hits
    seen = (shape_index >= 0).nonzero().squeeze(-1)
    points = (eye + distance[seen, None] * directions[seen]).float()
    normals, index = facing[seen].float(), shape_index[seen]
    toward_eye = -torch.nn.functional.normalize(directions[seen].float(), dim=-1)
    slant = (normals * toward_eye).sum(-1).clamp(min=0.05)
    pixel = distance[seen].float() / (focal * slant)  # metres

    surface = points.new_zeros(points.shape)
    for i, shape in enumerate(shapes):
        rows = (index == i).nonzero().squeeze(-1)
        surface[rows] = _albedo(shape, shape.in_object_frame(points[rows]), pixel[rows])
    sun = _unit(SUN, points)
    lit = ((normals @ sun).clamp(min=0.0) * _sunlight(shapes, points, normals, index))[:, None]
    sky = (_openness(shapes, points, normals, index) * (0.72 + 0.28 * normals[:, 2]))[:, None]
    halfway = torch.nn.functional.normalize(sun + toward_eye, dim=-1)
    gloss = ((normals * halfway).sum(-1).clamp(min=0.0) ** 60)[:, None] * (lit > 0)
    glossy = points.new_tensor([0.2 if shape.pattern == "band" else 0.02 for shape in shapes])[index, None]
    linear = surface * (lit * points.new_tensor(SUN_COLOR) + sky * points.new_tensor(SKY_LIGHT)) + glossy * gloss

    image = points.new_tensor(SKY_COLOR).expand(len(directions), 3).clone()
    image[seen] = linear
    return _encoded(image)


def own_colors(shapes: Sequence[Shape], hits: Hits) -> Tensor:
    """Return the (N, 3) uint8 sRGB color of what N rays met, without light and shadow: a tenth of the time."""
    table = torch.tensor([*(shape.color for shape in shapes), SKY_COLOR], dtype=torch.float32, device="cpu")
    _, _, shape_index = hits
    return _encoded(table).to(shape_index.device)[shape_index]  # -1, nothing, is the last


def _encoded(linear: Tensor) -> Tensor:
    return (linear.clamp(0.0, 1.0) ** (1 / 2.2) * 255.0).round().to(torch.uint8)


def _albedo(shape: Shape, local: Tensor, pixel: Tensor) -> Tensor:
    """Return (M, 3) linear RGB at points in the shape's own coordinates, seen by pixels (M,) metres wide."""
    base = local.new_tensor(shape.color).expand_as(local)
    if shape.pattern == "wood":
        return _wood(local, pixel)
    if shape.pattern == "tiles":
        cell = torch.floor(local[:, :2] / 0.5)
        from_joint = 0.25 - (local[:, :2] - 0.5 * cell - 0.25).abs().amax(-1)
        tone = 1.0 + 0.06 * _hash(cell[:, 0] + 37.0 * cell[:, 1])
        return base * (tone * (1.0 - 0.35 * _line(from_joint, 0.005, pixel)))[:, None]
    if shape.pattern == "band":
        half = shape.bounding_radius
        across = local[:, 2].abs() / half
        return torch.where((across < 0.16)[:, None], 0.25 * base + 0.62, base)
    return base


def _wood(local: Tensor, pixel: Tensor) -> Tensor:
    """Planks along x, each with its own tone, and a grain of wavering rings."""
    x, y = local[:, 0], local[:, 1]
    plank = torch.floor(y / 0.1)
    start = _hash(plank)
    ring = y * 95.0 + 1.3 * torch.sin(x * 4.1 + 5.0 * start) + 0.5 * torch.sin(x * 11.0 + 9.0 * start) + 9.0 * start
    grain = 0.5 + 0.5 * torch.sin(2.0 * math.pi * (0.16 * ring + 0.12 * torch.sin(ring)))
    fiber = torch.sin(y * 900.0 + 6.0 * torch.sin(x * 3.0 + start)) * torch.sin(x * 17.0 + 40.0 * start + y * 60.0)
    tone = 1.0 + 0.10 * start - 0.20 * grain + 0.03 * fiber
    from_seam = 0.05 - (y - 0.1 * plank - 0.05).abs()
    tone = tone * (1.0 - 0.5 * _line(from_seam, 0.001, pixel))
    return local.new_tensor((0.60, 0.385, 0.205)) * tone[:, None]


def _line(distance: Tensor, half_width: float, pixel: Tensor) -> Tensor:
    """Return the (M,) part of each pixel that a line of this half-width covers, ``distance`` (M,) from its middle."""
    covered = (half_width + 0.5 * pixel - distance) / pixel
    return covered.clamp(min=0.0).minimum((2.0 * half_width / pixel).clamp(max=1.0))


def _sunlight(shapes: Sequence[Shape], points: Tensor, normals: Tensor, index: Tensor) -> Tensor:
    """Return the (N,) part of a round sun that each point sees, by sampling its disc."""
    lifted = points + 2e-4 * normals  # float32 hits lie within 1e-6 m of the surface: start clear of it
    sun = _unit(SUN, points)
    side = torch.nn.functional.normalize(torch.linalg.cross(sun, _unit((0.0, 1.0, 0.0), sun)), dim=0)
    other = torch.linalg.cross(sun, side)
    samples = torch.arange(SUN_SAMPLES, dtype=torch.float64, device="cpu")
    radius, angle = SUN_SPREAD * ((samples + 0.5) / SUN_SAMPLES).sqrt(), samples * GOLDEN_ANGLE
    across = (radius * torch.stack([angle.cos(), angle.sin()])).T.to(points)  # (SUN_SAMPLES, 2)
    toward = sun + across @ torch.stack([side, other])
    dark = torch.zeros((SUN_SAMPLES, len(points)), dtype=torch.bool, device=points.device)
    facing = normals @ sun > 0
    for i, shape in enumerate(shapes):
        if shape.label < 0:
            continue  # nothing lies below the floor
        # No solid shades itself (all are convex), or a point from which its bounding sphere is clear of the sun's cone.
        along = (shape.center.to(points) - points) @ sun
        aside = (shape.center.to(points) - points - along[:, None] * sun).square() @ points.new_ones(3)
        reach = shape.bounding_radius + 1.5 * SUN_SPREAD * along.clamp(min=0.0)
        rows = (facing & (index != i) & (along > -reach) & (aside < reach * reach)).nonzero().squeeze(-1)
        if not len(rows):
            continue
        # Few rays are cast at once, since each call costs more than they do; many, sample by sample, stay in the cache.
        starts = lifted[rows]
        at_once = min(SUN_SAMPLES, max(1, RAYS_AT_ONCE // len(rows)))
        for first in range(0, SUN_SAMPLES, at_once):
            part = toward[first : first + at_once]
            met, _ = shape.intersect(starts.repeat(len(part), 1), part.repeat_interleave(len(rows), dim=0))
            dark[first : first + at_once, rows] |= torch.isfinite(met).reshape(len(part), -1)
    return 1.0 - dark.float().mean(0)


def _openness(shapes: Sequence[Shape], points: Tensor, normals: Tensor, index: Tensor) -> Tensor:
    """Return the (N,) part of the sky that the objects leave free, each taken as a ball.

    Source: Quilez, Sphere ambient occlusion: a ball of radius r at distance d hides cos(angle) * (r / d)^2.
    """
    free = points.new_ones(len(points))
    for i, shape in enumerate(shapes):
        if shape.label < 1:
            continue
        offset = shape.center.to(points) - points
        distance = offset.norm(dim=-1).clamp(min=1e-6)
        radius = 0.85 * float(shape.center[2])  # the ball that rests where the object rests
        facing = ((normals * offset).sum(-1) / distance).clamp(min=0.0)
        hidden = facing * (radius / distance.clamp(min=radius)) ** 2
        free *= torch.where(index == i, 1.0, 1.0 - 0.9 * hidden)
    return free


def _unit(vector: tuple[float, float, float], like: Tensor) -> Tensor:
    return torch.nn.functional.normalize(like.new_tensor(vector), dim=0)


def _hash(values: Tensor) -> Tensor:
    """Scatter whole numbers over [-1, 1)."""
    return 2.0 * torch.frac(torch.sin(values * 12.9898 + 4.1) * 437.585).abs() - 1.0
