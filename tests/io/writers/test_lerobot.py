"""LeRobot datasets that are written: what stands in the files, read by pyarrow and PyAV alone, and by the package."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pcdata import open_source
from pcdata.errors import CaptureError, ConfigError
from pcdata.io import convert
from pcdata.io.sources.capture_source import episodes_of
from pcdata.io.writers import lerobot_tables, lerobot_videos
from pcdata.structures import Episode, PointCloud, Signal
from pcdata.synthetic import TeleopSource
from tests.exports.samples import tree
from tests.io.writers.made_captures import MadeCaptures, cut_to_episodes, made_captures, made_frame
from tests.signals import markers

av = pytest.importorskip("av")
parquet = pytest.importorskip("pyarrow.parquet")

ROWS, EPISODES = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"


def decoded(path: Path, pixels: str) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        assert container.streams.video[0].codec_context.name in ("ffv1", "h264")
        return [frame.to_ndarray(format=pixels) for frame in container.decode(video=0)]


def info(path: Path) -> Any:
    return json.loads((path / "meta/info.json").read_text())


def test_depth_is_lossless_video_that_others_decode_bit_for_bit(tmp_path: Path) -> None:
    made = cut_to_episodes(made_captures(views=2))
    convert(made, "lerobot", tmp_path / "out")
    for view in range(2):
        stored = decoded(tmp_path / f"out/videos/depth.view{view}/chunk-000/file-000.mkv", "gray16le")
        assert len(stored) == len(made)
        for units, name in zip(stored, made.ids):
            assert units.dtype == np.uint16
            metres = (units.astype(np.float64) * 0.0001).astype(np.float32)
            assert np.array_equal(metres, made.load(name).depth[view].numpy())
    assert len(decoded(tmp_path / "out/videos/observation.images.view1/chunk-000/file-000.mp4", "rgb24")) == len(made)
    assert not any(key.startswith("depth.") for key in info(tmp_path / "out")["features"])


def test_damaged_depth_is_never_filled_from_the_picture_before(tmp_path: Path) -> None:
    made = cut_to_episodes(made_captures())
    convert(made, "lerobot", tmp_path / "out")
    file = tmp_path / "out/videos/depth.view0/chunk-000/file-000.mkv"
    content, refused = file.read_bytes(), 0
    for place in range(700, len(content), 397):
        file.write_bytes(content[:place] + bytes([content[place] ^ 16]) + content[place + 1 :])
        source = open_source(tmp_path / "out")
        for name, own in zip(made.ids, source.ids):
            try:
                assert torch.equal(source.load(own).depth, made.load(name).depth)
            except CaptureError:
                refused += 1
    assert refused > 3


def test_rows_and_episodes_are_what_pyarrow_reads(tmp_path: Path) -> None:
    made = cut_to_episodes(made_captures())
    convert(made, "lerobot", tmp_path / "out", state=["joints", "count"])
    rows = parquet.read_table(tmp_path / "out" / ROWS).to_pylist()
    assert [row["index"] for row in rows] == [*range(len(made))]
    assert [row["frame_index"] for row in rows] == [step for one in made.episodes for step in range(one.length)]
    for row, name in zip(rows, made.ids):
        frame = made.load(name)
        assert row["observation.joints"] == frame.signals["joints"][0].tolist()
        assert row["action"] == frame.signals["action"][0].tolist()
        assert row["observation.eef"] == frame.signals["eef"][0].tolist()
        expected = [*frame.signals["joints"][0].float().tolist(), float(frame.signals["count"][0])]
        assert row["observation.state"] == expected
        assert row["camera.view0.intrinsics"] == frame.camera.intrinsics[0].tolist()
        assert row["camera.view0.base_from_camera"] == frame.world_from_camera[0].tolist()
    episodes = parquet.read_table(tmp_path / "out" / EPISODES).to_pylist()
    fps = info(tmp_path / "out")["fps"]
    for episode, own in zip(episodes, made.episodes):
        assert (episode["dataset_from_index"], episode["length"]) == (own.first, own.length)
        assert episode["videos/depth.view0/from_timestamp"] == pytest.approx(own.first / fps)
        joints = np.stack([made.load(made.ids[place]).signals["joints"][0].numpy() for place in own.steps])
        for name, value in (("min", joints.min(0)), ("mean", joints.mean(0)), ("std", joints.std(0))):
            assert episode[f"stats/observation.joints/{name}"] == pytest.approx(value.tolist())
        assert np.shape(episode["stats/observation.images.view0/mean"]) == (3, 1, 1)
    stats = json.loads((tmp_path / "out/meta/stats.json").read_text())
    every = np.stack([made.load(name).signals["joints"][0].numpy() for name in made.ids])
    assert stats["observation.joints"]["mean"] == pytest.approx(every.mean(0).tolist())
    assert stats["observation.joints"]["std"] == pytest.approx(every.std(0).tolist())
    assert stats["observation.joints"]["count"] == [len(made)]


@pytest.mark.parametrize("depth", ["ffv1", "image", "array"])
def test_every_way_to_store_depth_comes_back_bit_for_bit(depth: str, tmp_path: Path) -> None:
    made = cut_to_episodes(made_captures(views=2))
    report = convert(made, "lerobot", tmp_path / "out", depth=depth, color="image")
    assert "depth" not in report.lost
    source = open_source(tmp_path / "out")
    for name, own in zip(made.ids, source.ids):
        assert torch.equal(source.load(own).depth, made.load(name).depth)
        assert torch.equal(source.load(own).colors, made.load(name).colors)


def test_depth_that_is_rounded_is_told_in_metres_and_what_16_bits_do_not_hold_is_no_reading(tmp_path: Path) -> None:
    first = made_frame(0)
    first = replace(first, depth=first.depth.clone())
    first.depth[0, 0, :2] = torch.tensor([0.0004, 66.0])
    report = convert(MadeCaptures({"0": first}), "lerobot", tmp_path / "out", metres_per_unit=0.001)
    read = open_source(tmp_path / "out").load("000000-000000").depth
    assert read[0, 0, :2].tolist() == [0.0, 0.0]
    off = (read.double() - first.depth.double()).abs()
    off[0, 0, :2] = 0
    assert report.lost["depth"].metres == pytest.approx(float(off.max()), abs=1e-9)
    assert (report.lost["depth"].values, report.lost["depth"].captures) == (2, 1)
    odd = replace(first, depth=first.depth * 1.00037)
    with pytest.raises(ConfigError, match=r"metres_per_unit=0\.0001"):
        convert(MadeCaptures({"0": odd}), "lerobot", tmp_path / "odd", depth="ffv1")


def test_what_the_first_capture_decides_is_told_and_holds_for_all(tmp_path: Path) -> None:
    first, second = made_frame(0), made_frame(1)
    report = convert(MadeCaptures({"0": first, "1": second}), "lerobot", tmp_path / "fit")
    assert any("whole units of 0.0001 m" in note for note in report.notes)
    halves = replace(second, depth=(second.depth.double() * 1.25).float())
    coarse = replace(first, depth=(first.depth.double() * 10).round().float() / 10, provenance={})
    far = replace(second, depth=second.depth * 100)
    for one, other in ((first, halves), (coarse, second), (first, far)):
        with pytest.raises(CaptureError, match=r"001: its depth is no whole units.*unlike that of 0.*depth=array"):
            convert(MadeCaptures({"0": one, "1": other}), "lerobot", tmp_path / "out")
        assert not (tmp_path / "out").exists()
    fine = MadeCaptures({"0": coarse, "1": second})
    with pytest.raises(CaptureError, match=r"say metres_per_unit=0\.0001 ") as refused:
        convert(fine, "lerobot", tmp_path / "out")
    assert "depth=array" in str(refused.value)
    assert "depth" not in convert(fine, "lerobot", tmp_path / "out", metres_per_unit=0.0001).lost
    mixed = MadeCaptures({"0": first, "1": far})
    assert "depth" not in convert(mixed, "lerobot", tmp_path / "array", depth="array").lost


def test_floats_of_a_simulator_are_kept_as_they_are(tmp_path: Path) -> None:
    made = TeleopSource(num_episodes=1, size=(12, 16))
    convert(made, "lerobot", tmp_path / "out")
    source = open_source(tmp_path / "out")
    assert source.episodes == made.episodes
    for name, own in list(zip(made.ids, source.ids))[::6]:
        before, after = made.load(name), source.load(own)
        assert torch.equal(before.depth, after.depth)
        assert torch.equal(before.world_from_camera, after.world_from_camera)
        assert all(after.recorded_signals[key].same_bits(one) for key, one in before.recorded_signals.items())


def test_captures_between_episodes_are_none_when_they_are_read_back(tmp_path: Path) -> None:
    made = made_captures()
    made.episodes = [Episode("only", 1, 2, [0.0, 0.125], {"task": "pick"})]
    convert(made, "lerobot", tmp_path / "out")
    source = open_source(tmp_path / "out")
    assert len(source) == len(made)
    found = episodes_of(source)
    assert [(one.id, one.first, one.length, one.times) for one in found] == [("only", 1, 2, (0.0, 0.125))]
    assert info(tmp_path / "out")["fps"] == 8


def test_files_that_grow_large_are_followed_by_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lerobot_videos, "FILE_MEGABYTES", 0)
    monkeypatch.setattr(lerobot_tables, "FILE_MEGABYTES", 0)
    monkeypatch.setattr(lerobot_tables, "_GROUP_BYTES", 1)
    made = cut_to_episodes(made_captures())
    convert(made, "lerobot", tmp_path / "out", color="image")
    assert (tmp_path / "out/videos/depth.view0/chunk-000/file-001.mkv").exists()
    assert (tmp_path / "out/data/chunk-000/file-001.parquet").exists()
    source = open_source(tmp_path / "out")
    for name, own in zip(made.ids[::-1], source.ids[::-1]):
        assert torch.equal(source.load(own).depth, made.load(name).depth)
        assert source.load(own).signals["joints"].tolist() == made.load(name).signals["joints"].tolist()


def test_points_are_in_the_frame_of_the_poses_with_colors_and_a_mask(tmp_path: Path) -> None:
    made = cut_to_episodes(made_captures(views=2))
    convert(made, "lerobot", tmp_path / "out", points=400)
    clouds = open_source(tmp_path / "out", clouds=True)
    cloud = clouds.load(clouds.ids[1])
    assert isinstance(cloud, PointCloud)
    frame = made.load(made.ids[1])
    assert cloud.frame_id == "base"
    assert cloud.num_points == min(400, int((frame.depth > 0).sum()))
    assert cloud.colors is not None
    few = made_captures()
    convert(few, "lerobot", tmp_path / "few", points=50)
    assert open_source(tmp_path / "few", clouds=True).load("000000-000000").num_points == 50


def test_options_and_captures_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    made = cut_to_episodes(made_captures())
    for wrong, words in [
        ({"depth": "png"}, "depth must be one of"),
        ({"color": "jpeg"}, "color must be one of"),
        ({"fps": 0}, "fps must be"),
        ({"fps": 29.97}, "whole number"),
        ({"points": -1}, "points must be"),
        ({"state": ["jonts"]}, "did you mean 'joints'"),
        ({"state": 7}, "NAME,NAME or a list"),
        ({"action": ["joints"]}, "is the column action already"),
        ({"depth": "array", "metres_per_unit": 0.001}, "leave out metres_per_unit"),
        ({"robot_type": ""}, "robot_type must be"),
    ]:
        with pytest.raises(ConfigError, match=words):
            convert(made, "lerobot", tmp_path / "out", **wrong)
    first, second = made.load(made.ids[0]), made.load(made.ids[1])
    for odd, words in [
        (second.with_signal("more", torch.zeros(1, 2), "invariant"), "more differ"),
        (second.with_signal("joints", torch.zeros(1, 7), "invariant"), "joints differ"),
        (replace(second, colors=None), "has no colors, 0 has"),
        (replace(second, frame_id="table", recorded_signals={}), "poses lead to 'table'"),
        (made_frame(1, views=2), "has 2 views"),
    ]:
        with pytest.raises(CaptureError, match=words):
            convert(MadeCaptures({"0": first, "1": odd}), "lerobot", tmp_path / "out")
    twice = {"a b": Signal(torch.zeros(1, 2), "invariant"), "a_b": Signal(torch.zeros(1, 2), "invariant")}
    with pytest.raises(CaptureError, match="both be the column"):
        convert(MadeCaptures({"0": replace(first, recorded_signals=twice)}), "lerobot", tmp_path / "out")
    assert not (tmp_path / "out").exists()


OFFICIAL = """
import json, sys
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
def opened(path, **options):
    return LeRobotDataset("made/here", root=path, video_backend="pyav", depth_output_unit="mm", **options)
def plain(value):
    return value.tolist() if hasattr(value, "tolist") else value
def told(path):
    data = opened(path)
    keys = [key for key in data.features if key not in data.meta.video_keys]
    delta = {key: [-1 / data.fps, 0.0, 1 / data.fps] for key in ("action", "observation.images.view0")}
    part = opened(path, episodes=[1], delta_timestamps=delta)
    batches = [*torch.utils.data.DataLoader(data, batch_size=2, num_workers=2)]
    windows = next(iter(torch.utils.data.DataLoader(part, batch_size=2, num_workers=1)))
    return {
        "frames": data.num_frames, "episodes": data.num_episodes, "fps": data.fps, "task": [i["task"] for i in data],
        "rows": {key: [plain(item[key]) for item in data] for key in keys},
        "images": {key: list(data[0][key].shape) for key in data.meta.video_keys},
        "batches": [plain(batch["action"]) for batch in batches], "batch_keys": sorted(batches[0]),
        "windows": plain(windows["action"]), "window_pad": plain(windows["action_is_pad"]),
        "window_images": list(windows["observation.images.view0"].shape),
        "stats": {key: plain(one["mean"]) for key, one in data.meta.stats.items()},
    }
print(json.dumps([told(path) for path in sys.argv[1:]]))
"""


def official_python() -> str:
    """Return a Python that has the package lerobot: PCDATA_LEROBOT_PYTHON, or this one."""
    python = os.environ.get("PCDATA_LEROBOT_PYTHON", sys.executable)
    probe = subprocess.run([python, "-c", "import lerobot.datasets"], capture_output=True, check=False)
    if probe.returncode:
        pytest.skip(
            "the package lerobot (Python 3.12) is not installed; PCDATA_LEROBOT_PYTHON names a Python that has it"
        )
    return python


def captures_of_all_kinds() -> MadeCaptures:
    """Two cameras with labels, mask and confidence, and signals of every kind, of each kind of pose in one layout."""
    made = made_captures(views=2)
    for number, (name, frame) in enumerate(made.frames.items()):
        for signal, (values, kind) in markers(1, seed=number).items():
            is_more = "/" not in signal or signal in ("pose/xyz_quat_xyzw", "delta/matrix")
            if is_more and signal not in frame.signals:
                frame = frame.with_signal(signal, values, kind, frame_of(kind))
        made.frames[name] = frame
    return cut_to_episodes(made)


def frame_of(kind: str) -> str | None:
    return None if kind.split()[0] in ("invariant", "text") else "base"


@pytest.mark.slow
def test_the_package_lerobot_opens_what_is_written(tmp_path: Path) -> None:
    python = official_python()
    made = captures_of_all_kinds()
    ways = {"image": {"depth": "image", "metres_per_unit": 0.001}, "ffv1": {}, "array": {"depth": "array"}}
    for name, options in ways.items():
        convert(made, "lerobot", tmp_path / name, fps=20, points=300, state=["joints", "gripper"], **options)
    environment = {**os.environ, "HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "home")}
    paths = [str(tmp_path / name) for name in ways]
    done = subprocess.run(
        [python, "-c", OFFICIAL, *paths], capture_output=True, text=True, check=False, env=environment
    )
    assert done.returncode == 0, done.stderr[-2000:]
    frames = [made.load(name) for name in made.ids]
    actions = [frame.signals["action"][0].tolist() for frame in frames]
    for (name, told), path in zip(zip(ways, json.loads(done.stdout.splitlines()[-1])), paths):
        assert (told["frames"], told["episodes"], told["fps"]) == (len(made), len(made.episodes), 20)
        assert told["task"] == [frame.signals["task"][0] for frame in frames]
        assert told["images"] == {f"observation.images.view{view}": [3, 12, 16] for view in range(2)}
        assert told["rows"]["action"] == actions
        assert [action for batch in told["batches"] for action in batch] == actions
        assert told["windows"] == [[actions[place] for place in places] for places in ((2, 2, 3), (2, 3, 3))]
        assert told["window_pad"] == [[True, False, False], [False, False, True]]
        assert told["window_images"] == [2, 3, 3, 12, 16]
        assert told["stats"]["action"] == pytest.approx(np.mean(actions, 0).tolist(), abs=1e-6)
        rows = parquet.read_table(Path(path) / ROWS).to_pylist()
        for key, values in told["rows"].items():
            if not key.endswith("_depth"):
                written = [row[key] for row in rows]
                # The package returns numbers of 64 bits as float32.
                assert values == written or np.array_equal(np.float32(values), np.float32(written)), key
        assert {"observation.pointcloud.xyz", "observation.joints", "observation.force", "text.language"} < {*rows[0]}
        if name == "image":
            for millimetres, frame in zip(told["rows"]["observation.images.view1_depth"], frames):
                assert np.abs(np.array(millimetres)[0] - 1000 * frame.depth[1].numpy()).max() <= 0.501
        source = open_source(path)
        for own, frame in zip(source.ids, frames):
            read = source.load(own)
            assert torch.equal(read.depth, frame.depth) or name == "image"
            assert torch.equal(read.labels, frame.labels)
            assert torch.equal(read.mask, frame.mask)
            assert read.signals.keys() == frame.signals.keys()
            for key, signal in frame.recorded_signals.items():
                assert read.recorded_signals[key].same_bits(signal), key


def test_signals_of_a_row_are_named_as_exports_name_them(tmp_path: Path) -> None:
    made = cut_to_episodes(made_captures())
    for name, state in (("text", "joints, count"), ("list", ["joints", "count"])):
        convert(made, "lerobot", tmp_path / name, state=state)
    assert tree(tmp_path / "text") == tree(tmp_path / "list")
    with pytest.raises(ConfigError, match="NAME,NAME"):
        convert(made, "lerobot", tmp_path / "bad", state="joints,,count")


def test_poses_in_the_state_are_position_and_rotation_in_the_layout_asked_for(tmp_path: Path) -> None:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3] = torch.tensor([[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3]])
    frames = {"0": made_frame().with_signal("hand", pose[None], "pose matrix", "base")}
    rows = {"": [0, -1, 0, 1, 0, 0], "xyz_quat_xyzw": [0, 0, 0.5**0.5, 0.5**0.5]}
    for number, (poses, rotation) in enumerate(rows.items()):
        out = tmp_path / str(number)
        convert(MadeCaptures(frames), "lerobot", out, state="hand", poses=poses)
        (row,) = parquet.read_table(out / ROWS).column("observation.state").to_pylist()
        assert row == pytest.approx([0.1, 0.2, 0.3, *rotation])
        assert info(out)["features"]["observation.state"]["shape"] == [len(row)]
    with pytest.raises(ConfigError, match="lerobot: poses: a pose is written in a row as one of"):
        convert(MadeCaptures(frames), "lerobot", tmp_path / "bad", state="hand", poses="matrix")
    with pytest.raises(ConfigError, match="give state=NAME,NAME too"):
        convert(MadeCaptures(frames), "lerobot", tmp_path / "bad", poses="xyz_quat_xyzw")


def test_quaternions_in_the_state_go_on_within_an_episode_and_begin_anew_with_the_next(tmp_path: Path) -> None:
    frames = {}
    for number in range(12):
        half = 0.2 * (number + 5)  # w passes 0 within each episode
        quaternion = torch.tensor([[0.1, 0.2, 0.3, 0.0, 0.0, np.sin(half), np.cos(half)]], dtype=torch.float64)
        pose = Signal(quaternion, "pose xyz_quat_xyzw", "base").with_poses_as("xyz_rot6d_rows")
        frame = made_frame(number).without_signal("action")
        frames[f"{number:02d}"] = frame.with_signal("hand", pose.values, pose.kind, "base")
    made = MadeCaptures(frames, [Episode("a", 0, 5), Episode("b", 5, 7)])
    convert(made, "lerobot", tmp_path / "out", state="hand,hand", action="hand", poses="xyz_quat_wxyz")
    table = parquet.read_table(tmp_path / "out" / ROWS)
    for column in ("observation.state", "action"):
        rows = np.array(table.column(column).to_pylist()).reshape(12, -1, 7)[:, :, 3:]
        half = 0.2 * (np.arange(12) + 5)
        wanted = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=1)[:, None]
        assert np.abs(np.abs((rows * wanted).sum(-1)) - 1).max() < 1e-6
        for steps in (slice(0, 5), slice(5, 12)):
            assert (rows[steps.start, :, 0] >= 0).all()
            assert np.linalg.norm(np.diff(rows[steps], axis=0), axis=-1).max() < 0.21  # half the angle of a step


def test_a_dataset_without_its_facts_is_known_by_its_folders(tmp_path: Path) -> None:
    convert(MadeCaptures({"0": made_frame()}), "lerobot", tmp_path / "out")
    (tmp_path / "out" / "meta" / "info.json").unlink()
    with pytest.raises(CaptureError, match=r"LeRobot dataset, but meta/info\.json is missing: copy the dataset again"):
        open_source(tmp_path / "out")


def test_one_row_of_large_arrays_is_read_without_decoding_hundreds(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    rows = lerobot_tables.RowsWriter(tmp_path, {"depth": {"dtype": "float32", "shape": [240, 320]}})
    rows.begin_episode()
    for number in range(40):
        rows.add({"depth": np.full((240, 320), number, np.float32)})
    rows.end_episode()
    rows.close()
    (path,) = tmp_path.rglob("*.parquet")
    about = parquet.ParquetFile(path).metadata
    assert about.num_rows == 40
    groups = [about.row_group(number).num_rows for number in range(about.num_row_groups)]
    assert max(groups) * 240 * 320 * 4 < 5_000_000
