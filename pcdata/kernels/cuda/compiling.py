"""Kernels compiled when they are first needed: CUDA C++ by NVRTC, through NVIDIA's cuda-core.

Torch has a loader of its own (``torch.cuda._compile_kernel``), which needs nothing but torch. It does not serve better:
it is no public interface, keeps nothing on disk, so that every process compiles again, and launches no kernel whose
blocks meet. Torch's wheels for CUDA bring NVRTC and cuda-bindings; cuda-core is 6 MB more.
"""

from __future__ import annotations

import importlib
from types import ModuleType
from typing import Any

from pcdata import extras
from pcdata.kernels.cuda import kept_binaries
from pcdata.kernels.cuda.declarations import SOURCES, sources_digest

# No fused multiply-add: distances must equal the reference bit for bit. Nothing else depends on these.
OPTIONS: dict[str, Any] = {"std": "c++17", "fma": False}

NVRTC_INSTALL = "pip install nvidia-cuda-nvrtc (for CUDA 12: nvidia-cuda-nvrtc-cu12)"


def why_no_compiler() -> str | None:
    """Return why kernels cannot be compiled and what to do, or None."""
    problem = extras.why_missing("cuda.core")
    if problem is not None:
        return problem
    if not SOURCES.exists():
        return "the sources of the kernels are not installed; reinstall pcdata"
    try:
        supported_architectures()
    except Exception as error:  # not found, or of another CUDA: each version of the bindings has words of its own
        told = f"{type(error).__name__}: {' '.join(str(error).split())}"
        return f"NVRTC, which compiles kernels, does not load ({told}); run: {NVRTC_INSTALL}"
    return None


def supported_architectures() -> list[int]:
    """Return the compute capabilities that NVRTC compiles for, such as 90 for 9.0."""
    _, listed = _checked(_nvrtc().nvrtcGetSupportedArchs())
    return sorted(listed)


def target_for(capability: tuple[int, int], supported: list[int]) -> tuple[str, str]:
    """Return the architecture to name, and what to make: machine code, or, for a GPU newer than NVRTC, PTX.

    The driver makes machine code of PTX.
    """
    wanted = 10 * capability[0] + capability[1]
    if wanted in supported:
        return f"sm_{wanted}", "cubin"
    older = [one for one in supported if one < wanted]
    if not older:
        raise RuntimeError(
            f"NVRTC compiles for compute capability {min(supported) / 10:.1f} and later, the GPU has {wanted / 10:.1f}"
        )
    return f"compute_{max(older)}", "ptx"


def compiled(theme: str, architecture: str, form: str) -> bytes:
    """Return the kernels of one header as machine code (``cubin``) or ``ptx``, from disk if they were made before."""
    version = ".".join(map(str, _checked(_nvrtc().nvrtcVersion())[1:]))
    identity = f"{theme} {architecture} {form} NVRTC {version} {sorted(OPTIONS.items())} {sources_digest()}"
    found = kept_binaries.load(identity)
    if found is None:
        found = compile_theme(theme, architecture, form)
        kept_binaries.keep(identity, found)
    return found


def compile_theme(theme: str, architecture: str, form: str) -> bytes:
    """Compile the kernels of one header now.

    Raises:
        RuntimeError: the compiler refuses them; with its log.
    """
    core = cuda_core()
    options = core.ProgramOptions(arch=architecture, include_path=[str(SOURCES)], **OPTIONS)
    try:
        made = core.Program(f'#include "pc/gpu/{theme}.hpp"\n', "c++", options).compile(form)
    except Exception as error:
        raise RuntimeError(f"NVRTC does not compile {theme} for {architecture}: {error}; please report this") from error
    return bytes(made.code)


def cuda_core() -> ModuleType:
    """Return cuda-core."""
    return extras.require("cuda.core")


def _nvrtc() -> ModuleType:
    return importlib.import_module("cuda.bindings.nvrtc")


def _checked(result: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return what a call of the bindings gave, if its first value says that it went well."""
    if int(result[0]) != 0:
        raise RuntimeError(f"{result[0]}")
    return result
