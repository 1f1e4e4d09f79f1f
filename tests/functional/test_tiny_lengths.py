"""The unit is the user's: as long as a length is taken, what it finds does not depend on how small the numbers are."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
import torch
from torch import Tensor

from pcdata import functional
from pcdata.errors import ConfigError

RADIUS = 0.125
SMALLEST = 2.0**-46  # a power of two changes no digit; RADIUS times this is 1.8 times the shortest length that is taken
FINDERS: dict[str, Callable[[Tensor, float, str], Tensor]] = {
    "ball_query": lambda p, r, b: functional.ball_query(p, radius=r, max_neighbors=8, backend=b)[0],
    "dbscan": lambda p, r, b: functional.dbscan(p, eps=r, min_points=5, backend=b),
    "estimate_normals": lambda p, r, b: functional.estimate_normals(p, radius=r, max_neighbors=10, backend=b),
    "radius_outlier_mask": lambda p, r, b: functional.radius_outlier_mask(p, min_neighbors=5, radius=r, backend=b),
}


@pytest.fixture(params=[False, True], ids=["kept", "flushed"])
def denormal_numbers(request: pytest.FixtureRequest) -> Iterator[None]:
    if not torch.set_flush_denormal(request.param):
        pytest.skip("this processor cannot choose")
    yield
    torch.set_flush_denormal(False)


@pytest.mark.usefixtures("denormal_numbers")
@pytest.mark.parametrize("name", FINDERS)
def test_the_smallest_length_finds_what_the_same_length_in_another_unit_finds(name: str) -> None:
    points = torch.rand(1000, 3, generator=torch.Generator().manual_seed(0))
    expected = FINDERS[name](points, RADIUS, "torch")
    for backend in ("torch", "torch_tree", "auto"):
        assert torch.equal(FINDERS[name](points * SMALLEST, RADIUS * SMALLEST, backend), expected), backend


@pytest.mark.parametrize("name", FINDERS)
def test_a_length_whose_square_has_lost_digits_is_refused(name: str) -> None:
    for length in (0.9e-15, 1e-22, 5e-324, 0.0):
        with pytest.raises(ConfigError, match="in the unit of the points, 1e-15 to 1e19"):
            FINDERS[name](torch.zeros(10, 3), length, "auto")
