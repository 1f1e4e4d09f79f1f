from __future__ import annotations

import itertools

import pytest
import torch

from pcdata.errors import ConfigError, TooFewPointsError
from pcdata.rng import seeded
from pcdata.validation.measures.earth_movers import earth_movers_distance


def test_the_best_matching_is_that_of_all_permutations():
    a, b = torch.rand(6, 3, generator=seeded(1)), torch.rand(6, 3, generator=seeded(2))
    costs = torch.cdist(a.double(), b.double())
    for squared in (False, True):
        cost = costs.square() if squared else costs
        best = min(float(cost[range(6), order].mean()) for order in itertools.permutations(range(6)))
        leaf = a.clone().requires_grad_()
        found = earth_movers_distance(leaf, None, b, None, squared=squared)
        assert found.item() == pytest.approx(best, rel=1e-6)
        found.sum().backward()
        assert float(leaf.grad.norm()) > 0
    with pytest.raises(ConfigError, match="clouds 0 have 6 and 5 points; sample both"):
        earth_movers_distance(a, None, b[:5], None)


def test_each_cloud_of_a_batch_is_matched_by_itself():
    a, b, ptr = torch.rand(9, 3, generator=seeded(1)), torch.rand(9, 3, generator=seeded(2)), torch.tensor([0, 4, 9])
    found = earth_movers_distance(a, ptr, b, ptr)
    alone = [earth_movers_distance(a[part], None, b[part], None) for part in (slice(0, 4), slice(4, 9))]
    assert torch.equal(found, torch.cat(alone))
    with pytest.raises(TooFewPointsError, match="cloud 0 of points_a is empty"):
        earth_movers_distance(a, torch.tensor([0, 0, 9]), b, torch.tensor([0, 0, 9]))
