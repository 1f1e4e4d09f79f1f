"""Presets on noisy, thin and real captures: what a preset makes, its own check takes, or the choice is named."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch

from pcdata.errors import ConfigError, ContractError, ShapeError, TooFewPointsError
from pcdata.io import open_source
from pcdata.models import CONTRACTS, check, preset, require
from pcdata.models.catalog import is_camera
from pcdata.rng import seeded
from pcdata.structures import DepthFrame, PointCloud
from pcdata.synthetic import tabletop
from pcdata.transforms import DecimateDepth, VoxelDownsample
from pcdata.verdicts import Verdict
from tests.models.captures import ANSWERS, answers, made_preset

each_contract = pytest.mark.parametrize("name", CONTRACTS)

TABLE_BOX = ((-0.4, -0.4, -0.01), (0.4, 0.4, 0.5))
NARROW_BOX = ((-0.2, -0.2, -0.01), (0.2, 0.2, 0.5))


@cache
def noisy(num_views: int) -> DepthFrame:
    """Views of a table of 640x480 pixels with a stereo camera's noise."""
    return tabletop(5, num_objects=5, num_views=num_views, size=(480, 640), noise="stereo", sample_id="noisy").frame


@cache
def real(capture_name: str) -> DepthFrame | PointCloud:
    """The first capture of a folder of real ones."""
    if "PCDATA_TEST_DATA" not in os.environ:
        pytest.skip("PCDATA_TEST_DATA is not set: no real captures")
    source = open_source(Path(os.environ["PCDATA_TEST_DATA"]) / capture_name)
    return source.load(source.ids[0])


@cache
def decimated(capture: Callable[..., DepthFrame], which: int | str, factor: int) -> DepthFrame:
    """A capture with fewer pixels."""
    return DecimateDepth(factor=factor)(capture(which))


def affordable(name: str, capture: Callable[..., DepthFrame | PointCloud], which: int | str) -> DepthFrame | PointCloud:
    """Fewer pixels for models with normals, which take seconds per view where the compiled kernels are missing."""
    data = capture(which)
    with_normals = any(channel.name == "normals" for spec in CONTRACTS[name].tensors for channel in spec.channels)
    wide = isinstance(data, DepthFrame) and with_normals and CONTRACTS[name].voxel is None
    if wide:
        return decimated(capture, which, 4)
    large = isinstance(data, DepthFrame) and data.size[1] > 640 and CONTRACTS[name].takes != "depth image"
    return decimated(capture, which, 2) if large else data


@pytest.mark.parametrize(
    ("num_views", "crop", "choices"),
    [
        (1, TABLE_BOX, {}),
        (2, NARROW_BOX, {}),
        (2, None, {}),
        (1, NARROW_BOX, {"num_points": 5000}),
        (2, TABLE_BOX, {"num_points": 5000}),
        (1, None, {"num_points": 19000}),
        (2, NARROW_BOX, {"num_points": 19000}),
    ],
)
def test_the_voxel_size_is_found_for_the_count_whatever_the_crop(num_views, crop, choices):
    made = preset("dp3_guide", frame="base", crop=crop, **choices)
    batch = made.collate([made.pipeline(noisy(num_views))])
    wanted = choices.get("num_points", 10000)
    assert wanted <= batch.counts[0] <= 1.05 * wanted
    assert check(batch, "dp3_guide").verdict is Verdict.PASS


def test_a_voxel_size_that_was_chosen_stays_and_a_count_it_cannot_reach_names_the_choice():
    made = preset("dp3_guide", frame="base", crop=TABLE_BOX, voxel_size=0.003)
    assert [step.voxel_size for step in made.pipeline.steps if isinstance(step, VoxelDownsample)] == [0.003]
    with pytest.raises(ContractError, match=r"takes 5000 to 20000: .*crop=.*voxel_size="):
        made.collate([made.pipeline(noisy(2))])
    coarse = preset("dp3_guide", frame="base", crop=TABLE_BOX, voxel_size=0.05)
    with pytest.raises(ContractError, match=r"crop=.*voxel_size="):
        coarse.collate([coarse.pipeline(noisy(1))])
    for count in (4999, 20000):
        with pytest.raises(ConfigError, match="wanted number of voxels, 5000 to 19000"):
            preset("dp3_guide", frame="base", crop=None, num_points=count)
    with pytest.raises(ConfigError, match="give one of the two"):
        preset("dp3_guide", frame="base", crop=None, num_points=6000, voxel_size=0.005)


@each_contract
def test_noisy_captures_through_a_preset_are_what_its_own_check_takes(name):
    given = answers(name)
    table = {"crop": TABLE_BOX} if "crop" in given and not is_camera(CONTRACTS[name]) else {}
    made = preset(name, **given | table)
    sample = made.pipeline(affordable(name, noisy, 2), generator=seeded(0) if made.pipeline.is_random else None)
    assert check(made.collate([sample]), name).samples[Verdict.FAIL] == 0


@each_contract
@pytest.mark.parametrize("side", [4, 16, 40])
def test_a_few_readings_pass_or_are_refused_with_what_to_change(name, side):
    """A preset may pad; what it cannot repair is an error or a verdict that names a choice, or asks for more."""
    frame, inside = noisy(1), torch.zeros(480, 640)
    inside[240 - side // 2 : 240 + side // 2, 320 - side // 2 : 320 + side // 2] = 1
    few = replace(frame, depth=frame.depth * inside)
    made = made_preset(name)
    fault = ""
    try:
        sample = made.pipeline(few, generator=seeded(0) if made.pipeline.is_random else None)
        require(made.collate([sample]), name)
    except (ContractError, TooFewPointsError) as error:
        fault = str(error)
    assert not fault or re.search(r"crop=|num_points|voxel_size=|more readings|min_points|has no points", fault)
    if side == 4 and CONTRACTS[name].takes == "cloud":
        assert fault  # 16 readings are no surface


@each_contract
@pytest.mark.parametrize("capture_name", ["graspnet_frame", "osd", "seven_scenes"])
def test_real_captures_through_a_preset_are_what_its_own_check_takes(name, capture_name):
    if isinstance(real(capture_name), PointCloud) and (
        CONTRACTS[name].takes == "depth image" or CONTRACTS[name].main.content == "organized"
    ):
        pytest.skip("the model takes depth images, and this is a cloud")
    box = {**ANSWERS, "frame": "camera", "crop": ((-2.0, -2.0, 0.1), (2.0, 2.0, 3.0))}
    made = preset(name, **{choice: box[choice] for choice in CONTRACTS[name].required_choices})
    sample = made.pipeline(
        affordable(name, real, capture_name), generator=seeded(0) if made.pipeline.is_random else None
    )
    assert check(made.collate([sample]), name).samples[Verdict.FAIL] == 0


def test_clouds_without_pixels_are_refused_for_organized_models():
    made = made_preset("3d_diffuser_actor")
    cloud = PointCloud(points=torch.rand(500, 3), frame_id="base", colors=torch.rand(500, 3))
    with pytest.raises(ShapeError, match="give depth images, not cloud files"):
        made.collate([cloud])
