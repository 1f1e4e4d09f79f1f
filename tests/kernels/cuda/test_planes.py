"""RANSAC on a GPU: the reference's counts, winners, inliers."""

from __future__ import annotations

import pytest
import torch

from pcdata import functional as F
from pcdata.contracts.dispatch import INNER
from pcdata.errors import NoPlaneError
from pcdata.rng import seeded
from tests.kernels.cuda import harness

pytestmark = pytest.mark.skipif(harness.unavailable() is not None, reason=str(harness.unavailable()))
harness.register()


def table(count: int, seed: int) -> torch.Tensor:
    """Three fifths on a tilted, noisy plane."""
    points = torch.rand(count, 3, generator=seeded(seed)) + torch.tensor([0.3, -0.4, 1.0])
    on = torch.arange(count) % 5 < 3
    points[on, 2] = 1.2 + 0.1 * points[on, 0] + 0.004 * torch.randn(int(on.sum()), generator=seeded(seed + 1))
    return points


@pytest.mark.parametrize(
    "options",
    [{}, {"num_hypotheses": 1}, {"probability": 0.99}, {"up": [0.0, 0, 1], "max_tilt": 0.3}, {"distance": 1e-3}],
)
def test_planes_and_inliers_are_the_reference_s(options, ordered):
    points = torch.cat([table(900, 0), table(40, 3), table(260, 5)])
    ptr = torch.tensor([0, 900, 940, 1200])
    options = {"num_hypotheses": 60, "distance": 0.01, **options}
    planes, inliers = F.ransac_plane(points, ptr, **options, backend=harness.BACKEND)
    expected, wanted = F.ransac_plane(points, ptr, **options, backend="torch")
    assert torch.equal(inliers, wanted)
    torch.testing.assert_close(planes, expected, atol=1e-9, rtol=0)


@pytest.mark.parametrize("num_planes", [1, 5, 1100])
def test_counts_of_any_number_of_planes(num_planes, ordered):
    points, ptr = torch.cat([table(600, 1), table(30, 2)]), torch.tensor([0, 600, 630])
    planes = torch.nn.functional.normalize(torch.randn(2, num_planes, 4, generator=seeded(4)), dim=2).double()
    planes[:, ::3] = torch.tensor([0.0995, 0, -0.995, 1.194], dtype=torch.float64)
    competes = torch.rand(2, num_planes, generator=seeded(5)) < 0.8
    arguments = points, ptr, planes, competes, 0.05, torch.tensor([3, 0])
    found = INNER["record_planes"].kernels[harness.BACKEND](*arguments)
    assert torch.equal(found, INNER["record_planes"].reference(*arguments))


def test_clouds_without_a_plane_are_refused_as_by_the_reference():
    line = torch.arange(30.0)[:, None] * torch.tensor([1.0, 2.0, 0.5])
    with pytest.raises(NoPlaneError, match="all 1000 triples drawn lie on a line"):
        F.ransac_plane(line, backend=harness.BACKEND)
