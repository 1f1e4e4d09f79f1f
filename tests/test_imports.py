"""Files of one's own: run because somebody names them, once, in every process; never because a file says so."""

from __future__ import annotations

import json
import os
import pickle
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from torch.utils.data import DataLoader

import pcdata
from pcdata import imports
from pcdata.build import build_dataset, config_from_yaml
from pcdata.cli.main import main
from pcdata.errors import CacheError, ConfigError, PcdataWarning
from pcdata.io.sources.registry import LAYOUTS
from pcdata.io.store.manifest import FILE_NAME, Manifest, checksum_of
from pcdata.synthetic import SyntheticSource
from pcdata.transforms.base import REGISTRY
from tests.io.forged import first_shard
from tests.warm import run_script

ROOT = Path(__file__).parents[1]

STEP = """
import torch
from pcdata import Transform

class OwnThird(Transform):
    n: int = 3

    def transform(self, cloud, params):
        index = torch.arange(0, cloud.num_points, self.n)
        return cloud.select(index, torch.tensor([0, len(index)]))
"""
RANDOM = STEP.replace("class OwnThird(Transform):", "class OwnThird(Transform):\n    is_random = True")
READER = """
from pcdata import register_layout
from pcdata.io.sources.folder import FolderSource

@register_layout
class OwnFolder(FolderSource):
    kind, needs = "own_folder", "OWN and what a folder needs"

    def __init__(self, path, *, shade=0, **options):
        self.shade = shade
        super().__init__(path, **options)

    @classmethod
    def recognizes(cls, path):
        return (path / "OWN").exists()
"""


@pytest.fixture(autouse=True)
def _clean() -> Iterator[None]:
    """Forget the files of a test after it."""
    before = dict(imports._FILES)
    yield
    for digest in [digest for digest in imports._FILES if digest not in before]:
        del imports._FILES[digest]
        imports._forget(f"_pcdata_import_{digest[:16]}")


@pytest.fixture
def step(tmp_path: Path) -> Path:
    return written(tmp_path / "my_steps.py", STEP)


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def built(tmp_path: Path, step: Path, text: str = STEP) -> Path:
    pcdata.import_file(written(step, text))
    pipeline = "depth: [Deproject]\ncloud: [ToFrame: {frame: base}, MergeViews, OwnThird]\nloader: {num_workers: 1}\n"
    build_dataset(config_from_yaml(pipeline), SyntheticSource(num_scenes=2, size=(24, 32)), tmp_path / "dataset")
    return tmp_path / "dataset"


def forget() -> None:
    for digest in list(imports._FILES):
        del imports._FILES[digest]
        imports._forget(f"_pcdata_import_{digest[:16]}")


def test_a_file_is_run_once_under_a_private_name(tmp_path, step):
    count = written(
        tmp_path / "count.py", "import builtins\nbuiltins.own_runs = getattr(builtins, 'own_runs', 0) + 1\n"
    )
    for path in (count, str(count), written(tmp_path / "copy.py", count.read_text())):
        pcdata.import_file(path)
    import builtins

    assert builtins.__dict__.pop("own_runs") == 1
    before = list(sys.path)
    found = pcdata.import_file(step)
    assert (found.name, found.transforms, found.layouts) == ("my_steps.py", ("OwnThird",), ())
    assert REGISTRY["OwnThird"].__module__ == f"_pcdata_import_{found.sha256[:16]}"
    assert sys.path == before
    assert "my_steps" not in sys.modules


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = 1\nraise ValueError('broken')\n", r"my\.py:2: it cannot be run: ValueError: broken"),
        ("def f():\n    return 1 / 0\n\nf()\n", r"my\.py:2: it cannot be run: ZeroDivisionError"),
        ("x = (\n", r"my\.py:1: it cannot be run: SyntaxError"),
        ("raise SystemExit(0)\n", "it cannot be run: SystemExit: 0"),
        ("import nothing_of_this_name\n", "ModuleNotFoundError"),
        ("x = '\0'\n", "it cannot be run"),
        ("from pcdata import Transform\nclass Center(Transform): pass\n", "called Center is registered already"),
        (READER.replace("own_folder", "rig"), "a layout called rig is registered already"),
        (
            "import pcdata\nfrom pcdata.io import Source\n@pcdata.register_layout\nclass A(Source): kind = 'a'\n",
            "A does not say _load, files, recognizes",
        ),
        ("import pcdata\npcdata.register_layout(3)\n", "must be a subclass of pcdata.io.Source, got 3"),
        (READER.replace('"own_folder"', "7"), "OwnFolder.kind must be a text"),
    ],
)
def test_a_file_that_cannot_be_run_is_a_typed_error_and_leaves_nothing(capsys, tmp_path, text, message):
    known = dict(REGISTRY), dict(LAYOUTS), set(sys.modules)
    path = written(tmp_path / "my.py", text)
    with pytest.raises(ConfigError, match=message):
        pcdata.import_file(path)
    assert main(["inspect", str(tmp_path), "--import", str(path)]) == 2
    assert capsys.readouterr().err.startswith("pcdata: import ")
    assert (dict(REGISTRY), dict(LAYOUTS)) == known[:2]
    assert not [name for name in set(sys.modules) - known[2] if name.startswith("_pcdata")]


def test_what_fails_after_its_classes_were_made_leaves_none_of_them(tmp_path):
    for text, registry, name in ((STEP, REGISTRY, "OwnThird"), (READER, LAYOUTS, "own_folder")):
        with pytest.raises(ConfigError, match="late"):
            pcdata.import_file(written(tmp_path / "late.py", f"{text}\nraise RuntimeError('late')\n"))
        assert name not in registry
        pcdata.import_file(written(tmp_path / "late.py", text))
        assert name in registry


def test_only_a_regular_file_is_run(capsys, tmp_path):
    os.mkfifo(tmp_path / "fifo.py")
    for name in ("missing.py", ".", "fifo.py"):
        with pytest.raises(ConfigError, match=r"import: .*"):
            pcdata.import_file(tmp_path / name)
        assert main(["doctor"]) == 0
        for command in (
            ["build", "c.yaml", "--out", "d"],
            ["inspect", "x"],
            ["validate", "x"],
            ["calib", "check", "x"],
        ):
            assert main([*command, "--import", str(tmp_path / name)]) == 2
        for command in (["check", "x", "--model", "dp3_sim"], ["export", "x", "--to", "dp3", "--out", "y"]):
            assert main([*command, "--import", str(tmp_path / name)]) == 2
        assert capsys.readouterr().err.count("pcdata: import: ") == 6


def test_a_dataset_remembers_name_and_hash_of_the_files_that_it_needs(tmp_path, step):
    pcdata.import_file(written(tmp_path / "other.py", STEP.replace("OwnThird", "OwnOther")))
    dataset = built(tmp_path, step)
    (one,) = Manifest.read(dataset).imports
    assert one == {
        "file": "my_steps.py",
        "sha256": imports.hashlib.sha256(STEP.encode()).hexdigest(),
        "transforms": ["OwnThird"],
        "layouts": [],
        "combinators": [],
    }
    assert str(tmp_path) not in (dataset / FILE_NAME).read_text() + (dataset / "load.py").read_text()


def test_a_dataset_with_steps_of_its_own_says_which_file_it_needs(capsys, tmp_path, step):
    dataset = built(tmp_path, step)
    forget()
    with pytest.raises(
        CacheError, match=r"unknown transform 'OwnThird'.* steps from my_steps\.py \(sha256 [0-9a-f]{12}"
    ):
        pcdata.CachedCloudDataset(dataset)
    for command in (["inspect", str(dataset)], ["check", str(dataset), "--model", "pointcept"]):
        assert main(command) == 1
        assert "--import FILE.py" in capsys.readouterr().err
        assert main([*command, "--import", str(step)]) in (0, 1)
        told = capsys.readouterr()
        assert not told.err
        assert "my_steps.py" in told.out or command[0] == "check"
        forget()


def test_a_configuration_with_an_unknown_step_or_layout_points_to_import(capsys, tmp_path):
    config = written(tmp_path / "c.yaml", "cloud: [OwnThird]\n")
    assert main(["build", str(config), "--out", str(tmp_path / "d")]) == 2
    assert "unknown transform 'OwnThird'" in (told := capsys.readouterr().err)
    assert "--import FILE.py" in told
    assert main(["inspect", str(tmp_path), "--kind", "own_folder"]) == 2
    assert "--import FILE.py" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["import: [my.py]\n", "imports: my.py\n", "source: {import: my.py}\n"])
def test_no_configuration_can_name_a_file_to_run(tmp_path, text):
    written(tmp_path / "my.py", "raise SystemExit('was run')\n")
    with pytest.raises(ConfigError, match=r"unknown section|no such setting"):
        pcdata.load_config(written(tmp_path / "c.yaml", text))


@pytest.mark.parametrize("wrong", [3, ["a.py"], [{"file": "a.py"}], [{"file": 1, "sha256": "", "transforms": []}], {}])
def test_a_damaged_list_of_files_is_told(tmp_path, step, wrong):
    path = built(tmp_path, step) / FILE_NAME
    content = {**json.loads(path.read_text()), "imports": wrong}
    del content["checksum"]
    path.write_text(json.dumps({**content, "checksum": checksum_of(content)}))
    with pytest.raises(CacheError, match="imports must list files"):
        Manifest.read(path.parent)


def test_another_file_than_that_of_the_build_is_told(tmp_path, step):
    dataset = built(tmp_path, step)
    pcdata.CachedCloudDataset(dataset)  # the same file: no word
    forget()
    pcdata.import_file(written(step, STEP + "# changed\n"))
    with pytest.warns(PcdataWarning, match=r"built with another my_steps\.py \(sha256 .* is imported"):
        pcdata.CachedCloudDataset(dataset)


def test_a_pickled_dataset_brings_its_steps_along(tmp_path, step):
    dataset = pcdata.CachedCloudDataset(built(tmp_path, step, RANDOM))
    wanted = dataset[0].num_points
    kept = pickle.dumps(dataset)
    step.unlink()
    forget()
    assert "OwnThird" not in REGISTRY
    assert pickle.loads(kept)[0].num_points == wanted
    assert "OwnThird" in REGISTRY


@pytest.mark.slow
def test_workers_that_are_spawned_know_steps_and_readers(tmp_path):
    pcdata.import_file(written(tmp_path / "my.py", STEP + READER))
    folder = tmp_path / "captures"
    make_captures(folder)
    source = pcdata.open_source(folder, kind="own_folder", shade=2)
    chain = config_from_yaml("depth: [Deproject]\ncloud: [OwnThird]\n").pipeline
    dataset = pcdata.CloudDataset(source, chain)
    loader = DataLoader(dataset, num_workers=1, multiprocessing_context="spawn", collate_fn=list)
    assert [batch[0].num_points for batch in loader] == [len(dataset[0].points)] * 2


def make_captures(folder: Path) -> None:
    from pcdata.io import CaptureCamera, write_capture_camera, write_depth

    (folder / "depth").mkdir(parents=True)
    frame = pcdata.synthetic.tabletop(seed=0, size=(24, 32)).frame
    for number in range(2):
        write_depth(folder / f"depth/{number}.png", frame.depth[0], metres_per_unit=0.001, round_to_unit=True)
    write_capture_camera(folder / "intrinsics.json", CaptureCamera(camera=frame.camera, metres_per_unit=0.001))


def test_a_layout_of_ones_own_serves_every_command(capsys, tmp_path):
    reader = written(tmp_path / "reader.py", READER)
    make_captures(tmp_path / "captures")
    own = ["--import", str(reader), "--kind", "own_folder", "--option", "shade=2"]
    assert main(["inspect", str(tmp_path / "captures"), *own]) == 0
    assert "own_folder" in capsys.readouterr().out
    assert main(["inspect", str(tmp_path / "captures"), *own[:-1], "shadow=2"]) == 2
    assert "has no option 'shadow'; did you mean 'shade'?" in capsys.readouterr().err
    config = written(tmp_path / "c.yaml", "depth: [Deproject]\nsource: {kind: own_folder, shade: 3}\n")
    words = ["build", str(config), "--source", str(tmp_path / "captures"), "--out", str(tmp_path / "d")]
    assert main([*words, "--import", str(reader)]) == 0
    (one,) = Manifest.read(tmp_path / "d").imports
    assert one["layouts"] == ["own_folder"]
    # The stored clouds need no reader.
    forget()
    assert main(["inspect", str(tmp_path / "d")]) == 0
    assert "--import" not in (tmp_path / "d" / "load.py").read_text()


OTHERS = """
from dataclasses import dataclass
from pcdata.datasets import register_collate
from pcdata.exports import Target, register_target
from pcdata.exports.target import Item
from pcdata.io import register_store
from pcdata.io.store.npz_store import NpzStore

@register_store
class OwnStore(NpzStore):
    format, suffix = "own", ".own"

@register_collate
def collate_counts(clouds):
    return [cloud.num_points for cloud in clouds]

@register_target
@dataclass(frozen=True, kw_only=True)
class OwnTarget(Target):
    name, takes, layout, model = "own_target", "clouds", "one count a file", "pointnet_cls"
    def items(self, ids):
        return [Item((one,), (f"{one}.txt",)) for one in ids]
    def write(self, item, samples, folder, note):
        for _, cloud in samples:
            (folder / item.paths[0]).write_text(str(cloud.num_points))
"""


def test_stores_collates_and_targets_of_ones_own_are_used_by_their_names(tmp_path):
    own = written(tmp_path / "others.py", OTHERS)
    text = "depth: [Deproject]\noutput: {format: own}\nloader: {collate: counts}\n"
    with pytest.raises(
        ConfigError, match=r"(?s)output.format: .*hdf5, npz, packed, pt.*--import.*loader.collate: .*packed"
    ):
        config_from_yaml(text)
    pcdata.import_file(own)
    source = SyntheticSource(num_scenes=1, num_objects=1, size=(24, 32))
    out = build_dataset(config_from_yaml(text), source, tmp_path / "d").folder
    assert [one["file"] for one in Manifest.read(out).imports] == ["others.py"]
    assert list((first_shard(out) / "clouds").glob("*.own"))
    count = pcdata.CachedCloudDataset(out)[0].num_points
    assert pcdata.export_dataset(out, "own_target", tmp_path / "e").written == 1
    assert (tmp_path / "e" / "tabletop-0000.txt").read_text() == str(count)
    script = (out / "load.py").read_text()
    assert 'collate_fn=COLLATES["counts"]' in script.replace("'", '"')
    assert "--import FILE.py, for others.py" in script
    forget()
    with pytest.raises(
        CacheError, match=r"format must be one of hdf5, npz, packed, pt, webdataset, got 'own'.*--import"
    ):
        Manifest.read(out)


@pytest.mark.slow
def test_the_script_of_a_dataset_asks_for_the_file(tmp_path, step):
    script = built(tmp_path, step, RANDOM) / "load.py"
    without = run_script(script, folder=tmp_path)
    assert without.returncode == 2
    assert "steps of its own; say where they are: --import FILE.py, for my_steps.py" in without.stderr
    done = run_script(script, "--import", str(step), folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("epoch ") == 2
