"""Every option of every capture layout can be given on the command line, and is checked wherever it comes from."""

from __future__ import annotations

import argparse
import inspect
import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pcdata import open_source
from pcdata.cli.capture_flags import COMBINATOR_FLAGS, LAYOUT_FLAGS
from pcdata.cli.main import main
from pcdata.cli.options import _NO_OPTIONS, KINDS, add_capture_options, attribute_of, given_options
from pcdata.errors import CaptureError, ConfigError, PcdataError, UnitError
from pcdata.io import COMBINATORS, LAYOUTS, CaptureCamera, read_capture_camera, write_capture_camera
from pcdata.io.calibration.capture_camera import _STATED
from pcdata.io.sources.registry import OPENING, fields_of, options_of

SIZE = (6, 8)


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    root = tmp_path / "capture"
    (root / "depth").mkdir(parents=True)
    depth = np.full(SIZE, 800, np.uint16)
    depth[0] = 65535
    Image.fromarray(depth).save(root / "depth" / "1.png")
    state(root)
    return root


def state(root: Path, **changes: object) -> None:
    stated = {"width": 8, "height": 6, "fx": 10.0, "fy": 10.0, "cx": 3.5, "cy": 2.5, "metres_per_unit": 0.001}
    (root / "intrinsics.json").write_text(json.dumps(stated | changes))


def parsed(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_capture_options(parser)
    return parser.parse_args(words)


def test_flags_and_kinds_are_those_of_the_layouts() -> None:
    options = {name for layout in LAYOUTS.values() for name in inspect.signature(layout).parameters} - {"path"}
    assert set(LAYOUT_FLAGS) <= options
    assert options - set(LAYOUT_FLAGS) == set(), "give the new option a flag, so that --help tells of it"
    assert {*_NO_OPTIONS, "skip_file"} == {*OPENING}
    assert tuple(LAYOUTS) == KINDS
    assert tuple(COMBINATOR_FLAGS) == tuple(COMBINATORS), "give the new combinator a flag, so that --help tells of it"


def test_every_flag_becomes_the_option_of_python() -> None:
    words = {
        "metres_per_unit": (["0.001"], 0.001),
        "depth_encoding": (["rotated"], "rotated"),
        "invalid_values": (["65535,4095"], [65535, 4095]),
        "background_label": (["0"], 0),
        "calibration": (["c.yaml"], "c.yaml"),
        "camera": (["left"], "left"),
        "frame_id": (["base"], "base"),
        "folders": (["color=rgb"], {"color": "rgb"}),
        "intrinsics": (["585", "585", "320", "240"], [585, 585, 320, 240]),
        "registered": ([], True),
        "color_from_depth": (["1 0 0 0.02, 0 1 0 0"], [1, 0, 0, 0.02, 0, 1, 0, 0]),
        "labels_from": (["scalar_Label"], "scalar_Label"),
        "links_to": (["/store"], ["/store"]),
        "max_time_apart": (["0.05"], 0.05),
        "signals": (["eef=pose xyz_quat_xyzw in base"], {"eef": {"kind": "pose xyz_quat_xyzw", "frame": "base"}}),
        "depth_values": (["z_buffer"], "z_buffer"),
        "near": (["0.01"], 0.01),
        "far": (["4"], 4.0),
        "rows": (["bottom_first"], "bottom_first"),
        "extrinsics": (["frame_to_camera"], "frame_to_camera"),
        "clouds": ([], True),
        "depth": (["/cam/depth"], ["/cam/depth"]),
        "color": (["/cam/color"], ["/cam/color"]),
        "camera_info": (["/cam/depth=/cam/info"], {"/cam/depth": "/cam/info"}),
        "cloud": (["/points"], "/points"),
        "poses": (["eef=gripper"], {"eef": "gripper"}),
        "clock": (["recorded"], "recorded"),
        "max_gap": (["0.2"], 0.2),
    }
    for name, (flag, _) in LAYOUT_FLAGS.items():
        text, value = words[name]
        assert given_options(parsed(flag, *text)) == {name: value}
        assert getattr(parsed(), attribute_of(flag)) is None
    assert given_options(parsed("--folder", "color=rgb", "--folder", "pose=")) == {
        "folders": {"color": "rgb", "pose": None}
    }
    assert given_options(parsed("--signal", "joints=invariant 7", "--signal", "debug=")) == {
        "signals": {"joints": {"kind": "invariant 7"}, "debug": None}
    }


@pytest.mark.parametrize("flag", ["--invalid-values", "--color-from-depth"])
def test_numbers_that_are_none_are_refused_in_words(flag: str, capsys) -> None:
    with pytest.raises(SystemExit):
        parsed(flag, "1 0 zero")
    assert "numbers" in capsys.readouterr().err.partition(f"argument {flag}: must be ")[2]


def test_any_option_can_be_given_by_its_name(capture: Path) -> None:
    options = given_options(parsed("--option", "invalid_values=[65535]", "--option", "frame_id=base"))
    assert options == {"invalid_values": [65535], "frame_id": "base"}
    with pytest.raises(ConfigError, match="given twice"):
        given_options(parsed("--invalid-values", "1", "--option", "invalid_values=[2]"))
    assert main(["inspect", str(capture), "--option", "invalid_value=[1]"]) == 2


def test_combinators_are_flags_and_their_fields_are_options() -> None:
    assert given_options(parsed("--averaged", "10", "--option", "averaged.max_jump=0.05")) == {
        "averaged": {"num_frames": 10, "max_jump": 0.05}
    }
    assert given_options(parsed("--temporal", "4")) == {"temporal": 4}
    assert given_options(parsed("--option", "temporal.alpha=0.2", "--option", "temporal.delta=9")) == {
        "temporal": {"alpha": 0.2, "delta": 9}
    }
    assert given_options(parsed("--option", "temporal=true")) == {"temporal": True}
    assert given_options(parsed("--convention", "opengl", "--option", "convention.depth=ray")) == {
        "convention": {"axes": "opengl", "depth": "ray"}
    }
    with pytest.raises(ConfigError, match="given twice"):
        given_options(parsed("--averaged", "10", "--option", "averaged.num_frames=5"))


def test_the_page_on_captures_tells_every_layout_option_and_combinator() -> None:
    page = (Path(__file__).resolve().parents[2] / "docs" / "captures.md").read_text(encoding="utf-8")
    rows = {name for line in page.splitlines() if line.startswith("| `") for name in re.findall(r"`([^`]+)`", line)}
    named = {word for row in rows for word in row.split()}
    assert {*LAYOUTS, *COMBINATORS, *LAYOUT_FLAGS, *(flag for flag, _ in LAYOUT_FLAGS.values())} <= named
    for name, combinator in COMBINATORS.items():
        assert {*fields_of(combinator), f"--{name}"} <= named


def test_what_a_capture_may_say_of_itself_is_all_but_where_its_links_lead() -> None:
    assert set(options_of(LAYOUTS["folder"])) - set(_STATED) == {"links_to"}  # a capture must not open other folders
    assert set(_STATED) <= set(options_of(LAYOUTS["folder"]))


@pytest.mark.parametrize("command", ["inspect", "validate", "build", "export", "calib check"])
def test_every_command_on_captures_takes_them_and_lists_the_kinds(command: str, capsys) -> None:
    with pytest.raises(SystemExit):
        main([*command.split(), "--help"])
    text = " ".join(capsys.readouterr().out.split())
    combined = [f"--{name}" for name in COMBINATOR_FLAGS]
    for flag in (
        *(flag for flag, _ in LAYOUT_FLAGS.values()),
        *combined,
        "--option",
        "--only",
        "--skip",
        "--skip-file",
        *KINDS,
    ):
        assert flag in text


def test_a_value_that_means_no_reading_is_sayable_at_every_door(capture: Path, capsys) -> None:
    assert main(["inspect", str(capture), "--invalid-values", "65535"]) == 0
    assert "40 of 48 pixels valid" in capsys.readouterr().out
    assert open_source(capture, invalid_values=[65535]).load("1").depth.max() < 1
    state(capture, invalid_values=[65535])
    assert open_source(capture).load("1").depth.max() < 1
    assert open_source(capture, invalid_values=[65535]).ids == ["1"]
    with pytest.raises(CaptureError, match="correct the file if it is wrong"):
        open_source(capture, invalid_values=[4095])


def test_the_calibration_file_keeps_values_that_mean_no_reading(capture: Path, tmp_path: Path) -> None:
    state(capture, invalid_values=[65535, 4095])
    read = read_capture_camera(capture / "intrinsics.json")
    assert isinstance(read, CaptureCamera)
    assert read.invalid_values == (65535, 4095)
    write_capture_camera(tmp_path / "again.json", read)
    assert read_capture_camera(tmp_path / "again.json").invalid_values == (65535, 4095)


@pytest.mark.parametrize("values", ["65535", 65535, [-1], [65536], [1.5], [True], ["1"], None])
def test_wrong_values_that_mean_no_reading_are_refused(values: object, capture: Path) -> None:
    with pytest.raises(ConfigError, match="invalid_values must list whole numbers"):
        open_source(capture, invalid_values=values)
    if values is not None:
        state(capture, invalid_values=values)
        with pytest.raises(CaptureError, match="invalid_values must list whole numbers"):
            open_source(capture)


@pytest.mark.parametrize("unit", ["0.001", -0.001, 0, True, [0.001], 1e400, 1000])
def test_a_wrong_unit_is_refused_at_every_door(unit: object, capture: Path) -> None:
    state(capture, metres_per_unit=unit)
    with pytest.raises((UnitError, CaptureError)):
        open_source(capture)
    state(capture, metres_per_unit=None)
    with pytest.raises(UnitError):
        open_source(capture, metres_per_unit=unit)


@pytest.mark.parametrize(
    "options",
    [
        {"background_label": "0"},
        {"background_label": -1},
        {"background_label": 1.5},
        {"frame_id": 3},
        {"frame_id": " "},
        {"camera": 3},
        {"folders": [1]},
    ],
)
def test_wrong_options_are_typed_errors(options: dict[str, object], capture: Path) -> None:
    with pytest.raises(PcdataError):
        open_source(capture, **options)


@pytest.mark.parametrize("intrinsics", [(585, 585), "abcd", (1, 2, 3, "4"), (1, 2, 3, float("nan")), 5])
def test_wrong_intrinsics_are_typed_errors(intrinsics: object, tmp_path: Path) -> None:
    Image.fromarray(np.full(SIZE, 800, np.uint16)).save(tmp_path / "frame-1.depth.png")
    with pytest.raises(ConfigError, match="four numbers"):
        open_source(tmp_path, intrinsics=intrinsics)
