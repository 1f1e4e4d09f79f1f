"""Where labeled objects are and how large: centers, heights, boxes, hulls, outlines, and labels back on the image."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pcdata.errors import ConfigError, DTypeError, NoPlaneError, ShapeError
from pcdata.functional.areas import seen_areas
from pcdata.functional.boxes import smallest_box
from pcdata.functional.hulls import convex_hull_3d
from pcdata.functional.rectangles import smallest_rectangle
from pcdata.functional.selection import convex_hull, plane_axes
from pcdata.structures import PointCloud
from pcdata.transforms.found_planes import planes_in_cloud


@dataclass(frozen=True, kw_only=True)
class ObjectFacts:
    """One labeled object of a cloud, in the cloud's present coordinates and unit.

    Args:
        label: its label.
        num_points: how many points have it.
        area: of its surface as far as it was seen, in the square of the unit.
        centroid: (3,) float64 mean of its points.
        height: how far its highest point is above the table.
        box: (4, 4) float64 pose of the smallest box around it that stands upright on the table: origin in the middle,
            x along the longer side, z up.
        size: (3,) float64 edges of the box along its x, y, z.
        outline: (C, 3) float64 corners of the convex hull seen from above, on the table, counterclockwise from above.
        hull: (P, 3) float64 corners of the convex hull of its points in space.
        volume: of that hull, in the cube of the unit: less than the object's own where a side of it was not seen.
        tight_box: (4, 4) float64 pose of the smallest box around its points, turned in any way: origin in the middle, x
            along the longest edge, z along the shortest.
        tight_size: (3,) float64 edges of that box along its x, y, z.
    """

    label: int
    num_points: int
    area: float
    centroid: Tensor
    height: float
    box: Tensor
    size: Tensor
    outline: Tensor
    hull: Tensor
    volume: float
    tight_box: Tensor
    tight_size: Tensor


def describe_objects(cloud: PointCloud, b: int = 0, *, up: Tensor | None = None) -> list[ObjectFacts]:
    """Return what is known of every label from 0 up in cloud ``b``, in the order of labels.

    Upright boxes reach from the table to the top where the table is known: what a camera sees of an object ends above
    its foot. Hull, volume and tight box are of the points alone.

    Args:
        cloud: labeled points.
        b: which cloud of a batch.
        up: (3,) away from what the objects stand on, in the cloud's coordinates; None = the normal of the plane that
            RemovePlane found last. Given, heights are above the lowest point of all objects.

    Raises:
        DTypeError: the cloud has no labels.
        NoPlaneError: no plane was found in it and no ``up`` is given.
        ConfigError: ``up`` is no direction.
    """
    own = cloud[b]
    if own.labels is None:
        raise DTypeError("describe_objects: the cloud has no labels; put ClusterObjects before it")
    labeled = own.labels >= 0
    points, labels = own.points[labeled].detach().double().cpu(), own.labels[labeled].cpu()
    plane = _base(own, up, points)
    axes = plane_axes(plane)
    found = []
    names, number = own.labels.unique(return_inverse=True)  # labels may be any numbers
    areas = seen_areas(own.points, torch.where(labeled, number, -1), len(names), own.image_grid())[names >= 0]
    for label, area in zip(torch.unique(labels).tolist(), areas.tolist(), strict=True):
        rows = points[labels == label]
        height = rows @ plane[:3] + plane[3]
        flat = rows @ axes
        corners = flat[convex_hull(flat)]
        center, along, size = smallest_rectangle(flat)
        low, high = min(0.0, float(height.min())), float(height.max())
        box = torch.eye(4, dtype=torch.float64, device="cpu")
        x = axes @ along
        box[:3, :3] = torch.stack([x, torch.linalg.cross(plane[:3], x), plane[:3]], 1)
        hull = convex_hull_3d(rows)
        tight_box, tight_size = smallest_box(rows[hull.corners])
        foot = -plane[3] * plane[:3]  # the point of the plane that is nearest to the origin
        box[:3, 3] = foot + axes @ center + plane[:3] * (low + high) / 2
        found.append(
            ObjectFacts(
                label=label,
                num_points=len(rows),
                area=area,
                centroid=rows.mean(0),
                height=high,
                box=box,
                size=torch.cat([size, size.new_tensor([high - low])]),
                outline=foot + corners @ axes.T,
                hull=rows[hull.corners],
                volume=hull.volume,
                tight_box=tight_box,
                tight_size=tight_size,
            )
        )
    return found


def _base(cloud: PointCloud, up: Tensor | None, points: Tensor) -> Tensor:
    """Return the plane (4,) that objects stand on, its normal toward them."""
    if up is not None:
        direction = torch.as_tensor(up, dtype=torch.float64, device="cpu").detach()
        if direction.shape != (3,) or not bool(torch.isfinite(direction).all()) or float(direction.norm()) == 0:
            raise ConfigError(f"describe_objects: up must be (3,), finite and not zero, got {direction.tolist()}")
        direction = direction / direction.norm()
        lowest = (points @ direction).min() if len(points) else direction.new_zeros(())
        return torch.cat([direction, -lowest[None]])
    planes = planes_in_cloud(cloud)
    if not len(planes):
        raise NoPlaneError(
            "describe_objects: no plane was found in the cloud, so up is not known; put RemovePlane before it, or give "
            "up=(x, y, z)"
        )
    plane = planes[-1]
    above = points @ plane[:3] + plane[3]
    return -plane if len(above) and float(above.median()) < 0 else plane


def label_image(
    cloud: PointCloud, b: int = 0, *, size: tuple[int, int] | None = None, view: int | None = None
) -> Tensor:  # (H, W) int64
    """Return the labels of cloud ``b`` on the pixels of its depth image; -1 where no labeled point came from.

    Points that were dropped since leave -1: label before thinning out for a dense mask.

    Args:
        cloud: labeled points that know their pixels (``source_index``).
        b: which cloud of a batch.
        size: (height, width) of the image; None = as the cloud's layout says, which downsampled clouds have lost.
        view: of a cloud merged from several, whose pixels are counted on from view to view; None = it is one image's.

    Raises:
        DTypeError: the cloud has no labels, or does not know its pixels.
        ShapeError: no size is given and the cloud has none, or pixels lie outside of it.
    """
    own = cloud[b]
    if own.labels is None or own.source_index is None:
        lacks = "labels; put ClusterObjects before it" if own.labels is None else "source_index: it is of no image"
        raise DTypeError(f"label_image: the cloud has no {lacks}")
    if size is None:
        if own.layout is None:
            raise ShapeError(
                "label_image: the cloud no longer lies on its image, so its size is not known; give size=(height, "
                "width), or label before steps that thin out or merge"
            )
        size = own.layout.size
    num_pixels = size[0] * size[1]
    pixel, labels = own.source_index, own.labels
    if view is not None:
        seen = pixel // num_pixels == view
        pixel, labels = pixel[seen] % num_pixels, labels[seen]
    elif own.layout is not None:
        pixel = pixel % num_pixels
    if len(pixel) and not (int(pixel.min()) >= 0 and int(pixel.max()) < num_pixels):
        raise ShapeError(
            f"label_image: pixels up to {int(pixel.max())} do not lie in an image of {size[0]} x {size[1]}; give its "
            "size, or the view of a merged cloud"
        )
    image = torch.full((num_pixels,), -1, dtype=torch.int64, device=own.device)
    image[pixel] = labels
    return image.reshape(size)
