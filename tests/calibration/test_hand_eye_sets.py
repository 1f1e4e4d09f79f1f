"""Folders that ViSP and robot_cal_tools save calibrate a camera with one command and no option."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pcdata.calibration import Chessboard, RobotPoses, calibrate_hand_eye, locate_board, parse_board, read_robot_poses
from pcdata.calibration.board_images import read_gray
from pcdata.calibration.robot_poses import read_hand_eye_set
from pcdata.cli import main
from pcdata.errors import CalibrationError, CaptureError, ConfigError
from pcdata.geometry import rigid
from pcdata.io.calibration.pose_nodes import rotation_from_vector
from pcdata.structures import Camera
from tests.calibration.boards import CAMERA, CHARUCO, CHESSBOARD, rendered
from tests.calibration.robots import MOUNT_FROM_CAMERA, apart, camera_poses, robot_poses

XML = """<?xml version="1.0"?><root><!-- a note --><camera><name>Camera</name>
<image_width>640</image_width><image_height>480</image_height><model><type>{kind}</type>
<px>604.0</px><py>606.5</py><u0>316.2</u0><v0>244.7</v0><kud>{kud}</kud><kdu>0</kdu></model></camera></root>"""
PINHOLE = Camera.pinhole(fx=604.0, fy=606.5, cx=316.2, cy=244.7, size=(480, 640))


def visp_pose(pose: torch.Tensor) -> str:
    """Six rows, as ViSP writes a pose vector."""
    cv2 = pytest.importorskip("cv2")
    turn = cv2.Rodrigues(pose[:3, :3].numpy())[0].ravel().tolist()
    rows = "\n".join(f"  - [{value!r}]" for value in [*pose[:3, 3].tolist(), *turn])
    return f"rows: 6\ncols: 1\ndata: \n{rows}\n"


@pytest.fixture
def visp(tmp_path: Path) -> Path:
    """Five poses with the target's, as ViSP's tools leave them."""
    poses = robot_poses(camera_poses(5))
    for n, (robot, target) in enumerate(zip(poses.base_from_gripper, poses.camera_from_target), start=1):
        (tmp_path / f"ur_pose_rPe_{n}.yaml").write_text(visp_pose(robot))
        (tmp_path / f"ur_pose_cPo_{n}.yaml").write_text(visp_pose(target))
    return tmp_path


def test_poses_that_visp_located_give_the_camera(visp: Path) -> None:
    result = calibrate_hand_eye(read_robot_poses(visp))
    millimetres, degrees = apart(result.mount_from_camera, MOUNT_FROM_CAMERA)
    assert (result.setup, millimetres < 1e-3, degrees < 1e-4) == ("eye-in-hand", True, True)


def test_the_setup_is_what_fits_and_is_asked_for_where_neither_does() -> None:
    for setup in ("eye-in-hand", "eye-to-hand"):
        assert calibrate_hand_eye(robot_poses(camera_poses(6), setup=setup)).setup == setup
    poses = robot_poses(camera_poses(3))
    shuffled = RobotPoses(
        names=poses.names,
        base_from_gripper=poses.base_from_gripper,
        camera_from_target=poses.camera_from_target[[1, 2, 0]],
    )
    with pytest.raises(CalibrationError, match=r"--setup eye-in-hand or eye-to-hand|by different angles"):
        calibrate_hand_eye(shuffled)


def test_images_are_located_with_the_folders_camera_and_note(visp: Path) -> None:
    for file in [*visp.glob("*cPo*"), visp / "ur_pose_rPe_4.yaml", visp / "ur_pose_rPe_5.yaml"]:
        file.unlink()
    pytest.importorskip("cv2")
    for n, pose in enumerate(camera_poses(5)[:3], start=1):
        Image.fromarray(rendered(pose, CHESSBOARD)).save(visp / f"ur_image-{n}.png")
    (visp / "cam.xml").write_text(XML.format(kind="perspectiveProjWithDistortion", kud=0.08))
    with pytest.raises(ConfigError, match="--board chessboard:COLSxROWS:SQUARE"):
        read_robot_poses(visp)
    (visp / "note.txt").write_text("Chessboard\n9 x 6\nsquare size: 25 mm\n")
    found = read_hand_eye_set(visp)
    assert str(found.board) == "chessboard:9x6:0.025"
    assert found.camera_for is not None
    assert found.camera_for((480, 640)).distortion[0].tolist() == [0.08, 0.0, 0.0, 0.0]  # type: ignore[index]
    with pytest.raises(CaptureError, match="cameras of 640x480, the images are 320x240"):
        found.camera_for((240, 320))
    poses = read_robot_poses(visp, camera=CAMERA)
    for pose, truth in zip(poses.camera_from_target, camera_poses(5)):
        millimetres, degrees = apart(pose, truth)
        assert millimetres < 0.5
        assert degrees < 0.2
    (visp / "ur_image-3.png").unlink()
    with pytest.raises(CaptureError, match=r"1 images that show the target are missing: .*/ur_image-3\.png"):
        read_robot_poses(visp)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<!DOCTYPE a><root/>", "no document type"),
        (XML.format(kind="ProjWithKannalaBrandtDistortion", kud=0), "the projection model 'ProjWithKannala"),
        (XML.format(kind="perspectiveProjWithDistortion", kud="x"), "<kud> must be a number, got 'x'"),
    ],
)
def test_a_camera_that_cannot_be_read_is_told(visp: Path, text: str, message: str) -> None:
    (visp / "cam.xml").write_text(text)
    with pytest.raises(CaptureError, match=message):
        read_robot_poses(visp)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ("[[1], [2]]", "a pose has 6 rows"),
        ("[[0], [0], [0], [180], [0], [0]]", "are these degrees"),
        ("[[0], [0], [0], [.nan], [0], [0]]", "finite number"),
        ("[[900], [0], [0], [0], [0], [0]]", "is it in millimetres"),
    ],
)
def test_faults_in_poses_are_told_with_their_file(visp: Path, data: str, message: str) -> None:
    (visp / "ur_pose_rPe_2.yaml").write_text(f"rows: 6\ncols: 1\ndata: {data}\n")
    with pytest.raises(CalibrationError, match=message):
        read_robot_poses(visp)


def test_a_chessboard_with_two_ends_is_never_taken_the_wrong_way_round() -> None:
    pytest.importorskip("cv2")
    pose = camera_poses(1)[0]
    turned = pose @ rigid.from_rotation_translation(
        rotation_from_vector(torch.tensor([0.0, 0.0, torch.pi])), torch.tensor([0.2, 0.125, 0.0], dtype=torch.float64)
    )
    seen = {}
    for name, one in (("as it is", pose), ("by half a turn", turned)):
        view = CHESSBOARD.find(rendered(one, CHESSBOARD))
        assert view is not None
        seen[name] = locate_board(view, CAMERA)[0]
        assert apart(seen[name], one)[1] < 0.2
    assert apart(*seen.values())[1] > 179
    assert not Chessboard(8, 6, 0.025).has_two_ends


def test_one_tag_among_several_is_asked_for_and_tells_no_lens() -> None:
    cv2 = pytest.importorskip("cv2")
    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    image = np.full((480, 640), 255, np.uint8)
    for number, left in ((3, 60), (7, 360)):
        image[140:340, left : left + 200] = cv2.aruco.generateImageMarker(tags, number, 200)
    with pytest.raises(ConfigError, match=r"tags 3, 7 are in one image; say which: tag:APRILTAG_36h11:0.048:ID"):
        parse_board("tag:APRILTAG_36h11:0.048").find(image)
    view = parse_board("tag:apriltag_36h11:0.048:7").find(image)
    assert view is not None
    place, rms = locate_board(view, PINHOLE)
    assert rms < 0.5
    assert place[2, 3] == pytest.approx(604 * 0.048 / 200, rel=0.01)  # 200 pixels wide, head on
    assert parse_board("tag:APRILTAG_36h11:0.048:8").find(image) is None
    for wrong in ("tag:APRILTAG_36h12:0.048", "tag:APRILTAG_36h11:48"):
        with pytest.raises(ConfigError):
            parse_board(wrong).find(image)


def robot_cal_tools(folder: Path) -> Path:
    """Six poses before a ChArUco board, as robot_cal_tools saves them."""
    cv2 = pytest.importorskip("cv2")
    (folder / "poses").mkdir()
    (folder / "images").mkdir()
    poses = robot_poses(camera_poses(6, degrees=25.0))
    for n, robot in enumerate(poses.base_from_gripper):
        x, y, z, w = _quaternion(robot)
        place = dict(zip("xyz", robot[:3, 3].tolist()))
        (folder / "poses" / f"{n}.yaml").write_text(json.dumps(place | {"qx": x, "qy": y, "qz": z, "qw": w}))
        Image.fromarray(rendered(poses.camera_from_target[n], CHARUCO)).save(folder / "images" / f"{n}.png")
    (folder / "cal_data.yaml").write_text(
        "".join(f"- {{pose: poses/{n}.yaml, image: images/{n}.png}}\n" for n in range(6))
    )
    (folder / "camera_intr.yaml").write_text("intrinsics: {fx: 604.0, fy: 606.5, cx: 316.2, cy: 244.7}\n")
    number = cv2.aruco.DICT_5X5_100
    (folder / "target.yaml").write_text(
        "target_finder: {type: 'rct_ros_tools::CharucoGridTargetFinderPlugin', rows: 7, cols: 9, chessboard_dim: 0.03, "
        f"aruco_marker_dim: 0.022, dictionary: {number}}}\n"
    )
    return folder


def _quaternion(pose: torch.Tensor) -> list[float]:
    from scipy.spatial.transform import Rotation

    return list(Rotation.from_matrix(pose[:3, :3].numpy()).as_quat())


def test_a_set_of_robot_cal_tools_with_its_images_gives_the_camera(tmp_path: Path) -> None:
    folder = robot_cal_tools(tmp_path)
    assert read_hand_eye_set(folder).board == CHARUCO
    poses = read_robot_poses(folder, camera=CAMERA)
    assert max(rms for rms in poses.reprojection_rms if rms is not None) < 0.3
    millimetres, degrees = apart(calibrate_hand_eye(poses).mount_from_camera, MOUNT_FROM_CAMERA)
    assert millimetres < 3
    assert degrees < 0.3


def test_a_list_that_leads_out_of_its_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "set").mkdir()
    (tmp_path / "p.yaml").write_text("{x: 0, y: 0, z: 0, qx: 0, qy: 0, qz: 0, qw: 1}")
    (tmp_path / "set" / "cal_data.yaml").write_text("- {pose: ../p.yaml, image: 0.png}\n")
    with pytest.raises(CaptureError):
        read_robot_poses(tmp_path / "set")


# -- real sets -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("folder", "setup", "board", "most_px", "most_mm"),
    [
        ("eye-in-hand", "eye-in-hand", "chessboard:9x6:0.0236", 0.6, 5.0),
        ("eye-to-hand", "eye-to-hand", "tag:APRILTAG_36h11:0.048", 0.5, 2.5),
    ],
)
def test_real_frankas_open_without_an_option(
    test_data: Path, folder: str, setup: str, board: str, most_px: float, most_mm: float
) -> None:
    pytest.importorskip("cv2")
    path = test_data / "visp_hand_eye" / folder
    poses = read_robot_poses(path)
    assert len(poses.names) == 8
    assert any(board in line for line in poses.read_from)
    assert max(rms for rms in poses.reprojection_rms if rms is not None) < most_px
    result = calibrate_hand_eye(poses)
    residuals = np.array([*result.translation_residuals.values()])
    assert result.setup == setup
    assert 1000 * np.sqrt((residuals**2).mean()) < most_mm  # where the eight poses put the target
    assert apart(result.solutions["Park-Martin"], result.mount_from_camera)[0] < 3


def test_real_sets_without_images_say_which_and_what_they_are(test_data: Path, capsys) -> None:
    root = test_data / "robot_cal_tools_poses"
    with pytest.raises(
        CaptureError, match=r"16 poses .* fx 1352\.03 .* images/0\.png, images/1\.png.*charuco:5x7:0\.03"
    ):
        read_robot_poses(root / "test_set_charuco")
    with pytest.raises(CaptureError, match=r"15 images .*images/14\.png.*ModifiedCircleGrid.* none that is located"):
        read_robot_poses(root / "test_set_10x10")
    with pytest.raises(CalibrationError, match=r"angles of joints .*base_from_gripper"):
        read_robot_poses(root / "positioner_kinematic_measurements.yaml")
    assert main(["inspect", str(root)]) == 0
    out = capsys.readouterr().out
    assert out.count("next          pcdata calib hand-eye") == 2


def test_quaternions_by_name_put_the_target_of_the_guesses_on_the_table(test_data: Path) -> None:
    found = read_hand_eye_set(test_data / "robot_cal_tools_poses" / "test_set_10x10")
    first = found.base_from_gripper["0"]
    assert first[:3, 2].tolist() == pytest.approx([0.0, 0.0, -1.0], abs=0.05)  # the tool looks down
    # Guesses of the set: the camera is turned by -90 degrees on the wrist, the target 0.772 m before it, facing it.
    camera = first @ rigid.from_rotation_translation(
        rotation_from_vector(torch.tensor([0.0, 0.0, -torch.pi / 2])), torch.zeros(3, dtype=torch.float64)
    )
    quaternion = torch.tensor([0.999656, 0.00396669, 0.020924, 0.0152998], dtype=torch.float64)
    target = camera @ rigid.from_rotation_translation(
        rigid.rotation_from_quaternion(quaternion / quaternion.norm()),
        torch.tensor([0.00330134, 0.0778156, 0.77218], dtype=torch.float64),
    )
    assert target[:3, 2].tolist() == pytest.approx([0.0, 0.0, 1.0], abs=0.05)
    assert abs(float(target[2, 3])) < 0.15


def test_inspect_and_validate_name_the_command(test_data: Path, capsys, tmp_path: Path) -> None:
    assert main(["inspect", str(test_data / "moveit_hand_eye")]) == 0
    assert "saved by MoveIt Calibration" in capsys.readouterr().out
    shutil.copytree(test_data / "visp_hand_eye" / "eye-in-hand", tmp_path / "a set")
    assert main(["validate", str(tmp_path / "a set")]) != 0
    assert f"pcdata calib hand-eye '{tmp_path / 'a set'}'" in capsys.readouterr().out
    assert read_gray(tmp_path / "a set" / "franka_image-1.png").shape == (480, 640)
