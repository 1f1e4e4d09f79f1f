"""From a call to the driver: what is declared, checked, packed and asked of it; the driver is played by the harness."""

from __future__ import annotations

import contextlib
import ctypes
import sys
from types import SimpleNamespace

import pytest
import torch

from pcdata import functional as F
from pcdata.contracts import dispatch
from pcdata.errors import BackendError
from pcdata.kernels.cuda import compiling, gpu, launching
from pcdata.kernels.cuda.declarations import KINDS, declared, kernels, themes, values_of
from pcdata.rng import seeded
from tests.kernels.cuda import harness

needs_harness = pytest.mark.skipif(harness.unavailable() is not None, reason=str(harness.unavailable()))

DECLARED = """
// PC_KERNEL(pc_of_a_comment, const float* x) {
PC_KERNEL(pc_plain, const float* points,  // (N, 3)
          int64_t rows, double limit, uint8_t* flags) {
}
PC_GRID_KERNEL(pc_together, uint32_t* arrivals) {}
"""


def test_declarations_are_read_with_their_arguments():
    plain, together = declared(DECLARED, "theme")
    assert (plain.name, plain.theme, plain.meets) == ("pc_plain", "theme", KINDS[""])
    assert [(one.name, one.dtypes, one.number) for one in plain.parameters] == [
        ("points", (torch.float32,), None),
        ("rows", (), int),
        ("limit", (), float),
        ("flags", (torch.uint8, torch.bool), None),
    ]
    assert together.meets == KINDS["GRID_"]
    with pytest.raises(ValueError, match="pc_new: arguments are pointers, int64_t or double, not 'int count'"):
        declared("PC_KERNEL(pc_new, int count) {", "theme")


@needs_harness
def test_all_headers_of_kernels_are_in_the_harness_and_names_differ():
    listed = (harness.SOURCES / "harness" / "kernels.hpp").read_text()
    assert [theme for theme in themes() if f'"pc/gpu/{theme}.hpp"' not in listed] == []
    texts = [path.read_text() for path in (harness.SOURCES / "pc" / "gpu").glob("*.hpp")]
    found = [one for text in texts for one in declared(text, "", "".join(texts))]
    assert len(found) == len(kernels()) > 3
    for kernel in kernels().values():
        with pytest.raises(RuntimeError, match="another number of arguments"):
            harness.Harness()._start(kernel.name, 1, 32, [])


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ([torch.zeros(2, 3), 2, 0.5], TypeError, "takes 4 arguments, got 3"),
        ([torch.zeros(2, 3).double(), 2, 0.5, None], TypeError, "points takes a tensor of torch.float32"),
        ([torch.zeros(2, 3), 2.0, 0.5, None], TypeError, "rows takes int, got 2.0"),
        ([torch.zeros(2, 3), 2, None, None], TypeError, "limit takes float, got None"),
        ([torch.zeros(3, 2).T, 2, 0.5, None], ValueError, "points must be contiguous and on cpu"),
        ([torch.zeros(2, 3, device="meta"), 2, 0.5, None], ValueError, "points must be contiguous and on cpu"),
    ],
)
def test_wrong_arguments_never_reach_a_kernel(arguments, error, words):
    with pytest.raises(error, match=words):
        values_of(declared(DECLARED, "")[0], arguments, "cpu")


def test_tensors_go_as_addresses_and_none_as_null():
    points = torch.zeros(2, 3)
    assert values_of(declared(DECLARED, "")[0], [points, 2, 1, None], "cpu") == [points.data_ptr(), 2, 1.0, 0]


class PlayedDriver:
    """Takes the driver's calls as they are documented, and runs the kernel in the harness."""

    def __init__(self, handles: dict[int, str]) -> None:
        self.handles = handles
        self.together: list[str] = []
        self.CUfunction = int

    def cuLaunchKernel(self, handle, gx, gy, gz, bx, by, bz, shared, stream, arguments, extra):
        assert (gy, gz, by, bz, shared, stream, extra) == (1, 1, 1, 1, 0, 1234, 0)
        name = self.handles[handle]
        count = len(kernels()[name].parameters)
        addresses = (ctypes.c_void_p * count).from_address(arguments)
        words = (ctypes.c_uint64 * count)(*(ctypes.c_uint64.from_address(one).value for one in addresses))
        told = ctypes.create_string_buffer(400)
        sizes = ctypes.c_int64(gx), ctypes.c_int64(bx)
        tail = ctypes.c_int64(count), ctypes.c_uint64(0), told, ctypes.c_int64(400)
        return (harness.library().pc_run_kernel(name.encode(), *sizes, words, *tail),)

    def cuLaunchCooperativeKernel(self, handle, *sizes_and_arguments):
        self.together.append(self.handles[handle])
        return self.cuLaunchKernel(handle, *sizes_and_arguments, 0)

    def cuOccupancyMaxActiveBlocksPerMultiprocessor(self, function, block, shared):
        return 0, 2


class PlayedCode:
    def __init__(self, handles: dict[int, str]) -> None:
        self.handles = handles

    def from_cubin(self, binary: bytes) -> PlayedCode:
        assert binary.startswith(b"machine code of ")
        return self

    def get_kernel(self, name: str) -> SimpleNamespace:
        self.handles[len(self.handles) + 1] = name
        return SimpleNamespace(handle=len(self.handles))


@pytest.fixture
def played(monkeypatch):
    handles: dict[int, str] = {}
    driver = PlayedDriver(handles)
    monkeypatch.setitem(sys.modules, "cuda", SimpleNamespace())
    monkeypatch.setitem(sys.modules, "cuda.bindings", SimpleNamespace())
    monkeypatch.setitem(sys.modules, "cuda.bindings.driver", driver)
    monkeypatch.setattr(gpu, "cuda_core", lambda: SimpleNamespace(ObjectCode=PlayedCode(handles)))
    monkeypatch.setattr(gpu, "compiled", lambda theme, *target: f"machine code of {theme} {target}".encode())
    monkeypatch.setattr(gpu, "supported_architectures", lambda: [80, 90])
    properties = SimpleNamespace(major=9, minor=0, multi_processor_count=2)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda index: properties)
    monkeypatch.setattr(torch.cuda, "device", lambda index: contextlib.nullcontext())
    monkeypatch.setattr(torch.cuda, "current_stream", lambda index: SimpleNamespace(cuda_stream=1234))
    launcher = gpu.GpuLauncher(0)
    launcher.device_type = "cpu"
    harness.register()
    monkeypatch.setitem(launching.LAUNCHERS, "cpu", lambda tensor: launcher)
    return driver


@needs_harness
def test_the_gpu_s_launcher_starts_what_the_harness_starts(played):
    points = torch.rand(700, 3, generator=seeded(0))
    arguments = {"radius": 0.06, "min_neighbors": 3}
    found = F.radius_outlier_mask(points, backend=harness.BACKEND, **arguments)
    assert torch.equal(found, F.radius_outlier_mask(points, backend="torch", **arguments))
    assert "pc_count_around" in played.handles.values()


@needs_harness
def test_a_driver_that_refuses_is_told_of(played, monkeypatch):
    monkeypatch.setattr(played, "cuLaunchKernel", lambda *arguments: (701,))
    with pytest.raises(RuntimeError, match="a kernel could not be started on GPU 0: 701"):
        F.radius_outlier_mask(torch.rand(10, 3), backend=harness.BACKEND)


def test_absent_backends_say_why_and_what_to_do(monkeypatch):
    monkeypatch.setattr(torch.version, "cuda", None)
    assert "was built without CUDA" in str(gpu.unavailable())
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert "finds no CUDA device" in str(gpu.unavailable())
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(compiling.extras, "why_missing", lambda module: f"{module} is not installed: run pip")
    assert gpu.unavailable() == "cuda.core is not installed: run pip"
    monkeypatch.setattr(compiling.extras, "why_missing", lambda module: None)

    def absent() -> None:
        raise OSError("libnvrtc.so.13 was not found")

    monkeypatch.setattr(compiling, "supported_architectures", absent)
    assert "NVRTC, which compiles kernels, does not load (OSError: libnvrtc" in str(gpu.unavailable())
    assert "pip install nvidia-cuda-nvrtc" in str(gpu.unavailable())


def test_a_backend_of_another_device_is_refused_before_any_kernel(monkeypatch):
    monkeypatch.setattr(dispatch, "why_unavailable", lambda backend: None)
    import pcdata.kernels.cuda  # noqa: F401

    with pytest.raises(BackendError, match=r"'cuda' computes on cuda, but the tensors are on cpu; move them with \.to"):
        F.radius_outlier_mask(torch.rand(5, 3), backend="cuda")


@pytest.mark.parametrize(
    ("capability", "target"),
    [((9, 0), ("sm_90", "cubin")), ((8, 9), ("compute_80", "ptx")), ((12, 1), ("compute_100", "ptx"))],
)
def test_a_gpu_newer_than_the_compiler_gets_code_that_its_driver_finishes(capability, target):
    assert compiling.target_for(capability, [80, 90, 100]) == target


def test_a_gpu_older_than_the_compiler_is_refused():
    with pytest.raises(RuntimeError, match=r"NVRTC compiles for compute capability 8\.0 and later, the GPU has 7\.0"):
        compiling.target_for((7, 0), [80, 90, 100])
