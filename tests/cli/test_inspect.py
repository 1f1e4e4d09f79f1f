"""The command inspect on captures: what it tells of what is there, of what is missing, and how to go on."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pcdata.cli.main import main
from pcdata.io import convert
from tests.exports.samples import tree
from tests.io.writers.made_captures import MadeCaptures, cut_to_episodes, made_captures, made_frame


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    convert(cut_to_episodes(made_captures(6, views=2)), "folder", tmp_path / "a rig")
    return tmp_path / "a rig"


def inspected(capsys, *words: object) -> tuple[int, str, str]:
    code = main(["inspect", *map(str, words)])
    return (code, *capsys.readouterr())


def test_it_tells_cameras_unit_poses_signals_episodes_and_times(rig, capsys):
    code, out, err = inspected(capsys, rig)
    assert (code, err) == (0, "")
    for line in (
        "captures  5: 000, 001, 002, ..., ",
        "cameras   view0: 16x12, fx 20.3, fy 21.7, cx 7.3, cy 5.8, lens of 8 coefficients",
        "          view1: 16x12, fx 21.8, fy 23.2",
        "unit      1 stored = 0.0001 m",
        "images    color, labels, confidence, mask",
        "poses     lead to 'base', ",
        "signals   joints: invariant, (7,) float64",
        "          eef: pose matrix in 'base', (4, 4) float64",
        "          task: text, such as 'put the cube on the disc: µ'",
        "episodes  2 of 2 to 3 captures: pick 0, pick 1",
        "          0.2 s in all, 15 Hz, no gaps",
        "attributes: task ('place'), success (True), tries (2)",
    ):
        assert line in out


def test_the_commands_to_go_on_have_the_options_that_were_given(rig, capsys):
    _, out, _ = inspected(capsys, rig, "--kind", "rig", "--skip", "001", "--skip-refused", "--limit=2")
    path = f"'{rig}'"
    assert f"pcdata validate {path} --kind rig --skip 001 --limit=2\n" in out
    assert f"pcdata convert {path} --kind rig --skip 001 --skip-refused --limit=2 --to " in out
    assert "left out  1 capture" in out


def test_json_says_the_same_to_a_file_or_alone_on_the_output(rig, capsys, tmp_path):
    _, text, _ = inspected(capsys, rig)
    code, told, _ = inspected(capsys, rig, "--json", tmp_path / "facts.json")
    assert (code, told) == (0, text)
    facts = json.loads((tmp_path / "facts.json").read_text())
    assert facts == json.loads(inspected(capsys, rig, "--json", "-")[1])
    assert (facts["schema"], facts["captures"], facts["metres_per_unit"]) == ("pcdata.inspection/1", 5, 0.0001)
    assert facts["signals"]["plan"] == {"kind": "position", "frame": "base", "shape": [3, 3], "dtype": "float32"}
    assert facts["bytes"] < sum(len(content) for content in tree(rig).values() if content)


def test_gaps_between_captures_are_counted_and_the_largest_is_named(capsys, tmp_path):
    made = made_captures(8)
    times = [0.0, 0.1, 0.2, 0.9, 1.0]
    made.episodes = [type(made.episodes[0])("a", 0, 5, times)]
    convert(made, "folder", tmp_path / "in")
    (tmp_path / "in" / "timestamps.json").write_text(json.dumps({n: float(t) for n, t in zip(made.ids, range(8))}))
    assert "no gaps" in inspected(capsys, tmp_path / "in")[1]
    every = dict(zip(made.ids, [*times, 2.0, 2.1, 2.2]))
    (tmp_path / "in" / "timestamps.json").write_text(json.dumps(every))
    assert "1.0 s in all, 10 Hz, 1 gaps, the largest 0.7 s in a" in inspected(capsys, tmp_path / "in")[1]


def test_what_is_missing_is_named(capsys, tmp_path):
    bare = made_frame(recorded_signals={}, colors=None, world_from_camera=None, frame_id=None)
    convert(MadeCaptures({"000": bare}), "folder", tmp_path / "in")
    out = inspected(capsys, tmp_path / "in")[1]
    assert "missing   poses: clouds stay in the camera's frame (--calibration FILE --frame NAME gives them)" in out
    assert "          color\n" in out


@pytest.mark.parametrize("lacking", ["intrinsics", "unit", "both"])
def test_captures_that_are_not_opened_are_told_as_far_as_they_can_be(capsys, tmp_path, lacking):
    depth = np.full((40, 60), 800, np.uint16)
    depth[:, :30] = 1500
    np.save(tmp_path / "depth_000.npy", depth)
    options = {
        "intrinsics": ["--metres-per-unit", "0.001"],
        "unit": ["--intrinsics", "50", "50", "29", "19"],
        "both": [],
    }
    code, out, err = inspected(capsys, tmp_path, *options[lacking])
    assert code == 1
    assert err.startswith("pcdata: pairs source")
    assert "depth_000.npy: 60x40 uint16, stored numbers from 800 to 1500" in out
    (command,) = [line.split("next")[1].strip() for line in out.splitlines() if line.startswith("next")]
    assert ("--intrinsics FX FY CX CY" in command) == (lacking != "unit")
    assert "--metres-per-unit 0.001" in command.partition(str(tmp_path))[2]
    followed = command.replace("FX FY CX CY", "50 50 29 19").split()[1:]
    assert main(followed) == 0


def test_json_of_captures_that_are_not_opened_says_why(capsys, tmp_path):
    np.save(tmp_path / "depth_000.npy", np.full((40, 60), 800, np.uint16))
    code, out, _ = inspected(capsys, tmp_path, "--json", "-")
    facts = json.loads(out)
    assert (code, facts["layout"], facts["files"]) == (1, ["pairs"], {".npy": 1})
    assert facts["refused"].startswith("IntrinsicsError")
    assert facts["options"] == ["--intrinsics FX FY CX CY", "--metres-per-unit 0.001"]


def test_a_recording_that_is_not_opened_is_told_by_its_topics(capsys, tmp_path):
    recordings = pytest.importorskip("tests.ros_recordings")
    make = recordings.Types(2)
    entries = [entry for entry in recordings.recording(make) if not entry[0].endswith("camera_info")]
    recordings.written(tmp_path / "take.mcap", entries, make)
    code, out, _ = inspected(capsys, tmp_path / "take.mcap")
    assert code == 1
    assert "contents  " in out
    assert "/joint_states (sensor_msgs/msg/JointState, 20 messages, 100 Hz)" in out
    assert out.splitlines()[-1].endswith("take.mcap --intrinsics FX FY CX CY")
    followed = ["--intrinsics", "20", "21", "8", "6"]
    code, out, _ = inspected(capsys, tmp_path / "take.mcap", *followed)
    assert code == 0
    (joints,) = [line.split() for line in out.splitlines() if line.startswith("/joint_states")]
    assert joints == [
        "/joint_states",
        "signal",
        "joint_states/position",
        "100",
        "20",
        "linear",
        "13",
        "0",
        "3",
        "0",
        "0.01",
        "s",
    ]


def test_a_lerobot_dataset_that_is_not_opened_is_told_by_its_features(capsys, tmp_path):
    pytest.importorskip("pyarrow")
    convert(cut_to_episodes(made_captures()), "lerobot", tmp_path / "set", color="image", fps=10)
    (tmp_path / "set" / "meta" / "pcdata.json").unlink()
    code, out, _ = inspected(capsys, tmp_path / "set")
    assert code == 1
    assert "observation.joints: float64 [7]" in out
    assert "not opened  " in out
