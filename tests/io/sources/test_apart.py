"""Nothing is written among the captures that are read, whoever writes, and no report replaces one of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from pcdata import open_source
from pcdata.cli.main import main
from pcdata.errors import CacheError, ConfigError
from pcdata.files.scratch import hidden_folder
from pcdata.io.sources.capture_source import check_apart
from tests.captures import folder_capture
from tests.exports.samples import tree

BUILD = ["build", "c.yaml", "--source"]
FUSE = ["fuse", "--frame", "base", "--voxel-size", "0.1"]
EXPORT = ["export", "--to", "graspnet_scene"]


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("one", "two"):
        (tmp_path / "sets" / name).mkdir(parents=True)
        folder_capture(tmp_path / "sets" / name)
    (tmp_path / "c.yaml").write_text("depth: [Deproject]\noutput: {format: npz}\n")
    return tmp_path


@pytest.mark.parametrize(
    "line",
    [
        [*BUILD, "sets/one", "--out", "sets/one/set"],
        [*BUILD, "sets/one", "--out", "sets/one"],
        [*BUILD, "sets/one", "--out", "sets", "--overwrite"],
        [*BUILD, "sets/one", "--out", "sets/two/../one/depth/x", "--workers", "0"],
        [*BUILD, "sets/one", "--out", "sets/one/set", "--dry-run"],
        [*BUILD, "sets/*", "--out", "sets/three"],
        [*BUILD, "sets/*", "--out", "sets/three/deep"],
        [*BUILD, "sets/*", "--limit", "2", "--out", "sets/one/deep"],
        [*FUSE, "sets/one", "--out", "sets/one/surface.ply"],
        [*EXPORT, "sets/one", "--out", "sets/one/export"],
        ["validate", "sets/one", "--json", "sets/one/intrinsics.json"],
        ["inspect", "sets/one", "--json", "sets/one/intrinsics.json"],
        ["calib", "overlap", "sets", "--json", "sets/one/intrinsics.json"],
        ["calib", "overlap", "sets", "--figure", "sets/one/color/a_1.png"],
        ["check", "sets/one", "--model", "dp3_sim", "--json", "sets/one/intrinsics.json"],
        ["check", "c.yaml", "--model", "dp3_sim", "--json", "./c.yaml"],
    ],
    ids=" ".join,
)
def test_what_would_land_among_the_captures_is_refused(here, capsys, line):
    before = tree(here)
    assert main(line) == 2
    told = capsys.readouterr().err
    assert any(words in told for words in ("inside the captures", "holds the captures", "fits the pattern", "is read"))
    assert tree(here) == before


def test_a_build_beside_the_captures_is_none_among_them(here, capsys):
    assert main([*BUILD, "sets/one", "--out", "sets/one-set", "--workers", "0"]) == 0, capsys.readouterr().err
    assert main(["validate", "sets/one", "--json", "report.json"]) in (0, 1)
    assert open_source(here / "sets" / "one").ids == ["a_1", "a_2", "a_10"]
    export = ["export", "sets/one-set", "--to", "pointcept", "--out"]
    assert main([*export, "sets/one-set/scenes"]) == 2, "an export into the dataset"
    assert main([*export, "scenes"]) == 0


def test_a_link_to_the_captures_is_the_captures(here):
    (here / "link").symlink_to(here / "sets" / "one")
    with pytest.raises(ConfigError, match="inside the captures"):
        check_apart("x", here / "link" / "set", open_source(here / "sets" / "one"))
    with pytest.raises(ConfigError, match="inside the captures"):
        check_apart("x", here / "sets" / "one" / "set", open_source(here / "link"))


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ([*BUILD, "sets/one", "--out", ""], "out: is empty"),
        ([*BUILD, "", "--out", "set"], "source: is empty"),
        (["build", "", "--source", "sets/one", "--out", "set"], "config: is empty"),
        (["inspect", ""], "path: is empty"),
        (["verify", ""], "dataset: is empty"),
        ([*BUILD, "sets/one", "--out", "set", "--calibration", ""], "calibration: is empty"),
    ],
    ids=str,
)
def test_an_empty_path_is_not_the_folder_that_one_is_in(here, capsys, line, told):
    before = tree(here)
    assert main(line) == 2
    assert told in capsys.readouterr().err
    assert tree(here) == before


def test_an_empty_path_in_python_is_refused_too():
    with pytest.raises(ConfigError, match="empty"):
        open_source("")


@pytest.mark.parametrize("line", [[*BUILD, "sets/one"], ["convert", "sets/one", "--to", "folder"]], ids=" ".join)
def test_the_root_of_a_disk_is_no_place_to_write(here, capsys, line):
    assert main([*line, "--out", "/"]) in (1, 2)
    told = capsys.readouterr().err
    assert "root of a disk" in told or "holds the captures" in told


def test_beside_the_root_of_a_disk_nothing_is_hidden():
    with pytest.raises(CacheError, match="root of a disk"):
        hidden_folder(Path("/"), "building")


@pytest.mark.parametrize(
    ("line", "told"),
    [
        (["build", "c.yaml", "--wrokers", "1"], "did you mean '--workers'"),
        (["card", "set", "--lisense", "mit"], "did you mean '--license'"),
        (["calib", "overlap", "rig", "--figrue=x.png"], "did you mean '--figure'"),
    ],
    ids=str,
)
def test_a_misspelled_option_is_told_with_the_right_one(capsys, line, told):
    with pytest.raises(SystemExit) as ended:
        main(line)
    assert ended.value.code == 2
    assert told in capsys.readouterr().err
