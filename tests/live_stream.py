"""A stream of one camera: noisy frames of a table, as captures and as arrays of a driver."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

import pcdata

SIZE = (60, 80)


def chain(**plane):
    return pcdata.Compose(
        [
            pcdata.MaskDepth(near=0.2, far=2.0),
            pcdata.RemoveFlyingPixels(),
            pcdata.Deproject(),
            pcdata.CropWorkspace(frame="camera", lower=(-0.4, -0.4, 0.2), upper=(0.4, 0.4, 1.5)),
            pcdata.RemoveStatisticalOutliers(),
            pcdata.RemoveRadiusOutliers(min_neighbors=2, radius=0.05),
            pcdata.RemovePlane(num_hypotheses=100, probability=0.99, **plane),
            pcdata.FarthestPointSample(num_points=64),
            pcdata.EstimateNormals(radius=0.1),
        ]
    )


def moved(scene, number):
    """Another frame of the same camera."""
    generator = torch.Generator().manual_seed(number)
    noise = 0.0005 * torch.randn(scene.depth.shape, generator=generator)
    return replace(scene, depth=torch.where(scene.depth > 0, scene.depth + noise, 0.0), sample_id=f"frame{number}")


def arrays(frame):
    """The frame as a driver gives it: millimetres, color and a pose."""
    depth = np.rint(frame.depth[0].numpy() * 1000).astype(np.uint16)
    return depth, frame.colors[0].numpy(), frame.world_from_camera[0].numpy()


def of_arrays(frame, **options):
    depth, colors, pose = arrays(frame)
    return pcdata.DepthFrame.from_numpy(
        depth,
        frame.camera,
        metres_per_unit=0.001,
        colors=colors,
        world_from_camera=pose,
        frame_id=frame.frame_id,
        **options,
    )


def assert_equal(cloud, expected):
    assert cloud.history == expected.history
    assert cloud.meta == expected.meta
    assert cloud.fields().keys() == expected.fields().keys()
    for name, values in expected.fields().items():
        assert torch.equal(cloud.fields()[name], values), name
