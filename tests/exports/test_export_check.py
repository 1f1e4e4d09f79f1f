"""pcdata check on what pcdata export wrote: the record says which arrays are what."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from pcdata.cli.main import main
from pcdata.errors import CacheError, ConfigError, PcdataError, TooFewPointsError
from pcdata.exports import TARGETS, check_export, export_dataset
from pcdata.exports.export_record import FILE_NAME, ExportRecord
from pcdata.exports.target import Target
from tests.exports import test_dp3
from tests.exports.samples import Samples, cloud, frame, shape

TABLE = {name: {"class": "mug", "split": split} for name, split in {"a": "train", "b": "test", "c": "train"}.items()}


def dp3(folder: Path, **options: object) -> Path:
    export_dataset(test_dp3.clouds(), "dp3", folder, episodes=test_dp3.episodes(), **options)
    return folder


@pytest.mark.parametrize("options", [{}, {"colors": False}, {"frame": "base"}, {"compression": "none"}])
def test_an_export_for_dp3_needs_no_keys(capsys, tmp_path, options):
    folder = dp3(tmp_path / "out.zarr", **options)
    assert main(["check", str(folder), "--model", "dp3_sim"]) == 0
    assert "PASS: of 5 captures 5 pass" in capsys.readouterr().out
    assert main(["check", str(folder), "--model", "dp3_sim", "--limit", "2"]) == 0
    assert "of 2 captures" in capsys.readouterr().out
    # The same by keys; for a model of other counts it is as wrong as it is.
    keys = ["--keys", "points=data/point_cloud", "--frame", "base", "--unit", "m"]
    keys += [] if options.get("colors", True) else ["--set", "channels=xyz"]
    assert main(["check", str(folder), "--model", "dp3_sim", *keys]) == 0
    assert main(["check", str(folder), "--model", "graspnet_baseline"]) == 1


def test_the_record_knows_the_frame_and_no_argument_changes_it(capsys, tmp_path):
    folder = dp3(tmp_path / "out.zarr")
    assert ExportRecord.read(folder).coordinates == [["base", "m"]]
    assert main(["check", str(folder), "--model", "dp3_sim", "--frame", "world"]) == 1
    assert "the data are in 'base', the model works in 'world'" in capsys.readouterr().out
    mixed = Samples({"a": cloud(1100), "b": replace(cloud(1100), frame_id="table")})
    export_dataset(mixed, "pointcept", tmp_path / "mixed")
    checks = check_export(tmp_path / "mixed", "pointcept").checks.items()
    assert [one.worst.verdict.value for (rule, _), one in checks if rule == "frame"] == ["unknown"]
    assert check_export(tmp_path / "mixed", "pointcept", frame_id="base", frame="base").verdict.value == "pass"


def test_a_continued_export_knows_the_frames_of_what_it_kept(tmp_path):
    broken = Samples({"a": cloud(1100), "b": cloud(1100, frame_id="table"), "c": cloud(0)})
    with pytest.raises(TooFewPointsError):
        export_dataset(broken, "pointcept", tmp_path / "out", resume=True)
    whole = Samples({**broken.samples, "c": cloud(1100)})
    assert export_dataset(whole, "pointcept", tmp_path / "out", resume=True).kept == 2
    assert ExportRecord.read(tmp_path / "out").coordinates == [["base", "m"], ["table", "m"]]


def test_arrays_that_somebody_turned_or_renamed_are_found(tmp_path):
    source = Samples({name: shape(seed=number) for number, name in enumerate(TABLE)})
    export_dataset(source, "pointnet", tmp_path / "out", table=TABLE)
    with h5py.File(tmp_path / "out" / "ply_data_test0.h5", "a") as file:
        turned = file["data"][...].transpose(0, 2, 1)
        del file["data"]
        file["data"] = turned
    summary = check_export(tmp_path / "out", "pointnet_cls")
    assert {rule for (rule, _), entry in summary.checks.items() if entry.worst.verdict.value == "fail"} >= {"layout"}
    with h5py.File(tmp_path / "out" / "ply_data_test0.h5", "a") as file:
        file.move("data", "points")
    with pytest.raises(PcdataError, match=r"no array 'data'.*points"):
        check_export(tmp_path / "out", "pointnet_cls")


def test_a_stated_number_of_points_is_that_of_the_export(tmp_path):
    source = Samples({f"t{step}": cloud(100, seed=step) for step in range(5)})
    export_dataset(source, "dp3", tmp_path / "o", episodes=test_dp3.episodes(), num_points=100, frame="base")
    assert check_export(tmp_path / "o", "dp3_sim").verdict.value == "pass"
    assert check_export(tmp_path / "o", "dp3_sim", num_points=512).verdict.value == "fail"


def test_every_file_of_an_export_of_shapes_is_judged(capsys, tmp_path):
    source = Samples({name: shape(seed=number) for number, name in enumerate(TABLE)})
    export_dataset(source, "pointnet", tmp_path / "out", table=TABLE)
    assert main(["check", str(tmp_path / "out"), "--model", "pointnet_cls", "--frame", "base"]) in (0, 1)
    told = capsys.readouterr().out
    assert "of 3 captures" in told
    with h5py.File(tmp_path / "out" / "ply_data_test0.h5", "a") as file:
        file["data"][...] = np.nan
    assert main(["check", str(tmp_path / "out"), "--model", "pointnet_cls", "--frame", "base"]) == 1
    assert "FAIL finite (ply_data_test0.h5/0)" in capsys.readouterr().out


def test_a_part_of_an_export_needs_no_keys_either(capsys, tmp_path):
    folder = dp3(tmp_path / "out.zarr", frame="base")
    for part in ("data", "data/point_cloud"):
        assert main(["check", str(folder / part), "--model", "dp3_sim"]) == 0
        assert "PASS: of 5 captures 5 pass" in capsys.readouterr().out
    assert main(["check", str(folder / "data/action"), "--model", "dp3_sim"]) == 2
    told = capsys.readouterr().err
    assert "holds no clouds" in told
    assert "are in data/point_cloud" in told
    assert main(["check", str(folder / "data/nothing"), "--model", "dp3_sim"]) == 1
    assert "no such file" in capsys.readouterr().err
    # What lies there but was not exported is anybody's.
    np.savez(folder / "data" / "a.npz", xyz=np.zeros((3, 3)))
    assert main(["check", str(folder / "data" / "a.npz"), "--model", "dp3_sim"]) == 2
    assert "it has xyz" in capsys.readouterr().err


def test_one_file_of_an_export_of_shapes_is_judged_alone(tmp_path):
    source = Samples({name: shape(seed=number) for number, name in enumerate(TABLE)})
    export_dataset(source, "pointnet", tmp_path / "out", table=TABLE)
    for name, count in {"ply_data_test0.h5": 1, "ply_data_train0.h5": 2}.items():
        assert sum(check_export(tmp_path / "out" / name, "pointnet_cls").samples.values()) == count
    with pytest.raises(ConfigError, match=r"are in ply_data_test0\.h5/data, ply_data_train0\.h5/data"):
        check_export(tmp_path / "out" / "shape_names.txt", "pointnet_cls")


def test_what_is_said_of_every_sample_is_said_once(capsys, tmp_path):
    """The samples of a file are 0, 1, 2, ...: digits of the numbers that are said of them."""
    folder = dp3(tmp_path / "out")
    assert main(["check", str(folder), "--model", "m2t2"]) == 1
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith(("FAIL ", "UNKNOWN "))]
    assert [line.split()[1] for line in lines] == ["layout", "count", "channels", "range"]
    assert all("(0, 1, 2, 3, 4)" in line for line in lines)


def test_exports_of_files_for_every_sample_are_judged_as_they_were_exported(capsys, tmp_path):
    """Texts of ModelNet, and folders of Pointcept whose channels lie in files of their own."""
    source = Samples({name: cloud(1100, seed=number) for number, name in enumerate(TABLE)})
    for target, model, part, broken in [
        ("modelnet", "pointnet2_cls", "mug/mug_0001.txt", "mug/mug_0002.txt"),
        ("pointcept", "pointcept", "train/a", "test/b/coord.npy"),
    ]:
        folder = tmp_path / target
        export_dataset(source, target, folder, table=TABLE)
        assert main(["check", str(folder), "--model", model, "--frame", "base"]) == 0
        assert "PASS: of 3 captures 3 pass" in capsys.readouterr().out
        assert main(["check", str(folder / part), "--model", model, "--frame", "base"]) == 0
        assert "of 1 capture 1 pass" in capsys.readouterr().out
        (folder / broken).write_bytes(b"nothing")
        with pytest.raises(CacheError, match=f"{broken}: "):
            check_export(folder, model)
    with pytest.raises(ConfigError, match="holds no samples"):
        check_export(tmp_path / "modelnet" / "shape_names.txt", "pointnet2_cls")


def test_a_pointcept_scene_without_colors_is_judged_by_what_it_has(tmp_path):
    export_dataset(Samples({"a": replace(cloud(1100), colors=None)}), "pointcept", tmp_path / "out")
    assert check_export(tmp_path / "out", "pointcept", frame="base").verdict.value == "pass"
    assert check_export(tmp_path / "out", "sonata", frame="base").verdict.value == "fail"
    np.save(tmp_path / "out" / "train" / "a" / "coord.npy", np.full((1100, 3), np.nan, np.float32))
    assert check_export(tmp_path / "out", "pointcept", frame="base").verdict.value == "fail"


def test_an_export_that_check_does_not_read_says_so(tmp_path, monkeypatch):
    export_dataset(Samples({"a": frame()}), "contact_graspnet", tmp_path / "out")
    monkeypatch.setattr(TARGETS["contact_graspnet"], "cloud_fields", Target.cloud_fields)
    with pytest.raises(ConfigError, match=r"writes one npz per capture.* passed the rules of contact_graspnet_api"):
        check_export(tmp_path / "out", "contact_graspnet_api")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"coordinates": [["base"]]}, "coordinates must list frames with their units"),
        ({"complete": False}, "unfinished export"),
        ({"target": "nothing"}, "no target 'nothing'"),
        ({"schema": 3}, "sch"),
    ],
)
def test_a_record_that_is_not_whole_is_told(capsys, tmp_path, change, message):
    record = dp3(tmp_path / "out") / FILE_NAME
    record.write_text(json.dumps({**json.loads(record.read_text()), **change}))
    with pytest.raises(CacheError, match=message):
        check_export(tmp_path / "out", "dp3_sim")
    assert main(["check", str(tmp_path / "out"), "--model", "dp3_sim"]) == 1
    assert message in capsys.readouterr().err


def test_files_of_others_name_the_candidates(capsys, tmp_path):
    (dp3(tmp_path / "out") / FILE_NAME).unlink()
    (tmp_path / "out/data/point_cloud").rename(tmp_path / "out/data/xyz")
    np.savez(tmp_path / "a.npz", xyz=np.zeros((3, 3)), rgb=np.zeros((3, 3)))
    np.save(tmp_path / "a.npy", np.zeros((3, 3)))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["clouds/xyz"] = np.zeros((3, 3))
    for name, words in {
        "out": "it has data/action, data/img, data/state, data/xyz, meta/episode_ends",
        "a.npz": "it has rgb, xyz",
        "a.h5": "it has clouds/xyz",
        "a.npy": "it is one array, without a name: --keys points=",
    }.items():
        assert main(["check", str(tmp_path / name), "--model", "dp3_sim"]) == 2
        told = capsys.readouterr().err
        assert words in told
        assert "the keys are point_cloud, points, colors, normals" in told
    assert main(["check", str(tmp_path / "a.npy"), "--model", "dp3_sim", "--keys", "points="]) in (0, 1)
