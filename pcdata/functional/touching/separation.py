"""From a depth image of what stands on a table to objects, those that touch apart."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from pcdata.functional.image_grid import ImageGrid, is_lined
from pcdata.functional.rows import ptr_from_counts, transform_points
from pcdata.functional.touching.colors import with_colors
from pcdata.functional.touching.contacts import region_contacts
from pcdata.functional.touching.faces import Scene
from pcdata.functional.touching.joining import REASONS, Objects, join_hollows, join_occluded, merge_weak_contacts
from pcdata.functional.touching.limits import KINECT_NOISE, Limits
from pcdata.functional.touching.parts import parted_at_jumps
from pcdata.functional.touching.ramps import sharpened
from pcdata.functional.touching.regions import smooth_regions
from pcdata.functional.touching.windows import PixelCamera

_NOISE_STEP = 3  # pixels: neighbors share noise, and whole steps of the sensor
_NOISE_FACTOR = 1.75  # of the table's noise to that of second differences over 3 pixels, on 45 tables of a Kinect


class Cut(NamedTuple):
    """Two objects that touch, and how clearly they are two."""

    objects: tuple[int, int]
    strength: float  # mean over the contact, 0 to 1
    num_pixels: int  # length of the contact


class Join(NamedTuple):
    """Regions that are one object though their contact does not say so, or though they do not touch."""

    object: int
    why: str  # of REASONS


class Separation(NamedTuple):
    """The objects of one cloud."""

    label: Tensor  # (N,) int64, in the order of their lowest rows; -1 = in no region
    noise: float  # of 1/z, in 1/m, that limits were scaled with
    num_regions: int  # smooth ones that objects were made of
    cuts: tuple[Cut, ...]
    joins: tuple[Join, ...]


def separate_objects(
    points: Tensor,  # (N, 3) float32, what stands on the table and nothing else
    grid: ImageGrid,  # of one cloud
    *,
    height: Tensor | None = None,  # (N,) metres above the table
    noise: float | None = None,
    colors: Tensor | None = None,  # (N, 3) float in [0, 1]
    limits: Limits | None = None,
    backend: str = "auto",
) -> Separation:
    """Part the objects of one organized cloud where they touch.

    The image is cut into regions that are smooth inside. Two regions are one object unless their contact is concave, or
    steps, over its whole length on the mean. Then what lies inside a bowl is joined to it (where heights are given),
    and parts of one face that an object in front keeps apart.

    Args:
        points: in metres, rows in pixel order.
        grid: the image they lie on.
        height: above the table; without it bowls and cups may come apart into their inside and their wall.
        noise: standard deviation of 1/z, in 1/m, as measured on a table; None = from second differences of the points.
        colors: of the points, which make contacts stronger or weaker; None = geometry alone.
        limits: the numbers of the method; None = those of :mod:`pcdata.functional.touching.limits`.
        backend: which body of the pixel operations to run.
    """
    limits = limits or Limits()
    if len(points) == 0:
        return Separation(grid.pixel_index.new_zeros(0), noise or KINECT_NOISE, 0, (), ())
    objects, region = regions_of(points, grid, height, noise, limits, backend, colors)
    merge_weak_contacts(objects)
    join_hollows(objects)
    join_occluded(objects)
    lookup = torch.tensor([*objects.object_of, -1], dtype=torch.int64, device=points.device)
    label, names = in_order_of_rows(lookup[region])
    return Separation(
        label,
        objects.scene.noise,
        objects.scene.num_regions,
        tuple(
            Cut((names[a], names[b]), total / count, count)
            for (a, b), (total, count, _) in objects.contacts().items()
            if a in names and b in names
        ),
        tuple(
            Join(names[objects.object_of[region]], why)
            for region, why in objects.joins
            if objects.object_of[region] in names
        ),
    )


def regions_of(
    points: Tensor,
    grid: ImageGrid,
    height: Tensor | None,
    noise: float | None,
    limits: Limits,
    backend: str,
    colors: Tensor | None,
    *,
    over_jumps: bool = True,
) -> tuple[Objects, Tensor]:
    """Cut one image into smooth regions, each an object of its own as yet; also return the region (N,) of points.

    What no seed reaches but over a jump belongs to the region that does; without ``over_jumps`` to one of its own.
    """
    inverse, camera, pixel = _image(points, grid)
    lined = is_lined(pixel, (inverse.shape[0], inverse.shape[1]))
    if noise is None:
        noise = _measured_noise(_without_lines(inverse) if lined else inverse)
    # Nor is more told apart than pixels show: on a surface that leans by 45 degrees 1/z changes by as much in one.
    noise = max(noise, float(inverse[inverse > 0].median()) / camera.fx)
    if lined:
        inverse = _without_lines(inverse, 2 * limits.jump * noise)
    inverse = sharpened(inverse, camera, noise, limits)
    heights = None
    if height is not None:
        heights = torch.zeros_like(inverse)
        heights.view(-1)[pixel] = height.double()
    regions = smooth_regions(inverse, camera, noise, limits, backend=backend)
    if not over_jumps:
        regions = regions._replace(label=parted_at_jumps(inverse, regions.label, camera, noise, limits))
    contacts = region_contacts(inverse, regions.label, camera, noise, limits, backend=backend)
    if colors is not None:
        image = torch.zeros(inverse.numel(), 3, dtype=torch.float64, device=points.device)
        image[pixel] = colors.double()
        contacts = with_colors(contacts, regions.label, image)
    scene = Scene(inverse, regions.label, regions.normals, heights, contacts, camera, noise, limits)
    return Objects(scene), regions.label.view(-1)[pixel]


def _image(points: Tensor, grid: ImageGrid) -> tuple[Tensor, PixelCamera, Tensor]:
    """Return 1/z over the window of the image that the points fill, its camera, and the pixel of every point there."""
    seen = points
    if grid.camera_from_points is not None:
        seen = transform_points(points, ptr_from_counts([len(points)], device=points.device), grid.camera_from_points)
    width = grid.size[1]
    v, u = grid.pixel_index // width, grid.pixel_index % width
    top, left = int(v.min()), int(u.min())
    shape = int(v.max()) - top + 1, int(u.max()) - left + 1
    inverse = torch.zeros(shape, dtype=torch.float64, device=points.device)
    pixel = (v - top) * shape[1] + (u - left)
    inverse.view(-1)[pixel] = 1 / seen[:, 2].double()
    k = grid.intrinsics[0].double().cpu()
    fx, fy, cx, cy = (float(k[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return inverse, PixelCamera(fx, fy, cx - left, cy - top), pixel


def _without_lines(inverse: Tensor, most: float = math.inf) -> Tensor:
    """Fill single missing pixels between two that are there by their mean, along rows, along columns and once more.

    By the farther one where the two are more than ``most`` apart: two equal steps would look like a slope, not a jump.
    No surface that is followed rises by two jumps over two pixels, as noise is at least what one pixel shows.
    """
    filled = inverse.clone()
    for _ in range(2):
        for image in (filled, filled.T):
            before, here, after = image[:, :-2], image[:, 1:-1], image[:, 2:]
            missing = (here == 0) & (before > 0) & (after > 0)
            between = torch.where((before - after).abs() > most, torch.minimum(before, after), (before + after) / 2)
            here[missing] = between[missing]
    return filled


def _measured_noise(inverse: Tensor) -> float:
    """Return the noise of 1/z from what differs from the mean of the pixels three to the left and to the right."""
    step = _NOISE_STEP
    left, middle, right = inverse[:, : -2 * step], inverse[:, step:-step], inverse[:, 2 * step :]
    whole = (left > 0) & (middle > 0) & (right > 0)
    if not bool(whole.any()):
        return KINECT_NOISE
    bend = (left - 2 * middle + right)[whole].abs().median()
    return _NOISE_FACTOR * 1.4826 * float(bend) / 6**0.5


def in_order_of_rows(found: Tensor) -> tuple[Tensor, dict[int, int]]:
    """Number objects (n,) of 0, 1, ... by their first rows; -1 stays. Also return old -> new."""
    count = int(found.max()) + 1 if len(found) else 0
    rows = torch.arange(len(found), dtype=torch.int64, device=found.device)
    first = torch.full((count + 1,), len(found), dtype=torch.int64, device=found.device)
    first.scatter_reduce_(0, found + 1, rows, "amin")
    order = first[1:].argsort(stable=True)[: int((first[1:] < len(found)).sum())]
    number = torch.full_like(first, -1)
    number[order + 1] = torch.arange(len(order), dtype=torch.int64, device=found.device)
    return number[found + 1], dict(zip(order.tolist(), range(len(order))))


__all__ = ["REASONS", "Cut", "Join", "Separation", "in_order_of_rows", "separate_objects"]
