"""pcdata fuse: captures in, one cloud, mesh or volume out."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest
import torch

import pcdata
from pcdata.cli import known_names
from pcdata.cli.main import main
from pcdata.functional import tsdf
from pcdata.io import CaptureCamera, open_source, read_volume, write_capture_camera, write_depth, write_pose
from pcdata.structures import TSDFVolume


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("captures")
    for role in ("depth", "poses"):
        (root / role).mkdir()
    frame = pcdata.synthetic.tabletop(seed=1, num_views=3, size=(60, 80), floor=False).frame
    assert frame.world_from_camera is not None
    for view in range(3):
        write_depth(root / f"depth/{view}.png", frame.depth[view], metres_per_unit=0.001, round_to_unit=True)
        write_pose(root / f"poses/{view}.txt", frame.world_from_camera[view])
    camera = pcdata.Camera(intrinsics=frame.camera.intrinsics[:1], size=frame.size)
    write_capture_camera(root / "intrinsics.json", CaptureCamera(camera=camera, metres_per_unit=0.001, frame_id="base"))
    return root


def fuse(captures: Path, out: Path, *words: str) -> int:
    return main(["fuse", str(captures), "--voxel-size", "0.01", "--out", str(out), *words])


def volume_of(captures: Path, **settings: object) -> TSDFVolume:
    volume = TSDFVolume(voxel_size=0.01, **settings)  # type: ignore[arg-type]
    source = open_source(captures)
    for sample_id in source.ids:
        volume.integrate(source.load(sample_id))  # type: ignore[arg-type]
    return volume


def test_cloud_mesh_and_volume_are_those_of_the_volume_in_python(capsys, captures, tmp_path):
    wanted = volume_of(captures, weighting="inverse_square", carve="never", truncation=0.04)
    words = ["--weighting", "inverse_square", "--carve", "never", "--truncation", "0.04"]
    assert fuse(captures, tmp_path / "cloud.ply", *words) == 0
    assert "in frame 'base', from 3 views of 3 captures" in capsys.readouterr().out
    cloud = pcdata.read_ply(tmp_path / "cloud.ply")
    assert torch.equal(cloud.points, wanted.extract_points().points)
    assert cloud.frame_id == "base"
    assert fuse(captures, tmp_path / "mesh.ply", "--mesh", *words) == 0
    assert pcdata.read_ply(tmp_path / "mesh.ply").num_points == wanted.extract_mesh().vertices.num_points
    assert b"element face" in (tmp_path / "mesh.ply").read_bytes()[:2000]
    assert fuse(captures, tmp_path / "volume.npz", *words) == 0
    again = read_volume(tmp_path / "volume.npz")
    assert torch.equal(again.extract_points().points, wanted.extract_points().points)


def test_min_weight_and_left_out_captures_are_heeded(capsys, captures, tmp_path):
    assert fuse(captures, tmp_path / "seen.ply", "--min-weight", "2") == 0
    assert int(pcdata.read_ply(tmp_path / "seen.ply").extra["num_views"].min()) == 2
    assert fuse(captures, tmp_path / "two.ply", "--skip", "1") == 0
    assert "from 2 views of 2 captures" in capsys.readouterr().out
    assert fuse(captures, tmp_path / "one.ply", "--limit", "1") == 0
    assert "from 1 view of 1 capture" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("out", "words", "message"),
    [
        ("cloud.pcd", [], "--out must end in .ply"),
        ("volume.npz", ["--mesh"], "which --mesh cannot change"),
        ("volume.npz", ["--min-weight", "2"], "which --min-weight cannot change"),
        ("no/cloud.ply", [], "there is no folder"),
        ("folder.ply", [], "is a folder; name a file"),
        ("there.ply", [], "exists; choose another file, or replace it (--overwrite)"),
        ("a.ply", ["--voxel-size", "0"], "voxel_size"),
        ("a.ply", ["--voxel-size", "nan"], "voxel_size"),
        ("a.ply", ["--truncation", "-1"], "truncation"),
        ("a.ply", ["--min-weight", "-1"], "min_weight"),
    ],
)
def test_a_wrong_request_is_exit_2_and_writes_nothing(capsys, captures, tmp_path, out, words, message):
    (tmp_path / "folder.ply").mkdir()
    (tmp_path / "there.ply").write_text("mine")
    assert fuse(captures, tmp_path / out, *words) == 2
    assert message in capsys.readouterr().err
    assert (tmp_path / "there.ply").read_text() == "mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder.ply", "there.ply"]


def test_overwrite_replaces_a_file(captures, tmp_path):
    (tmp_path / "there.ply").write_text("mine")
    assert fuse(captures, tmp_path / "there.ply", "--overwrite") == 0
    assert pcdata.read_ply(tmp_path / "there.ply").num_points > 1000


def test_captures_that_cannot_be_fused_are_exit_1_in_words(capsys, captures, tmp_path):
    assert fuse(captures, tmp_path / "a.ply", "--voxel-size", "0.0005", "--max-megabytes", "1") == 1
    assert "use larger voxels" in capsys.readouterr().err
    assert fuse(captures, tmp_path / "a.ply", "--folder", "pose=") == 1
    assert "give it poses" in capsys.readouterr().err
    assert fuse(captures, tmp_path / "cloud.ply") == 0
    assert fuse(tmp_path / "cloud.ply", tmp_path / "a.ply") == 1
    assert "takes a DepthFrame, got PointCloud" in capsys.readouterr().err
    assert not (tmp_path / "a.ply").exists()


def test_help_knows_the_ways_to_weigh_and_carve():
    assert get_args(tsdf.Weighting) == known_names.WEIGHTINGS
    assert get_args(tsdf.Carving) == known_names.CARVINGS
