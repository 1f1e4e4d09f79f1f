"""Exports of clouds straight from captures: ``pcdata export CAPTURES --to dp3 --model dp3_sim``."""

from __future__ import annotations

from pathlib import Path

import pytest

from pcdata.build import BuildConfig, build_dataset
from pcdata.cli.main import main
from pcdata.exports import export_dataset
from pcdata.io import convert
from pcdata.models import preset
from pcdata.synthetic import TeleopSource
from tests.exports.samples import tree

CHOICES = ["--model", "dp3_sim", "--set", "frame=base", "--set", "crop=none", "--set", "num_points=32"]


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("captures") / "in"
    convert(TeleopSource(num_episodes=1, num_views=2, size=(24, 32)), "folder", folder)
    return folder


def test_clouds_made_on_the_way_are_those_of_a_dataset_between(captures, tmp_path):
    command = ["export", str(captures), "--to", "dp3", *CHOICES, "--set", "state=joints,gripper"]
    assert main([*command, "--out", str(tmp_path / "way.zarr")]) == 0
    made = preset("dp3_sim", frame="base", crop=None, num_points=32)
    build_dataset(
        BuildConfig().for_model(made), TeleopSource(num_episodes=1, num_views=2, size=(24, 32)), tmp_path / "d"
    )
    export_dataset(tmp_path / "d", "dp3", tmp_path / "built.zarr", state="joints,gripper")
    record = "pcdata_export.json"  # which names what the clouds were made of
    way, built = tree(tmp_path / "way.zarr"), tree(tmp_path / "built.zarr")
    assert way.pop(record) != built.pop(record)
    assert way == built
    assert main(["check", str(tmp_path / "way.zarr"), "--model", "dp3_sim"]) == 0


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--to", "dp3", "--model", "dp3_simm"], "did you mean 'dp3_sim'"),
        (["--to", "dp3", "--model", "dp3_sim"], "leaves open what only you can know"),
        (["--to", "dp3", *CHOICES, "--set", "colour=yes"], "has no option 'colour'"),
        (["--to", "ggcnn", *CHOICES], "written from depth images, of which --model makes clouds"),
    ],
)
def test_a_wrong_request_says_what_is_wrong(captures, tmp_path, capsys, words, told):
    assert main(["export", str(captures), *words, "--out", str(tmp_path / "out")]) == 2
    assert told in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_model_for_a_built_dataset_is_refused(tmp_path, capsys):
    made = preset("dp3_sim", frame="base", crop=None, num_points=32)
    build_dataset(
        BuildConfig().for_model(made), TeleopSource(num_episodes=1, num_views=1, size=(24, 32)), tmp_path / "d"
    )
    assert main(["export", str(tmp_path / "d"), "--to", "dp3", *CHOICES, "--out", str(tmp_path / "out")]) == 2
    assert "is a built dataset, whose clouds are made; --model is for captures" in capsys.readouterr().err
