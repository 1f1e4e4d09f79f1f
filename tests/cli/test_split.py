"""``pcdata split``, and the splits where commands and configurations take them."""

from __future__ import annotations

import runpy
import shutil

import pytest

from pcdata import split_dataset
from pcdata.build import build_dataset, config_from_yaml
from pcdata.cli.main import main
from pcdata.datasets.splits import Splits
from pcdata.errors import CacheError
from pcdata.synthetic import SyntheticSource, TeleopSource

CONFIG = """
depth: [Deproject]
cloud: [RandomSample: {num_points: 48, if_short: repeat}]
loader: {split: val, num_workers: 0}
"""


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    folder = tmp_path_factory.mktemp("split") / "set"
    config = config_from_yaml(CONFIG.replace("RandomSample", "FarthestPointSample"))
    build_dataset(config, SyntheticSource(num_scenes=10, num_objects=1, size=(12, 16)), folder)
    return folder


@pytest.fixture
def dataset(built, tmp_path):
    return shutil.copytree(built, tmp_path / "set")


def test_the_command_tells_what_is_in_every_split(dataset, capsys):
    assert main(["split", str(dataset)]) == 0
    told = capsys.readouterr().out
    assert "by sample, parts train=0.8, val=0.1, test=0.1, seed 0" in told
    assert [line.split() for line in told.splitlines()[1:5] if "%" in line] == [
        ["train", "8", "8", "80.0%"],
        ["val", "1", "1", "10.0%"],
        ["test", "1", "1", "10.0%"],
    ]
    assert main(["inspect", str(dataset)]) == 0
    assert "train 8, val 1, test 1" in capsys.readouterr().out


def test_a_table_stratifies_and_another_rule_needs_a_fresh_draw(dataset, tmp_path, capsys):
    ids = Splits.read(dataset).part_of() if (dataset / "splits.json").is_file() else split_dataset(dataset).part_of()
    table = tmp_path / "table.csv"
    table.write_text("sample,light\n" + "".join(f"{one},{n % 2}\n" for n, one in enumerate(sorted(ids))))
    words = ["split", str(dataset), "--parts", "a=0.6,b=rest", "--stratify", "column:light", "--table", str(table)]
    assert main(words) == 2
    assert "draw all anew with --fresh" in capsys.readouterr().err
    assert main([*words, "--fresh", "--seed", "1"]) == 0
    chosen = Splits.read(dataset).ids("a")
    assert [sum(sorted(ids).index(one) % 2 == light for one in chosen) for light in (0, 1)] == [3, 3]


@pytest.mark.parametrize("parts", ["train", "train=x", "train=0.5,train=0.5", "=1"])
def test_parts_that_say_nothing_are_refused(dataset, parts, capsys):
    with pytest.raises(SystemExit):
        main(["split", str(dataset), "--parts", parts])
    assert "NAME=SHARE" in capsys.readouterr().err


def test_the_loading_script_loads_the_split_of_the_configuration(dataset, capsys):
    with pytest.raises(CacheError, match="there are no splits; draw them with 'pcdata split"):
        runpy.run_path(str(dataset / "load.py"), run_name="__main__")
    split_dataset(dataset)
    runpy.run_path(str(dataset / "load.py"), run_name="__main__")
    assert "epoch 1: PointCloud(48 points" in capsys.readouterr().out  # of 10 samples one is in the split val


def test_an_export_takes_one_split(dataset, tmp_path, capsys):
    splits = split_dataset(dataset)
    words = ["export", str(dataset), "--to", "pointcept", "--split", "test", "--out", str(tmp_path / "out")]
    assert main(words) == 0
    assert [path.name for path in (tmp_path / "out" / "test").iterdir()] == splits.ids("test")
    assert main(["export", str(tmp_path), "--to", "pointcept", "--split", "test", "--out", str(tmp_path / "o")]) == 2


def test_episodes_stay_whole(tmp_path, capsys):
    source = TeleopSource(num_episodes=3, num_views=1, size=(6, 8))
    build_dataset(config_from_yaml("depth: [Deproject]"), source, tmp_path / "set")
    assert main(["split", str(tmp_path / "set"), "--by", "sample"]) == 2
    assert "would be in" in capsys.readouterr().err
    assert main(["split", str(tmp_path / "set"), "--parts", "train=rest,val=1"]) == 0
    assert {*Splits.read(tmp_path / "set").groups["val"]} < {one.id for one in source.episodes}
