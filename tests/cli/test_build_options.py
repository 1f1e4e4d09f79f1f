"""The options of `pcdata build`: settings, looking ahead, and who works."""

from __future__ import annotations

import re

import pytest

from pcdata import CachedCloudDataset
from pcdata.build import config_from_yaml
from pcdata.cli.build import _workers
from pcdata.io.store.manifest import Manifest
from tests.build.test_builder import tree
from tests.cli.test_cli import captures, config, run

__all__ = ["captures", "config"]  # fixtures


def test_print_config_is_resolved_and_loads_again(capsys, config, captures, tmp_path):
    words = ["--source", captures, "--only", "scan[01]", "--format", "npz", "--set", "output.shard_size=2"]
    code, out, err = run(capsys, "build", config, *words, "--print-config")
    assert (code, err) == (0, "")
    again = tmp_path / "again.yaml"
    again.write_text(out)
    assert run(capsys, "build", again, "--print-config")[1] == out
    assert run(capsys, "build", again, "--out", tmp_path / "a")[0] == 0
    assert run(capsys, "build", config, *words, "--out", tmp_path / "b")[0] == 0
    assert tree(tmp_path / "a" / "shards") == tree(tmp_path / "b" / "shards")
    assert CachedCloudDataset(tmp_path / "a").ids == ["scan0", "scan1"]


@pytest.mark.parametrize("model", ["dp3_sim", "pointnet_part"])
def test_print_config_of_a_model_loads_again(capsys, tmp_path, model):
    choices = ["--set", "frame=camera", "--set", "crop=none" if model == "dp3_sim" else "category=3"]
    code, out, _ = run(capsys, "build", "--model", model, *choices, "--print-config")
    assert code == 0
    assert config_from_yaml(out).to_yaml() == out


def test_set_changes_settings_with_their_types(capsys, config, captures, tmp_path):
    words = [
        "cloud.FarthestPointSample.num_points=8",
        "output.format=npz",
        "augment.0.RandomRotation.degrees=[1, 2, 3, 4]",
    ]
    call = ["build", config, "--source", captures, "--out", tmp_path / "out"]
    code, _, err = run(capsys, *call, *(word for text in words[:2] for word in ("--set", text)))
    assert code == 0, err
    manifest = Manifest.read(tmp_path / "out")
    assert (manifest.format, manifest.pipeline["cloud"][0]["FarthestPointSample"]["num_points"]) == ("npz", 8)
    code, _, err = run(capsys, *call, "--set", words[2])
    assert code == 2
    assert "--set augment.0.RandomRotation.degrees: RandomRotation.degrees: " in err


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        (
            "cloud.FarthestPointSample.num_points=many",
            "--set cloud.FarthestPointSample.num_points: FarthestPointSample.",
        ),
        ("cloud.FarthestPointSample.num_point=8", "did you mean 'num_points'?"),
        ("cloud.FarthestPoint.num_points=8", "cloud has no step 'FarthestPoint'"),
        ("cloud.3.x=8", "cloud has 1 entries, counted from 0"),
        ("output.formt=npz", "--set output.formt: output.formt: no such setting; did you mean 'format'?"),
        ("ouput.format=npz", "--set ouput.format: unknown section 'ouput'; did you mean 'output'?"),
        ("depth.Deproject.x=1", "--set depth.Deproject.x: Deproject.x: no such field"),
        ("output.format={a: [}", "is no value in YAML"),
        ("output.format.x=1", "output.format"),
        ("format=npz", "SECTION.STEP.FIELD=VALUE"),
    ],
)
def test_faults_of_what_is_set_name_the_path(capsys, config, captures, tmp_path, setting, words):
    code, out, err = run(capsys, "build", config, "--source", captures, "--out", tmp_path / "out", "--set", setting)
    assert (code, out) == (2, "")
    assert words in err


def test_a_dry_run_tells_and_writes_nothing(capsys, config, captures, tmp_path):
    call = ["build", config, "--source", captures, "--out", tmp_path / "out", "--set", "output.shard_size=2"]
    before = sorted(tmp_path.rglob("*"))
    code, out, err = run(capsys, *call, "--dry-run")
    assert (code, err) == (0, "")
    for words in ("4 in 2 shards of 2", "to do", "2 shards", "FarthestPointSample", "kB"):
        assert words in out
    assert sorted(tmp_path.rglob("*")) == before
    assert run(capsys, *call, "--num-shards", 2, "--shard-index", 1)[0] == 0
    _, out, _ = run(capsys, *call, "--dry-run")
    assert re.search(r"^finished +1 shards, ", out, re.MULTILINE)


def test_jobs_take_their_index_from_the_environment(capsys, config, captures, tmp_path, monkeypatch):
    call = ["build", config, "--source", captures, "--out", tmp_path / "out", "--set", "output.shard_size=1"]
    code, _, err = run(capsys, *call, "--num-shards", 2)
    assert code == 2
    assert "SLURM_ARRAY_TASK_ID" in err
    for name, index in (("SLURM_ARRAY_TASK_ID", "1"), ("JOB_COMPLETION_INDEX", "0")):
        monkeypatch.setenv(name, index)
        code, out, err = run(capsys, *call, "--num-shards", 2, "--workers", 0)
        assert code == 0, err
        monkeypatch.delenv(name)
    assert "4 samples" in out or "2 samples" in out
    assert len(CachedCloudDataset(tmp_path / "out")) == 4
    assert run(capsys, *call, "--num-shards", 2, "--shard-index", 2)[0] == 2
    assert run(capsys, *call, "--shard-index", 0)[0] == 2


def test_without_an_output_the_request_is_at_fault(capsys, config, captures):
    code, out, err = run(capsys, "build", config, "--source", captures)
    assert (code, out) == (2, "")
    assert "--out DIR" in err


def test_workers_are_the_cores_where_there_are_several_shards():
    class Words:
        workers, engine, timeout = None, "pool", None

    assert _workers(Words, 1) == 0
    assert 1 <= _workers(Words, 2) <= 2
    Words.timeout = 3.0
    assert _workers(Words, 1) == 1
    Words.workers = 5
    assert _workers(Words, 1) == 5
