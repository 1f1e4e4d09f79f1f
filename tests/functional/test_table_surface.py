"""Which points are the table, by its own bend and noise."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from pcdata.errors import NoPlaneError, ShapeError
from pcdata.functional import ImageGrid, supporting_plane, table_surface
from pcdata.functional.table_surface import window_medians
from pcdata.io import read_pcd
from pcdata.rng import seeded
from tests.tables import TABLE, box, rectangle

LEVEL = torch.tensor([[0.0, 0.0, 1.0, 0.0]], dtype=torch.float64)
SIZE = (120, 160)
K = torch.tensor([[[150.0, 0, 79.5], [0, 150.0, 59.5], [0, 0, 1]]], dtype=torch.float64)


def seen_table(
    *, noise: float = 0.0, bend: float = 0.0, low: float = 0.03, seed: int = 0, blocks: bool = True
) -> tuple[Tensor, Tensor, Tensor]:  # points (N, 3), whether each is the table's, heights (N,)
    """A camera 1 m over a table looks straight down: z is down, the table at z = 1, blocks ``low`` high on it.

    ``noise`` is that of 1/z, ``bend`` metres at the corners of the image.
    """
    v, u = torch.meshgrid(torch.arange(SIZE[0]).double(), torch.arange(SIZE[1]).double(), indexing="ij")
    x, y = (u - 79.5) / 150, (v - 59.5) / 150
    on_block = ((x - 0.1).abs() < 0.08) & ((y + 0.1).abs() < 0.06)
    on_block |= (u < 12) & (v > 90)  # at the border of the image
    on_block &= blocks
    height = torch.where(on_block, low, 0.0)
    depth = 1 - height + bend * (x**2 + 0.5 * x * y)
    depth = 1 / (1 / depth + noise * torch.randn(SIZE, generator=seeded(seed), dtype=torch.float64))
    points = torch.stack([x * depth, y * depth, depth], dim=-1).reshape(-1, 3).float()
    return points, ~on_block.reshape(-1), height.reshape(-1)


def grid_of(pixel: Tensor | None = None) -> ImageGrid:
    return ImageGrid(torch.arange(SIZE[0] * SIZE[1]) if pixel is None else pixel, SIZE, K)


FACING = torch.tensor([[0.0, 0.0, -1.0, 1.0]], dtype=torch.float64)


@pytest.mark.parametrize("organized", [True, False])
@pytest.mark.parametrize(("noise", "bend"), [(0.0, 0.0), (0.001, 0.008), (0.004, 0.0)])
def test_the_feet_of_blocks_stay_and_the_bent_noisy_table_goes(organized, noise, bend):
    points, table, _ = seen_table(noise=noise, bend=bend, low=0.03 if noise < 0.002 else 0.05)
    found = table_surface(
        points, planes=FACING, viewpoint=(0.0, 0.0, 0.0), grid=grid_of() if organized else None, distance=0.01
    )
    wrong = found.table != table
    assert float(wrong.float().mean()) < 0.01
    torch.testing.assert_close(found.planes, FACING, atol=0.012 if bend else 1e-3, rtol=0)


def test_noise_is_measured_and_heights_are_over_the_surface():
    points, table, height = seen_table(noise=0.002, bend=0.006)
    found = table_surface(points, planes=FACING, viewpoint=(0.0, 0.0, 0.0), grid=grid_of())
    assert float(found.disparity_noise[0]) == pytest.approx(
        0.002, rel=0.1
    )  # seen from 1 m: of 1/distance as of heights
    assert float(found.noise[0]) == pytest.approx(0.002, rel=0.15)
    off = (found.height.double() - height)[table]
    assert abs(float(off.median())) < 2e-4
    assert float((found.height.double() - height)[~table].median().abs()) < 1.5e-3


def test_without_a_viewpoint_noise_is_the_same_everywhere():
    table, block = rectangle(**TABLE, count=6000, noise=0.002), box((0.1, 0.2, 0.0), (0.1, 0.1, 0.1), count=1500)
    found = table_surface(torch.cat([table, block]), planes=LEVEL)
    assert float(found.noise[0]) == pytest.approx(0.002, rel=0.1)
    assert math.isnan(float(found.disparity_noise[0]))
    assert float(found.table[:6000].float().mean()) > 0.99
    assert float(found.table[6000:].float().mean()) < 0.1


def test_a_thin_thing_is_kept_where_the_sensor_shows_it_and_not_where_noise_hides_it():
    for noise, kept in ((0.0002, True), (0.002, False)):
        points, table, _ = seen_table(noise=noise, low=0.006)
        found = table_surface(points, planes=FACING, viewpoint=(0.0, 0.0, 0.0), grid=grid_of())
        share = float((~found.table)[~table].float().mean())
        assert share > 0.9 if kept else share == 0


def test_specks_are_the_table_whatever_the_resolution():
    """A block of 3 x 3 cm is something, one of 1 x 1 cm is not, of however many pixels they are."""
    for step in (1, 2):
        points, _, _ = seen_table(blocks=False)
        pixel = torch.arange(SIZE[0] * SIZE[1])
        v, u = pixel // SIZE[1], pixel % SIZE[1]
        for left, pixels in ((20, 6), (80, 2)):  # 6.7 mm each
            raised = (v >= 40) & (v < 40 + pixels) & (u >= left) & (u < left + pixels)
            points[raised, :] *= 0.95
        if step == 2:
            fine = torch.nn.functional.interpolate(points.T.reshape(1, 3, *SIZE), scale_factor=2).reshape(3, -1).T
            size, intrinsics = (240, 320), K.clone()
            intrinsics[:, :2] *= 2
            grid, points = ImageGrid(torch.arange(len(fine)), size, intrinsics), fine.contiguous()
        else:
            grid = grid_of()
        found = table_surface(points, planes=FACING, viewpoint=(0.0, 0.0, 0.0), grid=grid)
        image = ~found.table.reshape(grid.size)
        assert 30 * step**2 < int(image[:, : 60 * step].sum()) <= 36 * step**2  # medians round corners
        assert not bool(image[:, 60 * step :].any())


def test_a_table_without_anything_on_it_is_all_table_and_what_is_far_below_is_not():
    points, _, _ = seen_table(noise=0.001, blocks=False)
    below = torch.arange(len(points)) % SIZE[1] > 140
    points[below] *= 1.1
    found = table_surface(points, planes=FACING, viewpoint=(0.0, 0.0, 0.0), grid=grid_of())
    assert bool((found.table == ~below).all())


def test_heights_are_judged_by_the_lower_median_of_the_pixels_around():
    pixel = (torch.rand(SIZE[0] * SIZE[1], generator=seeded(0)) < 0.8).nonzero().squeeze(1)
    values = torch.rand(len(pixel), generator=seeded(1))
    image = torch.full(SIZE, torch.nan).reshape(-1)
    image[pixel] = values
    image = image.reshape(SIZE).numpy()
    found = window_medians(values, torch.zeros(len(pixel), 3), torch.tensor([0, len(pixel)]), grid_of(pixel))
    for row in range(0, len(pixel), 37):
        v, u = divmod(int(pixel[row]), SIZE[1])
        around = np.sort(image[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2], axis=None)
        around = around[~np.isnan(around)]
        assert float(found[row]) == around[(len(around) - 1) // 2]


def with_clutter(above: int, below: int) -> Tensor:
    """A level table of 6000 points with a noise of 2 mm, and so many points of walls within 4 cm of its level."""
    table = rectangle(**TABLE, count=6000, noise=0.002)
    walls = torch.rand(above + below, 3, generator=seeded(1)) - torch.tensor([0.5, 0.5, 0.0])
    walls[:, 2] = (walls[:, 2] * 0.04) * torch.cat([torch.ones(above), -torch.ones(below)])
    return torch.cat([table, walls])


def test_clutter_that_crosses_a_table_is_not_its_noise():
    for side in (0, 3000, 9000):  # 0, a third and the half of what lies within its noise
        found = table_surface(with_clutter(side, side), planes=LEVEL)
        assert bool(found.believed[0])
        assert float(found.noise[0]) == pytest.approx(0.002, rel=0.15)
    # What is on one side alone may be things that stand on it: it moves the median, but not without limit.
    found = table_surface(with_clutter(6000, 0), planes=LEVEL)
    assert 0.0018 < float(found.noise[0]) < 0.004


def test_a_surface_that_is_mostly_clutter_is_not_believed_and_none_of_it_is_the_table():
    points = with_clutter(60_000, 60_000)
    found = table_surface(points, planes=LEVEL)
    assert not bool(found.believed[0])
    assert not bool(found.table.any())
    assert torch.equal(found.flat, points[:, 2].abs() < 0.01)
    assert torch.equal(found.below, points[:, 2] <= -0.01)
    assert torch.equal(found.height, points[:, 2])
    assert torch.equal(found.planes, LEVEL)
    assert bool(found.noise.isnan().all())


@pytest.mark.parametrize("limit", [0.003, 0.006])
def test_noise_that_no_sensor_has_is_not_believed(limit):
    points, _, _ = seen_table(noise=0.004, low=0.05)
    found = table_surface(points, planes=FACING, viewpoint=(0.0, 0.0, 0.0), grid=grid_of(), max_noise=limit)
    assert bool(found.believed[0]) == (limit > 0.004)


def test_lines_of_missing_pixels_do_not_make_crumbs_of_things():
    points, table, _ = seen_table(noise=0.001, low=0.05)
    pixel = torch.arange(len(points))
    there = (pixel // SIZE[1] % 4 > 0) & (pixel % SIZE[1] % 5 > 0)
    found = table_surface(
        points[there], planes=FACING, viewpoint=(0.0, 0.0, 0.0), grid=grid_of(pixel[there]), distance=0.01
    )
    assert float((found.table != table[there]).float().mean()) < 0.01


def test_crumbs_go_with_the_table_and_are_no_part_of_its_surface():
    points, _, _ = seen_table(noise=0.001, blocks=False)
    points[5000:5002] *= 0.5
    found = table_surface(points, planes=FACING, viewpoint=(0.0, 0.0, 0.0), grid=grid_of())
    assert bool(found.table.all())
    assert not bool(found.flat[5000:5002].any())
    assert 0.97 < float(found.flat.float().mean()) < 1
    torch.testing.assert_close(found.planes, FACING, atol=1e-3, rtol=0)


def test_planes_that_are_none_are_refused():
    points = rectangle(**TABLE)
    with pytest.raises(NoPlaneError, match="normal that is not zero"):
        table_surface(points, planes=torch.zeros(1, 4, dtype=torch.float64))
    with pytest.raises(NoPlaneError, match="cloud 0: the plane has 0 points nearer than distance"):
        table_surface(points, planes=LEVEL - torch.tensor([[0.0, 0, 0, 5.0]], dtype=torch.float64))
    with pytest.raises(ShapeError, match="viewpoint must be"):
        table_surface(points, planes=LEVEL, viewpoint=(0.0, 1.0))


@pytest.mark.parametrize("name", ["learn19", "learn37"])
def test_the_table_of_a_kinect_is_found_to_a_hundredth(name, test_data: Path):
    cloud = read_pcd(test_data / "osd" / f"{name}.pcd")
    truth = cloud.labels // 10 == 0
    planes, _ = supporting_plane(cloud.points, likely_up=(0.0, -1.0, -0.3), probability=0.9999)
    found = table_surface(cloud.points, planes=planes, viewpoint=(0.0, 0.0, 0.0), grid=cloud.image_grid())
    hit = int((found.table & truth).sum())
    assert hit / int(found.table.sum()) > 0.99
    assert hit / int(truth.sum()) > 0.99
    assert 0.002 < float(found.disparity_noise[0]) < 0.003  # of a Kinect, in 1/m
