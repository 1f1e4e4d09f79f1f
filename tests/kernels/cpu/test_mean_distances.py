"""The mean distances of the statistical filter: the same bits with an image as without, and as by exact sums."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from pcdata.contracts.dispatch import why_unavailable
from pcdata.kernels.cpu import native

pytestmark = pytest.mark.skipif(why_unavailable("cpu") is not None, reason=str(why_unavailable("cpu")))


def means(points: Tensor, k: int, pixel: Tensor | None = None, width: int = 0) -> Tensor:
    """The mean distance of every point of one cloud to its k nearest."""
    found = torch.full((len(points),), torch.nan, dtype=torch.float64)
    outlier = torch.empty(len(points), dtype=torch.bool)
    ptr = torch.tensor([0, len(points)])
    native.call("pc_statistical_outliers", points, ptr, 1, k, 2.0, pixel, width, None, found, outlier, None, None)
    return found


def exact_means(points: Tensor, k: int) -> np.ndarray:
    """The same by brute force, each sum rounded once."""
    offset = points.numpy()[:, None] - points.numpy()[None]
    square = offset * offset
    squared = np.sort((square[..., 0] + square[..., 1]) + square[..., 2], 1)[:, :k]
    return np.array([math.fsum(row.tolist()) / len(row) for row in np.sqrt(squared)])


def depths(kind: str, random: np.random.Generator) -> np.ndarray:
    v, u = np.mgrid[0:50, 0:90]
    z = 1 + 0.3 * np.sin(u / 17) + 0.2 * np.cos(v / 11)
    if kind == "noise":
        z += random.normal(scale=0.02, size=z.shape)
    elif kind == "centimeters":
        z = z.round(2)
    elif kind == "strays":
        z = np.where(random.random(z.shape) < 0.06, random.uniform(0.2, 8, z.shape), z)
    elif kind == "steps":
        z = np.where((u // 7 + v // 5) % 2 == 0, z, z + 1.5)
    elif kind == "steep":
        z = 0.3 + v * 0.3
    elif kind == "magnitudes":
        z *= 10.0 ** random.uniform(-6, 6, z.shape)
    return z


def image(kind: str, seed: int = 0, kept: float = 1.0) -> tuple[Tensor, Tensor, int]:
    """Points of a made depth image, the pixels they lie on, and its width."""
    random = np.random.default_rng(seed)
    z = depths(kind, random)
    height, width = z.shape
    v, u = np.mgrid[0:height, 0:width]
    points = np.stack([(u - width / 2) * z / 70, (v - height / 2) * z / 70, z], -1).reshape(-1, 3).astype(np.float32)
    if kind == "copies":
        points[:] = points[random.integers(0, 300, len(points))]
    elif kind == "a line of magnitudes":
        points[:, :2] *= np.exp2(-random.integers(0, 60, (len(points), 1))).astype(np.float32)
    pixel = np.flatnonzero(random.random(len(points)) < kept)
    return torch.from_numpy(points[pixel]), torch.from_numpy(pixel), width


KINDS = ["smooth", "noise", "centimeters", "strays", "steps", "steep", "magnitudes", "copies", "a line of magnitudes"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("kept", [1.0, 0.95, 0.4])
def test_an_image_gives_the_same_bits(kind: str, kept: float, instruction_set: str):
    points, pixel, width = image(kind, kept=kept)
    for k in (2, 9, 10, 20, 33, 48):
        assert torch.equal(means(points, k), means(points, k, pixel, width)), k


@pytest.mark.parametrize("kind", ["noise", "strays", "steps", "copies"])
def test_sums_are_exact(kind: str, instruction_set: str):
    points, pixel, width = image(kind, kept=0.3)
    for k in (2, 20, 48):
        assert np.array_equal(means(points, k, pixel, width).numpy(), exact_means(points, k)), k


def test_a_cloud_smaller_than_the_neighborhood_averages_all():
    points, pixel, width = image("noise", kept=0.003)
    assert 2 < len(points) < 20
    assert np.array_equal(means(points, 20, pixel, width).numpy(), exact_means(points, 20))


def test_distances_that_no_float_holds_are_left_out():
    points, pixel, width = image("smooth", kept=0.3)
    points[::50] *= 1e25
    assert torch.equal(means(points, 20), means(points, 20, pixel, width))


@pytest.mark.parametrize("seed", range(4))
def test_a_grid_that_does_not_fit_costs_time_alone(seed: int):
    points, pixel, width = image("smooth", seed)
    points = points[torch.randperm(len(points), generator=torch.Generator().manual_seed(seed))].contiguous()
    assert torch.equal(means(points, 20), means(points, 20, pixel, width))
