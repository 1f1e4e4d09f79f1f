"""The command convert: what it writes, what it tells, and with which exit code it ends."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from pcdata import open_source
from pcdata.cli.main import main
from pcdata.errors import CaptureError, ConfigError
from pcdata.io import convert, write_ply
from pcdata.structures import PointCloud, Signal
from pcdata.synthetic import TeleopSource
from tests.exports.samples import tree
from tests.factories import base_from_camera
from tests.io.writers.made_captures import cut_to_episodes, made_captures, made_frame


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    still = base_from_camera(1)
    signals = {"joints": Signal(torch.zeros(1, 2), "invariant")}
    made = cut_to_episodes(made_captures(6, world_from_camera=still, recorded_signals=signals))
    convert(made, "folder", tmp_path / "in")
    return tmp_path / "in"


def test_it_tells_what_was_written_and_the_command_to_go_on(capture, tmp_path, capsys):
    assert main(["convert", str(capture), "--to", "folder", "--out", str(tmp_path / "out put")]) == 0
    said, progress = capsys.readouterr()
    assert f"{tmp_path / 'out put'}  (folder: 5 captures in 2 episodes, " in said
    assert "lost     nothing" in said
    assert f"next     pcdata inspect '{tmp_path / 'out put'}'" in said
    assert "convert 5/5 004" in progress
    assert tree(tmp_path / "out put") == tree(capture)


def test_a_dry_run_tells_what_would_be_written_and_writes_nothing(capture, tmp_path, capsys):
    before = sorted(tmp_path.iterdir())
    words = ["convert", str(capture), "--to", "folder", "--out", str(tmp_path / "out")]
    assert main([*words, "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert "dry run  nothing is written; " in said
    assert "folder: 5 captures in 2 episodes, about " in said
    assert "streams  depth, color, labels, mask, confidence, lens, pose, signal joints" in said
    assert "lost     nothing" in said
    assert sorted(tmp_path.iterdir()) == before
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "file").touch()
    assert main([*words, "--dry-run"]) == 1
    assert "exists already" in capsys.readouterr().err


def test_which_sensor_took_a_capture_is_written_and_read_back(tmp_path):
    said = {"sensor_name": "Intel RealSense D435", "serial": "0123", "registered_to": "color"}
    convert(made_captures(6, provenance=said), "folder", tmp_path / "out")
    source = open_source(tmp_path / "out")
    assert said.items() <= source.load(source.ids[0]).provenance.items()


def test_captures_of_clouds_among_depth_images_are_named_with_how_to_leave_them_out(tmp_path):
    made = made_captures(6)
    made.frames["004"] = PointCloud(points=torch.rand(9, 3), frame_id="camera")
    with pytest.raises(ConfigError, match=r"no depth image but a PointCloud.*--skip ID") as caught:
        convert(made, "folder", tmp_path / "out")
    assert caught.value.sample_id == "004"
    assert not (tmp_path / "out").exists()


def test_captures_are_chosen_and_combined_as_everywhere(capture, tmp_path, capsys):
    out = tmp_path / "out"
    words = ["--skip", "001", "--limit", "3", "--metres-per-unit", "0.0001", "--option", "frame_id='base'"]
    assert main(["convert", str(capture), "--to", "folder", "--out", str(out), *words]) == 0
    assert open_source(out).ids == ["000", "002", "003"]
    assert "1 capture left out" in capsys.readouterr().out
    smooth = ["--temporal", "2", "--option", "temporal.alpha=0.5"]
    assert main(["convert", str(capture), "--to", "folder", "--out", str(tmp_path / "smooth"), *smooth]) == 0
    smoothed = open_source(capture, temporal={"num_frames": 2, "alpha": 0.5})
    assert torch.equal(open_source(tmp_path / "smooth").load("001").depth, smoothed.load("001").depth)


def test_a_capture_that_cannot_be_read_stops_it_or_is_left_out_and_told(capture, tmp_path, capsys):
    np.save(capture / "depth" / "002.npy", np.zeros((12, 16), np.float32))
    (capture / "depth" / "002.png").unlink()
    out = tmp_path / "out"
    assert main(["convert", str(capture), "--to", "folder", "--out", str(out)]) == 1
    assert "--skip 002" in capsys.readouterr().err
    assert not out.exists()
    assert main(["convert", str(capture), "--to", "folder", "--out", str(out), "--skip-refused"]) == 0
    assert "002: NoReadingError" in capsys.readouterr().out
    assert [(one.id, one.length) for one in open_source(out).episodes] == [("pick 0", 2), ("pick 1", 2)]


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        (["--to", "mcab", "--out", "out"], 2, "did you mean 'mcap'"),
        (["--to", "folder", "--out", "out", "--set", "color=raw"], 2, "folder has no option 'color'"),
        (["--to", "mcap", "--out", "out", "--set", "color=raw", "--set", "color=png"], 2, "set twice"),
        (["--to", "mcap", "--out", "out", "--set", "quality=high"], 2, "quality must be a whole number"),
        (["--to", "folder", "--out", "in/out"], 2, "inside the captures"),
        (["--to", "folder", "--out", "in"], 2, "inside the captures"),
        (["--to", "folder", "--out", "taken"], 1, "exists already"),
        (["--to", "folder", "--out", "out", "--only", "x*"], 1, "fits only"),
    ],
)
def test_a_wrong_request_is_2_and_wrong_data_are_1(capture, tmp_path, capsys, monkeypatch, words, code, told):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "mine").touch()
    before = tree(tmp_path)
    assert main(["convert", "in", *words]) == code
    assert told in capsys.readouterr().err
    assert tree(tmp_path) == before


def test_ids_that_no_file_can_have_are_spelled_in_another_way_and_keep_their_order(tmp_path):
    made = made_captures(4)
    made.episodes = []
    ids = ["b/1", "ä ö", "Ä Ö", ".x"]
    made.frames = dict(zip(ids, made.frames.values()))
    report = convert(made, "folder", tmp_path / "out")
    source = open_source(tmp_path / "out")
    assert source.ids == ["0_b%2F1", "1_ä ö", "2_Ä Ö", "3_%2Ex"]
    assert "4 captures have ids" in report.notes[0]
    for own, frame in zip(source.ids, made.frames.values()):
        assert torch.equal(source.load(own).depth, frame.depth)


def test_spaces_and_letters_of_any_language_stay_in_names(tmp_path):
    made = made_captures(4)
    made.episodes, made.frames = [], dict(zip(["ä 1", "ä 2", "ä 3", "ä 4"], made.frames.values()))
    assert not convert(made, "folder", tmp_path / "out").notes
    assert open_source(tmp_path / "out").ids == ["ä 1", "ä 2", "ä 3", "ä 4"]


def test_a_camera_that_changes_keeps_its_intrinsics_skew_and_window(tmp_path):
    made = made_captures(4)
    made.episodes = []
    cameras = [made.frames[name].camera for name in made.ids]
    skewed = cameras[1].to_dict() | {"is_window": True}
    skewed["intrinsics"][0][0][1:] = [0.5, -7.0]  # skew, and a principal point outside
    cameras[1] = type(cameras[1]).from_dict(skewed)
    made.frames = {n: made.frames[n].to("cpu") for n in made.ids}
    for name, camera in zip(made.ids, cameras):
        object.__setattr__(made.frames[name], "camera", camera)
    convert(made, "folder", tmp_path / "out")
    source = open_source(tmp_path / "out")
    assert [source.load(name).camera.to_dict() for name in source.ids] == [camera.to_dict() for camera in cameras]
    stated = json.loads((tmp_path / "out" / "intrinsics" / "001.json").read_text())
    assert (stated["skew"], stated["is_window"], stated["cx"]) == (0.5, True, -7.0)


def test_simulated_demonstrations_come_back_as_they_are(tmp_path):
    teleop = TeleopSource(num_episodes=2, num_views=2, size=(24, 32))
    report = convert(teleop, "folder", tmp_path / "out")
    source = open_source(tmp_path / "out")
    assert (report.samples, report.episodes, report.lost) == (len(teleop), 2, {})
    assert source.episodes == teleop.episodes
    for name in teleop.ids[::10]:
        read, made = source.load(name), teleop.load(name)
        assert torch.equal(read.depth, made.depth)
        assert torch.equal(read.labels, made.labels)
        assert all(read.recorded_signals[key].same_bits(one) for key, one in made.recorded_signals.items())


def test_what_lies_in_the_captures_and_is_not_read_is_told(capture, tmp_path, capsys):
    (capture / "thermal").mkdir()
    (capture / "thermal" / "0.png").touch()
    assert main(["convert", str(capture), "--to", "folder", "--out", str(tmp_path / "out")]) == 0
    assert "not read thermal/" in capsys.readouterr().out


def test_a_capture_that_does_not_fit_the_others_is_named(tmp_path, capsys):
    made = made_captures(4)
    made.episodes = []
    made.frames["002"] = made_frame(2, colors=None)
    with pytest.raises(CaptureError, match="lacks what those before it have: colors") as e:
        convert(made, "folder", tmp_path / "out")
    assert e.value.sample_id == "002"
    assert not (tmp_path / "out").exists()


def test_clouds_are_no_captures_to_write(tmp_path, capsys):
    write_ply(tmp_path / "a.ply", PointCloud(points=torch.rand(9, 3), frame_id="camera"))
    assert main(["convert", str(tmp_path / "a.ply"), "--to", "folder", "--out", str(tmp_path / "out")]) == 2
    assert "no depth image but a PointCloud" in capsys.readouterr().err
