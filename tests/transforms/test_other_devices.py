"""Steps and fusion on a device that is not the processor, without a GPU: see ``pretend_device``."""

from __future__ import annotations

import pytest
import torch

from pcdata.structures import PointCloud, TSDFVolume
from pcdata.synthetic import tabletop
from tests import pretend_device
from tests.factories import assert_same, cloud_in_base
from tests.pretend_device import device, host, watching
from tests.transforms.examples import Example
from tests.transforms.test_contract import COUNTS, each_example, run

pytestmark = pytest.mark.skipif(not pretend_device.AVAILABLE, reason="this PyTorch has no devices written in Python")


@each_example
def test_a_step_gives_on_another_device_what_it_gives_on_the_processor(example: Example):
    data = example.make(COUNTS)
    there = data.to(device())
    with watching() as watched:
        found = run(example, there)
    assert found.device.type == pretend_device.NAME
    assert watched.launches
    assert_same(run(example, data), found.to("cpu"), tolerance=2e-6)


def test_fusion_gives_the_same_surface():
    def fused(where: torch.device) -> TSDFVolume:
        volume = TSDFVolume(voxel_size=0.01, backend="torch", device=where)
        for seed in range(2):
            volume.integrate(tabletop(seed, size=(60, 80)).frame.to(where))
        return volume

    here, there = fused(torch.device("cpu")), fused(device())
    assert torch.equal(here.blocks.keys, host(there.blocks.keys))
    assert_same(here.extract_points(), there.extract_points().to("cpu"))
    assert_same(here.extract_mesh(), there.extract_mesh().to("cpu"))


def test_clouds_come_together_and_apart_there():
    clouds = [cloud_in_base((count,)) for count in (5, 1, 3)]
    together = PointCloud.cat([cloud.to(device()) for cloud in clouds])
    assert_same(together.to("cpu"), PointCloud.cat(clouds))
    assert_same(together.padded().to("cpu"), PointCloud.cat(clouds).padded())
    for one, other in zip(together.unbatch(), clouds, strict=True):
        assert_same(one.to("cpu"), other)
    assert_same(together.to_frame("camera").to("cpu"), PointCloud.cat(clouds).to_frame("camera"))
