"""The command validate: exit codes, table, JSON."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from pcdata.cli import main
from pcdata.io import write_ply
from pcdata.sensors import sensor_profile
from pcdata.structures import PointCloud
from tests.validation.captures import scene, store


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    frames = list(scene(num_views=1).noisy_frames(2))
    frames = [replace(frame, colors=frame.colors ^ number) for number, frame in enumerate(frames)]  # type: ignore[operator]
    return store(tmp_path / "capture", frames)


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    try:
        code = main(["validate", *map(str, arguments)])
    except SystemExit as leave:
        code = leave.code  # type: ignore[assignment]
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err
    return code, out, err


def test_a_good_capture_is_exit_0_with_a_table(capsys, folder: Path) -> None:
    code, out, _ = run(capsys, folder)
    assert code == 0
    assert out.splitlines()[0].split() == ["check", "view", "pass", "unknown", "warn", "fail", "worst", "passes"]
    assert "PASS: of 2 captures 2 pass, 0 unknown, 0 warn, 0 fail" in out
    assert "->" not in out


def test_a_bad_capture_is_exit_1_and_says_what_to_do(capsys, folder: Path) -> None:
    (folder / "depth" / "f1.png").write_bytes((folder / "depth" / "f0.png").read_bytes())
    code, out, _ = run(capsys, folder)
    assert code == 1
    assert "FAIL repeated_depth, view 0 (f1):" in out
    assert "->" in out
    assert run(capsys, folder, "--limit", 1)[0] == 0


def test_json_has_every_check_and_appears_only_when_done(capsys, folder: Path, tmp_path: Path) -> None:
    file = tmp_path / "report.json"
    assert run(capsys, folder, "--json", file)[0] == 0
    report = json.loads(file.read_text())
    assert report["schema"] == "pcdata.validation/1"
    assert [sample["sample_id"] for sample in report["samples"]] == ["f0", "f1", "*"]
    assert report["summary"]["verdict"] == "pass"
    check = report["samples"][0]["checks"][0]
    assert {"name", "value", "threshold", "verdict", "advice", "found", "view"} <= set(check)
    assert run(capsys, folder, "--json", tmp_path / "absent" / "report.json")[0] == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["capture", "report.json"]


def test_the_workspace_can_be_given(capsys, folder: Path) -> None:
    code, out, _ = run(capsys, folder, "--workspace", 3, 9)
    assert code == 1
    assert "FAIL workspace_fraction" in out
    assert run(capsys, folder, "--workspace", 9, 3)[0] == 2
    assert run(capsys, folder, "--workspace", 1)[0] == 2


def test_the_workspace_can_be_that_of_a_sensor(capsys, folder: Path, tmp_path: Path) -> None:
    file = tmp_path / "report.json"
    assert run(capsys, folder, "--sensor", "realsense_d435", "--json", file)[0] == 0
    limits = json.loads(file.read_text())["limits"]
    assert tuple(limits["workspace"]) == sensor_profile("realsense_d435").range
    code, _, err = run(capsys, folder, "--sensor", "realsense_d345")
    assert code == 2
    assert "'realsense_d435'" in err
    assert run(capsys, folder, "--sensor", "realsense_d435", "--workspace", 1, 2)[0] == 2


def test_a_calibration_that_cannot_be_is_a_failed_check(capsys, folder: Path, tmp_path: Path) -> None:
    facts = json.loads((folder / "intrinsics.json").read_text())
    (folder / "intrinsics.json").write_text(json.dumps(facts | {"cx": 2 * facts["width"]}))
    code, out, _ = run(capsys, folder, "--json", tmp_path / "report.json")
    assert code == 1
    assert "FAIL intrinsics" in out
    assert "do these intrinsics belong to another resolution?" in out
    assert json.loads((tmp_path / "report.json").read_text())["summary"]["verdict"] == "fail"


def test_files_that_do_not_pair_up_are_a_failed_check_of_the_whole(capsys, folder: Path, tmp_path: Path) -> None:
    next(iter(sorted((folder / "color").iterdir()))).unlink()
    code, out, err = run(capsys, folder, "--json", tmp_path / "report.json")
    assert (code, err) == (1, "")
    assert "FAIL readable" in out
    assert "color is missing for" in out
    (report,) = json.loads((tmp_path / "report.json").read_text())["samples"]
    assert report["checks"][0]["verdict"] == "fail"


@pytest.mark.parametrize("inside", ["", "depth", "notes.txt"])
def test_a_folder_without_captures_says_so_and_fails_no_capture(capsys, tmp_path: Path, inside: str) -> None:
    folder = tmp_path / "captures"
    (folder / inside).mkdir(parents=True)
    code, out, err = run(capsys, folder, "--json", tmp_path / "report.json")
    assert (code, err) == (1, "")
    assert "FAIL readable (all captures): open_source: " in out
    assert "nothing can be read before that" in out
    assert "--skip" not in out
    assert out.splitlines()[-1] == "FAIL: no capture was read"
    (report,) = json.loads((tmp_path / "report.json").read_text())["samples"]
    assert report["whole"]


def test_a_wrong_unit_given_on_the_command_line_is_a_failed_check(capsys, folder: Path) -> None:
    facts = json.loads((folder / "intrinsics.json").read_text())
    del facts["metres_per_unit"]
    (folder / "intrinsics.json").write_text(json.dumps(facts))
    assert run(capsys, folder, "--metres-per-unit", 0.001)[0] == 0
    code, out, _ = run(capsys, folder, "--metres-per-unit", 0.01)
    assert code == 1
    assert "FAIL depth_unit" in out
    assert "--metres-per-unit 0.001" in out


def test_clouds_are_judged_too(capsys, tmp_path: Path) -> None:
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) + 0.2
    write_ply(tmp_path / "scan.ply", PointCloud(points=points, frame_id="camera"))
    assert run(capsys, tmp_path / "scan.ply")[0] == 0


def test_nothing_there_is_exit_1_and_an_unknown_layout_exit_2(capsys, folder: Path, tmp_path: Path) -> None:
    code, out, err = run(capsys, tmp_path / "nowhere")
    assert (code, out) == (1, "")
    assert "no such file or folder" in err
    assert run(capsys, folder, "--kind", "folderr")[0] == 2
    assert run(capsys)[0] == 2
