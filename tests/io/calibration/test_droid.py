"""Extrinsics by episode and serial go before those of a calibration."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from pcdata import Calibration, Camera, read_calibration, with_droid_extrinsics, write_calibration
from pcdata.cli.main import main
from pcdata.errors import CaptureError, PoseError

EPISODE = "AUTOLab+0d4edc83+2023-10-21-19h-09m-36s"
SIX = [0.4, -0.3, 0.5, -1.9, 0.1, 0.7]


def recorded() -> Calibration:
    camera = Camera.pinhole(fx=500, fy=500, cx=63.5, cy=47.5, size=(96, 128))
    return Calibration(
        cameras={"23404442": camera, "29838012": camera},
        transforms={
            "23404442_from_base": torch.eye(4, dtype=torch.float64),
            "base_from_29838012": torch.eye(4, dtype=torch.float64),
        },
    )


def written(path: Path, said: Any) -> Path:
    path.write_text(json.dumps(said))
    return path


def test_six_numbers_are_a_place_and_angles_about_fixed_axes_as_scipy_reads_them(tmp_path: Path) -> None:
    said = {EPISODE: {"23404442": SIX, "source": "cam2base", "quality": 0.9}, "other": {}}
    found = with_droid_extrinsics(recorded(), written(tmp_path / "a.json", said), episode=EPISODE)
    pose = found.transform("base", "23404442").numpy()
    assert np.abs(pose[:3, :3] - Rotation.from_euler("xyz", SIX[3:]).as_matrix()).max() < 1e-12
    assert pose[:3, 3].tolist() == SIX[:3]
    assert torch.equal(found.transform("base", "29838012"), torch.eye(4, dtype=torch.float64))
    assert "23404442_from_base" not in found.transforms


def test_a_file_of_one_episode_may_hold_matrices(tmp_path: Path) -> None:
    matrix = np.eye(4)
    matrix[:3, 3] = 1, 2, 3
    found = with_droid_extrinsics(recorded(), written(tmp_path / "a.json", {"29838012": matrix.tolist()}))
    assert found.transform("base", "29838012")[:3, 3].tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    ("said", "episode", "error", "words"),
    [
        ({EPISODE: {"23404442": SIX}}, None, CaptureError, "has 1 episodes; say which: episode="),
        ({EPISODE: {"23404442": SIX}}, EPISODE[:-1], CaptureError, "has no episode.*did you mean"),
        ({"1": SIX}, None, CaptureError, "has none of the cameras 23404442, 29838012; it has 1"),
        ({"23404442": SIX[:5]}, None, CaptureError, "three Euler angles, or a 4x4 matrix"),
        ({"23404442": [*SIX[:5], "a"]}, None, CaptureError, "must be numbers"),
        ({"23404442": [*SIX[:5], 10**400]}, None, CaptureError, "JSON|numbers"),
        ({"23404442": (2 * np.eye(4)).tolist()}, None, PoseError, "not rigid"),
        ([], None, CaptureError, "JSON"),
    ],
)
def test_files_that_say_no_place_are_refused(said: Any, episode: Any, error: type, words: str, tmp_path: Path) -> None:
    with pytest.raises(error, match=words):
        with_droid_extrinsics(recorded(), written(tmp_path / "a.json", said), episode=episode)


def test_the_command_writes_what_the_function_returns(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = written(tmp_path / "a.json", {EPISODE: {"23404442": SIX}})
    write_calibration(tmp_path / "old.yaml", recorded())
    call = ["calib", "droid", str(tmp_path / "old.yaml"), str(said), "--out", str(tmp_path / "new.yaml")]
    assert main(call) == 1
    assert "--episode" in capsys.readouterr().err
    assert not (tmp_path / "new.yaml").exists()
    assert main([*call, "--episode", EPISODE]) == 0
    told = capsys.readouterr().out
    assert "base_from_23404442" in told
    assert "as they were: 29838012" in told
    wanted = with_droid_extrinsics(recorded(), said, episode=EPISODE)
    found = read_calibration(tmp_path / "new.yaml")
    assert list(found.transforms) == list(wanted.transforms)
    assert all(torch.equal(found.transforms[name], matrix) for name, matrix in wanted.transforms.items())
    assert main([*call, "--episode", EPISODE]) != 0
    assert "exists" in capsys.readouterr().err
