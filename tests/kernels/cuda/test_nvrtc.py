"""NVRTC compiles every kernel: no GPU is needed for that, only cuda-core and NVRTC."""

from __future__ import annotations

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
