"""Images one pixel wide, of one view or several, with readings or without: a result or a typed error."""

from __future__ import annotations

import pytest
import torch

import pcdata
from pcdata import transforms as T
from pcdata.alignment.patches import fit_depth_patches
from pcdata.errors import PcdataError
from pcdata.rng import seeded
from pcdata.structures import Camera, DepthFrame, register_to_color
from tests.transforms.examples import ALL, NAMES

SIZES = [(1, 64), (64, 1), (1, 1), (1, 3), (2, 2)]
FROM_IMAGES = [(example.transform, name) for example, name in zip(ALL, NAMES) if example.transform.takes is DepthFrame]
CHAINS = {
    "normals": [T.Deproject(), T.EstimateNormals()],
    "merged": [T.Deproject(), T.ToFrame(frame="base"), T.MergeViews(voxel_size=0.01), T.EstimateNormals()],
    "outliers": [T.Deproject(), T.RemoveStatisticalOutliers(), T.RemoveRadiusOutliers()],
    "objects": [T.Deproject(), T.ClusterObjects(min_size=1, min_points=1)],
    "voxels": [T.Deproject(), T.VoxelDownsample(voxel_size=0.01)],
    "plane": [T.Deproject(), T.RemovePlane()],
}


def thin(size: tuple[int, int], views: int, *, empty: bool) -> DepthFrame:
    height, width = size
    generator = seeded(0)
    depth = 0.5 + 0.3 * torch.rand(views, *size, generator=generator)
    depth = torch.where(torch.rand(depth.shape, generator=generator) < (1.0 if empty else 0.2), 0.0, depth)
    camera = Camera.pinhole(fx=60.0, fy=60.0, cx=(width - 1) / 2, cy=(height - 1) / 2, size=size)
    return DepthFrame(
        depth=depth,
        camera=Camera(intrinsics=camera.intrinsics.repeat(views, 1, 1), size=size),
        colors=torch.randint(256, (views, *size, 3), generator=generator, dtype=torch.uint8),
        labels=torch.randint(3, (views, *size), generator=generator),
        world_from_camera=torch.eye(4, dtype=torch.float64).repeat(views, 1, 1),
        frame_id="base",
        sample_id="thin",
    )


@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("views", [1, 2])
@pytest.mark.parametrize("empty", [False, True])
def test_thin_images_pass_or_raise_a_typed_error(size, views, empty):
    frame = thin(size, views, empty=empty)
    move = torch.eye(4, dtype=torch.float64).repeat(views, 1, 1)
    calls = {name: (lambda step=step: step(frame, generator=seeded(0))) for step, name in FROM_IMAGES}
    calls |= {name: (lambda steps=steps: T.Compose(steps)(frame)) for name, steps in CHAINS.items()}
    calls["registration"] = lambda: register_to_color(frame, frame.colors, frame.camera, move)
    calls["validate"] = lambda: pcdata.validate_frame(frame)
    done = 0
    for name, call in calls.items():
        try:
            call()
        except PcdataError:
            continue
        except Exception as error:
            raise AssertionError(name) from error
        done += 1
    assert done > len(FROM_IMAGES) // 3


@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("focal", [20.0, 60.0, 600.0])
def test_an_image_too_small_for_a_window_holds_no_patch(size, focal):
    intrinsics = torch.tensor([[focal, 0.0, 0.0], [0.0, focal, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    patches = fit_depth_patches(torch.ones(size), intrinsics)
    assert patches.depth.shape == patches.half.shape == patches.points.shape[:2]
    assert not bool((patches.depth > 0).any())
