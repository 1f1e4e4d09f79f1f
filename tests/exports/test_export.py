"""Exporting: all or nothing, what is there stays, and what was interrupted goes on."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from pcdata import CachedCloudDataset, open_source
from pcdata.build import build_dataset, config_from_yaml
from pcdata.cli import main
from pcdata.errors import CacheError, CaptureError, ConfigError
from pcdata.exports import TARGETS, export_dataset
from pcdata.exports.export_record import FILE_NAME
from pcdata.exports.targets import target_named
from pcdata.io.writers.capture_folder import write_capture
from pcdata.structures import Episode
from pcdata.synthetic import SyntheticSource
from tests.exports.samples import Samples, cloud, frame, tree

PIPELINE = """
depth: [MaskDepth: {near: 0.1, far: 3.0}, Deproject]
cloud: [ToFrame: {frame: base}, MergeViews, FarthestPointSample: {num_points: 32, if_short: repeat}]
augment: [RandomRotation: {degrees: 90}]
"""


def captures(number=4) -> Samples:
    return Samples({f"f{step}": frame(seed=step) for step in range(number)})


def stop(*_):
    raise KeyboardInterrupt


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    folder = tmp_path_factory.mktemp("built") / "dataset"
    source = SyntheticSource(num_scenes=3, num_objects=1, size=(12, 16))
    build_dataset(config_from_yaml(PIPELINE), source, folder)
    return folder


# -- all or nothing ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("target", ["contact_graspnet", "graspnet", "ggcnn"])
@pytest.mark.parametrize("stopper", [stop, lambda: frame(colors=None, depth=torch.zeros(1, 12, 16))])
def test_an_export_that_fails_leaves_nothing(tmp_path, target, stopper):
    source = captures()
    source.samples["f2"] = stopper
    options = {} if target == "contact_graspnet" else {"any_size": True}
    if target == "contact_graspnet" and stopper is not stop:
        source.samples["f2"] = lambda: cloud()
    with pytest.raises(BaseException):  # noqa: B017, PT011  # whichever it is
        export_dataset(source, target, tmp_path / "new" / "out", **options)
    assert list(tmp_path.iterdir()) == []


def test_what_was_there_survives_an_overwriting_export_that_fails(tmp_path):
    export_dataset(captures(), "contact_graspnet", tmp_path / "out")
    before = tree(tmp_path)
    source = captures()
    source.samples["f3"] = stop
    with pytest.raises(KeyboardInterrupt):
        export_dataset(source, "contact_graspnet", tmp_path / "out", overwrite=True)
    assert tree(tmp_path) == before


def test_an_existing_folder_is_refused_and_overwritten_only_on_demand(tmp_path):
    out = tmp_path / "out"
    export_dataset(captures(4), "contact_graspnet", out)
    with pytest.raises(CacheError, match=r"--continue.*--overwrite"):
        export_dataset(captures(2), "contact_graspnet", out)
    export_dataset(captures(2), "contact_graspnet", out, overwrite=True)
    assert sorted(path.name for path in out.glob("*.npz")) == ["f0.npz", "f1.npz"]
    with pytest.raises(ConfigError, match="not both"):
        export_dataset(captures(2), "contact_graspnet", out, overwrite=True, resume=True)


def test_an_empty_folder_may_be_exported_into(tmp_path):
    (tmp_path / "out").mkdir()
    export_dataset(captures(1), "contact_graspnet", tmp_path / "out")
    assert (tmp_path / "out" / "f0.npz").is_file()


@pytest.mark.parametrize("resume", [False, True])
def test_a_folder_of_somebody_else_is_never_touched(tmp_path, resume):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("years of work")
    before = tree(tmp_path)
    with pytest.raises(CacheError, match="not a pcdata export"):
        export_dataset(captures(), "contact_graspnet", tmp_path / "out", overwrite=not resume, resume=resume)
    assert tree(tmp_path) == before


def test_files_added_to_an_export_are_not_overwritten(tmp_path):
    out = tmp_path / "out"
    export_dataset(captures(1), "ggcnn", out, any_size=True)
    (out / "01" / "pcd0100cpos.txt").write_text("5 6\n9 6\n9 10\n5 10\n")  # annotated by hand
    before = tree(tmp_path)
    with pytest.raises(CacheError, match=r"01/pcd0100cpos\.txt, which the export did not write"):
        export_dataset(captures(1), "ggcnn", out, any_size=True, overwrite=True)
    assert tree(tmp_path) == before


def test_a_link_leads_to_the_new_export(tmp_path):
    export_dataset(captures(1), "contact_graspnet", tmp_path / "real")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    export_dataset(captures(2), "contact_graspnet", tmp_path / "link", overwrite=True)
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real" / "f1.npz").is_file()


# -- continuing ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("target", "options"),
    [
        ("contact_graspnet", {}),
        ("graspnet", {"any_size": True}),
        ("graspnet_scene", {"any_size": True, "frames_per_scene": 2}),
        ("ggcnn", {"any_size": True, "grasps": {f"f{n}": np.ones((1, 4, 2)) for n in range(4)}}),
    ],
)
def test_a_continued_export_is_the_same_as_one_in_one_go(tmp_path, target, options):
    export_dataset(captures(), target, tmp_path / "one go", **options)
    source = captures()
    source.samples["f3"] = stop
    with pytest.raises(KeyboardInterrupt):
        export_dataset(source, target, tmp_path / "out", resume=True, **options)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one go", "out"]
    with pytest.raises(CacheError, match="unfinished"):
        export_dataset(captures(), target, tmp_path / "out", overwrite=True, **options)
    source = captures()
    report = export_dataset(source, target, tmp_path / "out", resume=True, **options)
    finished = 2 if target == "graspnet_scene" else 3
    assert (report.kept, report.written) == (finished, 4 - finished)
    assert source.loaded == source.ids[finished:]
    assert tree(tmp_path / "out") == tree(tmp_path / "one go")
    again = export_dataset(captures(), target, tmp_path / "out", resume=True, **options)
    assert (again.kept, again.written) == (4, 0)


def test_an_item_that_was_moved_by_half_is_written_again(tmp_path, monkeypatch):
    options = {"any_size": True, "grasps": {f"f{n}": np.ones((1, 4, 2)) for n in range(4)}}
    export_dataset(captures(), "ggcnn", tmp_path / "one go", **options)
    rename = os.replace

    def fails_at_the_second_depth(source, target):
        if str(target).endswith("pcd0101d.tiff"):
            raise KeyboardInterrupt
        rename(source, target)

    monkeypatch.setattr("pcdata.exports.exporter.os.replace", fails_at_the_second_depth)
    with pytest.raises(KeyboardInterrupt):
        export_dataset(captures(), "ggcnn", tmp_path / "out", resume=True, **options)
    monkeypatch.undo()
    assert (tmp_path / "out/01/pcd0101r.png").exists()
    export_dataset(captures(), "ggcnn", tmp_path / "out", resume=True, **options)
    assert tree(tmp_path / "out") == tree(tmp_path / "one go")


@pytest.mark.parametrize("exists", [True, False], ids=["to a file", "to nothing"])
@pytest.mark.parametrize(
    ("target", "options", "place"),
    [
        ("contact_graspnet", {}, "f1.npz"),
        ("contact_graspnet", {}, "pcdata_export.json"),
        ("ggcnn", {"any_size": True}, "01/pcd0101r.png"),
        ("ggcnn", {"any_size": True}, "01"),
        ("graspnet", {"any_size": True}, "f1"),
    ],
)
def test_a_continued_export_writes_through_no_link(tmp_path, target, options, place, exists):
    source = captures()
    source.samples["f1"] = stop
    with pytest.raises(KeyboardInterrupt):
        export_dataset(source, target, tmp_path / "out", resume=True, **options)
    link, elsewhere = tmp_path / "out" / place, tmp_path / "elsewhere"
    if link.exists():
        link.rename(elsewhere)
    elif exists:
        elsewhere.mkdir()
    if not exists:
        elsewhere = tmp_path / "nowhere"
    link.symlink_to(elsewhere)
    before = tree(tmp_path)
    with pytest.raises(CacheError, match=r"is a link to .*writes into its own folder only") as caught:
        export_dataset(captures(), target, tmp_path / "out", resume=True, **options)
    assert str(link) in str(caught.value)
    assert tree(tmp_path) == before


def test_an_export_killed_at_its_start_can_be_continued(tmp_path, monkeypatch):
    def stop_here(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("pcdata.exports.exporter.rename_to_free", stop_here)
        with pytest.raises(KeyboardInterrupt):
            export_dataset(captures(), "contact_graspnet", tmp_path / "out", resume=True)
    assert not (tmp_path / "out").exists()  # never without its plan
    export_dataset(captures(), "contact_graspnet", tmp_path / "out", resume=True)


def test_only_the_same_export_is_continued(tmp_path):
    out = tmp_path / "out"
    export_dataset(captures(3), "contact_graspnet", out, resume=True)
    before = tree(out)
    for source, target, options, message in [
        (captures(4), "contact_graspnet", {}, "its samples are others"),
        (captures(3), "contact_graspnet", {"label_offset": 1}, "its options are"),
        (captures(3), "graspnet", {"any_size": True}, "its target is 'contact_graspnet', not 'graspnet'"),
    ]:
        with pytest.raises(CacheError, match=message):
            export_dataset(source, target, out, resume=True, **options)
    assert tree(out) == before


def test_an_array_of_all_samples_is_continued_as_a_whole(tmp_path):
    robot = {"e": {"samples": np.array(["a", "b"]), "state": np.zeros((2, 1)), "action": np.zeros((2, 1))}}
    with pytest.raises(KeyboardInterrupt):
        export_dataset(Samples({"a": cloud(512), "b": stop}), "dp3", tmp_path / "out", resume=True, episodes=robot)
    assert [path.name for path in (tmp_path / "out").iterdir()] == [FILE_NAME]
    source = Samples({"a": cloud(512), "b": cloud(512)})
    export_dataset(source, "dp3", tmp_path / "out", resume=True, episodes=robot)
    export_dataset(source, "dp3", tmp_path / "one go", episodes=robot)
    assert tree(tmp_path / "out") == tree(tmp_path / "one go")


KEPT = re.compile(r"says: of (`[^;]*`) every finished sample; .* of (`[^;]*`), whose files hold all samples in common")


def test_the_page_says_which_targets_keep_finished_samples_and_which_start_over():
    """What one item holds decides: a sample, or all of them."""
    ids = [f"f{number}" for number in range(4)]
    robot = {"e": {"samples": np.array(ids), "state": np.zeros((4, 1)), "action": np.zeros((4, 1))}}
    robot["e"]["imagin_robot"] = np.zeros((4, 96, 7))
    given = {"dexart": {"episodes": robot}, "graspnet_scene": {"frames_per_scene": 2}}
    robot = {"e": {name: array for name, array in robot["e"].items() if name != "imagin_robot"}}
    given |= {name: {"episodes": robot} for name in ("dp3", "idp3", "maniflow", "demogen", "diffusion_policy")}
    table = {name: {"class": "mug", "split": "train"} for name in ids}
    given |= {name: {"table": table} for name in ("pointnet", "pointnet_part", "modelnet", "pointcept")}
    halves = [Episode("a", 0, 2), Episode("b", 2, 2)]
    parts = {name: len(target_named(name, given.get(name, {})).plan(ids, halves, ())) for name in TARGETS}
    assert (parts["graspnet_scene"], parts["rise"]) == (2, 2)
    text = (Path(__file__).parents[2] / "docs" / "exports.md").read_text(encoding="utf-8")
    kept, over = (set(re.findall(r"`(\w+)`", said)) for said in KEPT.search(" ".join(text.split())).groups())
    assert kept == {name for name, count in parts.items() if count == 4}
    assert over == {name for name, count in parts.items() if count == 1}


def test_the_record_lists_samples_and_files(tmp_path):
    export_dataset(captures(2), "contact_graspnet", tmp_path / "out", label_offset=1)
    record = json.loads((tmp_path / "out" / FILE_NAME).read_text())
    assert record["samples"] == ["f0", "f1"]
    assert record["files"] == ["f0.npz", "f1.npz"]
    assert record["options"] == {"label_offset": 1, "view": None}
    assert record["complete"] is True


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"schema": "pcdata.export/1", "surprise": 1}'])
def test_a_damaged_record_is_named(tmp_path, text):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / FILE_NAME).write_text(text)
    with pytest.raises(CacheError, match=FILE_NAME):
        export_dataset(captures(1), "contact_graspnet", tmp_path / "out", overwrite=True)


# -- what is asked for ---------------------------------------------------------------------------------------------


def test_an_unknown_target_lists_all_and_the_nearest():
    with pytest.raises(ConfigError, match="did you mean 'pointnet'") as caught:
        export_dataset(captures(), "pontnet", "out")
    assert all(f"  {name} (from " in str(caught.value) for name in TARGETS)


def test_an_unknown_option_or_a_value_that_does_not_fit_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="did you mean 'label_offset'"):
        export_dataset(captures(), "contact_graspnet", tmp_path / "out", label_ofset=1)
    with pytest.raises(ConfigError, match=r"label_offset: .*got 'one'"):
        export_dataset(captures(), "contact_graspnet", tmp_path / "out", label_offset="one")
    with pytest.raises(ConfigError, match="camera: "):
        export_dataset(captures(), "graspnet_scene", tmp_path / "out", camera="lidar")


def test_sources_without_samples_or_with_one_id_twice_are_refused(tmp_path):
    with pytest.raises(CaptureError, match="no samples"):
        export_dataset(Samples({}), "contact_graspnet", tmp_path / "out")
    twice = captures(1)
    twice.ids = ["f0", "f0"]
    with pytest.raises(CaptureError, match="'f0' comes more than once"):
        export_dataset(twice, "contact_graspnet", tmp_path / "out")
    with pytest.raises(TypeError, match="ids and load"):
        export_dataset(5, "contact_graspnet", tmp_path / "out")


def test_a_built_dataset_is_exported_as_stored_and_with_its_random_end(built, tmp_path):
    as_stored = CachedCloudDataset(built, augment=None)
    for number, (source, dataset) in enumerate(
        [
            (as_stored, as_stored),
            (built, CachedCloudDataset(built)),
            (str(built), CachedCloudDataset(built)),
            (CachedCloudDataset(built, seed=3), CachedCloudDataset(built, seed=3)),
        ]
    ):
        export_dataset(source, "pointcept", tmp_path / str(number))
        for stored, name in zip(dataset, dataset.ids, strict=True):
            coord = np.load(tmp_path / str(number) / "train" / name / "coord.npy")
            assert np.array_equal(coord, stored.points.numpy())
    record = json.loads((tmp_path / "0" / FILE_NAME).read_text())
    assert record["source"] == dataset.manifest.fingerprint


def test_images_are_not_made_of_clouds(built, tmp_path):
    with pytest.raises(ConfigError, match="has clouds alone; give the captures"):
        export_dataset(built, "ggcnn", tmp_path / "out")


# -- the command ---------------------------------------------------------------------------------------------------


@pytest.fixture
def capture_folder(tmp_path):
    write_capture(frame(), tmp_path / "raw")
    return tmp_path / "raw" / "view0"


def run(capsys, *arguments: object) -> tuple[int, str, str]:
    try:
        code = main(["export", *map(str, arguments)])
    except SystemExit as leave:
        code = leave.code
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err
    return code, out, err


def test_the_command_exports_captures(capsys, capture_folder, tmp_path):
    out = tmp_path / "out"
    options = ["--set", "any_size=true", "--set", "label_offset=1"]
    code, text, _ = run(capsys, capture_folder, "--to", "graspnet", "--out", out, *options)
    assert code == 0
    assert f"export  {out}  (graspnet: 1 sample written)" in text
    delivered = open_source(out).load("0")
    assert torch.equal(delivered.depth, frame().depth)
    assert torch.equal(delivered.mask, frame().mask)
    code, _, err = run(capsys, capture_folder, "--to", "graspnet", "--out", out, *options)
    assert (code, "exists already" in err) == (1, True)
    assert run(capsys, capture_folder, "--to", "graspnet", "--out", out, *options, "--overwrite")[0] == 0
    code, text, _ = run(capsys, capture_folder, "--to", "graspnet", "--out", out, *options, "--continue")
    assert (code, "0 samples written, 1 were there" in text) == (0, True)


def test_the_command_exports_a_dataset(capsys, built, tmp_path):
    code, text, _ = run(capsys, built, "--to", "pointcept", "--out", tmp_path / "out", "--set", "frame=base")
    assert code == 0
    assert "3 samples written" in text
    code, _, err = run(capsys, built, "--to", "pointcept", "--out", tmp_path / "b", "--set", "frame=world")
    assert code == 1
    assert "ToFrame(frame='world')" in err
    code, _, err = run(capsys, built, "--to", "pointcept", "--out", tmp_path / "b", "--limit", 1)
    assert (code, "--limit" in err) == (2, True)


@pytest.mark.parametrize("target", ["contact_graspnet", "graspnet_scene"])
def test_samples_that_do_not_fit_are_left_out_with_what_goes_with_them(tmp_path, target):
    source = captures(4)
    source.samples["f1"] = cloud()  # no image
    scenes = target == "graspnet_scene"
    options = {"any_size": True, "frames_per_scene": 2, "label_offset": 1} if scenes else {}
    with pytest.raises(TypeError, match="sample 'f1'") as caught:
        export_dataset(source, target, tmp_path / "out", **options)
    assert any("all others fit; leave out what does not fit with --skip-bad" in note for note in caught.value.__notes__)
    report = export_dataset(source, target, tmp_path / "out", skip_bad=True, **options)
    assert report.left_out.keys() == ({"f0", "f1"} if scenes else {"f1"})
    assert report.written == 4 - len(report.left_out)
    again = export_dataset(captures(4), "contact_graspnet", tmp_path / "all", skip_bad=True)
    assert (again.written, again.left_out) == (4, {})
    source.samples |= dict.fromkeys(source.ids, cloud())
    with pytest.raises(CaptureError, match=r"all 4 samples are left out.*'f0': DTypeError"):
        export_dataset(source, target, tmp_path / "none", skip_bad=True, **options)
    assert not (tmp_path / "none").exists()


def test_the_command_tells_what_it_leaves_out(capsys, tmp_path):
    for number, one in enumerate([frame(), frame(seed=1, labels=torch.zeros(1, 12, 16, dtype=torch.int64))]):
        write_capture(one, tmp_path / str(number))
    options = ["--to", "contact_graspnet", "--out", tmp_path / "out"]
    code, _, err = run(capsys, tmp_path / "*" / "view0", *options)
    assert code == 1
    assert "objects must have the numbers 1" in err
    assert "all others fit; leave out what does not fit with --skip-bad" in err
    code, out, _ = run(capsys, tmp_path / "*" / "view0", *options, "--skip-bad")
    assert code == 0
    assert "1 sample written" in out
    assert "1 sample left out: 1 CaptureError" in out
    record = json.loads((tmp_path / "out" / FILE_NAME).read_text())
    assert len(record["left_out"]) == 1


def test_the_command_says_what_is_wrong_with_the_request(capsys, capture_folder, tmp_path):
    for options, message in [
        (["--to", "dp2"], "did you mean 'dp3'"),
        (["--to", "dp3", "--set", "episodes"], "must be NAME=VALUE"),
        (["--to", "dp3", "--set", "frame=a", "--set", "frame=b"], "set twice"),
        (["--to", "dp3", "--set", "frames=a"], "did you mean 'frame'"),
        (["--to", "dp3"], "the option episodes"),
    ]:
        code, _, err = run(capsys, capture_folder, *options, "--out", tmp_path / "out")
        assert (code, message in err) == (2, True), err
    assert not (tmp_path / "out").exists()
