"""DP3, read as 3D-Diffusion-Policy reads it: common/replay_buffer.py, dataset/adroit_dataset.py."""

from __future__ import annotations

import tracemalloc
import weakref
from pathlib import Path

import numpy as np
import pytest
import torch

from pcdata.errors import CaptureError, ConfigError, ContractError, ShapeError, TooFewPointsError
from pcdata.exports import TARGETS, export_dataset
from pcdata.exports import replay_buffer as replay_buffer_rows
from tests.exports.samples import Samples, cloud, frame
from tests.exports.test_zarr_v2 import read_by_the_specification

KEYS = ["state", "action", "point_cloud", "img"]  # AdroitDataset; the others load no more


def replay_buffer(folder: Path) -> dict[str, np.ndarray]:
    """The arrays that ReplayBuffer.copy_from_path takes, with what it asserts."""
    assert all((folder / name / ".zgroup").is_file() for name in (".", "data", "meta"))
    data = {key: read_by_the_specification(folder / "data" / key) for key in KEYS}
    ends = read_by_the_specification(folder / "meta" / "episode_ends")
    for value in data.values():
        assert value.shape[0] == ends[-1]
    return data | {"episode_ends": ends}


def episodes(lengths=(3, 2)) -> dict:
    generator, start, result = np.random.default_rng(1), 0, {}
    for number, length in enumerate(lengths):
        result[f"episode{number}"] = {
            "samples": np.array([f"t{step}" for step in range(start, start + length)]),
            "state": generator.random((length, 7)),
            "action": generator.random((length, 4)),
        }
        start += length
    return result


def clouds(number=5, count=512, **changes) -> Samples:
    return Samples({f"t{step}": cloud(count, seed=step, **changes) for step in range(number)})


def test_the_replay_buffer_holds_the_clouds_states_and_actions(tmp_path):
    source, robot = clouds(), episodes()
    report = export_dataset(source, "dp3", tmp_path / "out.zarr", episodes=robot)
    buffer = replay_buffer(tmp_path / "out.zarr")
    assert report.written == 5
    assert ["fewer than 8 steps" in note for note in report.notes] == [True]
    assert buffer["episode_ends"].dtype == np.int64
    assert buffer["episode_ends"].tolist() == [3, 5]
    assert buffer["point_cloud"].shape == (5, 512, 6)
    assert {key: buffer[key].dtype for key in KEYS} == dict.fromkeys(KEYS, np.float32) | {"img": np.uint8}
    for step, name in enumerate(source.ids):
        stored = source.samples[name]
        assert np.array_equal(buffer["point_cloud"][step, :, :3], stored.points.numpy())
        assert np.array_equal(buffer["point_cloud"][step, :, 3:], (stored.colors * 255).numpy())
    for key in ("state", "action"):
        wanted = np.concatenate([robot[name][key] for name in sorted(robot)]).astype(np.float32)
        assert np.array_equal(buffer[key], wanted)


def test_the_zarr_package_opens_it_as_the_loader_does(tmp_path):
    zarr = pytest.importorskip("zarr", minversion="2.12", reason="zarr is not installed")
    export_dataset(clouds(), "dp3", tmp_path / "out.zarr", episodes=episodes())
    group = zarr.open(str(tmp_path / "out.zarr"), "r")
    root = zarr.group(group.store)
    assert sorted(key for key, _ in root["data"].items()) == sorted(KEYS)
    wanted = replay_buffer(tmp_path / "out.zarr")
    for key in KEYS:
        value = root["data"][key][:]
        assert np.array_equal(value, wanted[key])
        assert value.min() <= value.max()  # the loader prints the range of every array
    assert root["meta"]["episode_ends"][:].tolist() == [3, 5]
    assert root["data"]["point_cloud"].chunks == (100, 512, 6)


def test_episodes_come_from_npz_files_in_the_order_of_their_names(tmp_path):
    robot = episodes()
    (tmp_path / "robot").mkdir()
    for name, arrays in robot.items():
        np.savez(tmp_path / "robot" / f"{name}.npz", **arrays)
    export_dataset(clouds(), "dp3", tmp_path / "files", episodes=str(tmp_path / "robot"))
    export_dataset(clouds(), "dp3", tmp_path / "mapping", episodes=robot)
    ours, theirs = replay_buffer(tmp_path / "files"), replay_buffer(tmp_path / "mapping")
    assert all(np.array_equal(ours[key], theirs[key]) for key in ours)


def test_more_timesteps_than_a_chunk(tmp_path, monkeypatch):
    assert replay_buffer_rows._CHUNK == 100
    monkeypatch.setattr(replay_buffer_rows, "_CHUNK", 10)
    options = {"compression": "none", "colors": False, "num_points": 64}
    report = export_dataset(clouds(23, 64), "dp3", tmp_path / "out", episodes=episodes((23,)), **options)
    assert report.notes == []
    assert sorted(path.name for path in (tmp_path / "out/data/point_cloud").iterdir()) == [
        ".zarray", "0.0.0", "1.0.0", "2.0.0",
    ]  # fmt: skip
    buffer = replay_buffer(tmp_path / "out")
    assert np.array_equal(buffer["point_cloud"][22], cloud(64, seed=22).points.numpy())


def test_padding_by_zeros_is_noted_with_what_it_does_to_the_statistics(tmp_path):
    source = clouds()
    points = source.samples["t3"].points + 2.0
    source = Samples({name: cloud(512, points=points) for name in source.ids})
    padded = points.clone()
    padded[500:] = 0
    source.samples["t3"] = cloud(512, points=padded)
    report = export_dataset(source, "dp3", tmp_path / "out", episodes=episodes())
    assert len(report.notes) == 2
    assert "1 clouds have points at exactly 0 0 0" in report.notes[1]
    assert "'t3'" in report.notes[1]
    low = min(points.min(dim=0).values.tolist())
    assert f"{low:.3g}" in report.notes[1]  # the range without the zeros


@pytest.mark.parametrize(
    ("sample", "error", "fix"),
    [
        (cloud(1024), ShapeError, "the samples before have 512 points, this one has 1024"),
        (cloud(511), ContractError, r"count: 511 points .*FarthestPointSample\(num_points=512"),
        (cloud(512, unit="normalized"), ContractError, "unit: .*remove the normalization"),
        (cloud(512, frame_id="camera"), ContractError, r"frame: .*'camera'.*'base'; add ToFrame"),
        (cloud(512, points=1000 * cloud(512).points), ContractError, "scale: .*millimetres"),
        (cloud(512, colors=None), CaptureError, "colors=false"),
        (cloud(512, points=torch.full((512, 3), torch.nan)), ContractError, "finite: "),
        (cloud(0), TooFewPointsError, "empty"),
        (cloud(512, ptr=torch.tensor([0, 4, 512])), ShapeError, "MergeViews"),
        (frame(), TypeError, "pcdata build"),
    ],
)
def test_what_the_loader_cannot_take_is_refused_with_the_fix(tmp_path, sample, error, fix):
    source = clouds()
    source.samples["t2"] = sample
    with pytest.raises(error, match=fix) as caught:
        export_dataset(source, "dp3", tmp_path / "out", episodes=episodes())
    assert "dp3: sample 't2'" in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_episodes_too_short_for_a_sequence_are_noted(tmp_path):
    """common/sampler.py: a sequence of 16 starts at most 1 step before an episode and ends at most 7 beyond it."""
    for length, sequences in ((7, 0), (8, 1)):
        starts = range(-1, length - 16 + 7 + 1)  # create_indices: min_start .. max_start
        assert len(starts) == sequences
        report = export_dataset(clouds(length), "dp3", tmp_path / str(length), episodes=episodes((length,)))
        assert [("1 episode of fewer than 8 steps (first: 'episode0')" in note) for note in report.notes] == [True] * (
            not sequences
        )


def test_a_frame_can_be_asked_for(tmp_path):
    with pytest.raises(ContractError, match="the data are in 'base', the model works in 'world'"):
        export_dataset(clouds(), "dp3", tmp_path / "out", episodes=episodes(), frame="world")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda robot: None, "needs to know which samples make an episode.*the option episodes"),
        (lambda robot: {}, "has no episode"),
        (lambda robot: robot["episode1"].pop("action") is None or robot, "must have samples, state, action"),
        (lambda robot: robot["episode1"].update(actions=0) or robot, "did you mean 'action'"),
        (lambda robot: robot["episode1"].update(state=np.zeros((3, 7))) or robot, r"state must be numbers \(2, D\)"),
        (lambda robot: robot["episode1"].update(state=np.zeros((2, 6))) or robot, "state has 6 columns"),
        (lambda robot: robot["episode1"].update(action=np.full((2, 4), np.nan)) or robot, "not finite"),
        (lambda robot: robot["episode1"].update(samples=np.array(["t3", "t5"])) or robot, "sample 't5', which is not"),
        (lambda robot: robot["episode1"].update(samples=np.array([3, 4])) or robot, "samples must be texts"),
    ],
)
def test_robot_data_that_does_not_fit_is_refused(tmp_path, change, message):
    source = clouds()
    with pytest.raises(ConfigError, match=message):
        export_dataset(source, "dp3", tmp_path / "out", episodes=change(episodes()))
    assert source.loaded == []
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_episode_file_is_named(tmp_path):
    (tmp_path / "robot").mkdir()
    (tmp_path / "robot" / "a.npz").write_bytes(b"no archive")
    with pytest.raises(ConfigError, match=r"a\.npz"):
        export_dataset(clouds(), "dp3", tmp_path / "out", episodes=tmp_path / "robot")


def test_clouds_are_not_kept_and_memory_does_not_grow_with_their_number(tmp_path, monkeypatch):
    monkeypatch.setattr(replay_buffer_rows, "_CHUNK", 10)
    alive: weakref.WeakSet = weakref.WeakSet()
    most = 0

    def load(step: int):
        nonlocal most

        most = max(most, len(alive))
        made = cloud(1024, seed=step)
        alive.add(made)
        return made

    def peak(number: int) -> int:
        source = Samples({f"t{step}": (lambda step=step: load(step)) for step in range(number)})
        robot = episodes((number,))
        tracemalloc.start()
        export_dataset(source, "dp3", tmp_path / str(number), episodes=robot)
        size = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return size

    one_chunk = 10 * 1024 * 6 * 4
    few, many = peak(10), peak(30)
    assert most <= 2  # the one that was written last, and its view in the writer's loop
    # Thrice the clouds are two chunks more; all that grows are names, states and actions.
    assert many - few < one_chunk / 2


def test_options_are_plain_in_the_record():
    assert TARGETS["dp3"](episodes=Path("robot")).options()["episodes"] == "robot"
    assert TARGETS["dp3"](episodes={"b": {}, "a": {}}).options()["episodes"] == ["a", "b"]


def test_another_count_is_exported_where_it_is_stated_and_refused_where_it_is_not(tmp_path):
    source = clouds(count=2048)
    with pytest.raises(ContractError, match=r"count: 2048 points .*say num_points=2048"):
        export_dataset(source, "dp3", tmp_path / "out.zarr", episodes=episodes())
    export_dataset(source, "dp3", tmp_path / "out.zarr", episodes=episodes(), num_points=2048)
    assert replay_buffer(tmp_path / "out.zarr")["point_cloud"].shape == (5, 2048, 6)
    with pytest.raises(ContractError, match="count: 512 points per cloud, the model takes 2048"):
        export_dataset(clouds(), "dp3", tmp_path / "other.zarr", episodes=episodes(), num_points=2048)
    with pytest.raises(ConfigError, match="num_points must be 512, 1024, or any other"):
        export_dataset(source, "dp3", tmp_path / "few.zarr", episodes=episodes(), num_points=3)
