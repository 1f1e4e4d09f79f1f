"""From recordings to what a policy trains from, in two commands: convert, then export."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from pcdata import open_source
from pcdata.cli.main import main
from pcdata.exports import export_dataset
from pcdata.io import convert
from pcdata.models import preset
from pcdata.synthetic import TeleopSource
from tests.exports.test_zarr_v2 import read_by_the_specification

pytest.importorskip("pyarrow")
pytest.importorskip("av")
pytest.importorskip("rosbags")
from tests.ros_recordings import EPOCH, Entry, Types, written

TELEOP = TeleopSource(num_episodes=2, num_views=2, size=(24, 32))
CHOICES = ["--model", "dp3_sim", "--set", "frame=base", "--set", "crop=none", "--set", "num_points=32"]


def arrays(zarr: Path) -> dict[str, bytes]:
    """The files of the arrays that a policy reads."""
    return {
        file.relative_to(zarr).as_posix(): file.read_bytes()
        for part in ("data", "meta")
        for file in sorted((zarr / part).rglob("*"))
        if file.is_file()
    }


def exported(captures: Path, out: Path, state: str, *others: str) -> Path:
    told = [word for one in (f"state={state}", *others) for word in ("--set", one)]
    assert main(["export", str(captures), "--to", "dp3", *CHOICES, *told, "--out", str(out)]) == 0
    return out


def test_recordings_become_what_the_simulation_gives_bit_for_bit_in_two_commands(tmp_path: Path) -> None:
    convert(TELEOP, "mcap", tmp_path / "bags")
    command = ["convert", str(tmp_path / "bags"), "--to", "lerobot", "--set", "color=image"]
    assert main([*command, "--out", str(tmp_path / "lerobot")]) == 0
    zarr = exported(tmp_path / "lerobot", tmp_path / "dp3.zarr", "joints,gripper")

    made = preset("dp3_sim", frame="base", crop=None, num_points=32)
    direct = tmp_path / "direct.zarr"
    export_dataset(made.dataset(TELEOP), "dp3", direct, frame="base", num_points=32, state="joints,gripper")
    assert arrays(zarr) == arrays(direct)
    source = open_source(tmp_path / "lerobot")
    assert all(torch.equal(source.load(a).depth, TELEOP.load(b).depth) for a, b in zip(source.ids, TELEOP.ids))


def test_streams_of_other_rates_and_with_gaps_are_joined_as_stated(tmp_path: Path, capsys) -> None:
    make = Types(2)
    ids = TELEOP.ids[: TELEOP.episodes[0].length]
    entries: list[Entry] = []
    stamps = [EPOCH + 100_000_000 * step for step in range(len(ids))]
    for name, stamp in zip(ids, stamps):
        frame = TELEOP.load(name)
        k = frame.camera.intrinsics[0].reshape(-1).tolist()
        entries.append(("/cam/depth/image_raw", stamp, make.image(stamp, frame.depth[0].numpy(), "32FC1")))
        entries.append(("/cam/depth/camera_info", stamp, make.camera_info(stamp, size=(24, 32), k=k)))
        entries.append(("/cam/color/image_raw", stamp, make.image(stamp, frame.colors[0].numpy(), "rgb8")))
        entries.append(("/tf", stamp, make.transform(stamp, "base", "camera_optical", (0.0, 0.0, 1.0), (1.0, 0, 0, 0))))
    # Joints at 37 Hz from before the first to beyond the last image, with a hole around the fifth.
    times = EPOCH - 20_000_000 + np.arange(60) * 27_027_027
    hole = (times > stamps[4] - 150_000_000) & (times < stamps[4] + 150_000_000)
    joints = np.sin((times - EPOCH) / 1e9)
    for time, value in zip(times[~hole].tolist(), joints[~hole].tolist()):
        entries.append(("/joint_states", time, make.joints(time, one=value, two=-value)))
    # Commands at 4 Hz: the last one counts until the next.
    commanded = [EPOCH - 10_000_000 + 250_000_000 * number for number in range(7)]
    for number, time in enumerate(commanded):
        entries.append(("/command", time, make.numbers([number] * 4)))
    bag = written(tmp_path / "take.mcap", entries, make, form="mcap")

    options = ["--frame", "base", "--signal", "command=position + invariant 1 in base"]
    command = ["convert", str(bag), *options, "--to", "lerobot", "--set", "color=image", "--set", "fps=10"]
    assert main([*command, "--out", str(tmp_path / "lerobot")]) == 0
    told = capsys.readouterr().out
    said = times[~hole]
    farther = [max(stamp - said[said <= stamp].max(), said[said >= stamp].min() - stamp) for stamp in stamps]
    left = [step for step, gap in enumerate(farther) if gap > 100_000_000]
    assert left == [3, 4, 5]
    assert f"{len(left)} captures left out" in told
    zarr = exported(tmp_path / "lerobot", tmp_path / "dp3.zarr", "joint_states/position", "action=command")
    kept = [stamp for step, stamp in enumerate(stamps) if step not in left]
    state = read_by_the_specification(zarr / "data" / "state")
    expected = np.interp(kept, said, joints[~hole])
    assert np.allclose(state, np.stack([expected, -expected], axis=1), atol=1e-6)
    last = [max(number for number, time in enumerate(commanded) if time <= stamp) for stamp in kept]
    action = read_by_the_specification(zarr / "data" / "action")
    assert np.array_equal(action, np.repeat(np.array(last, np.float32)[:, None], 4, axis=1))
    assert read_by_the_specification(zarr / "meta" / "episode_ends").tolist() == [3, len(kept)]
