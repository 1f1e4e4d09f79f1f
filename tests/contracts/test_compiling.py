"""``torch.compile``: a network compiles once for all batches, and is cut where it calls an operation or a step."""

from __future__ import annotations

import subprocess
import sys
from functools import partial

import pytest
import torch
from torch import Tensor, nn
from torch._dynamo.testing import CompileCounter, CompileCounterWithBackend

from pcdata import functional as F
from pcdata.datasets.collate import collate_fixed, collate_packed, collate_padded
from pcdata.structures import PointCloud
from pcdata.transforms import Compose, CropWorkspace, RandomSample
from tests.factories import cloud_in_base

COUNTS = ((30, 21, 40), (31, 50, 2), (100, 3, 9), (7, 8, 9))


@pytest.fixture(autouse=True)
def _compiler_begins_anew():
    torch.compiler.reset()
    yield
    torch.compiler.reset()


class OfPacked(nn.Module):
    """The smallest network on packed clouds: a layer, the largest of every cloud, a layer."""

    def __init__(self) -> None:
        super().__init__()
        self.inner, self.outer = nn.Linear(3, 8), nn.Linear(8, 2)

    def forward(self, points: Tensor, ptr: Tensor) -> Tensor:
        features = torch.relu(self.inner(points))
        cloud = torch.searchsorted(ptr, torch.arange(len(points)), right=True) - 1
        top = features.new_full((len(ptr) - 1, 8), -1e9)
        return self.outer(top.scatter_reduce(0, cloud[:, None].expand_as(features), features, "amax"))


class OfPadded(OfPacked):
    def forward(self, points: Tensor, mask: Tensor) -> Tensor:
        features = torch.relu(self.inner(points)).masked_fill(~mask[..., None], -1e9)
        return self.outer(features.amax(1))


def batches() -> list[list[PointCloud]]:
    return [[cloud_in_base((count,), seed=count) for count in counts] for counts in COUNTS]


@pytest.mark.parametrize("backend", ["eager", "aot_eager"])
def test_a_network_of_packed_batches_compiles_once_where_their_length_is_said_to_change(backend):
    counter, network = CompileCounterWithBackend(backend), OfPacked()
    compiled = torch.compile(network, backend=counter)
    for clouds in batches():
        batch = collate_packed(clouds)
        torch._dynamo.mark_dynamic(batch.points, 0)
        assert torch.equal(compiled(batch.points, batch.ptr), network(batch.points, batch.ptr))
    assert counter.frame_count == 1


def test_the_compiler_finds_out_by_itself_at_the_second_batch():
    counter, network = CompileCounter(), OfPacked()
    compiled = torch.compile(network, backend=counter)
    for clouds in batches():
        batch = collate_packed(clouds)
        compiled(batch.points, batch.ptr)
    assert counter.frame_count == 2


def test_clouds_padded_to_buckets_compile_once_for_each_bucket():
    collate = partial(collate_padded, buckets=(64, 128))
    counter, network = CompileCounter(), OfPadded()
    compiled = torch.compile(network, backend=counter, dynamic=False)
    for clouds in batches() * 2:
        batch = collate(clouds)
        assert torch.equal(compiled(batch.points, batch.mask), network(batch.points, batch.mask))
    assert counter.frame_count == 2


def test_clouds_of_one_length_compile_once():
    sample = RandomSample(num_points=16, with_replacement=True)
    counter, network = CompileCounter(), OfPadded()
    compiled = torch.compile(network, backend=counter, dynamic=False)
    for seed, clouds in enumerate(batches()):
        generator = torch.Generator("cpu").manual_seed(seed)
        batch = collate_fixed([sample(cloud, generator=generator) for cloud in clouds])
        compiled(batch.points, batch.mask)
    assert counter.frame_count == 1


class WithOperations(nn.Module):
    def forward(self, points: Tensor, ptr: Tensor) -> Tensor:
        doubled = points * 2
        normals = F.estimate_normals(doubled, ptr, radius=0.5, max_neighbors=8)
        index, _ = F.farthest_point_sample(doubled, ptr, num_samples=2)
        return (doubled[index] + normals[index]).sum(0)


class WithStep(nn.Module):
    def __init__(self, step: nn.Module) -> None:
        super().__init__()
        self.step, self.network = step, OfPacked()

    def forward(self, cloud: PointCloud) -> Tensor:
        cloud = self.step(cloud)
        return self.network(cloud.points * 2, cloud.ptr)


CROP = CropWorkspace(frame="base", lower=(-9.0, -9.0, -9.0), upper=(9.0, 9.0, 9.0))


def test_operations_cut_a_compiled_network_once_each_and_are_not_traced():
    counter, network = CompileCounter(), WithOperations()
    compiled = torch.compile(network, backend=counter)
    for clouds in batches():
        batch = collate_packed(clouds)
        assert torch.equal(compiled(batch.points, batch.ptr), network(batch.points, batch.ptr))
    # Before the two calls and behind them, each once for the first length and once for any.
    assert counter.frame_count <= 4


@pytest.mark.parametrize("step", [CROP, Compose([CROP, CROP])], ids=["step", "chain"])
def test_steps_cut_a_compiled_network_once_and_are_not_traced(step):
    counter, network = CompileCounter(), WithStep(step)
    compiled = torch.compile(network, backend=counter)
    for clouds in batches():
        batch = collate_packed(clouds)
        assert torch.equal(compiled(batch), network(batch))
    assert counter.frame_count <= 2


def test_what_is_wrong_is_told_as_without_a_compiler():
    compiled = torch.compile(WithOperations(), backend="eager")
    with pytest.raises(Exception, match="estimate_normals: points has 1 NaN or infinite values of 3"):
        compiled(torch.full((1, 3), torch.nan)[:, :3].index_fill(1, torch.tensor([0, 1]), 0.0), torch.tensor([0, 1]))


def test_nobody_loads_the_compiler_who_does_not_compile():
    code = "import sys, pcdata, pcdata.functional, torch; assert 'torch._dynamo' not in sys.modules"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
