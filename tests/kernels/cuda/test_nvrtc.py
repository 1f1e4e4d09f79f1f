"""NVRTC compiles every kernel: no GPU is needed for that, only cuda-core and NVRTC."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from pcdata.kernels.cuda import compiling
from pcdata.kernels.cuda.declarations import kernels, themes

pytestmark = [
    pytest.mark.nvrtc,
    pytest.mark.skipif(compiling.why_no_compiler() is not None, reason=str(compiling.why_no_compiler())),
]


@pytest.mark.parametrize("architecture", ["sm_80", "sm_90", "sm_100"])
@pytest.mark.parametrize("theme", themes())
def test_every_kernel_compiles(theme, architecture):
    made = compiling.compile_theme(theme, architecture, "cubin")
    wanted = [kernel.name for kernel in kernels().values() if kernel.theme == theme]
    assert wanted
    assert [name for name in wanted if name.encode() not in made] == []


def test_the_compiler_is_told_to_fuse_no_multiplication_with_an_addition():
    options = compiling.cuda_core().ProgramOptions(arch="sm_80", **compiling.OPTIONS)
    assert [one for one in options.as_bytes("nvrtc") if b"fmad" in one] == [b"--fmad=false"]


def test_what_the_compiler_refuses_is_told_with_its_log(tmp_path, monkeypatch):
    (tmp_path / "pc" / "gpu").mkdir(parents=True)
    (tmp_path / "pc" / "gpu" / "wrong.hpp").write_text("no such language\n")
    monkeypatch.setattr(compiling, "SOURCES", tmp_path)
    with pytest.raises(RuntimeError, match=r"(?s)NVRTC does not compile wrong for sm_80: .*wrong\.hpp"):
        compiling.compile_theme("wrong", "sm_80", "cubin")


STARTS = """
import contextlib, sys, types
import torch
from pcdata.kernels.cuda import compiling, gpu
if sys.argv[1] == "compile":
    for theme in ("radius", "farthest"):
        compiling.compiled(theme, "sm_90", "cubin")
    sys.exit()
torch.cuda.get_device_properties = lambda index: types.SimpleNamespace(major=9, minor=0, multi_processor_count=132)
torch.cuda.device = lambda index: contextlib.nullcontext()
torch.cuda.current_stream = lambda index: types.SimpleNamespace(cuda_stream=0xABC)
launcher = gpu.GpuLauncher(0)
print(launcher.resident_blocks("pc_sample_cloud", 1024), "resident", flush=True)
launcher._start("pc_count_beside", 3, 256, [42, 2.5])
launcher._start("pc_sample_cloud", 5, 1024, [43, -1.25])
"""


@pytest.mark.skipif(shutil.which("gcc") is None, reason="there is no C compiler to build a driver with")
def test_cuda_core_and_its_bindings_load_and_start_what_they_are_told(tmp_path):
    source = Path(__file__).with_name("played_driver.c")
    built = tmp_path / "libcuda.so.1"
    subprocess.run(["gcc", "-w", "-shared", "-fPIC", str(source), "-o", str(built)], check=True)
    (tmp_path / "starts.py").write_text(STARTS)
    root = str(Path(__file__).parents[3])
    own = {**os.environ, "XDG_CACHE_HOME": str(tmp_path), "PYTHONPATH": root}
    played = {**own, "LD_LIBRARY_PATH": str(tmp_path)}
    for word, environment in (("compile", own), ("start", played)):  # cuda-core compiles with no driver, or a real one
        command = [sys.executable, str(tmp_path / "starts.py"), word]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.splitlines() == [
        "load ELF",
        "kernel pc_sample_cloud of 0x55",
        "occupancy of 0x77 in blocks of 1024 with 0",
        "924 resident",
        "load ELF",
        "kernel pc_count_beside of 0x55",
        "launch 0x77: 3 1 1 blocks of 256 1 1, 0 shared, on 0xabc, with 42 and 2.50, no more",
        "together, launch 0x77: 5 1 1 blocks of 1024 1 1, 0 shared, on 0xabc, with 43 and -1.25, no more",
    ]
