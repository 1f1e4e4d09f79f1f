"""Connected parts of depth images: points whose pixels are neighbors and that are near each other."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner, op
from pcdata.contracts.host import rising
from pcdata.contracts.numbers import checked_count, checked_image_size, checked_length
from pcdata.errors import ShapeError
from pcdata.functional.radius import squared_radius
from pcdata.functional.rows import cloud_of_rows

_WIDEST = 3  # pixels of a window that is looked at: holes of two


@inner
def linked_pixels(
    points: Tensor,
    ptr: Tensor,
    pixel_index: Tensor,
    size: tuple[int, int],
    eps: float,
    reach: int,
    *,
    backend: str = "auto",
) -> Tensor:
    """Return the labels that :func:`image_clusters` gives, of points on pixels (N,) of images of ``size``."""
    height, width = size
    cloud = cloud_of_rows(ptr)
    none = len(points)
    shape = len(ptr) - 1, height + 2 * reach, width + 2 * reach
    row_of = torch.full(shape, none, dtype=torch.int64, device=points.device)
    rows = torch.arange(none, dtype=torch.int64, device=points.device)
    v, u = pixel_index // width + reach, pixel_index % width + reach
    row_of[cloud, v, u] = rows
    limit = squared_radius(eps, points.device)
    pairs = []
    for down in range(reach + 1):
        for right in range(-reach, reach + 1):
            if down == 0 and right <= 0:
                continue  # each pair once
            other = row_of[cloud, v + down, u + right]
            there = other < none
            one, two = rows[there], other[there]
            dx, dy, dz = (points[one] - points[two]).unbind(1)
            near = ((dx * dx + dy * dy) + dz * dz) < limit
            pairs.append(torch.stack([one[near], two[near]]))
    return _numbered(lowest_rows(torch.cat(pairs, 1), none, points.device), ptr)


def lowest_rows(pairs: Tensor, count: int, device: torch.device) -> Tensor:
    """Return the lowest row of each row's connected part, given the pairs (2, E) that are linked."""
    lowest = torch.arange(count, dtype=torch.int64, device=device)
    while True:
        a, b = lowest[pairs[0]], lowest[pairs[1]]
        if bool((a == b).all()):
            return lowest
        # The roots of linked rows are joined, then every row is sent to the root of its root.
        smaller, larger = torch.minimum(a, b), torch.maximum(a, b)
        lowest.scatter_reduce_(0, larger, smaller, "amin")
        while not bool((lowest[lowest] == lowest).all()):
            lowest = lowest[lowest]


def _numbered(lowest: Tensor, ptr: Tensor) -> Tensor:
    """Number the parts of each cloud 0, 1, ... in the order of their lowest rows."""
    first = lowest == torch.arange(len(lowest), dtype=torch.int64, device=lowest.device)
    before = torch.cat([lowest.new_zeros(1), first.cumsum(0)])
    return before[lowest] - before[ptr[:-1]][cloud_of_rows(ptr)]


@op(
    points="N 3",
    ptr="ptr N B",
    pixel_index="N : int64",
    size=checked_image_size,
    eps=checked_length,
    reach=partial(checked_count, maximum=_WIDEST),
    steps=(linked_pixels,),
    gradient=False,
)
def image_clusters(
    points: Tensor,  # (N, 3) float32
    ptr: Tensor | None = None,  # (B+1,); None = one cloud
    *,
    pixel_index: Tensor,  # (N,) int64 row * width + column, increasing within a cloud
    size: tuple[int, int],
    eps: float = 0.02,
    reach: int = 1,
    backend: str = "auto",
) -> Tensor:  # (N,) int64 label
    """Label the connected parts of depth images: a fast stand-in for :func:`dbscan` while points lie on their image.

    Two points are linked where their pixels differ by at most ``reach`` in row and column and d < eps (strict, as
    ``d2 < float32(eps) * float32(eps)``); linked points share a label. Labels are 0, 1, ... in each cloud in the order
    of their lowest rows, and every point has one. What is near in space but not on the image, as a thing and what hides
    half of it, is not linked.

    Args:
        points: the clouds, in any unit of length.
        ptr: row pointers.
        pixel_index: where each point lies on its cloud's image, as :class:`ImageGrid` holds it.
        size: (height, width) of the images.
        eps: in the unit of the points.
        reach: pixels, 1 to 3: 2 bridges lines of one missing pixel.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        ConfigError: eps is not a positive length, or reach not 1 to 3.
        ShapeError: pixels outside the image, or not increasing within a cloud.
    """
    assert ptr is not None  # @op fills it
    height, width = size
    inside = (pixel_index >= 0) & (pixel_index < height * width)
    if not bool(inside.all()) or not rising(pixel_index, ptr):
        raise ShapeError(
            f"image_clusters: pixel_index must increase within each cloud and lie in 0..{height * width - 1}, the "
            "pixels of size; points that were reordered lie on no image"
        )
    label: Tensor = linked_pixels(points, ptr, pixel_index, size, eps, reach, backend=backend)
    return label
