from __future__ import annotations

import dataclasses

import pytest
import torch

from pcdata.errors import ConfigError, FrameError, TooFewPointsError
from pcdata.geometry import rigid
from pcdata.rng import seeded
from pcdata.structures import PointCloud
from pcdata.transforms import Compose, CropWorkspace, NormalizeUnitSphere, RandomRotation
from tests.factories import cloud_in_base, cloud_in_camera

BOX = {"frame": "base", "lower": (-0.1, -0.1, -0.05), "upper": (0.1, 0.2, 0.3)}


def points_of(*rows: tuple[float, float, float]) -> PointCloud:
    return PointCloud(points=torch.tensor(rows), frame_id="base")


def test_exactly_the_points_inside_stay_in_order():
    cloud = cloud_in_base()
    cropped = CropWorkspace(**BOX)(cloud)
    lower, upper = torch.tensor(BOX["lower"]), torch.tensor(BOX["upper"])
    inside = ((cloud.points >= lower) & (cloud.points <= upper)).all(1)
    assert torch.equal(cropped.extra["row"], torch.nonzero(inside).squeeze(1))
    assert 0 < cropped.num_points < cloud.num_points


def test_crop_keeps_labels_aligned():
    cloud = cloud_in_base()
    cropped = CropWorkspace(**BOX)(cloud)
    assert torch.equal(cropped.labels, cloud.labels[cropped.extra["row"]])


def test_the_faces_belong_to_the_box():
    corners = points_of((-0.1, -0.1, -0.05), (0.1, 0.2, 0.3), (0.10001, 0.0, 0.0), (0.0, 0.20001, 0.0))
    assert CropWorkspace(**BOX)(corners).num_points == 2


def test_an_oriented_box_is_an_aligned_box_in_its_own_coordinates():
    cloud = cloud_in_base()
    angle = torch.tensor(0.7, dtype=torch.float64)
    rotation = rigid.rotation_about_axis(torch.tensor([0.0, 0.0, 1.0]), angle)
    pose = rigid.from_rotation_translation(rotation, torch.tensor([0.05, -0.03, 0.02]))
    sides = {"lower": (-0.08, -0.1, -0.1), "upper": (0.08, 0.1, 0.1)}
    oriented = CropWorkspace(frame="base", frame_from_box=pose, **sides)(cloud)
    in_box = cloud.transformed(rigid.invert_rigid(pose).repeat(3, 1, 1), frame_id="box")
    aligned = CropWorkspace(frame="box", **sides)(in_box)
    assert torch.equal(oriented.extra["row"], aligned.extra["row"])
    assert 0 < oriented.num_points < cloud.num_points


def test_a_box_in_another_frame_is_refused_with_the_way_out():
    with pytest.raises(FrameError) as caught:
        CropWorkspace(**BOX)(cloud_in_camera())
    assert str(caught.value).splitlines()[0] == (
        "CropWorkspace: its fields are given in frame 'base' but the cloud is in 'camera'; "
        "add ToFrame(frame='base') before it"
    )


def test_nothing_left_is_an_error_that_names_the_sample():
    far = {"frame": "base", "lower": (5.0, 5.0, 5.0), "upper": (6.0, 6.0, 6.0)}
    with pytest.raises(
        TooFewPointsError, match=r"CropWorkspace: nothing is left of cloud 0 \(sample 'sample-0'\): 0 of 120 points"
    ):
        CropWorkspace(**far)(cloud_in_base())


def test_a_box_that_is_none_is_refused():
    with pytest.raises(ConfigError, match="lower must be below upper on every axis"):
        CropWorkspace(frame="base", lower=(0, 0, 0), upper=(1, 0, 1))
    with pytest.raises(ConfigError, match="frame_from_box: the pose is not rigid"):
        CropWorkspace(**BOX, frame_from_box=[[2.0, 0, 0, 0], [0, 2.0, 0, 0], [0, 0, 2.0, 0], [0, 0, 0, 1.0]])


def test_cropped_normalized_and_rotated_clouds_return_to_their_source():
    source = cloud_in_camera((200, 30, 120))
    cloud = source.transformed(source.frames["base"], frame_id="base")
    chain = Compose([CropWorkspace(**BOX), NormalizeUnitSphere(), RandomRotation(axis=None)])
    result = chain(cloud, generator=seeded(0))
    assert result.unit == "normalized"
    back = result.in_source_frame()
    assert (back.frame_id, back.unit) == ("camera", "m")
    error = (back.points - source.points[result.extra["row"]]).norm(dim=1)
    assert float(error.max()) < 1e-6


def test_an_empty_cloud_of_a_batch_stays_empty():
    cloud = cloud_in_base((50, 0, 50))
    assert int(CropWorkspace(**BOX)(cloud).counts[1]) == 0
    assert dataclasses.replace(cloud).counts.tolist() == [50, 0, 50]
