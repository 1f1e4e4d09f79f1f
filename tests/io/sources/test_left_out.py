"""Captures that are left out: by a list, or where they are refused; always told."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pcdata import load_config, open_source, refused_captures
from pcdata.build import build_dataset
from pcdata.cli.main import main
from pcdata.datasets import CachedCloudDataset
from pcdata.errors import CacheError, CaptureError, ConfigError, DTypeError, PoseError, WriteError
from pcdata.io.sources.averaged import AveragedSource
from pcdata.io.sources.open_source import read_skip_file
from pcdata.io.store.manifest import Manifest
from pcdata.report.inspection_text import skipped_text

SIZE = (24, 32)
STEPS = "depth:\n- Deproject: {}\ncloud:\n- FarthestPointSample: {num_points: 16}\n"
LOST = "-inf " * 16


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Six frames: 2 has lost its pose, 4 has no reading."""
    root = tmp_path / "capture"
    for role in ("depth", "poses"):
        (root / role).mkdir(parents=True)
    intrinsics = {"width": 32, "height": 24, "fx": 30.0, "fy": 30.0, "cx": 15.5, "cy": 11.5, "metres_per_unit": 0.001}
    (root / "intrinsics.json").write_text(json.dumps(intrinsics))
    for number in range(6):
        depth = np.full(SIZE, 0 if number == 4 else 800, np.uint16)
        Image.fromarray(depth).save(root / "depth" / f"{number}.png")
        (root / "poses" / f"{number}.txt").write_text(LOST if number == 2 else "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1")
    return root


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "build.yaml"
    path.write_text(STEPS)
    return path


def test_refused_captures_are_found_with_their_reasons(capture: Path) -> None:
    refused = refused_captures(open_source(capture))
    assert list(refused) == ["2", "4"]
    assert refused["2"].startswith("PoseError: ")
    assert "poses/2.txt" in refused["2"]
    assert refused["4"].startswith("NoReadingError: ")
    source = open_source(capture).without(refused)
    assert source.ids == ["0", "1", "3", "5"]
    assert source.skipped == refused
    for sample_id in source.ids:
        source.load(sample_id)


def test_a_list_of_captures_is_left_out_and_remembered(capture: Path) -> None:
    source = open_source(capture).without(["4"]).without(["2"])
    assert source.skipped == {"4": "listed", "2": "listed"}
    assert source.subset(["5", "0"]).skipped == source.skipped
    assert open_source(capture).skipped == {}
    with pytest.raises(CaptureError, match="cannot leave out 7, which it does not have"):
        source.without(["7"])
    with pytest.raises(CaptureError, match="nothing is left"):
        source.without(source.ids)
    with pytest.raises(DTypeError):
        source.without("0")


def test_the_limit_counts_what_is_left(capture: Path) -> None:
    assert open_source(capture, limit=2, skip=["0"]).ids == ["1", "2"]
    assert open_source(capture, limit=3, skip=["0"], skip_refused=True).ids == ["1", "3"]


def test_a_build_quarantines_refused_captures_and_records_why(capture: Path, config: Path, tmp_path: Path) -> None:
    source = open_source(capture).without(["0"])
    report = build_dataset(load_config(config), source, tmp_path / "out")
    assert report.skipped == {"0": "listed"}
    assert [reason.partition(":")[0] for reason in report.quarantined.values()] == ["PoseError", "NoReadingError"]
    assert [sample.id for sample in report.samples] == ["1", "3", "5"]
    manifest = Manifest.read(tmp_path / "out")
    assert (manifest.skipped, manifest.quarantined) == (report.skipped, report.quarantined)
    assert CachedCloudDataset(tmp_path / "out").ids == ["1", "3", "5"]


def test_what_a_step_refuses_is_quarantined_too(capture: Path, tmp_path: Path) -> None:
    (tmp_path / "many.yaml").write_text("depth:\n- Deproject: {}\ncloud:\n- RemovePlane: {distance: 0.01}\n")
    depth = np.full(SIZE, 800, np.uint16)
    depth[:, 16:] = np.linspace(500, 700, 16).astype(np.uint16)
    for number in (0, 1):
        Image.fromarray(depth).save(capture / "depth" / f"{number}.png")
    Image.fromarray(np.where(np.indices(SIZE).sum(0) == 3, 800, 0).astype(np.uint16)).save(capture / "depth" / "3.png")
    report = build_dataset(load_config(tmp_path / "many.yaml"), open_source(capture), tmp_path / "out")
    assert report.quarantined["3"].startswith("NoPlaneError in RemovePlane: ")


def test_a_summary_of_thousands_stays_short() -> None:
    told = skipped_text({str(number): "PoseError: lost" for number in range(5000)})
    assert told.splitlines()[0] == "5,000 captures left out: 5000 PoseError"
    assert told.splitlines()[-1] == "  and 4980 more; dataset.json lists them all"
    assert len(told.splitlines()) == 22


def test_a_full_disk_is_no_refused_capture(capture: Path, config: Path, tmp_path: Path, monkeypatch) -> None:
    config.write_text(STEPS + "output: {keep_raw: true}\n")

    def fail(*arguments: object) -> None:
        raise WriteError("cannot be written")

    monkeypatch.setattr("pcdata.build.capture_work.write_capture", fail)
    with pytest.raises(CacheError, match="cannot be written"):
        build_dataset(load_config(config), open_source(capture), tmp_path / "out")
    assert not (tmp_path / "out").exists()


# -- the command line and the configuration ----------------------------------------------------------------------------


def test_the_command_line_leaves_out_and_tells(capture: Path, config: Path, tmp_path: Path, capsys) -> None:
    build = ["build", str(config), "--source", str(capture), "--out"]
    assert main([*build, str(tmp_path / "strict"), "--max-bad", "1"]) == 1
    assert "--max-bad" in capsys.readouterr().err
    assert main([*build, str(tmp_path / "a")]) == 3
    out = capsys.readouterr().out
    assert "2 captures failed twice, now quarantined: 1 PoseError, 1 NoReadingError" in out
    assert "  2: PoseError: " in out
    assert main(["inspect", str(tmp_path / "a")]) == 0
    assert "4: NoReadingError" in capsys.readouterr().out
    (tmp_path / "bad.txt").write_text("# lost\n2\n\n4\n")
    assert main([*build, str(tmp_path / "b"), "--skip", "0", "--skip-file", str(tmp_path / "bad.txt")]) == 0
    assert "3 captures left out: 3 listed" in capsys.readouterr().out
    assert CachedCloudDataset(tmp_path / "b").ids == ["1", "3", "5"]
    assert main([*build, str(tmp_path / "c"), "--skip", "77"]) == 1


def test_other_commands_leave_out_and_tell(capture: Path, tmp_path: Path, capsys) -> None:
    (capture / "poses" / "0.txt").write_text(LOST)
    assert main(["inspect", str(capture)]) == 1
    capsys.readouterr()
    assert main(["inspect", str(capture), "--skip-refused"]) == 0
    told = capsys.readouterr()
    assert "3: 1, 3, 5" in told.out
    assert "left out 0: PoseError" in told.err
    main(["validate", str(capture), "--skip", "0", "--skip", "2", "--skip", "4"])
    told = capsys.readouterr()
    assert "of 3 captures" in told.out
    assert "left out 4: listed" in told.err
    assert main(["calib", "check", str(capture), "--skip-refused"]) in (0, 1)
    assert "left out 4: NoReadingError" in capsys.readouterr().err


def test_the_configuration_says_it_all(capture: Path, config: Path, tmp_path: Path) -> None:
    config.write_text(STEPS + 'source: {path: capture, kind: folder, limit: 5, skip: ["0"]}\n')
    assert main(["build", str(config), "--out", str(tmp_path / "a"), "--max-bad", "2"]) == 0
    assert CachedCloudDataset(tmp_path / "a").ids == ["1", "3", "5"]
    (capture / "bad.txt").write_text("2\n4\n")
    config.write_text(STEPS + "source: {path: capture, skip_file: capture/bad.txt}\n")
    source = load_config(config).source.open()
    assert source.ids == ["0", "1", "3", "5"]


def test_an_average_with_a_bad_capture_is_quarantined_until_that_is_left_out(capture: Path, config: Path) -> None:
    config.write_text(STEPS + "source: {path: capture, averaged: {num_frames: 3}}\n")
    source = load_config(config).source.open()
    assert isinstance(source, AveragedSource)
    with pytest.raises(PoseError, match=r"all 2 captures failed.*poses/2\.txt"):
        build_dataset(load_config(config), source, config.parent / "out")
    source = load_config(config).source.open(skip=["2", "4", "5"])
    assert source.group("0") == ["0", "1", "3"]
    report = build_dataset(load_config(config), source, config.parent / "out")
    assert (report.quarantined, report.skipped) == ({}, dict.fromkeys("245", "listed"))


def test_options_of_the_layout_come_from_the_configuration_and_may_not_be_contradicted(
    capture: Path, config: Path
) -> None:
    intrinsics = json.loads((capture / "intrinsics.json").read_text())
    del intrinsics["metres_per_unit"]
    (capture / "intrinsics.json").write_text(json.dumps(intrinsics))
    section = "source: {path: capture, metres_per_unit: 0.001, invalid_values: [65535], frame_id: base}\n"
    config.write_text(STEPS + section)
    settings = load_config(config).source
    source = settings.open()
    assert source.metres_per_unit == 0.001
    assert source.invalid_values == (65535,)
    assert source.frame_id == "base"
    assert settings.open(metres_per_unit=0.001).ids == source.ids
    with pytest.raises(ConfigError, match=r"metres_per_unit 0\.001, the argument 0\.01; drop one"):
        settings.open(metres_per_unit=0.01)


@pytest.mark.parametrize(
    ("section", "words"),
    [
        ("{invalid_value: [65535]}", "2:10.*did you mean 'invalid_values'"),
        ("{kind: foldr}", "did you mean 'folder'"),
        ("{skip: [5]}", "texts in quotes"),
        ("{limit: 0}", "whole number of at least 1"),
        ("{skip_refused: true}", "no such setting"),
        ("{averaged: 3, temporal: 3}", "choose one"),
        ("{average: 3}", "did you mean 'averaged'"),
        ("{averaged: {num_frame: 3}}", "2:20.*did you mean 'num_frames'"),
        ("{kind: graspnet, frame_id: base}", "no such setting"),
        ("{only: 5}", "a pattern of ids"),
        ("{sieve: {step: 2}}", "--import FILE"),
        ("{kind: own_frames}", "--import FILE"),
        ("[a]", "must be a mapping"),
    ],
)
def test_faults_of_the_section_are_told_with_their_place(section: str, words: str, config: Path) -> None:
    config.write_text(f"cloud: []\nsource: {section}\n")
    with pytest.raises(ConfigError, match=words):
        load_config(config)


def test_a_build_without_a_place_of_captures_says_how_to_give_it(config: Path, tmp_path: Path, capsys) -> None:
    assert main(["build", str(config), "--out", str(tmp_path / "a")]) == 2
    assert "--source PATH" in capsys.readouterr().err


def test_an_empty_list_of_captures_to_leave_out_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "bad.txt").write_text("# none\n")
    with pytest.raises(CaptureError, match="lists no id"):
        read_skip_file(tmp_path / "bad.txt")


def test_an_export_of_captures_leaves_out_and_a_built_dataset_refuses_the_flags(
    capture: Path, config: Path, tmp_path: Path, capsys
) -> None:
    export = ["export", str(capture), "--to", "ggcnn", "--out", str(tmp_path / "out"), "--skip-refused"]
    main(export)
    assert "left out 2: PoseError" in capsys.readouterr().err
    assert main(["build", str(config), "--source", str(capture), "--out", str(tmp_path / "a")]) == 3
    built = ["export", str(tmp_path / "a"), "--to", "dp3", "--out", str(tmp_path / "out2"), "--skip", "1"]
    assert main([*built, "--invalid-values", "65535", "--set", "episodes=x"]) == 2
    assert "--invalid-values, --skip cannot change" in capsys.readouterr().err
