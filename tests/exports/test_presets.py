"""preset -> build -> export, for every preset that has a target: what a build stores of it, and its random end."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pcdata.build import BuildConfig, build_dataset, config_from_yaml
from pcdata.build.model_section import stored_preset
from pcdata.cli.main import main
from pcdata.datasets import CachedCloudDataset, CloudDataset
from pcdata.errors import CacheError, ConfigError
from pcdata.exports import TARGETS, check_export, export_dataset, targets_of
from pcdata.exports.export_record import FILE_NAME
from pcdata.models import CONTRACTS, Preset, preset
from pcdata.synthetic import TeleopSource
from pcdata.transforms import RandomSample
from pcdata.verdicts import Verdict
from tests.exports.samples import Samples, cloud, tree
from tests.exports.scenes import Episodes
from tests.exports.test_dp3 import replay_buffer
from tests.models.captures import made_preset

EXPORTED = [(target, model) for target, kind in TARGETS.items() for model in kind.models()]


def scenes(number: int = 3, count: int = 3000) -> Samples:
    """Clouds in front of a camera, 0.3 to 0.9 m away."""
    made = {f"s{n}": cloud(count, seed=n, frame_id="camera", viewpoint=torch.zeros(1, 3)) for n in range(number)}
    away = torch.tensor([0.0, 0.0, 0.6])
    return Samples({name: replace(one, points=0.3 * one.points + away) for name, one in made.items()})


def built_for(made: Preset, source: Episodes, folder: Path) -> Any:
    """What a preset makes of captures: built with them beside it, or on the fly, where a build cannot store it."""
    try:
        stored_preset(made)
    except ConfigError:
        return made.dataset(source)
    config = config_from_yaml("output: {format: npz, keep_raw: true}").for_model(made)
    return build_dataset(config, source, folder).folder


@pytest.mark.parametrize(("target", "model"), EXPORTED)
def test_what_a_preset_makes_of_captures_is_exported_and_its_own_check_takes_it(tmp_path, target, model):
    """No target, no model and no option is named here: a new one is reached by itself."""
    kind, made = TARGETS[target], made_preset(model)
    # In images 0 is the background; in clouds it is a number like others.
    source = Episodes(kind.image_size or (240, 320), first_label=int(kind.takes == "captures"))
    report = export_dataset(
        built_for(made, source, tmp_path / "built"), target, tmp_path / "out", **kind.example(source.ids)
    )
    assert (report.written, report.left_out) == (2, {})
    random = kind.takes == "clouds" and made.pipeline.is_random
    draws = json.loads((tmp_path / "out" / FILE_NAME).read_text())["draws"]
    assert bool(draws) == random
    assert any("seed 0, epoch 0" in note for note in report.notes) == random
    summary = check_export(tmp_path / "out", model)
    told = [entry.worst for entry in summary.checks.values()]
    assert [one for one in told if one.verdict in (Verdict.FAIL, Verdict.UNKNOWN)] == []


def test_every_model_is_exported_or_has_no_target():
    reached = {model for _, model in EXPORTED}
    for model in CONTRACTS:
        assert targets_of(model) == [target for target, one in EXPORTED if one == model]
        assert bool(targets_of(model)) == (model in reached)
    with pytest.raises(ConfigError, match="no model contract"):
        targets_of("nothing")


def test_a_target_of_images_takes_the_captures_behind_clouds_or_says_what_to_do(tmp_path):
    source, options = Episodes(), {"any_size": True}
    config = config_from_yaml("depth: [Deproject]\ncloud: [RandomSample: {num_points: 64}]\noutput: {keep_raw: true}")
    build_dataset(config, source, tmp_path / "kept")
    report = export_dataset(tmp_path / "kept", "graspnet", tmp_path / "of the build", **options)
    assert any("Deproject, RandomSample did not run" in note for note in report.notes)
    export_dataset(source, "graspnet", tmp_path / "of the captures", **options)
    fly = CloudDataset(source, config.pipeline)
    export_dataset(fly, "graspnet", tmp_path / "of the fly", **options)
    wanted = {name: data for name, data in tree(tmp_path / "of the captures").items() if name != FILE_NAME}
    for name in ("of the build", "of the fly"):
        assert {key: data for key, data in tree(tmp_path / name).items() if key != FILE_NAME} == wanted, name
    build_dataset(replace(config, output=type(config.output)()), source, tmp_path / "alone")
    for given, message, more in [
        (tmp_path / "alone", r"give the captures .*, or build it with output: \{keep_raw: true\}", {}),
        (CloudDataset(source, config.pipeline, repeats=2), "without repeats", {}),
        (tmp_path / "kept", "seed is of the random end .* leave it out", {"seed": 1}),
    ]:
        with pytest.raises(ConfigError, match=message):
            export_dataset(given, "graspnet", tmp_path / "out", **options, **more)


# -- the random end ------------------------------------------------------------------------------------------------

SAMPLED = "cloud: [ToFrame: {frame: camera}, RandomSample: {num_points: 500}]\n"


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sampled") / "dataset"
    build_dataset(config_from_yaml(SAMPLED), scenes(count=900), folder)
    return folder


def coordinates(folder: Any) -> dict[str, np.ndarray]:
    return {path.parent.name: np.load(path) for path in sorted(folder.glob("train/*/coord.npy"))}


def test_an_export_holds_what_the_dataset_gives_with_that_seed_and_epoch(built, tmp_path):
    export_dataset(built, "pointcept", tmp_path / "out", seed=5, epoch=2, copies=2)
    dataset = CachedCloudDataset(built, seed=5, repeats=2)
    dataset.set_epoch(2)
    wanted = dict(zip(["s0", "s1", "s2", "s0-copy1", "s1-copy1", "s2-copy1"], dataset, strict=True))
    stored = coordinates(tmp_path / "out")
    assert stored.keys() == wanted.keys()
    assert all(np.array_equal(stored[name], one.points.numpy()) for name, one in wanted.items())
    assert not np.array_equal(stored["s0"], stored["s0-copy1"])
    draws = json.loads((tmp_path / "out" / FILE_NAME).read_text())["draws"]
    assert (draws["seed"], draws["epoch"], draws["copies"]) == (5, 2, 2)
    assert [next(iter(step)) for step in draws["steps"]] == ["RandomSample"]
    export_dataset(dataset, "pointcept", tmp_path / "of the object")
    again = coordinates(tmp_path / "of the object")
    assert all(np.array_equal(again[name], one) for name, one in stored.items())


def test_a_dataset_that_is_made_on_the_fly_is_exported_too(tmp_path):
    source = scenes(count=900)
    dataset = CloudDataset(source, RandomSample(num_points=500), seed=3)
    export_dataset(dataset, "pointcept", tmp_path / "out")
    stored = coordinates(tmp_path / "out")
    assert all(np.array_equal(stored[name], one.points.numpy()) for name, one in zip(source.ids, dataset, strict=True))


def test_copies_have_the_class_and_the_robot_of_their_sample(built, tmp_path):
    table = {name: {"class": "mug" if name == "s1" else "bowl", "split": "train"} for name in ("s0", "s1", "s2")}
    export_dataset(built, "pointcept", tmp_path / "scenes", table=table, copies=2)
    assert len(coordinates(tmp_path / "scenes")) == 6
    robot = {
        name: {"samples": np.array(ids), "state": seed + np.arange(len(ids))[:, None], "action": np.ones((len(ids), 1))}
        for seed, (name, ids) in enumerate({"a": ["s0", "s1"], "b": ["s2"]}.items())
    }
    export_dataset(built, "dp3", tmp_path / "out", episodes=robot, copies=2, num_points=500)
    buffer = replay_buffer(tmp_path / "out")
    assert buffer["episode_ends"].tolist() == [2, 4, 5, 6]
    assert buffer["state"].ravel().tolist() == [0, 1, 0, 1, 1, 1]
    dataset = CachedCloudDataset(built, repeats=2)
    order = [0, 1, 3, 4, 2, 5]  # copy 1 of sample n is 3 + n
    for row, index in zip(buffer["point_cloud"], order, strict=True):
        assert np.array_equal(row[:, :3], dataset[index].points.numpy())


def test_what_says_nothing_about_the_draws_is_refused(built, tmp_path):
    for options, message in [
        ({"seed": 1.5}, "seed must be a whole number"),
        ({"epoch": -1}, "epoch must be a whole number, 0 or more"),
        ({"copies": 0}, "copies must be a whole number, 1 or more"),
    ]:
        with pytest.raises(ConfigError, match=message):
            export_dataset(built, "pointcept", tmp_path / "out", **options)
    with pytest.raises(ConfigError, match="draws nothing, so 2 copies would be alike"):
        export_dataset(CachedCloudDataset(built, augment=None), "pointcept", tmp_path / "out", copies=2)
    with pytest.raises(ConfigError, match="seed is of the random end of a dataset"):
        export_dataset(scenes(), "pointcept", tmp_path / "out", seed=1)
    assert not (tmp_path / "out").exists()


def test_a_continued_export_keeps_its_draws(built, tmp_path):
    export_dataset(built, "pointcept", tmp_path / "out", resume=True, seed=1)
    assert export_dataset(built, "pointcept", tmp_path / "out", resume=True, seed=np.int64(1)).kept == 3
    with pytest.raises(CacheError, match="its draws are"):
        export_dataset(built, "pointcept", tmp_path / "out", resume=True, seed=2)


def test_the_command_draws_as_it_is_told_or_not_at_all(capsys, built, tmp_path):
    command = ["export", str(built), "--to", "pointcept", "--out"]
    assert main([*command, str(tmp_path / "a"), "--seed", "5", "--epoch", "2", "--copies", "2"]) == 0
    assert "RandomSample (seed 5, epoch 2, 2 copies of each sample)" in capsys.readouterr().out
    assert main([*command, str(tmp_path / "b"), "--as-stored"]) == 0
    assert {len(one) for one in coordinates(tmp_path / "b").values()} == {900}
    assert "random" not in capsys.readouterr().out
    assert main([*command, str(tmp_path / "c"), "--as-stored", "--seed", "5"]) == 2
    assert "--seed" in capsys.readouterr().err


def test_a_teleoperated_set_goes_through_build_and_export_with_its_signals_and_the_choices_of_its_model(tmp_path):
    source = TeleopSource(num_episodes=1, num_views=1, size=(12, 16))
    made = preset("dp3_sim", frame="base", crop=None, num_points=64, channels=["xyz"])
    build_dataset(BuildConfig().for_model(made), source, tmp_path / "built")
    report = export_dataset(tmp_path / "built", "dp3", tmp_path / "out", state="joints, gripper")
    assert (report.written, report.left_out) == (len(source), {})
    buffer = replay_buffer(tmp_path / "out")
    assert buffer["episode_ends"].tolist() == np.cumsum([one.length for one in source.episodes]).tolist()
    assert buffer["point_cloud"].shape == (len(source), 64, 3)  # of the preset, without a word more
    for row, name in enumerate(source.ids):
        signals = source.signals(name)
        state = np.concatenate([signals[key].values[0].numpy() for key in ("joints", "gripper")])
        assert np.array_equal(buffer["state"][row], state)
        assert np.array_equal(buffer["action"][row], signals["action"].values[0].numpy())  # of base, in base
    export_dataset(tmp_path / "built", "dp3", tmp_path / "pose", state="hand")  # position, two columns of the rotation
    for row, name in enumerate(source.ids):
        hand = source.signals(name)["hand"].values[0].numpy()
        expected = np.concatenate([hand[:3, 3], hand[:3, 0], hand[:3, 1]])
        assert replay_buffer(tmp_path / "pose")["state"][row] == pytest.approx(expected, abs=1e-6)
