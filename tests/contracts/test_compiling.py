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
from pcdata.errors import NonFiniteError
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
        label = F.dbscan(doubled, ptr, eps=0.5, min_points=2)
        index, *_ = F.farthest_point_groups(doubled, ptr, num_samples=2)
        return (doubled[index] + label[index, None]).sum(0)


class WithOperators(nn.Module):
    """Every operation that a compiler keeps whole."""

    def forward(self, points: Tensor, ptr: Tensor | None) -> tuple[Tensor, ...]:
        doubled = points * 2
        index, picked_ptr = F.farthest_point_sample(doubled, ptr, num_samples=2)
        picked = doubled[index]
        near, distance = F.knn(picked, picked_ptr, k=3, queries=doubled, queries_ptr=ptr)
        ball = F.ball_query(doubled, ptr, radius=0.4, max_neighbors=5, exclude_self=True)
        normals = F.estimate_normals(doubled, ptr, radius=0.5, max_neighbors=8)
        alone = F.radius_outlier_mask(doubled, ptr, radius=0.3) | F.statistical_outlier_mask(doubled, ptr)
        return picked + normals[index], near, distance * 2, *ball, alone & (doubled[:, 0] > 0)


@pytest.mark.parametrize("backend", ["eager", "aot_eager"])
@pytest.mark.parametrize("dynamic", [None, True])
def test_operations_of_known_shapes_are_no_cut(backend, dynamic):
    counter, network = CompileCounterWithBackend(backend), WithOperators()
    compiled = torch.compile(network, backend=counter, fullgraph=True, dynamic=dynamic)
    for clouds in batches():
        batch = collate_packed(clouds)
        for found, expected in zip(compiled(batch.points, batch.ptr), network(batch.points, batch.ptr), strict=True):
            assert torch.equal(found, expected)
    assert counter.frame_count <= 2
    for found, expected in zip(compiled(batch.points, None), network(batch.points, None), strict=True):
        assert torch.equal(found, expected)


POINTS, PTR = torch.rand(40, 3, generator=torch.Generator("cpu").manual_seed(0)), torch.tensor([0, 15, 40])
CALLS = {
    "farthest_point_sample": (POINTS, PTR, 4, torch.tensor([3, 0]), None, "auto"),
    "knn": (POINTS, PTR, 3, POINTS[:7], torch.tensor([0, 2, 7]), False, "l2", "torch"),
    "ball_query": (POINTS, None, 0.3, 4, None, None, True, "l2", "auto"),
    "estimate_normals": (POINTS, PTR, None, 9, "auto"),
    "statistical_outlier_mask": (POINTS, PTR, 5, 1.0, "auto"),
    "radius_outlier_mask": (POINTS, None, 3, 0.2, "auto"),
}


@pytest.mark.parametrize("name", CALLS)
def test_operators_keep_torch_s_rules(name):
    torch.library.opcheck(getattr(torch.ops.pcdata, name).default, CALLS[name])


def test_every_operator_is_tried_here():
    names = [name.partition("::") for name in torch._C._dispatch_get_all_op_names()]
    made = {name.partition(".")[0] for space, _, name in names if space == "pcdata"}
    assert made == CALLS.keys()


@pytest.mark.filterwarnings("ignore:The .grad attribute")  # the compiler looks at what a cut leaves
def test_a_gradient_through_neighbors_is_the_same_in_a_compiled_network():
    def loss(points: Tensor) -> Tensor:
        return F.knn(points, k=4)[1][:, 1:].sum()

    grads = []
    for call in (loss, torch.compile(loss, backend="eager")):
        points = POINTS.clone().requires_grad_()
        call(points).backward()
        grads.append(points.grad)
    assert torch.equal(*grads)


def test_an_operator_says_what_is_wrong_as_the_operation_does():
    compiled = torch.compile(lambda points: F.knn(points, k=2), backend="eager", fullgraph=True)
    with pytest.raises(NonFiniteError, match="knn: points has 3 NaN"):
        compiled(torch.full((1, 3), torch.nan))


@pytest.mark.parametrize(
    "call",
    [
        lambda points: F.farthest_point_sample(points, ratio=0.2)[0],
        lambda points: F.farthest_point_sample(points, num_samples=[4])[0],
        lambda points: F.ball_query(points, radius=torch.full((40,), 0.2), max_neighbors=3)[1],
        lambda points: F.radius_outlier_mask(points, radius=0.3, backend="torch"),
    ],
)
def test_calls_that_no_operator_takes_are_made_all_the_same(call):
    assert torch.equal(torch.compile(call, backend="eager")(POINTS), call(POINTS))


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
    with pytest.raises(Exception, match="dbscan: points has 1 NaN or infinite values of 3"):
        compiled(torch.full((1, 3), torch.nan)[:, :3].index_fill(1, torch.tensor([0, 1]), 0.0), torch.tensor([0, 1]))


def test_nobody_loads_the_compiler_who_does_not_compile():
    code = "import sys, pcdata, pcdata.functional, torch; assert 'torch._dynamo' not in sys.modules"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
