"""A build is its YAML: what the section source says can be said elsewhere, is kept, and builds the dataset again."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from pcdata import CachedCloudDataset, load_config, open_source, write_calibration
from pcdata.build import build_dataset
from pcdata.cli.main import main
from pcdata.errors import CaptureError, ConfigError, PcdataError
from pcdata.io.store.manifest import FILE_NAME, Manifest
from pcdata.structures import Calibration, Camera
from tests.captures import HEIGHT, WIDTH, folder_capture, seven_scenes_capture

STEPS = "depth: [Deproject]\ncloud: [VoxelDownsample: {voxel_size: 0.01}]\n"


@pytest.fixture
def captures(tmp_path: Path) -> Path:
    return seven_scenes_capture(tmp_path / "captures", still=True)


def config(tmp_path: Path, section: str) -> Path:
    path = tmp_path / "build.yaml"
    path.write_text(f"{STEPS}source: {section}\n")
    return path


def built(path: Path, out: Path, *words: str) -> Manifest:
    assert main(["build", str(path), "--out", str(out), *words]) == 0
    return Manifest.read(out)


def same_clouds(one: Path, other: Path) -> bool:
    return [sample.digest for sample in Manifest.read(one).samples] == [
        sample.digest for sample in Manifest.read(other).samples
    ]


SECTION = (
    "{path: captures, kind: seven_scenes, only: 'frame-*', limit: 3, invalid_values: [65535, 9], frame_id: base, "
    "temporal: {num_frames: 2, alpha: 0.5}}"
)
WORDS = [
    *("--source", "captures", "--kind", "seven_scenes", "--only", "frame-*", "--limit", "3"),
    *("--invalid-values", "65535,9", "--frame", "base", "--temporal", "2", "--option", "temporal.alpha=0.5"),
]


def test_the_section_the_command_line_and_python_say_the_same(captures, tmp_path, monkeypatch):
    said = built(config(tmp_path, SECTION), tmp_path / "a")
    monkeypatch.chdir(tmp_path)
    assert built(config(tmp_path, "{}"), tmp_path / "b", *WORDS).source == said.source
    source = open_source(
        captures, kind="seven_scenes", only="frame-*", limit=3, invalid_values=(65535, 9), frame_id="base",
        temporal={"num_frames": 2, "alpha": 0.5},
    )  # fmt: skip
    build_dataset(load_config(config(tmp_path, "{}")), source, tmp_path / "c")
    assert Manifest.read(tmp_path / "c").source == said.source
    assert same_clouds(tmp_path / "a", tmp_path / "b")
    assert same_clouds(tmp_path / "a", tmp_path / "c")
    assert said.source == {
        "path": "captures", "kind": "seven_scenes", "only": ["frame-*"], "limit": 3, "invalid_values": [65535, 9],
        "frame_id": "base", "temporal": {"num_frames": 2, "alpha": 0.5},
    }  # fmt: skip


def test_a_dataset_is_built_again_from_what_it_remembers(captures, tmp_path):
    text = (
        STEPS + "augment: [RandomFlip: {about: centroid}]\noutput: {format: npz, compression: gzip, keep_raw: true}\n"
    )
    (tmp_path / "build.yaml").write_text(text + "source: {path: captures, skip: [frame-000020]}\n")
    first = built(tmp_path / "build.yaml", tmp_path / "a")
    (tmp_path / "elsewhere").mkdir()
    captures.rename(tmp_path / "elsewhere" / "captures")
    assert main(["build", str(tmp_path / "a"), "--out", str(tmp_path / "b")]) == 2  # it does not say where they are
    again = built(tmp_path / "a", tmp_path / "b", "--source", str(tmp_path / "elsewhere" / "captures"))
    for name in ("source", "format", "compression", "fingerprint", "pipeline", "samples", "skipped"):
        assert getattr(again, name) == getattr(first, name), name
    assert (tmp_path / "b" / "shards" / "00000" / "raw").is_dir()
    assert same_clouds(tmp_path / "a", tmp_path / "b")


def test_a_dataset_for_a_model_is_built_again_for_it(captures, tmp_path, capsys):
    words = ["--source", str(captures), "--out"]
    choices = ["--model", "dp3_sim", "--set", "frame=camera", "--set", "crop=none", "--set", "num_points=32"]
    assert main(["build", *words, str(tmp_path / "a"), *choices]) == 0
    first, again = Manifest.read(tmp_path / "a"), built(tmp_path / "a", tmp_path / "b", *words[:2])
    assert (again.model, again.fingerprint) == (first.model, first.fingerprint)


def test_no_place_of_the_machine_is_kept(captures, tmp_path):
    camera = Camera.pinhole(fx=10.0, fy=11.0, cx=3.5, cy=2.5, size=(HEIGHT, WIDTH))
    folder_capture(tmp_path / "secret" / "one")
    write_calibration(tmp_path / "secret" / "cell.yaml", Calibration(cameras={"wrist": camera}))
    section = "{path: 'secret/o*', calibration: secret/cell.yaml, links_to: [" + str(tmp_path) + "/secret/store]}"
    manifest = built(config(tmp_path, section), tmp_path / "a")
    assert manifest.source["path"] == "secret/o*"
    assert (manifest.source["calibration"], manifest.source["links_to"]) == ("cell.yaml", ["store"])
    assert str(tmp_path) not in (tmp_path / "a" / FILE_NAME).read_text()
    again = ["--source", str(tmp_path / "secret" / "o*"), "--calibration", str(tmp_path / "secret" / "cell.yaml")]
    assert same_clouds(tmp_path / "a", built_folder(tmp_path, *again, "--links-to", str(tmp_path / "secret")))


def built_folder(tmp_path: Path, *words: str) -> Path:
    built(tmp_path / "a", tmp_path / "b", *words)
    return tmp_path / "b"


def test_a_source_that_was_not_opened_is_remembered_as_unknown(captures, tmp_path):
    source = open_source(captures)
    build_dataset(load_config(config(tmp_path, "{}")), source.subset(source.ids[:1]), tmp_path / "a")
    assert Manifest.read(tmp_path / "a").source == {}


def test_section_and_command_line_join_the_fields_of_a_combinator_and_may_not_contradict(captures, tmp_path):
    settings = load_config(config(tmp_path, "{path: captures, temporal: 2}")).source
    source = settings.open(temporal={"alpha": 0.5})
    assert (source.num_frames, source.alpha) == (2, 0.5)
    assert settings.open(temporal=2).opened == settings.open().opened
    with pytest.raises(ConfigError, match=r"temporal\.num_frames 2, the argument 3; drop one"):
        settings.open(temporal=3)
    with pytest.raises(ConfigError, match="choose one"):
        settings.open(averaged=3)
    with pytest.raises(ConfigError, match="only"):
        load_config(config(tmp_path, "{path: captures, only: 'frame-*'}")).source.open(only=["b"])


def test_what_is_made_of_a_bad_capture_is_quarantined_until_that_is_left_out(captures, tmp_path):
    (captures / "frame-000020.pose.txt").write_text("nan " * 16)
    file = config(tmp_path, "{path: captures, temporal: 2}")
    manifest = built(file, tmp_path / "a", "--max-bad", "2")
    assert list(manifest.quarantined) == ["frame-000020", "frame-000040"]  # the second is filtered with it
    assert all("frame-000020" in reason for reason in manifest.quarantined.values())
    assert built(file, tmp_path / "b", "--skip", "frame-000020").quarantined == {}
    assert CachedCloudDataset(tmp_path / "b").ids == ["frame-000000", "frame-000040"]


def test_every_command_on_captures_takes_combinators_and_patterns(captures, tmp_path, capsys):
    assert main(["inspect", str(tmp_path / "capt*"), "--averaged", "3", "--option", "averaged.max_moving=1"]) == 0
    told = capsys.readouterr().out
    assert "averaged of joined of seven_scenes" in told
    assert "1: captures/frame-000000" in told
    assert main(["validate", str(captures), "--temporal", "2", "--only", "frame-0000[02]0"]) in (0, 1)
    assert "of 2 captures" in capsys.readouterr().out
    assert main(["inspect", str(captures), "--option", "temporal.alpa=3"]) == 2
    assert "did you mean 'alpha'" in capsys.readouterr().err


# -- what a capture says of itself -------------------------------------------------------------------------------------


def stated(capture: Path, **more: object) -> Path:
    known = json.loads((capture / "intrinsics.json").read_text())
    (capture / "intrinsics.json").write_text(json.dumps(known | more))
    return capture


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    root = folder_capture(tmp_path / "capture")
    camera = Camera.pinhole(fx=12.0, fy=12.0, cx=3.0, cy=2.0, size=(HEIGHT, WIDTH))
    write_calibration(root / "cell.yaml", Calibration(cameras={"left": camera, "right": camera}))
    return root


def test_a_capture_states_its_calibration_camera_and_folders(capture, tmp_path):
    given = open_source(capture, calibration=capture / "cell.yaml", camera="left", folders={"color": None})
    says = open_source(stated(capture, calibration="cell.yaml", camera="left", folders={"color": None}))
    one, other = given.load("a_1"), says.load("a_1")
    assert torch.equal(one.camera.intrinsics, other.camera.intrinsics)
    assert float(other.camera.intrinsics[0, 0, 0]) == 12.0
    assert one.colors is other.colors is None
    assert one.provenance == other.provenance
    assert says.unread() == ["color/"]
    assert open_source(capture, calibration=capture / "cell.yaml", camera="left").ids == says.ids  # they agree


@pytest.mark.parametrize(
    ("says", "given"),
    [
        ({"calibration": "cell.yaml", "camera": "left"}, {"camera": "right"}),
        ({"calibration": "cell.yaml", "camera": "left"}, {"calibration": "other.yaml"}),
        ({"folders": {"color": None}}, {"folders": {"color": "color"}}),
        ({"calibration": "../cell.yaml"}, {}),
        ({"calibration": "/cell.yaml"}, {}),
        ({"calibration": 3}, {}),
        ({"camera": " "}, {}),
        ({"folders": {"color": "../color"}}, {}),
        ({"folders": ["color"]}, {}),
        ({"folders": {"colr": "color"}}, {}),
        ({"links_to": ["/"]}, {}),
    ],
)
def test_what_a_capture_may_not_say_or_contradicts_names_the_file(says, given, capture):
    with pytest.raises(PcdataError) as caught:
        open_source(stated(capture, **says), **given)
    assert isinstance(caught.value, CaptureError)
    assert "intrinsics.json" in str(caught.value)


def test_a_stated_calibration_may_not_lead_out_of_the_capture_by_a_link(capture, tmp_path):
    (capture / "cell.yaml").rename(tmp_path / "cell.yaml")
    (capture / "cell.yaml").symlink_to(tmp_path / "cell.yaml")
    with pytest.raises(CaptureError, match=r"cell\.yaml"):
        open_source(stated(capture, calibration="cell.yaml", camera="left"))
    assert open_source(capture, links_to=tmp_path).ids
