"""The options of `pcdata build`: settings, looking ahead, and who works."""

from __future__ import annotations

import re

import pytest

from pcdata import CachedCloudDataset
from pcdata.build import config_from_yaml
from pcdata.cli.build import _workers
from pcdata.errors import TooFewPointsError
from pcdata.io import write_capture
from pcdata.io.store.manifest import Manifest
from tests.build.test_builder import tree
from tests.cli.test_cli import captures, config, run
from tests.factories import tabletop_frame

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


@pytest.mark.parametrize(
    ("model", "choices", "is_told"),
    [("pointnet2_cls", [], True), ("pointnet2_semseg", [], False), ("dp3_sim", ["--set", "crop=none"], False)],
)
def test_a_model_of_single_objects_is_told_of_whole_scenes(capsys, tmp_path, model, choices, is_told):
    write_capture(tabletop_frame(1), tmp_path / "taken")
    words = ["--model", model, "--set", "frame=base", *choices, "--source", tmp_path / "taken" / "view0"]
    code, out, err = run(capsys, "build", *words, "--out", tmp_path / "set")
    assert code == 0, err
    assert ("takes clouds of one object, and these hold all that the captures show" in out) == is_told
    if is_told:  # clouds of objects are not told
        code, out, err = run(capsys, "clouds", tmp_path / "set", "--out", tmp_path / "ply")
        assert code == 0, err
        words[-1] = tmp_path / "ply"
        code, out, err = run(capsys, "build", *words, "--out", tmp_path / "objects")
        assert code == 0, err
        assert "one object" not in out


def test_samples_that_training_will_refuse_are_told(capsys, config, captures, tmp_path):
    whole = config.read_text()
    config.write_text(whole[: whole.index("augment:")] + "augment: [{RandomSample: {num_points: 100000}}]\n")
    code, out, err = run(capsys, "build", config, "--source", captures, "--out", tmp_path / "short")
    assert code == 0, err
    with pytest.raises(TooFewPointsError):
        CachedCloudDataset(tmp_path / "short", seed=0)[0]
    dataset = CachedCloudDataset(tmp_path / "short", augment=None)
    count = dataset[0].num_points
    assert (
        f"note     {len(dataset)} samples will be refused when read, having fewer than the 100,000 points that" in out
    )
    assert f"'{dataset.ids[0]}' ({count:,})" in out
    filled = "[{RandomSample: {num_points: 100001, if_short: repeat}}, {RandomSample: {num_points: 100000}}]"
    config.write_text(whole[: whole.index("augment:")] + f"augment: {filled}\n")
    code, out, err = run(capsys, "build", config, "--source", captures, "--out", tmp_path / "filled")
    assert code == 0, err
    assert "will be refused" not in out
    assert CachedCloudDataset(tmp_path / "filled", seed=0)[0].num_points == 100000
    config.write_text(whole[: whole.index("augment:")] + f"augment: [{{RandomSample: {{num_points: {count}}}}}]\n")
    code, out, err = run(capsys, "build", config, "--source", captures, "--out", tmp_path / "enough")
    assert code == 0, err
    assert "will be refused" not in out


def test_views_of_a_model_that_nothing_joins_are_told(capsys, tmp_path):
    write_capture(tabletop_frame(2), tmp_path / "rig")
    words = ["--model", "dp3_sim", "--set", "crop=none", "--source", tmp_path / "rig"]
    for frame, is_told in (("camera", True), ("base", False)):
        code, out, err = run(capsys, "build", *words, "--set", f"frame={frame}", "--out", tmp_path / frame)
        assert code == 0, err
        assert ("1 sample made of several views: a cloud of each by itself" in out) == is_told
        assert CachedCloudDataset(tmp_path / frame)[0].num_clouds == 1 + is_told


def test_training_refuses_a_sample_by_its_smallest_cloud(capsys, tmp_path):
    frame = tabletop_frame(2)
    fewest = int((frame.depth[1, :30] > 0).sum())
    frame.depth[1, 30:] = 0
    write_capture(frame, tmp_path / "rig")
    config = tmp_path / "views.yaml"
    steps = "depth: [Deproject: {}]\ncloud: [ToFrame: {frame: base}]\n"
    config.write_text(f"{steps}augment: [RandomSample: {{num_points: {fewest + 1}}}]\n")
    code, out, err = run(capsys, "build", config, "--source", tmp_path / "rig", "--out", tmp_path / "set")
    assert code == 0, err
    with pytest.raises(TooFewPointsError):
        CachedCloudDataset(tmp_path / "set", seed=0)[0]
    assert f"1 sample will be refused when read, having fewer than the {fewest + 1:,} points" in out
    assert f"(a cloud of {fewest:,})" in out


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


@pytest.mark.parametrize("inside", ["", "shards/00000", "dataset.json"])
def test_a_dataset_as_source_is_told_apart_from_captures(capsys, config, captures, tmp_path, inside):
    assert run(capsys, "build", config, "--source", captures, "--out", tmp_path / "set")[0] == 0
    for command in (("build", config, "--out", tmp_path / "new", "--source"), ("validate",)):
        code, out, err = run(capsys, *command, tmp_path / "set" / inside)
        assert code == 1
        told = next(line for line in (out + err).splitlines() if "open_source" in line)
        assert re.search(r"dataset that 'pcdata build' wrote.* built from \(captures\).*pcdata inspect .*/set$", told)
        assert "robomimic" not in out + err
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    "words",
    [
        ["calib", "refine", "CAPTURES", "--calibration", "c.yaml", "--out", "CAPTURES/new.yaml"],
        ["calib", "intrinsics", "CAPTURES", "--board", "chessboard:8x6:0.03", "--out", "CAPTURES/new.yaml"],
        ["calib", "hand-eye", "CAPTURES/poses.yaml", "--out", "CAPTURES/poses.yaml"],
        ["convert", "CAPTURES", "--to", "folder", "--out", "CAPTURES/new"],
        ["export", "CAPTURES", "--to", "dp3", "--out", "CAPTURES"],
        ["build", "CONFIG", "--source", "CAPTURES", "--out", "CAPTURES/new"],
    ],
    ids=lambda words: " ".join(words[:2]),
)
def test_nothing_is_written_among_what_is_read(capsys, config, captures, words):
    before = tree(captures)
    code, out, err = run(
        capsys, *(word.replace("CAPTURES", str(captures)).replace("CONFIG", str(config)) for word in words)
    )
    assert (code, out) == (2, "")
    assert re.search(r"would become part of them; choose a place outside|is what is read; choose another file", err)
    assert tree(captures) == before


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
    assert re.search(r"^finished +1 shard, ", out, re.MULTILINE)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--max-bad", "two"], "max_bad must be"),
        (["--engine", "rai"], "engine must be one of"),
        (["--timeout", "-1"], "timeout must be"),
        (["--timeout", "2", "--workers", "0"], "timeout needs a process"),
        (["--retry-quarantined", "--restart"], "without restart"),
        (["--finalize", "--num-shards", "2", "--shard-index", "0"], "finalize takes no part"),
    ],
    ids=" ".join,
)
def test_a_dry_run_refuses_what_the_build_would(capsys, config, captures, tmp_path, words, told):
    call = ["build", config, "--source", captures, "--out", tmp_path / "out", *words]
    for line in (call, [*call, "--dry-run"]):
        code, out, err = run(capsys, *line)
        assert (code, out) == (2, "")
        assert told in err


def test_a_dry_run_tells_what_the_options_change(capsys, config, captures, tmp_path):
    call = ["build", config, "--source", captures, "--out", tmp_path / "out", "--set", "output.shard_size=2"]

    def dry(*words):
        code, out, _ = run(capsys, *call, *words, "--dry-run")
        assert code == 0
        return dict(re.split("  +", line, maxsplit=1) for line in out.splitlines() if "  " in line)

    assert dry("--num-shards", 2, "--shard-index", 1)["to do"] == "1 shard of this job"
    assert "2 of 2 shards are not finished" in dry("--finalize")["in the way"]
    assert "no captures of it are quarantined" in dry("--retry-quarantined")["in the way"]
    assert run(capsys, *call, "--num-shards", 2, "--shard-index", 0)[0] == 0
    assert dry()["finished"].startswith("1 shard,")
    assert dry("--restart")["to do"] == "2 shards"
    assert "--restart deletes it" in dry("--format", "pt")["in the way"]
    assert "in the way" not in dry("--format", "pt", "--restart")
    assert run(capsys, *call)[0] == 0
    assert "--overwrite replaces it" in dry()["in the way"]
    assert "once this is built" in dry("--overwrite")["replaces"]


def test_a_dry_run_of_a_retry_tells_what_is_kept_and_what_is_tried_again(capsys, config, captures, tmp_path):
    call = ["build", config, "--source", captures, "--out", tmp_path / "out", "--set", "output.shard_size=1"]
    file = captures / "scan1.ply"
    whole = file.read_bytes()
    file.write_bytes(whole[:40])
    assert run(capsys, *call, "--workers", 0)[0] == 3
    file.write_bytes(whole)
    _, out, _ = run(capsys, *call, "--retry-quarantined", "--dry-run")
    told = dict(re.split("  +", line, maxsplit=1) for line in out.splitlines() if "  " in line)
    assert told["kept"].startswith("3 shards, ")
    assert (told["to do"], told["tried again"]) == ("1 shard", "1 capture")
    assert "once this is built" in told["replaces"]
    assert "in the way" not in told
    code, out, err = run(capsys, *call, "--retry-quarantined", "--workers", 0)
    assert (code, "3 of 4 shards were finished before" in err) == (0, True)


def test_a_job_that_is_started_again_after_the_last_one_has_nothing_to_do(capsys, config, captures, tmp_path):
    call = ["build", config, "--source", captures, "--out", tmp_path / "out", "--set", "output.shard_size=1"]
    for index in (0, 1):
        assert run(capsys, *call, "--num-shards", 2, "--shard-index", index)[0] == 0
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    for words in (["--num-shards", 2, "--shard-index", 0], ["--finalize"]):
        code, _, err = run(capsys, *call, *words)
        assert code == 0
        assert "the dataset was put into place before" in err
    other = ["--set", "cloud.FarthestPointSample.num_points=7"]
    code, _, err = run(capsys, *call, *other, "--num-shards", 2, "--shard-index", 0)
    assert code == 1
    assert "exists already" in err
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before


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


def test_what_lies_beside_the_captures_and_is_not_read_is_told(capsys, config, captures, tmp_path):
    (captures / "other").mkdir()
    (captures / "other" / "000.png").touch()
    call = ["build", config, "--source", captures, "--out", tmp_path / "out"]
    for line in ([*call, "--dry-run"], call):
        code, _, err = run(capsys, *line)
        assert code == 0
        assert re.search("^not read: .*other", err, re.MULTILINE)
