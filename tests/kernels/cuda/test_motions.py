"""Augmentation: the reference's bits for every cloud of a batch, moved, jittered and thinned in one pass."""

from __future__ import annotations

import math

import pytest
import torch

from pcdata import transforms as T
from pcdata.contracts.on_host import uploaded
from pcdata.functional.noise import move_points
from pcdata.functional.rows import inside_box, ptr_from_counts, transform_directions, transform_points
from pcdata.rng import seeded
from pcdata.structures import PointCloud
from tests import pretend_device
from tests.factories import assert_same
from tests.kernels.cuda import harness

pytestmark = pytest.mark.skipif(harness.unavailable() is not None, reason=str(harness.unavailable()))
harness.register()

COUNTS = [0, 1, 63, 64, 65, 0, 150]
PTR = ptr_from_counts(COUNTS)


def cloud(seed: int = 0) -> torch.Tensor:
    return torch.randn(sum(COUNTS), 3, generator=seeded(seed))


def matrices(seed: int = 1) -> torch.Tensor:
    made = torch.eye(4, dtype=torch.float64).repeat(len(COUNTS), 1, 1)
    made[:, :3] += 0.3 * torch.randn(len(COUNTS), 3, 4, generator=seeded(seed), dtype=torch.float64)
    return made


def noise(sigma: float, clip: float | None, seed: int = 2) -> tuple[torch.Tensor, float, float | None]:
    return torch.randint(-(2**62), 2**62, (len(COUNTS),), generator=seeded(seed)), sigma, clip


STEPS = {
    "a motion": [matrices()],
    "noise": [noise(0.01, None)],
    "much noise, cut": [noise(3.0, 2.0)],
    "all": [matrices(), noise(0.01, 0.015), matrices(5), noise(0.1, None, seed=9)],
}


def both(function, *arguments, **options):
    found = function(*arguments, **options, backend=harness.BACKEND)
    expected = function(*arguments, **options, backend="torch")
    assert torch.equal(found, expected)
    return found


@pytest.mark.parametrize("name", STEPS)
def test_points_are_taken_through_steps(name, ordered):
    steps = STEPS[name]
    both(move_points, cloud(), PTR, steps)
    both(move_points, cloud().T.contiguous().T, PTR, steps)
    mask = torch.rand(sum(COUNTS), generator=seeded(7)) < 0.6
    for keep in (mask, torch.zeros_like(mask), torch.ones_like(mask)):
        kept = keep, ptr_from_counts([int(part.sum()) for part in keep.split(COUNTS)])
        both(move_points, cloud(), PTR, steps, kept)
        own, other = cloud(), cloud()
        found = move_points(own, PTR, steps, kept, in_place=True, backend=harness.BACKEND)
        assert torch.equal(found, move_points(other, PTR, steps, kept, in_place=True, backend="torch"))
        assert len(found) == 0 or found.data_ptr() == own.data_ptr()
    own = cloud()
    expected = move_points(cloud(), PTR, steps, backend="torch")
    assert torch.equal(move_points(own, PTR, steps, in_place=True, backend=harness.BACKEND), expected)
    assert torch.equal(own, expected)
    assert set(ordered.started) == {"pc_take_through"}


def test_empty_batches_and_other_dtypes(ordered):
    for steps in ([], [matrices()]):
        both(move_points, cloud().double(), PTR, steps)
    none, ptr = torch.zeros((0, 3)), torch.tensor([0, 0])
    both(move_points, none, ptr, [torch.eye(4, dtype=torch.float64)[None]])
    both(transform_points, cloud().double(), PTR, matrices())
    assert not ordered.started


def test_points_and_directions_follow_motions(ordered):
    both(transform_points, cloud(), PTR, matrices())
    both(transform_points, cloud(), PTR, matrices().float())
    directions = cloud(3)
    directions[::9] = 0
    found = transform_directions(directions, PTR, matrices(), backend=harness.BACKEND)
    torch.testing.assert_close(found, transform_directions(directions, PTR, matrices(), backend="torch"))


def test_a_box_is_cut_out_of_points_that_are_finite(ordered):
    points = cloud()
    points[5] = torch.tensor([0.5, -0.25, 1.0])
    both(inside_box, points, (-0.5, -0.25, -1.0), (0.5, 1.0, 1.0))
    for bad in (math.nan, math.inf, -math.inf):
        points[17, 1] = bad
        assert inside_box(points, (-9, -9, -9), (9, 9, 9), backend=harness.BACKEND) is None


@pytest.mark.skipif(not pretend_device.AVAILABLE, reason="this PyTorch has no devices written in Python")
def test_a_batch_is_augmented_without_waiting(monkeypatch):
    device = harness.as_on_a_gpu(monkeypatch)
    points, ptr = cloud().to(device), uploaded(PTR, device)
    with pretend_device.watching() as watched:
        moved = move_points(points, ptr, STEPS["all"])
        moved = transform_directions(moved, ptr, uploaded(matrices(), device))
    assert not watched.waits
    assert moved.device.type == device.type


@pytest.mark.skipif(not pretend_device.AVAILABLE, reason="this PyTorch has no devices written in Python")
def test_a_chain_of_augmentation_waits_for_nothing_and_gives_what_it_gives_on_the_host(monkeypatch):
    device = harness.as_on_a_gpu(monkeypatch)
    steps = [T.RandomRotation(), T.RandomScale(), T.RandomShear(), T.RandomTranslation(), T.RandomJitter()]
    chain = T.Compose([*steps, T.RandomPointDropout(), T.RandomFlip()])
    normals = torch.nn.functional.normalize(cloud(4), dim=1)
    labels = torch.arange(sum(COUNTS))
    here = PointCloud(
        points=cloud(), ptr=PTR, normals=normals, labels=labels, frame_id="base", viewpoint=torch.zeros(len(COUNTS), 3)
    )
    there = here.to(device)
    with pretend_device.watching() as watched:
        found = chain(there, generator=seeded(3))
    assert not watched.waits
    assert_same(found.to("cpu"), chain(here, generator=seeded(3)), tolerance=1e-6)
