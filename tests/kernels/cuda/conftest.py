"""Tests of the GPU's kernels on the processor: the harness carries them."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.kernels.cuda import harness


@pytest.fixture(params=[0, 1, 2], ids=["in order", "drawn", "drawn otherwise"])
def ordered(request: pytest.FixtureRequest) -> Iterator[harness.Harness]:
    """The harness with threads in an order."""
    yield harness.use(request.param)
    harness.use(0)
