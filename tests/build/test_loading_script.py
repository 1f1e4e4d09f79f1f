"""load.py: the dataset brings the script that loads it."""

from __future__ import annotations

import runpy

import pytest

from pcdata.build import build_dataset, config_from_yaml
from pcdata.build.config import Loader
from pcdata.build.loading_script import loading_script
from pcdata.datasets import CachedCloudDataset, EpisodeWindows
from pcdata.errors import ConfigError
from pcdata.models import preset
from pcdata.synthetic import TeleopSource
from tests.warm import run_script


@pytest.mark.slow
@pytest.mark.parametrize(
    ("form", "collate", "num_workers", "expected"),
    [
        ("hdf5", "packed", 2, "PointCloud(2 clouds of 64-64 in 'base'"),
        ("npz", "padded", 0, "PaddedClouds(2 x 64 in 'base'"),
    ],
)
def test_the_script_runs_from_anywhere_and_prints_two_epochs(tmp_path, source, form, collate, num_workers, expected):
    text = (
        "depth: [Deproject]\n"
        "cloud: [ToFrame: {frame: base}, MergeViews, FarthestPointSample: {num_points: 64, if_short: repeat}]\n"
        "augment: [RandomRotation]\n"
        f"output: {{format: {form}}}\nloader: {{batch_size: 2, num_workers: {num_workers}, collate: {collate}}}\n"
    )
    build_dataset(config_from_yaml(text), source, tmp_path / "my data")
    done = run_script(tmp_path / "my data" / "load.py", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    lines = done.stdout.splitlines()
    assert [line.split(":")[0] for line in lines] == ["epoch 0", "epoch 0", "epoch 1", "epoch 1"]
    assert sum(expected in line for line in lines) == 2  # three samples: one full batch per epoch


def test_the_settings_arrive_in_the_script():
    text = loading_script(Loader(batch_size=17, num_workers=0, collate="fixed", seed=99))
    compile(text, "load.py", "exec")
    for part in ("batch_size=17", "num_workers=0", "collate_fn=collate_fixed", "seed=99"):
        assert part in text


def test_buckets_arrive_in_the_script_where_batches_are_padded():
    loader = config_from_yaml("loader: {collate: padded, buckets: [64, 128]}\n").loader
    text = loading_script(loader)
    compile(text, "load.py", "exec")
    assert "collate_fn=partial(collate_padded, buckets=(64, 128))" in text
    assert "from functools import partial\n" in text
    assert "functools" not in loading_script(Loader(collate="padded"))
    for wrong in ("{buckets: [64]}", "{collate: padded, buckets: [64, 32]}", "{collate: padded, buckets: [0]}"):
        with pytest.raises(ConfigError, match="buckets"):
            config_from_yaml(f"loader: {wrong}\n")


WINDOWS = "{num_obs: 2, horizon: 4, stride: 2, pad: drop, actions: [action]}"


def test_windows_of_the_configuration_arrive_in_the_script_and_run(tmp_path, capsys):
    source = TeleopSource(num_episodes=2, num_views=1, size=(12, 16))
    text = (
        "depth: [Deproject]\ncloud: [ToFrame: {frame: base}]\n"
        "augment: [RandomSample: {num_points: 16, if_short: repeat}]\n"
        f"loader: {{batch_size: 3, num_workers: 0, windows: {WINDOWS}}}\n"
    )
    config = config_from_yaml(text)
    assert config.loader.collate == "windows"
    build_dataset(config, source, tmp_path / "data")
    runpy.run_path(str(tmp_path / "data" / "load.py"), run_name="__main__")
    told = capsys.readouterr().out
    windows = EpisodeWindows(CachedCloudDataset(tmp_path / "data"), 2, 4, stride=2, pad="drop")
    assert told.count("epoch 0: ") == told.count("epoch 1: ") == -(-len(windows) // 3)
    assert "points (3, 2, 16, 3)" in told
    packed = loading_script(config_from_yaml(f"loader: {{windows: {WINDOWS}, collate: packed}}").loader)
    assert "collate_fn=collate_packed" in packed


def test_windows_without_episodes_are_refused_before_anything_is_built(tmp_path, source):
    config = config_from_yaml(f"depth: [Deproject]\nloader: {{windows: {WINDOWS}}}\n")
    with pytest.raises(ConfigError, match=r"has no episodes to cut windows from.*write_episodes"):
        build_dataset(config, source, tmp_path / "data")
    made = preset("dp3_sim", frame="base", crop=None)
    with pytest.raises(ConfigError, match=r"loader\.windows: the model's preset makes its own batches"):
        config_from_yaml(f"loader: {{windows: {WINDOWS}}}").for_model(made)
    with pytest.raises(ConfigError, match=r"loader\.windows: the model's preset makes its own batches"):
        config_from_yaml(f"model: {{name: dp3_sim, frame: base, crop: null}}\nloader: {{windows: {WINDOWS}}}\n")
