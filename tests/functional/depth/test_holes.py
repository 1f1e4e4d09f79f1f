"""Hole filling, against the rules written out pixel by pixel."""

from __future__ import annotations

import pytest
import torch

from pcdata.errors import CaptureError, ConfigError
from pcdata.functional import fill_holes, fill_rows
from pcdata.functional.depth.holes import RULES
from pcdata.rng import seeded


def image_with_holes(share: float, seed: int = 0) -> torch.Tensor:
    depth = 0.5 + torch.rand(2, 23, 31, generator=seeded(seed))
    depth[torch.rand(depth.shape, generator=seeded(seed + 1)) < share] = 0
    depth[0, 6:14, 5:17] = 0
    return depth


def filled_by_layers(depth: torch.Tensor, best) -> tuple[torch.Tensor, torch.Tensor]:
    """Fill one image, a layer at a time, a pixel at a time."""
    image, distance = depth.clone(), torch.zeros(depth.shape, dtype=torch.int64)
    height, width = depth.shape
    step = 0
    while True:
        step += 1
        layer = {}
        for row, column in (image == 0).nonzero().tolist():
            around = [(row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)]
            near = [image[r, c].item() for r, c in around if 0 <= r < height and 0 <= c < width and image[r, c] > 0]
            if near:
                layer[row, column] = best(near)
        if not layer:
            return image, distance
        for place, value in layer.items():
            image[place], distance[place] = value, step


@pytest.mark.parametrize("share", [0.05, 0.6, 0.97])
@pytest.mark.parametrize(("rule", "best"), [("farthest", max), ("nearest", min)])
def test_holes_are_filled_from_the_rim_inwards(rule, best, share):
    depth = image_with_holes(share)
    filled, distance = fill_holes(depth, rule=rule)
    for view in range(2):
        expected, steps = filled_by_layers(depth[view], best)
        assert torch.equal(filled[view], expected)
        assert torch.equal(distance[view], steps)


@pytest.mark.parametrize("share", [0.05, 0.6, 0.97])
def test_left_copies_the_last_reading_of_the_row(share):
    depth = image_with_holes(share)
    filled, distance = fill_holes(depth, rule="left")
    for row, found, steps in zip(depth.flatten(0, 1), filled.flatten(0, 1), distance.flatten(0, 1)):
        last, age = 0.0, 0
        for value, out, step in zip(row.tolist(), found.tolist(), steps.tolist()):
            last, age = (value, 0) if value > 0 else (last, age + 1)
            assert out == last
            assert step == (age if last > 0 else 0)


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("max_size", [None, 2])
def test_readings_stay_and_what_was_filled_is_known(rule, max_size):
    depth = image_with_holes(0.3)
    filled, distance = fill_holes(depth, rule=rule, max_size=max_size)
    assert torch.equal(filled[depth > 0], depth[depth > 0])
    assert torch.equal((filled > 0) & (depth == 0), distance > 0)
    assert bool((distance > 0).any())


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("max_size", [1, 3, 5])
def test_only_places_as_narrow_as_max_size_are_filled(rule, max_size):
    depth = torch.ones(1, 30, 60)
    widths = {1: 3, 3: 10, 4: 20, 5: 30, 8: 42}  # a square hole of every width, at a column
    for width, column in widths.items():
        depth[0, 5 : 5 + width, column : column + width] = 0
    depth[0, 20:22, 5:50] = 0  # a slit two pixels high
    filled, _ = fill_holes(depth, rule=rule, max_size=max_size)
    for width, column in widths.items():
        hole = filled[0, 5 : 5 + width, column : column + width]
        assert bool((hole > 0).all()) == (width <= max_size)
        assert bool((hole > 0).any()) == (width <= max_size)
    assert bool((filled[0, 20:22, 5:50] > 0).all()) == (max_size >= 2)


def test_farthest_takes_the_background_and_nearest_the_foreground():
    depth = torch.where(torch.arange(20) < 10, 0.5, 1.0).expand(1, 12, 20).clone()
    depth[..., 8:12] = 0
    assert fill_holes(depth, rule="farthest")[0][0, 6, 8:12].tolist() == [0.5, 0.5, 1.0, 1.0]
    depth[0, 6, 8:12] = torch.tensor([0.0, 0.0, 0.0, 1.0])
    assert fill_holes(depth, rule="farthest")[0][0, 6, 10].item() == 1.0
    lone = torch.tensor([[[0.5, 0.0, 1.0]]])
    assert fill_holes(lone, rule="farthest")[0][0, 0, 1].item() == 1.0
    assert fill_holes(lone, rule="nearest")[0][0, 0, 1].item() == 0.5
    assert fill_holes(lone, rule="left")[0][0, 0, 1].item() == 0.5


@pytest.mark.parametrize("rule", RULES)
def test_an_image_without_a_reading_stays_empty_and_one_without_a_hole_as_it_is(rule):
    assert not bool(fill_holes(torch.zeros(1, 4, 5), rule=rule)[0].any())
    full = torch.ones(1, 4, 5)
    filled, distance = fill_holes(full, rule=rule)
    assert torch.equal(filled, full)
    assert not bool(distance.any())


@pytest.mark.parametrize(
    ("radius", "expected"),
    [(1, [0, 1, 1, 1, 0, 2, 2, 2]), (2, [1, 1, 1, 1, 1, 2, 2, 2]), (9, [1, 1, 1, 1, 1, 1, 2, 2])],
)
def test_rows_are_filled_from_the_left_then_from_the_right(radius, expected):
    row = torch.tensor([0.0, 0, 1, 0, 0, 0, 2, 0])
    assert fill_rows(row.reshape(1, 1, -1), radius).flatten().tolist() == expected


def test_bad_requests_are_refused():
    with pytest.raises(ConfigError, match="fill_holes: rule must be one of 'left', 'farthest', 'nearest'"):
        fill_holes(torch.ones(1, 2, 2), rule="right")
    with pytest.raises(ConfigError, match="max_size"):
        fill_holes(torch.ones(1, 2, 2), max_size=0)
    with pytest.raises(CaptureError, match="negative"):
        fill_holes(-torch.ones(1, 2, 2))
