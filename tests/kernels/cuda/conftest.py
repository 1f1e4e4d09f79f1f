"""Tests of the GPU's kernels on the processor: the harness carries them."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.kernels.cuda import harness
from tests.sanitized import UNDER_SANITIZERS

# Sanitizers see what a thread reads and writes, which the order of threads hardly changes: one drawn order for them.
ORDERS = {1: "drawn"} if UNDER_SANITIZERS else {0: "in order", 1: "drawn", 2: "drawn otherwise"}


@pytest.fixture(params=ORDERS, ids=ORDERS.values())
def ordered(request: pytest.FixtureRequest) -> Iterator[harness.Harness]:
    """The harness with threads in an order."""
    yield harness.use(request.param)
    harness.use(0)
