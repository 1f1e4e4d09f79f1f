"""Fixtures shared by all tests."""

from __future__ import annotations

import gc
import hashlib
import os
import signal
from pathlib import Path
from typing import Any

import pytest
import torch

# Small tensors: threads cost more than they give, most of all where tests share the cores. Subprocesses inherit it.
os.environ.setdefault("OMP_NUM_THREADS", "1")
torch.set_num_threads(1)

# What is started in the background, or by nohup, ignores signals, and so would the commands under test.
for _number, _usual in (
    (signal.SIGINT, signal.default_int_handler),
    (signal.SIGTERM, signal.SIG_DFL),
    (getattr(signal, "SIGHUP", signal.SIGTERM), signal.SIG_DFL),
):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, _usual)

# Subprocesses keep the bytecode of pcdata, or each compiles it again.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# What is collected, 20,000 tests, lives as long as the run: the collector of garbage need not look through it.
gc.disable()


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session")
def test_data() -> Path:
    """The folder of real captures, named by PCDATA_TEST_DATA."""
    path = os.environ.get("PCDATA_TEST_DATA")
    if not path:
        pytest.skip("PCDATA_TEST_DATA is not set: it names a folder of real captures")
    return Path(path)


@pytest.fixture
def patches_fitted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A view that was fitted before is not fitted again, whatever its pose: a third of the time of aligning views."""
    monkeypatch.setattr("pcdata.alignment.surfaces.fit_depth_patches", _fitted_once)


_fitted: dict[bytes, Any] = {}


def _fitted_once(depth: torch.Tensor, intrinsics: torch.Tensor, distortion: torch.Tensor | None = None) -> Any:
    from pcdata.alignment.patches import fit_depth_patches  # most tests need none of it

    key = hashlib.sha256()
    for given in (depth, intrinsics, distortion):
        key.update(b"none" if given is None else f"{given.shape}{given.dtype}".encode() + given.numpy().tobytes())
    if key.digest() not in _fitted:
        _fitted[key.digest()] = fit_depth_patches(depth, intrinsics, distortion)
    return _fitted[key.digest()]
