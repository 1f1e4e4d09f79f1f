"""Fixtures shared by all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch

# Small tensors: threads cost more than they give, most of all where tests share the cores. Subprocesses inherit it.
os.environ.setdefault("OMP_NUM_THREADS", "1")
torch.set_num_threads(1)


@pytest.fixture(scope="session")
def test_data() -> Path:
    """The folder of real captures, named by PCDATA_TEST_DATA."""
    path = os.environ.get("PCDATA_TEST_DATA")
    if not path:
        pytest.skip("PCDATA_TEST_DATA is not set: it names a folder of real captures")
    return Path(path)
