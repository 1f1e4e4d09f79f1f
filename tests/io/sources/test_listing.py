"""What lies in a capture: links to nothing, folders of other names and files that belong to nothing are told."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.io import savemat

from pcdata import open_source, validate_source, write_ply
from pcdata.errors import CaptureError, ConfigError
from pcdata.exports.episodes import episode_names
from pcdata.io import AveragedSource, TemporallyFilteredSource
from pcdata.structures import PointCloud

SIZE = (6, 8)
INTRINSICS = {"width": 8, "height": 6, "fx": 10.0, "fy": 10.0, "cx": 3.5, "cy": 2.5, "metres_per_unit": 0.001}


def png(path: Path, value: int = 800) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full(SIZE, value, np.uint16)).save(path)


def rgb(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.zeros((*SIZE, 3), np.uint8)).save(path)


def pose(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")


def folder(root: Path, names: list[str]) -> Path:
    for number, name in enumerate(names):
        png(root / "depth" / f"{name}.png", 800 - 4 * number)
        rgb(root / "color" / f"{name}.png")
        pose(root / "poses" / f"{name}.txt")
    (root / "intrinsics.json").write_text(json.dumps(INTRINSICS | {"frame_id": "base"}))
    return root


def rig(root: Path) -> Path:
    for camera in ("left", "right"):
        folder(root / camera, ["1", "2"])
    return root


def scenes(root: Path) -> Path:
    for number in (9, 10):
        png(root / f"frame-{number}.depth.png")
        rgb(root / f"frame-{number}.color.png")
        pose(root / f"frame-{number}.pose.txt")
    (root / "camera-intrinsics.txt").write_text("10 0 3.5 0 10 2.5 0 0 1")
    return root


def graspnet(root: Path) -> Path:
    for name in ("9", "10"):
        png(root / name / "depth.png")
        png(root / name / "label.png", 0)
        rgb(root / name / "color.png")
        k = np.array([[10, 0, 3.5], [0, 10, 2.5], [0, 0, 1]])
        savemat(root / name / "meta.mat", {"intrinsic_matrix": k, "factor_depth": np.array([[1000]])})
    return root


def clouds(root: Path) -> Path:
    root.mkdir()
    for name in ("9", "10"):
        write_ply(root / f"{name}.ply", PointCloud(points=torch.rand(5, 3), frame_id="x"))
    return root


def lose(path: Path) -> None:
    """Make a path a link to what is not there, as a checkout of DataLad or DVC without its content has."""
    shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    path.symlink_to("/nowhere/at/all")


# -- order -------------------------------------------------------------------------------------------------------------


def test_unpadded_numbers_are_counted_at_every_door(tmp_path: Path) -> None:
    names = [str(number) for number in range(12)]
    root = folder(tmp_path / "c", names)
    (root / "timestamps.json").write_text(json.dumps({name: int(name) / 30 for name in names}))
    source = open_source(root)
    assert source.ids == names
    assert [source.load(name).capture_index for name in names] == list(range(12))
    assert open_source(root, limit=11).ids == names[:11]
    assert source.subset(["10", "9", "2"]).ids == ["2", "9", "10"]
    window = TemporallyFilteredSource(source=source, num_frames=3)
    assert window.load("10").provenance["temporal_filter"]["frames"] == ["8", "9", "10"]
    assert AveragedSource(source=source, num_frames=4).group("8") == ["8", "9", "10", "11"]


@pytest.mark.parametrize("layout", [scenes, graspnet, clouds])
def test_every_layout_counts(layout, tmp_path: Path) -> None:
    ids = open_source(layout(tmp_path / "c")).ids
    assert [name.removeprefix("frame-") for name in ids] == ["9", "10"]


def test_episodes_are_counted(tmp_path: Path) -> None:
    for name in ("10", "9"):
        np.savez(tmp_path / f"episode_{name}.npz", a=np.zeros(1))
    assert episode_names("here", tmp_path) == ["episode_9.npz", "episode_10.npz"]
    assert episode_names("here", {"e10": {}, "e9": {}}) == ["e9", "e10"]


def test_one_number_in_two_lengths_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="'01' and '1'"):
        open_source(folder(tmp_path / "c", ["1", "01", "2"]))


def test_partners_of_other_lengths_are_told_apart_from_missing_ones(tmp_path: Path) -> None:
    root = folder(tmp_path / "c", ["1", "2"])
    (root / "color" / "1.png").rename(root / "color" / "0001.png")
    with pytest.raises(CaptureError, match="'1' and '0001' are written in two ways"):
        open_source(root)


@pytest.mark.skipif(os.name == "nt", reason="names are Unicode there")
def test_a_file_whose_name_is_no_utf8_is_refused(tmp_path: Path) -> None:
    root = folder(tmp_path / "c", ["1"])
    try:
        shutil.copy(root / "depth" / "1.png", os.fsencode(root / "depth") + b"/2\xff.png")
    except OSError:
        pytest.skip("this file system has no such names")
    with pytest.raises(CaptureError, match="must be UTF-8"):
        open_source(root)


# -- links to nothing --------------------------------------------------------------------------------------------------

LINKS = [
    (lambda root: folder(root, ["1", "2"]), place)
    for place in ("depth/2.png", "color/2.png", "poses", "color", "depth", "intrinsics.json", "timestamps.json")
]
LINKS += [(rig, "right"), (rig, "third"), (rig, "left/depth/1.png"), (rig, "left/intrinsics.json")]
LINKS += [(scenes, f"frame-10.{end}") for end in ("depth.png", "color.png", "pose.txt")]
LINKS += [(scenes, "camera-intrinsics.txt")]
LINKS += [(graspnet, place) for place in ("10", "10/depth.png", "10/meta.mat", "10/label.png")]
LINKS += [(clouds, "10.ply"), (clouds, "11.pcd")]


@pytest.mark.parametrize(("layout", "place"), LINKS)
def test_a_link_to_nothing_is_an_error_that_names_it(layout, place: str, tmp_path: Path) -> None:
    root = layout(tmp_path / "c")
    lose(root / place)
    with pytest.raises(CaptureError, match="link to nothing") as caught:
        open_source(root)
    assert f"{root / place} -> /nowhere/at/all" in str(caught.value)


def test_a_lost_folder_of_another_name_is_told(tmp_path: Path) -> None:
    root = folder(tmp_path / "c", ["1"])
    shutil.rmtree(root / "poses")
    lose(root / "pose")
    with pytest.raises(CaptureError, match="link to nothing"):
        open_source(root)


def test_links_of_all_roles_are_named_in_one_message(tmp_path: Path) -> None:
    root = folder(tmp_path / "c", ["1", "2"])
    lose(root / "color" / "1.png")
    lose(root / "depth" / "2.png")
    with pytest.raises(CaptureError, match="2 links to nothing") as caught:
        open_source(root)
    assert str(root / "color" / "1.png") in str(caught.value)
    assert str(root / "depth" / "2.png") in str(caught.value)


def test_a_lost_capture_and_a_circle_of_links_are_told(tmp_path: Path) -> None:
    lose(tmp_path / "c")
    with pytest.raises(CaptureError, match="link to nothing"):
        open_source(tmp_path / "c")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(CaptureError, match="link to nothing"):
        open_source(tmp_path / "loop")


def test_links_within_the_capture_are_followed(tmp_path: Path) -> None:
    root = folder(tmp_path / "c", ["1", "2"])
    (root / ".store").mkdir()
    (root / "depth" / "2.png").rename(root / ".store" / "stored")
    (root / "depth" / "2.png").symlink_to("../.store/stored")
    (tmp_path / "by_another_name").symlink_to(root)
    for path in (root, tmp_path / "by_another_name"):
        assert open_source(path).load("2").depth.max() == pytest.approx(0.796)


OUTSIDE = [
    (lambda root: folder(root, ["9", "10"]), place)
    for place in ("depth/10.png", "color/10.png", "poses/10.txt", "depth", "intrinsics.json")
]
OUTSIDE += [(rig, "left/depth/1.png"), (rig, "right"), (scenes, "frame-10.depth.png"), (scenes, "frame-10.pose.txt")]
OUTSIDE += [(scenes, "camera-intrinsics.txt"), (graspnet, "10/meta.mat"), (graspnet, "10"), (clouds, "10.ply")]


@pytest.mark.parametrize(("layout", "place"), OUTSIDE)
def test_links_that_lead_out_of_the_capture_are_followed_only_where_that_is_allowed(
    layout, place: str, tmp_path: Path
) -> None:
    root = layout(tmp_path / "c")
    (tmp_path / "store").mkdir()
    (root / place).rename(tmp_path / "store" / Path(place).name)
    (root / place).symlink_to(tmp_path / "store" / Path(place).name)

    def load_all(**options: object) -> list[object]:
        source = open_source(root, **options)
        return [source.load(sample_id) for sample_id in source.ids]

    with pytest.raises(CaptureError, match=r"leads out of .*links_to="):
        load_all()
    assert len(load_all(links_to=tmp_path / "store")) == 2
    assert len(load_all(links_to=["/nowhere", str(tmp_path / "store")])) == 2


def test_validate_reads_nothing_outside(tmp_path: Path) -> None:
    root = folder(tmp_path / "c", ["1"])
    (root / "depth" / "1.png").rename(tmp_path / "stored.png")
    (root / "depth" / "1.png").symlink_to(tmp_path / "stored.png")
    (report,) = validate_source(open_source(root))
    assert [check.name for check in report.findings] == ["readable"]
    assert "leads out of" in report.findings[0].found


def test_a_named_file_may_be_a_link_to_anywhere(tmp_path: Path) -> None:
    (tmp_path / "here.ply").symlink_to(clouds(tmp_path / "c") / "9.ply")
    assert open_source(tmp_path / "here.ply").load("here").num_points == 5


def test_numbers_of_a_text_beside_a_plain_capture_are_told_and_what_is_told_can_be_read(tmp_path: Path) -> None:
    root = folder(tmp_path / "c", ["1"])
    (root / "intrinsics.json").unlink()
    with pytest.raises(CaptureError, match="with the numbers of this camera, such as"):
        open_source(root, kind="folder")
    (root / "camera_intrinsics.txt").write_text("611.345748 0 4.25\n0 612.5 3.5\n0 0 1\n")
    with pytest.raises(CaptureError, match=r"with the numbers of camera_intrinsics\.txt: ") as caught:
        open_source(root)
    told = re.search(r"\{.*\}", str(caught.value))
    assert told is not None
    (root / "intrinsics.json").write_text(told[0])
    camera = open_source(root)[0].camera
    expected = [[611.345748, 0, 4.25], [0, 612.5, 3.5], [0, 0, 1]]
    np.testing.assert_allclose(camera.intrinsics[0].numpy(), expected, rtol=1e-6)
    (root / "intrinsics.json").unlink()
    (root / "camera_intrinsics.txt").write_text("not a matrix")
    with pytest.raises(CaptureError, match="with the numbers of this camera, such as"):
        open_source(root, kind="folder")


MATRIX = "611.3 0 4.25 0 612.5 3.5 0 0 1"
OWN = {"width": 8, "height": 6, "fx": 10, "fy": 10, "cx": 3.5, "cy": 2.5, "metres_per_unit": 0.00012498664727900177}


@pytest.mark.parametrize(
    "beside",
    [
        {"intrinsics_color.txt": MATRIX},
        {"rgb_intrinsics.txt": MATRIX},
        {"ir-intrinsics.txt": MATRIX},
        {"intrinsics_a.txt": MATRIX, "intrinsics_b.txt": MATRIX.replace("611", "605")},
        {"intrinsics_a.txt": MATRIX, "intrinsics_b.txt": "unreadable"},
        {"intrinsics.txt": "1165 0 12.2 0 1165 9.1 0 0 1"},  # of an image three times as large
        {"intrinsics.txt": "nan 0 4 0 600 3 0 0 1"},
        {"intrinsics.txt": "1e39 0 4 0 inf 3 0 0 1"},
        {"intrinsics.txt": MATRIX + " " * (1 << 20)},
        {"intrinsics.txt": "\0\ud800"},
        {"camera_1.json": json.dumps(OWN | {"width": 16})},
        {"camera_1.json": json.dumps(OWN | {"depth_encoding": "rotated_left_3"})},
        {"camera_1.json": json.dumps(OWN | {"invalid_values": [65535]})},
    ],
)
def test_numbers_that_may_not_be_those_of_the_depth_camera_are_not_told(tmp_path: Path, beside: dict[str, str]) -> None:
    root = folder(tmp_path / "c", ["1"])
    (root / "intrinsics.json").unlink()
    for name, text in beside.items():
        (root / name).write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(CaptureError, match="with the numbers of this camera, such as"):
        open_source(root, kind="folder")


@pytest.mark.parametrize("link", ["intrinsics.txt", "depth/0.png", "depth"])
def test_no_numbers_are_told_of_what_lies_outside(tmp_path: Path, link: str) -> None:
    outside = folder(tmp_path / "outside", ["0"])
    (outside / "intrinsics.txt").write_text(MATRIX)
    root = folder(tmp_path / "c", ["1"])
    (root / "intrinsics.json").unlink()
    (root / "intrinsics.txt").write_text(MATRIX)
    if (root / link).is_dir():
        shutil.rmtree(root / link)
    (root / link).unlink(missing_ok=True)
    (root / link).symlink_to(outside / link)
    with pytest.raises(CaptureError, match="with the numbers of this camera, such as"):
        open_source(root, kind="folder")


def test_what_a_file_in_our_own_form_states_is_told_to_the_last_digit(tmp_path: Path) -> None:
    root = folder(tmp_path / "c", ["1"])
    (root / "intrinsics.json").unlink()
    (root / "camera_1\n.json").write_text(json.dumps(OWN))
    with pytest.raises(CaptureError, match=r"with the numbers of 'camera_1\\n\.json': ") as caught:
        open_source(root, kind="folder")
    assert json.loads(re.search(r"\{.*\}", str(caught.value))[0]) == OWN


def test_a_file_that_seems_to_hold_all_poses_is_told_with_where_poses_belong(tmp_path: Path) -> None:
    root = folder(tmp_path / "c", ["1"])
    (root / "poses.json").write_text("{}")
    assert open_source(root).unread() == ["poses.json"]  # poses are there
    shutil.rmtree(root / "poses")
    (told,) = open_source(root).unread()
    assert told == "poses.json; poses are read from poses/NAME.txt: 4x4 each, world from camera"
    (root / "poses.json").rename(root / "docker-compose.yaml")
    assert open_source(root).unread() == ["docker-compose.yaml"]


def test_all_folders_that_look_like_a_role_are_told_at_once_and_the_advice_works(tmp_path: Path) -> None:
    root = folder(tmp_path / "c", ["1"])
    (root / "poses").rename(root / "cam_poses")
    (root / "color").rename(root / "rgb")
    with pytest.raises(CaptureError, match=r"cam_poses/ looks like pose.*rgb/ looks like color.*rename them") as caught:
        open_source(root, kind="folder")
    text = str(caught.value)
    assert (
        "--folder pose=cam_poses --folder color=rgb (in Python folders={'pose': 'cam_poses', 'color': 'rgb'})" in text
    )
    assert "--folder pose= --folder color= (in Python 'pose': None, 'color': None)" in text
    assert set(open_source(root, folders={"pose": "cam_poses", "color": "rgb"}).files("1")) >= {"pose", "color"}
    assert not {"pose", "color"} & set(open_source(root, folders={"pose": None, "color": None}).files("1"))
    (root / "cam_poses").rename(root / "Cam Poses")
    with pytest.raises(CaptureError) as caught:
        open_source(root, kind="folder")
    said = shlex.split(re.search(r"or say (.*?) \(in Python", str(caught.value))[1])
    assert said == ["--folder", "pose=Cam Poses", "--folder", "color=rgb"]


# -- what exists and is not read ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["pose", "colour", "RGB", "image", "Depths", "label", "mask", "conf", "camera_poses"])
def test_a_folder_that_looks_like_a_role_is_read_or_refused_and_the_advice_works(name: str, tmp_path: Path) -> None:
    root = folder(tmp_path / "c", ["1"])
    role = {"pose": "pose", "camera_poses": "pose", "label": "labels", "mask": "mask", "conf": "confidence"}
    role = role.get(name, "depth" if name == "Depths" else "color")
    usual = {"pose": "poses", "color": "color", "depth": "depth"}.get(role)
    if usual:
        (root / usual).rename(root / name)
    else:
        (root / name).mkdir()
        Image.fromarray(np.zeros(SIZE, np.uint8)).save(root / name / "1.png")
    with pytest.raises(CaptureError, match=f"{name}/ looks like {role}.*--folder {role}={name}"):
        open_source(root, kind="folder")
    assert role in open_source(root, kind="folder", folders={role: name}).files("1")
    if role != "depth":
        assert role not in open_source(root, folders={role: None}).files("1")
        assert f"{name}/" in open_source(root, folders={role: None}).unread()


def test_wrong_names_of_folders_are_refused(tmp_path: Path) -> None:
    root = folder(tmp_path / "c", ["1"])
    for wrong in ({"colour": "rgb"}, {"color": "/etc"}, {"color": "../c/color"}, {"depth": None}, {"color": 3}):
        with pytest.raises(ConfigError):
            open_source(root, folders=wrong)
    with pytest.raises(CaptureError, match="has no folder 'rgb'"):
        open_source(root, folders={"color": "rgb"})


def test_what_lies_beside_is_told(tmp_path: Path) -> None:
    root = folder(tmp_path / "c", ["1"])
    (root / "ir").mkdir()
    for litter in (".DS_Store", "Thumbs.db", "notes.txt"):
        (root / litter).touch()
    assert open_source(root).unread() == ["ir/", "notes.txt"]
    cell = rig(tmp_path / "cell")
    (cell / "calibration.yaml").touch()
    (cell / "left" / "ir").mkdir()
    assert open_source(cell).unread() == ["calibration.yaml", "left/ir/"]
    seven = scenes(tmp_path / "seven")
    (seven / "readme.txt").touch()
    assert open_source(seven).unread() == ["readme.txt"]
    grasp = graspnet(tmp_path / "grasp")
    (grasp / "9" / "ir.png").touch()
    assert open_source(grasp).unread() == ["9/ir.png"]


def test_a_frame_that_lacks_a_file_does_not_vanish(tmp_path: Path) -> None:
    for missing in ("depth.png", "meta.mat", "color.png", "label.png"):
        root = graspnet(tmp_path / missing)
        (root / "10" / missing).unlink()
        with pytest.raises(CaptureError, match="10"):
            open_source(root)


def test_a_role_that_is_a_file_or_holds_folders_is_refused(tmp_path: Path) -> None:
    root = folder(tmp_path / "c", ["1"])
    (root / "depth" / "more").mkdir()
    with pytest.raises(CaptureError, match="more cannot be read as files"):
        open_source(root)
    (root / "depth" / "more").rmdir()
    shutil.rmtree(root / "poses")
    (root / "poses").write_text("1 0 0 0")
    with pytest.raises(CaptureError, match="poses: must be a folder"):
        open_source(root)


def test_an_empty_role_is_missing_for_every_sample(tmp_path: Path) -> None:
    root = folder(tmp_path / "c", ["1"])
    (root / "masks").mkdir()
    with pytest.raises(CaptureError, match="mask is missing for 1"):
        open_source(root)


def test_suffixes_are_read_in_either_case(tmp_path: Path) -> None:
    seven = scenes(tmp_path / "seven")
    (seven / "frame-10.depth.png").rename(seven / "frame-10.depth.PNG")
    assert open_source(seven).ids == ["frame-9", "frame-10"]
    (seven / "frame-10.depth.PNG").rename(seven / "frame-10.depth.tiff")
    with pytest.raises(CaptureError, match=r"frame-10.depth.tiff"):
        open_source(seven)


def test_a_capture_one_folder_down_is_named(tmp_path: Path) -> None:
    folder(tmp_path / "archive" / "capture", ["1"])
    with pytest.raises(CaptureError, match=r"A capture by itself is capture: pcdata inspect .*/archive/capture"):
        open_source(tmp_path / "archive")
