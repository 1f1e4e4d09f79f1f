"""The harness itself: what it must catch in a kernel, it catches."""

from __future__ import annotations

import ctypes
import subprocess

import pytest

from pcdata.kernels.cuda.declarations import SOURCES
from tests.kernels.cuda import harness

pytestmark = pytest.mark.skipif(harness.unavailable() is not None, reason=str(harness.unavailable()))

KERNELS = """
#include "pc/gpu/thread.hpp"
namespace pc::gpu {
PC_BLOCK_KERNEL(pc_sums_the_block, const int32_t* values, int32_t* sums) {
  PC_SHARED(int32_t, kept, 64);
  kept[thread_in_block()] = values[thread_index()];
  for (int step = block_size() / 2; step > 0; step /= 2) {
    sync_block();
    if (thread_in_block() < step) kept[thread_in_block()] += kept[thread_in_block() + step];
  }
  if (thread_in_block() == 0) sums[block_index()] = kept[0];
}
PC_BLOCK_KERNEL(pc_forgets_to_meet, const int32_t* values, int32_t* sums) {
  PC_SHARED(int32_t, kept, 64);
  kept[thread_in_block()] = values[thread_index()];
  const int next = (thread_in_block() + 1) % block_size();
  sums[thread_index()] = kept[next];
}
PC_BLOCK_KERNEL(pc_leaves_early, const int32_t* values, int32_t* sums) {
  if (values[thread_index()] == 0) return;
  sync_block();
  sums[thread_index()] = 1;
}
PC_KERNEL(pc_meets_unsaid, int32_t* sums) {
  sync_block();
  sums[thread_index()] = 1;
}
PC_BLOCK_KERNEL(pc_meets_all_unsaid, int32_t* sums) {
  uint32_t arrivals = 0;
  sync_grid(&arrivals);
  sums[thread_index()] = 1;
}
PC_BLOCK_KERNEL(pc_least_of_a_warp, const int32_t* values, int32_t* least, int32_t* negative) {
  least[thread_index()] = warp_min(values[thread_index()]);
  negative[thread_index()] = static_cast<int32_t>(ballot(values[thread_index()] < 0));
}
PC_GRID_KERNEL(pc_passes_on, int32_t* values, uint32_t* arrivals, int64_t rounds) {
  for (int64_t round = 0; round < rounds; ++round) {
    const int64_t from = (thread_index() + 37) % thread_count();
    const int32_t taken = fresh(values + from);
    sync_grid(arrivals);
    values[thread_index()] = taken + 1;
    sync_grid(arrivals);
  }
}
}
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("kernels")
    (folder / "harness").mkdir()
    (folder / "harness" / "kernels.hpp").write_text(KERNELS)
    built = folder / "kernels.so"
    sources = [f"-I{folder}", f"-I{SOURCES}", str(SOURCES / "harness" / "run.cpp")]
    subprocess.run([str(harness.COMPILER), *harness.FLAGS, *sources, "-o", str(built)], check=True)
    library = ctypes.CDLL(str(built))

    def run(name: str, blocks: int, block: int, *arrays: list[int] | int, seed: int = 1) -> list[list[int]]:
        held = [(ctypes.c_int32 * len(one))(*one) if isinstance(one, list) else one for one in arrays]
        words = [one if isinstance(one, int) else ctypes.addressof(one) for one in held]
        told = ctypes.create_string_buffer(400)
        failed = library.pc_run_kernel(
            name.encode(),
            *(ctypes.c_int64(blocks), ctypes.c_int64(block), (ctypes.c_uint64 * len(words))(*words)),
            *(ctypes.c_int64(len(words)), ctypes.c_uint64(seed), told, ctypes.c_int64(400)),
        )
        if failed:
            raise RuntimeError(told.value.decode())
        return [list(one) for one in held if not isinstance(one, int)]

    return run


@pytest.mark.parametrize("seed", range(4))
def test_threads_of_a_block_meet(run, seed):
    values = [(7 * i) % 31 - 9 for i in range(3 * 64)]
    _, sums = run("pc_sums_the_block", 3, 64, values, [0] * 3, seed=seed)
    assert sums == [sum(values[64 * b : 64 * b + 64]) for b in range(3)]


@pytest.mark.parametrize("seed", range(4))
def test_a_warp_shares_what_its_lanes_hold(run, seed):
    values = [(13 * i) % 101 - 20 for i in range(64)]
    _, least, negative = run("pc_least_of_a_warp", 1, 64, values, [0] * 64, [0] * 64, seed=seed)
    assert least == [min(values[:32])] * 32 + [min(values[32:])] * 32
    assert negative[0] & 0xFFFFFFFF == sum((values[i] < 0) << i for i in range(32))


@pytest.mark.parametrize("seed", range(4))
def test_all_threads_meet_across_blocks(run, seed):
    values, _ = run("pc_passes_on", 3, 32, list(range(96)), [0], 5, seed=seed)
    assert values == [(i + 5 * 37) % 96 + 5 for i in range(96)]


def test_a_kernel_that_forgets_to_meet_gives_wrong_results(run):
    values = list(range(1, 65))
    _, sums = run("pc_forgets_to_meet", 1, 64, values, [0] * 64)
    assert sums != values[1:] + values[:1]


def test_a_thread_that_leaves_while_others_wait_is_told_of(run):
    with pytest.raises(RuntimeError, match="pc_leaves_early: 63 of 64 threads wait for others"):
        run("pc_leaves_early", 1, 64, [0] + [1] * 63, [0] * 64)


@pytest.mark.parametrize("name", ["pc_meets_unsaid", "pc_meets_all_unsaid"])
def test_a_kernel_that_does_not_say_how_its_threads_meet_is_refused(run, name):
    with pytest.raises(RuntimeError, match=f"{name}: .*threads meet in a kernel that does not say so"):
        run(name, 1, 32, [0] * 32)


def test_an_unknown_kernel_and_a_wrong_number_of_arguments_are_refused(run):
    with pytest.raises(RuntimeError, match="pc_none: there is no such kernel"):
        run("pc_none", 1, 1)
    with pytest.raises(RuntimeError, match="another number of arguments"):
        run("pc_sums_the_block", 1, 1, [0])
