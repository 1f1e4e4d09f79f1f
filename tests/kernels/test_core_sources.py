"""The sources of the compiled core: one interface, headers that a GPU's compiler reads, no two meanings of a name."""

from __future__ import annotations

import importlib.util
import re
import shutil
import subprocess
from pathlib import Path
from types import ModuleType

import pytest

import pcdata.kernels

CORE = Path(pcdata.kernels.__file__).parent / "core"
MATH = sorted((CORE / "pc" / "math").glob("*.hpp"))

pytestmark = pytest.mark.skipif(not (CORE / "src").exists(), reason="the sources of the core are not installed")
needs_compiler = pytest.mark.skipif(shutil.which("g++") is None, reason="there is no C++ compiler")

# What NVRTC has without any header, as far as the core's maths use it.
CUDA = """
#define __CUDACC__
#define __CUDACC_RTC__
#define __host__
#define __device__
#define __forceinline__ inline
double sqrt(double), fabs(double), fma(double, double, double), nan(const char*);
float fabsf(float), sqrtf(float), ceilf(float), rintf(float), __uint_as_float(unsigned int);
unsigned int __float_as_uint(float);
"""


def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("write_signatures", CORE / "write_signatures.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def check_syntax(code: str, *flags: str) -> subprocess.CompletedProcess[str]:
    command = ["g++", "-std=c++17", "-fsyntax-only", "-Wall", "-Werror", *flags, f"-I{CORE}", "-x", "c++", "-"]
    return subprocess.run(command, input=code, capture_output=True, text=True)


def test_signatures_are_those_that_the_header_declares():
    writer = script()
    assert writer.SIGNATURES.read_text() == writer.render(writer.HEADER.read_text())


@pytest.mark.parametrize(
    "declaration", ["int32_t count", "const float& scale", "std::vector<float> points", "char* text"]
)
def test_a_header_with_arguments_that_python_cannot_give_is_refused(declaration: str):
    header = f"PC_EXPORT int32_t pc_new(const pc_context* context, {declaration});"
    with pytest.raises(ValueError, match="pc_new: arguments are int64_t, double or pointers"):
        script().render(header)


def test_comments_and_line_breaks_do_not_change_the_interface():
    declared = "PC_EXPORT int32_t pc_new(const pc_context* context, int64_t rows, const float* points);"
    other = "// New.\n" + declared.replace(", ", ",\n    ") + "  // so\n"
    wider = declared.replace("float", "double")
    assert script().render(declared) == script().render(other)
    assert script().render(declared) != script().render(wider)


@needs_compiler
def test_math_headers_compile_without_a_standard_library_as_nvrtc_reads_them():
    includes = "".join(f'#include "pc/math/{header.name}"\n' for header in MATH)
    done = check_syntax(CUDA + includes, "-nostdinc", "-nostdinc++")
    assert done.returncode == 0, done.stderr
    broken = check_syntax(CUDA + includes + "#include <vector>\n", "-nostdinc", "-nostdinc++")
    assert "vector" in broken.stderr


def test_every_function_of_the_math_headers_is_marked_for_the_gpu():
    assert MATH
    for header in MATH:
        assert "std::" not in header.read_text(), header.name
        for line in header.read_text().splitlines():
            opens = re.match(r"\s*(?!for|if|while|return|#|//)[\w:<>&*, ]*\b[\w=+\-*/()]+\(.*\{$", line)
            assert not opens or "PC_HD" in line, f"{header.name}: {line}"


def test_kernels_of_a_gpu_read_nothing_that_a_wheel_lacks():
    headers = sorted((CORE / "pc" / "gpu").glob("*.hpp"))
    assert headers
    for header in headers:
        for name in re.findall(r"#include (\S+)", header.read_text()):
            assert re.fullmatch(r'"pc/(gpu|math)/\w+\.hpp"|"harness/threads\.hpp"', name), f"{header.name}: {name}"


@needs_compiler
@pytest.mark.slow
def test_all_sources_compile_as_one_file():
    sources = sorted((CORE / "src").glob("*.cpp"))
    done = check_syntax(
        "".join(f'#include "{source}"\n' for source in sources), "-DPCDATA_INTERFACE=0", "-march=haswell"
    )
    assert done.returncode == 0, done.stderr
