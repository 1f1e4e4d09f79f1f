from __future__ import annotations

import math

import pytest
import torch

from pcdata.errors import DTypeError, FrameError, UnitError
from pcdata.functional import ParallelJaw
from pcdata.rng import seeded
from pcdata.structures import PointCloud
from pcdata.transforms import Compose, NormalizeUnitSphere, RandomRotation, RemovePlane, ToFrame, judge_grasps
from tests.tables import TABLE, box, rectangle, seen_from_camera

GRIPPER = ParallelJaw(
    opening=0.1, finger_length=0.05, finger_thickness=0.01, finger_width=0.02, palm_length=0.05, tip=0.0
)
PITCH = math.radians(40)
STEPS = {
    "as it was": [],
    "in the table's frame": [ToFrame(frame="table")],
    "turned and normalized": [ToFrame(frame="table"), RandomRotation(axis=None), NormalizeUnitSphere()],
}


def scene() -> tuple[PointCloud, torch.Tensor]:
    """A block 10 cm high on a table, seen by a camera; and the pose of the table's frame in the camera's."""
    in_table = torch.cat([rectangle(**TABLE), box((0.1, 0.05, 0.0), (0.06, 0.3, 0.1), count=3000)])
    ends = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    origin, *axes = seen_from_camera(ends, PITCH).double()
    camera_from_table = torch.eye(4, dtype=torch.float64)
    camera_from_table[:3, :3] = torch.stack([axis - origin for axis in axes], 1)
    camera_from_table[:3, 3] = origin
    cloud = PointCloud(
        points=seen_from_camera(in_table, PITCH),
        frame_id="camera",
        viewpoint=torch.zeros(1, 3),
        frames={"table": torch.linalg.inv(camera_from_table)[None]},
    )
    return RemovePlane(which="supporting", cut="measured")(cloud), camera_from_table


def grasps_in_table() -> torch.Tensor:
    """Straight down over the block's middle, tips 6 cm over the table; leaning 30 degrees; dug in; and beside it."""
    down = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    lean = torch.eye(4, dtype=torch.float64)
    lean[1:3, 1:3] = torch.tensor(
        [[math.cos(math.pi / 6), -math.sin(math.pi / 6)], [math.sin(math.pi / 6), math.cos(math.pi / 6)]]
    )
    grasps = torch.stack([down, lean @ down, down, down])
    grasps[:, :3, 3] = torch.tensor([[0.1, 0.05, 0.06], [0.1, 0.05, 0.06], [0.1, 0.05, -0.02], [0.05, 0.05, 0.06]])
    return grasps


@pytest.mark.parametrize("steps", STEPS)
def test_grasps_of_the_camera_come_out_right_wherever_the_cloud_was_moved(steps):
    cloud, camera_from_table = scene()
    moved = Compose(STEPS[steps])(cloud, generator=seeded(3)) if STEPS[steps] else cloud
    in_table = grasps_in_table()
    for frame, grasps in (("camera", camera_from_table @ in_table), ("table", in_table)):
        found = judge_grasps(moved, grasps, GRIPPER, frame=frame)
        angles = [math.degrees(one) for one in found.angle.tolist()]
        assert angles == pytest.approx([0.0, 30.0, 0.0, 0.0], abs=0.5)
        assert found.clearance[[0, 2]].tolist() == pytest.approx([0.06, -0.02], abs=0.002)
        assert found.hits[0] == 0  # a block of 6 cm between fingers of 10 cm
        assert found.held[0] > 50
        assert found.hits[3] > 3  # a finger in the block


def test_frames_and_units_that_are_not_known_are_told():
    cloud, _ = scene()
    with pytest.raises(FrameError, match="know the frames"):
        judge_grasps(cloud, grasps_in_table(), GRIPPER, frame="robot")
    with pytest.raises(UnitError, match="frame='camera'"):
        judge_grasps(NormalizeUnitSphere()(cloud), grasps_in_table(), GRIPPER)


def test_without_a_table_there_are_only_points():
    cloud, camera_from_table = scene()
    bare = PointCloud(points=cloud.points, frame_id="camera")
    found = judge_grasps(bare, camera_from_table @ grasps_in_table(), GRIPPER)
    assert found.angle is None
    assert found.clearance is None
    assert found.held[0] > 50


def test_grasps_that_are_no_tensor_are_named():
    cloud, _ = scene()
    grasps = torch.eye(4, dtype=torch.float64)[None]
    with pytest.raises(DTypeError, match=r"judge_grasps: grasps must be a torch.Tensor, .*not ndarray"):
        judge_grasps(cloud, grasps.numpy(), GRIPPER)
    with pytest.raises(DTypeError, match=r"judge_grasps: openings must be a torch.Tensor, .*not list"):
        judge_grasps(cloud, grasps, GRIPPER, openings=[0.05])
