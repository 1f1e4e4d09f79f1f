"""Importing pcdata is cheap and loads nothing that is not needed."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

import pcdata
from tests.fresh import run_fresh

HEAVY = ["cv2", "small_gicp", "open3d", "torch_cluster", "matplotlib", "h5py", "kornia", "scipy", "pydantic", "sympy"]


def in_a_new_process(code: str) -> str:
    """Run code in a fresh interpreter that finds the same pcdata, and return what it prints."""
    root = Path(pcdata.__file__).parent.parent
    return run_fresh(code, path=[root, *filter(None, [os.environ.get("PYTHONPATH")])])


def test_importing_pcdata_loads_not_even_torch():
    loaded = in_a_new_process("import sys, json, pcdata; print(json.dumps(sorted(sys.modules)))")
    packages = {name.split(".")[0] for name in json.loads(loaded)}
    assert not packages & {*HEAVY, "torch", "numpy", "yaml"}


def test_importing_the_parts_and_moving_a_batch_loads_nothing_heavy():
    # torch itself may load what is installed, so only what comes on top of it counts.
    code = """
import json, sys, torch
before = set(sys.modules)
import pcdata.functional, pcdata.structures, pcdata.synthetic, pcdata.transforms
pcdata.geometry.rigid.from_rotation_translation(torch.eye(3).repeat(2, 1, 1), torch.zeros(3))
print(json.dumps(sorted(set(sys.modules) - before)))
"""
    packages = {name.split(".")[0] for name in json.loads(in_a_new_process(code))}
    assert not packages & set(HEAVY)


def test_transforms_are_imported_in_a_blink():
    # Compiling to bytecode is not what is measured: the first process does it, conftest.py lets it keep what it made.
    code = """
import gc, time
start = time.process_time()
import torch
gc.disable()  # to go through all that torch has made takes longer than half of what is measured here
loaded = time.process_time()
import pcdata, pcdata.transforms
print(loaded - start, time.process_time() - loaded)
"""
    # Beside torch, which has to come first: a slow or busy machine is slow for both. One quick import is proof enough.
    times = []
    while len(times) < 4 and not any(ours < torchs / 6 for torchs, ours in times):
        times.append(tuple(map(float, in_a_new_process(code).split())))
    assert any(ours < torchs / 6 for torchs, ours in times), times


def test_every_public_name_resolves():
    for name in pcdata.__all__:
        assert getattr(pcdata, name) is not None
    assert sorted(pcdata.__all__) == dir(pcdata)
    assert len(set(pcdata.__all__)) == len(pcdata.__all__)
    with pytest.raises(AttributeError, match="no attribute 'VoxelDownsampel'"):
        _ = pcdata.VoxelDownsampel


@pytest.mark.parametrize(
    "package",
    [
        "calibration",
        "exports",
        "functional",
        "models",
        "structures",
        "transforms",
        "io",
        "datasets",
        "build",
        "report",
        "synthetic",
    ],
)
def test_every_public_name_of_a_package_resolves(package):
    module = getattr(pcdata, package)
    for name in getattr(module, "__all__", []):
        assert getattr(module, name) is not None
