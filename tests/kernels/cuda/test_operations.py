"""Every kernel of the GPU gives what the reference gives, whatever the order of its threads."""

from __future__ import annotations

import pytest
import torch

from pcdata import functional as F
from pcdata.contracts.dispatch import INNER, OPERATIONS
from pcdata.functional.largest_planes import largest_planes
from pcdata.rng import seeded
from tests import pretend_device
from tests.factories import assert_same
from tests.functional.test_op_contract import EXAMPLES, call, clouds_of, packed
from tests.functional.tsdf.test_step_contract import EXAMPLES as FUSION_STEPS
from tests.functional.tsdf.test_step_contract import call as call_step
from tests.kernels.cuda import harness
from tests.kernels.cuda.inner_calls import CALLS, on_image

pytestmark = pytest.mark.skipif(harness.unavailable() is not None, reason=str(harness.unavailable()))
harness.register()

SERVED = [example for example in EXAMPLES if OPERATIONS[example.name].serves(harness.BACKEND)]
# Clouds that kernels do not know: other than three coordinates.
LEFT_TO_REFERENCES = {"in_six_dimensions"}
each_served = pytest.mark.parametrize(
    "example", SERVED, ids=[f"{example.name}-{example.cloud.__name__}" for example in SERVED]
)


@each_served
def test_it_gives_what_the_reference_gives(example, ordered):
    arguments = packed(example, clouds_of(example))
    expected = call(example, arguments, backend="torch")
    for found, wanted in zip(call(example, arguments, backend=harness.BACKEND), expected, strict=True):
        if wanted.is_floating_point():
            torch.testing.assert_close(found, wanted, rtol=1e-6, atol=1e-6)
        else:
            assert torch.equal(found, wanted)


@pytest.mark.parametrize("name", CALLS)
def test_an_inner_function_gives_what_its_reference_gives(name, ordered):
    assert harness.BACKEND in INNER[name].kernels
    assert_same(CALLS[name](harness.BACKEND), CALLS[name]("torch"), tolerance=1e-6)
    assert ordered.started


@each_served
def test_a_cloud_in_a_batch_is_what_it_is_alone(example):
    clouds = clouds_of(example)
    expected = call(example, packed(example, clouds), backend="torch")
    together = call(example, packed(example, clouds), backend=harness.BACKEND)
    assert all(found.shape == wanted.shape for found, wanted in zip(together, expected, strict=True))
    for cloud in clouds:
        alone = packed(example, [cloud])
        for found, wanted in zip(
            call(example, alone, backend=harness.BACKEND), call(example, alone, backend="torch"), strict=True
        ):
            torch.testing.assert_close(found, wanted, rtol=1e-6, atol=1e-6)


@pytest.mark.skipif(not pretend_device.AVAILABLE, reason="this PyTorch has no devices written in Python")
@each_served
def test_on_a_device_auto_takes_the_kernels_and_results_stay_there(example, monkeypatch):
    device = harness.as_on_a_gpu(monkeypatch)
    arguments = packed(example, clouds_of(example))
    expected = call(example, arguments, backend="torch")
    launcher = harness.use(0)
    found = call(example, {key: value.to(device) for key, value in arguments.items()})
    assert launcher.started or example.cloud.__name__ in LEFT_TO_REFERENCES
    for one, wanted in zip(found, expected, strict=True):
        assert one.device.type == device.type
        torch.testing.assert_close(pretend_device.host(one), wanted, rtol=1e-6, atol=1e-6)


def test_every_kernel_is_run_by_some_operation():
    ran: set[str] = set()
    for example in SERVED:
        launcher = harness.use(0)
        call(example, packed(example, clouds_of(example)), backend=harness.BACKEND)
        ran |= set(launcher.started)
    launcher = harness.use(0)
    for run in CALLS.values():
        run(harness.BACKEND)
    for k in (8, 16, 32, 64):  # in windows
        for operation, count in (
            (F.knn, "k"),
            (F.statistical_outlier_mask, "num_neighbors"),
            (F.estimate_normals, "max_neighbors"),
        ):
            operation(**on_image(), **{count: k}, backend=harness.BACKEND)
    F.radius_outlier_mask(**on_image(), backend=harness.BACKEND)
    for name, arguments in FUSION_STEPS.items():
        call_step(name, arguments(), harness.BACKEND)
    F.knn(torch.rand(1100, 3), k=1, backend=harness.BACKEND)  # parents of leaves
    F.statistical_outlier_mask(torch.rand(90, 3), num_neighbors=40, backend=harness.BACKEND)
    F.estimate_normals(torch.rand(90, 3), max_neighbors=40, backend=harness.BACKEND)
    F.farthest_point_sample(torch.rand(33_000, 3), num_samples=2, backend=harness.BACKEND)  # all blocks for one cloud
    F.farthest_point_sample(torch.rand(33_000, 4), num_samples=2, backend=harness.BACKEND)  # in four columns
    many, ptr = torch.rand(17_000, 3, generator=seeded(0)), torch.tensor([0, 17_000])  # some of them are searched
    largest_planes(many, ptr, distance=0.1, num_hypotheses=5, seed=0, probability=0.9, backend=harness.BACKEND)
    ran |= set(launcher.started)
    assert ran == set(harness.kernel_names())
