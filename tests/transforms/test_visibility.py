"""Steps that keep what a camera sees."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from pcdata import transforms as T
from pcdata.errors import ConfigError, FrameError
from pcdata.functional import hidden_point_mask
from tests.factories import cloud_in_base, tabletop_frame
from tests.transforms.examples import VIEW


def test_of_another_view_s_points_those_stay_that_the_camera_has_in_its_image():
    frame = tabletop_frame(2)
    cloud = T.ToFrame(frame="base")(T.Deproject()(frame))
    k = frame.camera.intrinsics[0].tolist()
    step = T.CropFrustum(
        frame="base",
        frame_from_camera=tuple(map(tuple, frame.world_from_camera[0].tolist())),
        **{"fx": k[0][0], "fy": k[1][1], "cx": k[0][2], "cy": k[1][2], "size": frame.size},
    )
    kept = step(cloud)
    # Rays through the edges are rounded on their way to the base and back.
    assert kept[0].num_points > 0.98 * cloud[0].num_points
    assert 0 < kept[1].num_points < cloud[1].num_points
    outside = dataclasses.replace(step)
    outside = T.CropFrustum(**{**step.config_fields(), "invert": True})(cloud[1])
    assert outside.num_points + kept[1].num_points == cloud[1].num_points


def test_a_camera_that_is_none_and_a_pose_that_is_not_rigid_are_refused():
    for wrong, message in (
        ({"near": 1.0, "far": 0.5}, "near must be below far"),
        ({"cx": 500.0}, "principal point"),
        ({"lens": "fisheye"}, "fisheye has 4 coefficients"),
        ({"frame_from_camera": ((2.0, 0, 0, 0), (0, 1.0, 0, 0), (0, 0, 1.0, 0), (0, 0, 0, 1.0))}, "frame_from_camera"),
    ):
        with pytest.raises(ConfigError, match=message):
            T.CropFrustum(**{**VIEW, **wrong})


def test_points_that_are_hidden_from_where_the_sensor_stood_go():
    data = cloud_in_base((300, 200))
    kept = T.RemoveHiddenPoints()(data)
    hidden = hidden_point_mask(data.points, data.ptr, viewpoint=data.viewpoint)
    assert torch.equal(kept.points, data.points[~hidden])
    merged = T.MergeViews()(T.ToFrame(frame="base")(T.Deproject()(tabletop_frame(2))))
    with pytest.raises(FrameError, match="needs the viewpoint of each cloud"):
        T.RemoveHiddenPoints()(merged)
    seen = T.RemoveHiddenPoints(viewpoint=(0.0, 0.0, 3.0), frame="base")(merged)
    assert 0 < seen.num_points < merged.num_points
    for one in ({"viewpoint": (0.0, 0.0, 1.0)}, {"frame": "base"}):
        with pytest.raises(ConfigError, match="a viewpoint and its frame, or neither"):
            T.RemoveHiddenPoints(**one)
