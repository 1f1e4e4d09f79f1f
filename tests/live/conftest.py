"""The scene of the live tests."""

from __future__ import annotations

import pytest

import pcdata
from pcdata.synthetic import tabletop
from tests.live_stream import SIZE


@pytest.fixture(scope="session")
def scene() -> pcdata.DepthFrame:
    return tabletop(3, noise="stereo", num_views=1, size=SIZE).frame
