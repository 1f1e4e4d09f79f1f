"""Connected parts of depth images."""

from __future__ import annotations

from itertools import product

import pytest
import torch
from torch import Tensor

from pcdata.errors import ShapeError
from pcdata.functional import dbscan, image_clusters
from pcdata.rng import seeded

SIZE = (9, 14)


def scene(seed: int, share: float = 0.7) -> tuple[Tensor, Tensor]:
    """Points on some pixels of an image, and those pixels."""
    generator = seeded(seed)
    kept = torch.rand(SIZE[0] * SIZE[1], generator=generator) < share
    pixel = kept.nonzero().squeeze(1)
    depth = torch.randint(1, 4, (len(pixel),), generator=generator) * 0.5
    place = torch.stack([pixel % SIZE[1], pixel // SIZE[1]], 1) * 0.01
    return torch.cat([place, depth[:, None]], 1), pixel


def by_walking(points: Tensor, pixel: Tensor, eps: float, reach: int) -> list[int]:
    """Walk from the lowest unlabeled row to all that is linked, one after another."""
    row_of = {int(one): row for row, one in enumerate(pixel)}
    label, number = [-1] * len(points), 0
    for start in range(len(points)):
        if label[start] >= 0:
            continue
        stack = [start]
        while stack:
            row = stack.pop()
            if label[row] >= 0:
                continue
            label[row] = number
            v, u = divmod(int(pixel[row]), SIZE[1])
            for down, right in product(range(-reach, reach + 1), repeat=2):
                other = row_of.get((v + down) * SIZE[1] + u + right) if 0 <= u + right < SIZE[1] else None
                if other is not None and float((points[row] - points[other]).norm()) < eps:
                    stack.append(other)
        number += 1
    return label


@pytest.mark.parametrize("reach", [1, 2, 3])
def test_linked_pixels_share_a_label_in_the_order_of_their_lowest_rows(reach):
    for seed in range(2):
        clouds = [scene(seed, share) for share in (0.7, 0.3, 0.0, 1.0)]
        ptr = torch.tensor([0, *(len(points) for points, _ in clouds)]).cumsum(0)
        found = image_clusters(
            torch.cat([points for points, _ in clouds]),
            ptr,
            pixel_index=torch.cat([pixel for _, pixel in clouds]),
            size=SIZE,
            eps=0.2,
            reach=reach,
        )
        assert found.tolist() == [label for cloud in clouds for label in by_walking(*cloud, 0.2, reach)]


def test_without_gaps_it_labels_what_dbscan_labels():
    points, pixel = scene(3, 1.0)
    found = image_clusters(points, pixel_index=pixel, size=SIZE, eps=0.015)
    assert torch.equal(found, dbscan(points, eps=0.015, min_points=1))


def test_pixels_that_are_none_are_refused():
    points, pixel = scene(0)
    for wrong in (pixel.flip(0), pixel + SIZE[0] * SIZE[1], pixel - 30):
        with pytest.raises(ShapeError, match="image_clusters: pixel_index must increase"):
            image_clusters(points, pixel_index=wrong, size=SIZE)
