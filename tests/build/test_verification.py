"""pcdata verify: every damaged, missing or foreign file of a dataset is named, with the samples that it spoils."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch

from pcdata import PointCloud
from pcdata.build import build_dataset, config_from_yaml, verify_dataset, written_texts
from pcdata.build.written_texts import write_texts
from pcdata.cli.main import main
from pcdata.errors import CacheError, ConfigError
from pcdata.io.store.stores import STORES
from tests.build.test_builder import Clouds
from tests.io.forged import first_shard

FORMATS = list(STORES)


@pytest.fixture(scope="module")
def datasets(tmp_path_factory) -> dict[str, Path]:
    """Five clouds in three shards, in every format."""
    root, draw = tmp_path_factory.mktemp("verified"), torch.Generator().manual_seed(0)
    clouds = {f"s{n}": PointCloud(points=torch.rand(40, 3, generator=draw), frame_id="base") for n in range(5)}
    for form in FORMATS:
        config = config_from_yaml(f"cloud: [Center]\noutput: {{format: {form}, shard_size: 2}}\n")
        build_dataset(config, Clouds(clouds), root / form)
    return {form: root / form for form in FORMATS}


def flip(path: Path, place: int = -1) -> None:
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.write_bytes(content)


def faults(folder: Path, **options) -> list[tuple]:
    return [(fault.path, fault.kind, fault.samples) for fault in verify_dataset(folder, **options).faults]


@pytest.mark.parametrize("form", FORMATS)
def test_a_dataset_as_it_was_built_has_no_fault(datasets, form):
    told = []
    verdict = verify_dataset(datasets[form], workers=2, progress=lambda *each: told.append(each[:2]))
    assert (verdict.faults, verdict.num_files) == ([], 5 if form in ("npz", "pt") else 3)
    files = [path for path in datasets[form].glob("shards/**/*") if path.is_file() and path.suffix != ".tsv"]
    assert verdict.num_bytes == sum(path.stat().st_size for path in files)
    assert told == [(1, 3), (2, 3), (3, 3)]


@pytest.mark.parametrize("form", FORMATS)
def test_a_damaged_or_missing_file_is_named_with_its_samples_alone(datasets, tmp_path, form):
    folder = tmp_path / "set"
    shutil.copytree(datasets[form], folder)
    path = STORES[form](first_shard(folder)).path_of("s1")
    content = path.read_bytes()
    points = STORES[form](first_shard(folder)).read("s1").arrays["points"].tobytes()
    name = path.relative_to(folder).as_posix()
    flip(path, content.index(points) + 100)
    assert faults(folder) == [(name, "damaged", ("s1",))]
    path.write_bytes(content[:-50])
    ((_, kind, samples),) = faults(folder)
    assert kind == "damaged"
    assert "s1" in samples
    path.unlink()
    both = ("s1",) if form in ("npz", "pt") else ("s0", "s1")
    assert faults(folder) == [(name, "missing", both)]
    path.write_bytes(content)
    assert faults(folder) == []


def test_whatever_else_a_dataset_is_made_of_is_compared(datasets, tmp_path):
    for number, name in enumerate(["dataset.json", "index/ids.npy", "index/digests.npy", "shards/00001/files.tsv"]):
        folder = tmp_path / str(number)
        shutil.copytree(datasets["packed"], folder)
        flip(folder / name, -4)
        ((path, kind, samples),) = faults(folder)
        assert (path, kind, samples) == (name, "damaged", ())
        (folder / name).unlink()
        if name == "dataset.json":
            with pytest.raises(CacheError, match="not a pcdata dataset"):
                verify_dataset(folder)
        else:
            assert faults(folder)[0][0] == name


@pytest.mark.parametrize("place", [".", "index", "shards", "shards/00001", "shards/00001/raw/s2/view0"])
def test_what_no_build_wrote_is_foreign(datasets, tmp_path, place):
    shutil.copytree(datasets["packed"], tmp_path / "set")
    (tmp_path / "set" / place).mkdir(parents=True, exist_ok=True)
    (tmp_path / "set" / place / "intrinsics.json").write_text("{}")
    found = {path for path, kind, samples in faults(tmp_path / "set") if kind == "foreign" and not samples}
    assert any((Path(place) / "intrinsics.json").is_relative_to(path) for path in found)
    assert len(found) == 1


def test_a_link_in_place_of_a_file_is_damage(datasets, tmp_path):
    shutil.copytree(datasets["packed"], tmp_path / "set")
    path = first_shard(tmp_path / "set") / "clouds.packed"
    path.rename(tmp_path / "elsewhere")
    path.symlink_to(tmp_path / "elsewhere")
    verdict = verify_dataset(tmp_path / "set")
    assert {(fault.path, fault.kind) for fault in verdict.faults} >= {("shards/00000/clouds.packed", "damaged")}


def test_the_command_names_what_is_wrong_and_exits_with_1(datasets, tmp_path, capsys):
    assert main(["verify", str(datasets["npz"])]) == 0
    assert "all are what was written" in capsys.readouterr().out
    shutil.copytree(datasets["npz"], tmp_path / "set")
    flip(first_shard(tmp_path / "set") / "clouds" / "s1.npz")
    assert main(["verify", str(tmp_path / "set"), "--workers", "2"]) == 1
    out = capsys.readouterr().out
    assert "shards/00000/clouds/s1.npz" in out
    assert "which spoils 1 sample" in out
    assert main(["verify", str(tmp_path)]) == 1
    with pytest.raises(ConfigError, match="workers must be 1 or more"):
        verify_dataset(tmp_path / "set", workers=0)


def test_splits_that_were_changed_are_damage_and_a_card_edited_by_hand_is_a_note(datasets, tmp_path, capsys):
    folder = tmp_path / "set"
    shutil.copytree(datasets["packed"], folder)
    assert main(["split", str(folder), "--no-check"]) == 0
    assert "| train |" in (folder / "README.md").read_text()
    verdict = verify_dataset(folder)
    assert (verdict.faults, verdict.notes) == ([], [])
    text = (folder / "splits.json").read_text()
    (folder / "splits.json").write_text(text.replace('"s1"', '"s9"'))
    assert [one[:2] for one in faults(folder)] == [("splits.json", "damaged")]
    (folder / "splits.json").unlink()
    assert verify_dataset(folder).notes == [
        "the card tells of other splits than splits.json; 'pcdata card DATASET' writes it anew"
    ]
    (folder / "splits.json").write_text(text)
    with open(folder / "README.md", "a") as file:
        file.write("\nThe left camera was replaced in May.\n")
    (folder / "load.py").unlink()
    (folder / "card.yaml").write_text("lisense: mit")
    verdict = verify_dataset(folder)
    assert verdict.notes == ["README.md was edited by hand"]
    assert [(one.path, one.kind) for one in verdict.faults] == [("card.yaml", "damaged"), ("load.py", "missing")]
    (folder / "texts.sha256").write_text("no hash")
    assert ("texts.sha256", "damaged", ()) in faults(folder)
    (folder / "texts.sha256").unlink()
    assert ("texts.sha256", "missing", ()) in faults(folder)


def test_what_was_edited_by_hand_is_replaced_only_where_that_is_allowed(datasets, tmp_path, capsys):
    folder = tmp_path / "set"
    shutil.copytree(datasets["packed"], folder)
    written = (folder / "README.md").read_text()
    (folder / "README.md").write_text(f"{written}\nThe left camera was replaced in May.\n")
    assert main(["card", str(folder)]) == 2
    assert "README.md of" in (told := capsys.readouterr().err)
    assert "--overwrite" in told
    assert main(["split", str(folder), "--no-check"]) == 0
    assert "the card does not tell of these splits" in capsys.readouterr().out
    config = config_from_yaml("cloud: [Center]")
    with pytest.raises(CacheError, match=r"also holds README.md \(edited by hand\)"):
        build_dataset(
            config, Clouds({"a": PointCloud(points=torch.rand(9, 3), frame_id="base")}), folder, overwrite=True
        )
    assert "replaced in May" in (folder / "README.md").read_text()
    assert main(["card", str(folder), "--overwrite"]) == 0
    assert "replaced in May" not in (folder / "README.md").read_text()
    assert verify_dataset(folder).notes == []


def test_a_writer_killed_at_any_moment_leaves_no_edit(tmp_path, monkeypatch):
    write_texts(tmp_path, {"README.md": "old", "croissant.json": "old", "load.py": "old"})
    steps, write = [], written_texts._write
    for last in range(4):
        steps.clear()

        def killed(*given, last=last):
            steps.append(given[1])
            if len(steps) > last:
                raise KeyboardInterrupt
            write(*given)

        monkeypatch.setattr(written_texts, "_write", killed)
        with pytest.raises(KeyboardInterrupt):
            write_texts(tmp_path, {"README.md": f"new {last}", "croissant.json": f"new {last}"})
        assert written_texts.edited_texts(tmp_path) == []
    assert steps == ["texts.sha256", "README.md", "croissant.json", "texts.sha256"]
