"""The command line and models: a preset as a build, choices, and names in help texts."""

from __future__ import annotations

import inspect
import json
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest
import torch

import pcdata
from pcdata.build import build_dataset, config_from_yaml
from pcdata.calibration.refine import METHODS
from pcdata.cli import known_names
from pcdata.cli.main import main
from pcdata.datasets.split_dataset import PUBLISHED
from pcdata.datasets.split_groups import RULES
from pcdata.errors import CacheError, ConfigError
from pcdata.exports import export_dataset
from pcdata.exports.targets import TARGETS
from pcdata.io import WRITERS, CaptureCamera, write_capture_camera, write_color, write_depth, write_pose
from pcdata.io.sources.open_source import open_source
from pcdata.io.sources.registry import LAYOUTS
from pcdata.io.store.manifest import FILE_NAME, Manifest, checksum_of
from pcdata.io.store.stores import STORES
from pcdata.models import CONTRACTS, check, check_files, contract, preset
from pcdata.models.catalog import CHOICES, example
from pcdata.models.model_check import require
from pcdata.sensors import sensor_profiles
from pcdata.synthetic import tabletop
from pcdata.validation import CHECKS
from tests.warm import run_script

BOX = "crop=((-0.4,-0.4,-0.02),(0.4,0.4,0.5))"


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("captures")
    for role in ("depth", "color", "poses"):
        (root / role).mkdir()
    for number in range(2):
        frame = tabletop(seed=number, size=(120, 160)).frame
        write_depth(root / f"depth/{number}.png", frame.depth[0], metres_per_unit=0.001, round_to_unit=True)
        write_color(root / f"color/{number}.png", frame.colors[0])
        write_pose(root / f"poses/{number}.txt", frame.world_from_camera[0])
    camera = CaptureCamera(camera=frame.camera, metres_per_unit=0.001, frame_id="base")
    write_capture_camera(root / "intrinsics.json", camera)
    return root


def build(captures: Path, out: Path, *words: str) -> int:
    return main(["build", "--source", str(captures), "--out", str(out), *words])


# -- a preset as a build -----------------------------------------------------------------------------------------------


def test_a_model_is_built_without_a_configuration_and_passes_its_check(capsys, captures, tmp_path):
    out = tmp_path / "dataset"
    assert build(captures, out, "--model", "dp3_real", "--set", "frame=base", "--set", BOX, "--format", "npz") == 0
    assert main(["check", str(out), "--model", "dp3_real"]) == 0
    assert "PASS: of 2 captures" in capsys.readouterr().out
    manifest = Manifest.read(out)
    assert manifest.format == "npz"
    assert manifest.model["name"] == "dp3_real"
    assert manifest.model["choices"]["crop"] == [[-0.4, -0.4, -0.02], [0.4, 0.4, 0.5]]
    # In Python too, and a choice that is given goes before: 512 points are not what was built.
    dataset = pcdata.CachedCloudDataset(out)
    assert check(dataset, "dp3_real").verdict.value == "pass"
    assert main(["check", str(out), "--model", "dp3_real", "--num-points", "512"]) == 1
    # Another model takes nothing from what was chosen for this one.
    capsys.readouterr()
    assert main(["check", str(out), "--model", "dp3_sim"]) == 0
    assert "UNKNOWN frame (0, 1): the model leaves the frame open" in capsys.readouterr().out


def test_what_is_built_equals_what_the_preset_gives(captures, tmp_path):
    assert build(captures, tmp_path / "d", "--model", "dp3_sim", "--set", "frame=base", "--set", "crop=none") == 0
    stored = pcdata.CachedCloudDataset(tmp_path / "d")
    fresh = preset("dp3_sim", frame="base", crop=None).dataset(open_source(captures))
    for one, other in zip(stored, fresh):
        assert torch.equal(one.points, other.points)


def test_the_script_of_a_dataset_for_a_model_gives_the_tensors_of_the_model(captures, tmp_path):
    assert (
        build(captures, tmp_path / "d", "--model", "pointnet_part", "--set", "category=3", "--set", "frame=base") == 0
    )
    done = run_script(tmp_path / "d" / "load.py", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("ModelBatch(pointnet_part:") == 2


@pytest.mark.parametrize("model", sorted(name for name, one in CONTRACTS.items() if one.required_choices))
def test_open_choices_are_listed_and_what_the_message_says_to_type_is_accepted(capsys, captures, tmp_path, model):
    assert build(captures, tmp_path / "d", "--model", model) == 2
    text = capsys.readouterr().err
    words = ["--model", model]
    for choice in contract(model).required_choices:
        (line,) = (line for line in text.splitlines() if line.startswith(f"  --set {choice}=") or f"'{choice}=" in line)
        assert CHOICES[choice] in line
        words += subprocess.run(
            ["bash", "-c", f'printf "%s\\n" {line.strip().split("  ")[0]}'], capture_output=True, text=True, check=True
        ).stdout.splitlines()
    # These small images have too few points for one model, and pixels are not kept for another: neither is the request.
    assert build(captures, tmp_path / "d", *words) == {"3d_diffuser_actor": 2, "dp3_guide": 1}.get(model, 0)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "give a CONFIG, or --model NAME"),
        (["--set", "frame=base"], "give a CONFIG, or --model NAME"),
        (["--model", "dp3_rael"], "did you mean 'dp3_real'"),
        (["--model", "dp3_real", "--set", "fram=base"], "no choice 'fram'; did you mean 'frame'?; it has frame, crop"),
        (["--model", "dp3_real", "--set", "frame=base", "--set", "frame=base"], "--set frame: is given twice"),
        (["--model", "dp3_real", "--set", "frame=base", "--set", "crop=1"], "crop must be the workspace"),
        (["--model", "ggcnn"], "takes depth images, and a build stores clouds without their pixels"),
        (["--model", "3d_diffuser_actor", "--set", "frame=base"], "takes clouds with a point for every pixel"),
        (["--model", "dp3_real", "--set", "channels=xyz,rgbb"], "channels are ['xyz', 'rgb_255'], got ['rgbb', 'xyz']"),
    ],
)
def test_a_wrong_request_is_exit_2_with_what_exists(capsys, captures, tmp_path, words, message):
    assert build(captures, tmp_path / "d", *words) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "d").exists()


def test_a_configuration_may_name_a_model_instead_of_steps(captures, tmp_path):
    config = config_from_yaml(
        "model: {name: dp3_real, frame: base, crop: null, channels: [xyz]}\noutput: {format: npz}\n"
    )
    build_dataset(config, open_source(captures), tmp_path / "d")
    assert check(pcdata.CachedCloudDataset(tmp_path / "d"), "dp3_real").verdict.value == "pass"
    assert (pcdata.CachedCloudDataset(tmp_path / "d").manifest.model["choices"]) == {
        "frame": "base",
        "crop": None,
        "channels": ["xyz"],
    }


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("model: {frame: base}", "1:1: model: needs the model's name"),
        ("model: {name: dp3_real}", r"leaves open .* frame='base'"),
        ("model: {name: dp3_reel}", "did you mean 'dp3_real'"),
        ("model: {name: dp3_real, frame: base, crop: null}\ncloud: [MergeViews]", "2:1: section cloud"),
        ("model: {name: dp3_real, frame: base, crop: null}\nloader: {collate: fixed}", "2:10: loader.collate"),
        ("model: {name: grconvnet}", "takes depth images"),
        ("model: dp3_real", "model"),
    ],
)
def test_faults_of_the_section_model_are_told_with_their_places(text, message):
    with pytest.raises(ConfigError, match=message):
        config_from_yaml(text)


def test_a_model_is_named_once(capsys, captures, tmp_path):
    words = ["--model", "dp3_real", "--set", "frame=base", "--set", "crop=none"]
    for text, message in {
        "model: {name: dp3_sim, frame: base, crop: null}": "names the model dp3_sim already",
        "depth: [Deproject]": "has steps of its own",
        "loader: {collate: fixed}": "makes its own batches",
        "output: {format: hdf5, compression: lzf}": "format npz knows the compression none, gzip, not lzf",
    }.items():
        (tmp_path / "c.yaml").write_text(text)
        more = ["--format", "npz"] if "output" in text else []
        assert build(captures, tmp_path / "d", str(tmp_path / "c.yaml"), *words, *more) == 2
        assert message in capsys.readouterr().err


def test_a_damaged_model_in_a_manifest_is_told(captures, tmp_path):
    assert build(captures, tmp_path / "d", "--model", "dp3_sim", "--set", "frame=base", "--set", "crop=none") == 0
    path = tmp_path / "d" / FILE_NAME
    content = json.loads(path.read_text())
    del content["checksum"]
    for wrong in ([], {"name": 3, "choices": {}}, {"name": "dp3_sim"}, {"name": "dp3_sim", "choices": [], "x": 1}):
        changed = {**content, "model": wrong}
        path.write_text(json.dumps({**changed, "checksum": checksum_of(changed)}))
        with pytest.raises(CacheError, match="model must"):
            Manifest.read(tmp_path / "d")


# -- choices and options that are called as parameters are -------------------------------------------------------------


def test_no_choice_and_no_option_is_called_as_a_parameter_beside_it():
    for function in (check, check_files, require, preset, contract):
        taken = {
            name for name, one in inspect.signature(function).parameters.items() if one.kind is not one.POSITIONAL_ONLY
        }
        assert not taken & set(CHOICES), function
    options = {field.name for target in TARGETS.values() for field in fields(target)}
    assert not set(inspect.signature(export_dataset).parameters) & options
    layouts = {name for one in LAYOUTS.values() for name in inspect.signature(one).parameters} - {"path"}
    assert not set(inspect.signature(open_source).parameters) & layouts


def test_channels_are_a_choice_of_check_as_of_preset(captures, tmp_path, capsys):
    made = preset("dp3_sim", frame="base", crop=None, channels=["xyz"])
    cloud = made.dataset(open_source(captures))[0]
    assert check(cloud, "dp3_sim", frame="base", crop=None, channels=["xyz"]).verdict.value == "pass"
    words = ["--model", "dp3_sim", "--set", "frame=base", "--set", "crop=none", "--set", "channels=xyz"]
    assert build(captures, tmp_path / "d", *words) == 0
    assert pcdata.CachedCloudDataset(tmp_path / "d").manifest.model["choices"]["channels"] == ["xyz"]
    assert main(["check", str(tmp_path / "d"), *words]) == 0
    for wrong in ("", "xyz,red"):
        assert main(["check", str(tmp_path / "d"), *words[:-1], f"channels={wrong}"]) == 2
        assert "channels are ['xyz', 'rgb_255']" in capsys.readouterr().err


@pytest.mark.parametrize(
    "name", ["model", "data", "path", "keys", "name", "frame_id", "unit", "cheap", "limit", "channel_names", "but"]
)
def test_a_parameter_of_python_is_no_choice(capsys, captures, tmp_path, name):
    words = ["--model", "dp3_sim", "--set", f"{name}=1"]
    assert main(["check", str(captures), *words]) == 2
    assert f"no choice '{name}'" in (told := capsys.readouterr().err)
    assert "it has frame, crop, num_points, channels" in told
    assert build(captures, tmp_path / "d", *words) == 2
    for target in TARGETS:
        assert main(["export", str(captures), "--to", target, "--out", str(tmp_path / "e"), "--set", f"{name}=1"]) == 2
        assert f"has no option '{name}'" in capsys.readouterr().err


@pytest.mark.parametrize("name", sorted(set(inspect.signature(open_source).parameters) - {"options"}))
def test_a_parameter_of_opening_is_no_option(capsys, captures, name):
    assert main(["inspect", str(captures), "--option", f"{name}=1"]) == 2
    assert f"--option {name}: is no option of a layout" in capsys.readouterr().err


# -- names in help texts -----------------------------------------------------------------------------------------------


def test_help_knows_the_names_of_every_registry():
    assert tuple(LAYOUTS) == known_names.KINDS
    assert tuple(CHECKS) == known_names.CHECKS
    assert tuple(STORES) == known_names.FORMATS
    assert tuple(CONTRACTS) == known_names.MODELS
    assert tuple(CHOICES) == known_names.CHOICES
    assert {name: tuple(f.name for f in fields(one)) for name, one in TARGETS.items()} == known_names.TARGETS
    assert {name: tuple(f.name for f in fields(one)) for name, one in WRITERS.items()} == known_names.WRITERS
    assert tuple(sensor_profiles()) == known_names.SENSORS
    assert METHODS == known_names.REFINERS
    assert (RULES, (*PUBLISHED,)) == (known_names.SPLIT_RULES, known_names.PUBLISHED_SPLITS)
    for one in CONTRACTS.values():
        assert contract(one.name, **{choice: example(one, choice) for choice in one.required_choices})


@pytest.mark.parametrize(
    ("words", "names"),
    [
        (["build"], [*known_names.MODELS, *known_names.KINDS, *known_names.FORMATS, *known_names.CHOICES]),
        (["check"], [*known_names.MODELS, *known_names.CHOICES]),
        (["export"], [*known_names.TARGETS, *known_names.KINDS, "frames_per_scene", "label_offset"]),
        (["split"], [*known_names.SPLIT_RULES, *known_names.PUBLISHED_SPLITS]),
        (["convert"], [*known_names.WRITERS, *known_names.KINDS, "quality"]),
        (["validate"], [*known_names.CHECKS, *known_names.SENSORS, *known_names.KINDS]),
        (["calib", "check"], known_names.SENSORS),
        (["calib", "refine"], known_names.REFINERS),
    ],
)
def test_help_lists_what_may_be_given(capsys, monkeypatch, words, names):
    monkeypatch.setenv("COLUMNS", "1000")
    with pytest.raises(SystemExit):
        main([*words, "--help"])
    told = capsys.readouterr().out
    assert not [name for name in names if name not in told]


@pytest.mark.parametrize("words", [["--help"], ["build", "--help"], ["export", "--help"], ["check", "--help"]])
def test_help_waits_for_no_torch(words):
    code = f"import sys; from pcdata.cli import main\ntry: main({words!r})\nexcept SystemExit: pass"
    code += "\nprint('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "False"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["inspect", "X", "--kind", "foldr"], "did you mean 'folder'?; known: folder, rig"),
        (["export", "X", "--to", "dp33", "--out", "Y"], "did you mean 'dp3' or 'idp3'?"),
        (["check", "X", "--model", "nothing"], "known: 3d_diffuser_actor, anygrasp"),
        (["validate", "X", "--sensor", "realsense_d453"], "did you mean 'realsense_d457' or 'realsense_d455'"),
        (["export", "X", "--to", "dp3", "--out", "Y", "--set", "colrs=1"], "did you mean 'colors'?; it has state"),
        (["export", "X", "--to", "dp3", "--out", "Y", "--set", "num_points=many"], "num_points: "),
        (["check", "X", "--model", "dp3_sim", "--set", "num_points=many"], "num_points must be 512, 1024, or any"),
    ],
)
def test_a_wrong_name_is_told_with_those_that_exist(capsys, captures, words, message):
    assert main([str(captures) if word == "X" else word for word in words]) == 2
    assert message in capsys.readouterr().err
