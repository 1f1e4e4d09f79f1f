"""What a command refuses comes with what to do about it, in words of the command line."""

from __future__ import annotations

import os
import re
import shlex
import shutil
from pathlib import Path

import pytest

from pcdata.cli import main
from pcdata.io import write_capture
from tests.captures import folder_capture
from tests.factories import tabletop_frame


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    write_capture(tabletop_frame(1), tmp_path / "taken")
    return tmp_path / "taken" / "view0"


def told(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    capsys.readouterr()
    assert main([str(word) for word in words]) in (1, 2)
    return capsys.readouterr().err


def test_color_in_the_place_of_depth_is_taken_for_color(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.rmtree(capture / "depth")
    shutil.copytree(capture / "color", capture / "depth")
    assert "is it the color image, or a picture of the depth" in told(capsys, "inspect", capture)


def test_a_unit_that_is_said_twice_is_corrected_in_one_place(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = told(capsys, "inspect", capture, "--metres-per-unit", "0.5")
    assert "intrinsics.json: says metres_per_unit" in said
    assert "correct the file if it is wrong, else leave the argument out" in said


def test_a_sample_without_a_partner_is_completed_or_moved(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    depth = next((capture / "depth").iterdir())
    shutil.copy(depth, depth.with_name("another.png"))
    assert "is missing for another; add what is missing, or move" in told(capsys, "inspect", capture)


def test_a_link_that_leads_out_names_the_flag_that_allows_it(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    away = tmp_path / "in a cache"
    (capture / "depth").rename(away)
    (capture / "depth").symlink_to(away)
    said = told(capsys, "inspect", capture)
    flag = re.search(r"\((--links-to '[^']+')\)", said)
    assert flag is not None
    assert main(["inspect", str(capture), *shlex.split(flag[1])]) == 0


def test_a_tab_in_a_configuration_is_told_from_spaces(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "tab.yaml"
    config.write_text("depth:\n\t- Deproject\n")
    said = told(capsys, "build", config, "--source", capture, "--out", tmp_path / "set")
    assert "tab.yaml:2:1" in said
    assert "indent with spaces" in said


def test_fuse_looks_whether_it_may_write_before_it_reads(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    said = told(capsys, "fuse", capture, "--frame", "base", "--voxel-size", "0.01", "--out", tmp_path / "s.ply")
    assert f"no permission to write into {tmp_path}" in said
    assert "fuse 1/1" not in said


def test_one_view_is_told_in_the_singular() -> None:
    assert "1 view of " in repr(tabletop_frame(1))
    assert "2 views of " in repr(tabletop_frame(2))
    assert "Camera(1 view, " in repr(tabletop_frame(1).camera)


def test_a_damaged_dataset_and_too_few_groups_say_what_to_do(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "set"
    words = ["build", "--model", "dp3_sim", "--set", "frame=base", "--set", "crop=none", "--source", capture]
    assert main([str(word) for word in [*words, "--out", out]]) == 0
    assert "not enough groups for 3 parts, of 1 groups" in (said := told(capsys, "split", out))
    assert "--parts train=1.0" in said
    assert main(["split", str(out), "--parts", "train=1.0", "--no-check"]) == 0
    (out / "dataset.json").write_bytes((out / "dataset.json").read_bytes()[:100])
    assert "copy it again, or make it anew" in told(capsys, "inspect", out)


def test_a_capture_that_stops_a_command_is_left_out_by_the_options_that_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = folder_capture(tmp_path / "all")
    damaged, *_ = sorted((root / "depth").iterdir())
    damaged.write_bytes(damaged.read_bytes()[:60])
    name, count = damaged.stem, len(list((root / "depth").iterdir()))
    said = told(capsys, "clouds", root, "--out", tmp_path / "out")
    flag = re.search(r"leave it out with (--skip \S+), or all such captures with --skip-refused", said)
    assert flag is not None
    assert main(["clouds", str(root), "--out", str(tmp_path / "out"), *shlex.split(flag[1])]) == 0
    capsys.readouterr()
    main(["grade", str(root)])
    assert f"in 1 of {count} captures, first {name!r}" in capsys.readouterr().out


def test_a_surface_without_a_point_is_not_written(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for mesh in ([], ["--mesh"]):
        said = told(capsys, "fuse", capture, "--voxel-size", "10", "--out", tmp_path / "s.ply", *mesh)
        assert "no surface was found at voxels of 10 m: use smaller ones" in said
        assert not (tmp_path / "s.ply").exists()
