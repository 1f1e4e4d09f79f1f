"""A cloud remembers the depth image it lies on exactly as long as it lies on it."""

from __future__ import annotations

import pickle

import pytest
import torch

from pcdata.functional import project_points
from pcdata.rng import seeded
from pcdata.structures import PointCloud
from pcdata.synthetic import tabletop
from pcdata.transforms import (
    CropWorkspace,
    Deproject,
    FarthestPointSample,
    MaskDepth,
    MergeViews,
    NormalizeUnitSphere,
    RandomJitter,
    RandomScale,
    ToFrame,
    VoxelDownsample,
)

FRAME = tabletop(2, num_objects=3, num_views=2, size=(60, 80)).frame
CROP = CropWorkspace(frame="base", lower=(-0.3, -0.3, -0.01), upper=(0.3, 0.3, 0.4))


def on_image() -> PointCloud:
    return ToFrame(frame="base")(Deproject()(MaskDepth(far=2.0)(FRAME)))


def assert_grid_is_true(cloud: PointCloud) -> None:
    """Back in its camera, every point projects to the center of its pixel."""
    grid = cloud.image_grid()
    assert grid is not None
    assert grid.camera_from_points is not None
    seen = cloud.transformed(grid.camera_from_points)
    pixels, _ = project_points(seen.points, seen.ptr, intrinsics=grid.intrinsics)
    height, width = grid.size
    assert (height, width) == FRAME.size
    expected = torch.stack([grid.pixel_index % width, grid.pixel_index // width], dim=1)
    torch.testing.assert_close(pixels.double(), expected.double(), atol=1e-3, rtol=0)


def test_the_grid_of_a_moved_and_cropped_cloud_is_true() -> None:
    cropped = CROP(on_image())
    assert cropped.num_points < on_image().num_points
    assert_grid_is_true(cropped)


def test_the_grid_survives_batching_and_pickling() -> None:
    cloud = CROP(on_image())
    for single in cloud.unbatch():
        assert_grid_is_true(single)
    assert_grid_is_true(PointCloud.cat(cloud.unbatch()))
    assert_grid_is_true(pickle.loads(pickle.dumps(cloud)))


@pytest.mark.parametrize(
    "step",
    [
        MergeViews(),
        VoxelDownsample(voxel_size=0.01),
        FarthestPointSample(num_points=50),
        NormalizeUnitSphere(),
        RandomJitter(),
        RandomScale(low=1.5, high=1.6),
    ],
    ids=lambda step: type(step).__name__,
)
def test_a_step_that_leaves_the_image_forgets_it(step: torch.nn.Module) -> None:
    generator = seeded(0) if step.is_random else None
    assert step(CROP(on_image()), generator=generator).image_grid() is None


def test_clouds_of_different_images_share_no_grid() -> None:
    small = ToFrame(frame="base")(Deproject()(tabletop(2, num_objects=1, size=(30, 40)).frame))
    assert PointCloud.cat([small, on_image()]).image_grid() is None
