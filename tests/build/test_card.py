"""The card: filled from what happened, UNKNOWN where nobody said it, and safe whatever names say."""

from __future__ import annotations

import json
import re

import pytest
import torch
import yaml

from pcdata import PointCloud, build_dataset, split_dataset
from pcdata.build import config_from_yaml, write_card
from pcdata.build.card_text import as_markdown
from pcdata.build.origins import commonest
from pcdata.cli.main import main
from pcdata.errors import ConfigError
from pcdata.files.whole_folders import is_free
from pcdata.io.store.manifest import Manifest
from pcdata.io.store.shards import hash_of

EVIL = [
    "a|b",
    "# title",
    "[x](javascript:alert(1))",
    "<script>alert(1)</script>",
    "![i](https://evil.example/p.png)",
    "www.evil.example",
    "`code`",
    "--- ",
    "a\u202eb",
    "1. item",
    "*b* _i_ ~s~",
]
SAID = {
    "license": "cc-by-4.0",
    "sensor": "RealSense D435",
    "conditions": "daylight",
    "creator": "A lab",
    "url": "https://example.org/set",
    "date_published": "2026-01-29",
}


class Clouds:
    """Clouds with names that are no one's friends; one is refused."""

    name = kind = "clouds"

    def __init__(self, ids) -> None:
        self.ids = list(ids)

    def __len__(self) -> int:
        return len(self.ids)

    def load(self, sample_id):
        if sample_id.startswith("bad"):
            raise ConfigError(f"{EVIL[3]} is refused")
        count = 3 + self.ids.index(sample_id)
        points = torch.arange(3.0 * count).reshape(count, 3)
        return PointCloud(points=points, ptr=torch.tensor([0, count]), frame_id="base")


@pytest.fixture
def folder(tmp_path):
    build_dataset(
        config_from_yaml("cloud: [Center]\noutput: {format: npz}"), Clouds(["a", "b", "c", "d"]), tmp_path / "set"
    )
    return tmp_path / "set"


def head_of(text):
    return yaml.safe_load(re.match(r"---\n(.*?)\n---\n", text, re.DOTALL)[1])


def test_a_build_writes_a_card_of_what_happened(folder):
    text = (folder / "README.md").read_text()
    assert head_of(text) == {
        "license": "unknown",
        "pretty_name": f"Point clouds {hash_of(folder / 'dataset.json')[1][:8]}",
        "task_categories": ["robotics"],
        "size_categories": ["n<1K"],
        "tags": ["point-cloud", "depth", "robotics", "3d", "pcdata"],
    }
    assert "| Center | 4 | (empty) | 3 | 3 | 5 | 6 | 6 |" in text
    assert "| 4 | 3 | 3 | 5 | 6 | 6 | 0 |" in text
    assert "| sensor | UNKNOWN |" in text
    assert not list(folder.glob("*.tmp*"))


def test_strict_names_all_that_is_not_known_and_how_to_say_it_and_then_passes(folder, capsys):
    before = (folder / "README.md").read_bytes()
    assert main(["card", str(folder), "--strict"]) == 2
    told = capsys.readouterr().err
    assert [name for name in SAID if f"--{name.replace('_', '-')}" in told] == [*SAID]
    assert (folder / "README.md").read_bytes() == before
    words = [word for name, value in SAID.items() for word in (f"--{name.replace('_', '-')}", value)]
    assert main(["card", str(folder), "--strict", *words]) == 0
    text = (folder / "README.md").read_text()
    unknown = [line.split(" | ")[0] for line in text.splitlines() if "UNKNOWN" in line]
    assert unknown == [
        "| read as",
        "| change of depth before it was read",
    ]  # of a source in memory, which tells neither
    croissant = json.loads((folder / "croissant.json").read_text())
    assert (croissant["license"], croissant["datePublished"]) == (SAID["license"], SAID["date_published"])


def test_answers_and_the_bytes_of_a_card_outlive_a_split_and_a_build(folder):
    write_card(folder, {"license": "my own terms", "license_link": "https://example.org/terms"})
    split_dataset(folder)
    write_card(folder)
    text = (folder / "README.md").read_bytes()
    assert head_of(text.decode())["license_name"] == "my own terms"
    assert b"| train | 2 | 2 |" in text
    assert len(json.loads((folder / "croissant.json").read_text())["recordSet"]) == 1
    source, config = Clouds(["a", "b", "c", "d"]), config_from_yaml("cloud: [Center]\noutput: {format: npz}")
    build_dataset(config, source, folder, overwrite=True)
    assert (folder / "README.md").read_bytes() == text
    assert not is_free(folder)


def test_files_are_told_with_the_hashes_that_they_have(folder):
    import hashlib

    listed = json.loads((folder / "croissant.json").read_text())["distribution"]
    assert len(listed) > 10
    for one in listed:
        data = (folder / one["name"]).read_bytes()
        assert (one["sha256"], one["contentSize"]) == (hashlib.sha256(data).hexdigest(), f"{len(data)} B")


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"lisense": "mit"}, "did you mean 'license'"),
        ({"date_published": "yesterday"}, "must be a date"),
        ({"url": "javascript:alert(1)"}, "must begin with https"),
        ({"sensor": " "}, "must be a text"),
    ],
)
def test_answers_that_are_none_are_refused(folder, given, told):
    with pytest.raises(ConfigError, match=told):
        write_card(folder, given)
    (folder / "card.yaml").write_text(yaml.safe_dump(given))
    with pytest.raises(ConfigError, match=told):
        write_card(folder)


@pytest.mark.parametrize("text", EVIL)
def test_no_text_becomes_more_than_text(text):
    shown = as_markdown(text)
    assert not re.search(r"[<>|`\[\]*~!]|://|^[-#+=]|www\.|\u202e|^[0-9]+\. |\b_|_\b", re.sub(r"&#[0-9]+;", "E", shown))
    assert "\n" not in as_markdown(f"{text}\n\n{text}")


def test_names_of_samples_sensors_and_errors_cannot_write_into_the_card(tmp_path):
    ids = ["a", *(name for name in EVIL if "/" not in name and name == name.strip()), f"bad {EVIL[0]}"]
    config = config_from_yaml("output: {format: npz}")
    build_dataset(config, Clouds(ids), tmp_path / "set")
    write_card(tmp_path / "set", {"sensor": "\n---\nlicense: mit\n# x", "title": "t: {a: [1]\n---\n# <b>"})
    text = (tmp_path / "set" / "README.md").read_text()
    assert head_of(text)["license"] == "unknown"
    assert head_of(text)["pretty_name"].startswith("t: {a")
    body = text.split("\n---\n", 1)[1]
    assert "<script" not in body
    assert "<b>" not in body
    rows = [line for line in body.splitlines() if line.startswith("| bad")]
    assert len(rows) == 1
    assert rows[0].count("|") == 3


def test_sensors_that_differ_are_listed_with_the_samples_of_each(tmp_path):
    class Several(Clouds):
        def load(self, sample_id):
            cloud, place = super().load(sample_id), self.ids.index(sample_id)
            said = {"sensor": "D435", "serial": place // 3, "metres_per_unit": 0.001} if place < 5 else {}
            return cloud.with_meta([{"provenance": said}])

    config = config_from_yaml("cloud: [Center]\noutput: {format: npz, shard_size: 2}")
    build_dataset(config, Several("abcdef"), tmp_path / "set")
    text = (tmp_path / "set" / "README.md").read_text()
    told = "sensor D435, serial 0 (3 samples); sensor D435, serial 1 (2 samples); UNKNOWN (1 sample)"
    assert f"| sensor | {told} |" in text
    assert "read exactly, in the steps of 1 mm that it was stored in (5 samples); UNKNOWN (1 sample)" in text
    assert "| 6 | base/centered | m | base | none | points float32 |" in text
    assert any("sensor" in line for line in write_card(tmp_path / "set"))  # one is not known
    assert (tmp_path / "set" / "README.md").read_text() == text
    build_dataset(config, Several(f"s{n}" for n in range(60)), tmp_path / "more")
    origins = Manifest.read(tmp_path / "more").origins
    assert [one["samples"] for one in origins] == [3, 2, 55]
    kinds = commonest([{"sensor": f"{n}", "samples": 1 + (n == 7)} for n in range(60)])
    assert (kinds[7]["samples"], kinds[-1], len(kinds)) == (2, {"others": 10, "samples": 10}, 51)


@pytest.mark.filterwarnings("ignore")  # of what those packages use in turn
def test_the_card_is_read_by_mlcroissant_and_hugging_face(folder):
    mlcroissant, hub = pytest.importorskip("mlcroissant"), pytest.importorskip("huggingface_hub")
    split_dataset(folder)
    write_card(folder)
    dataset = mlcroissant.Dataset(str(folder / "croissant.json"))  # raises where there are errors
    assert dataset.metadata.name.startswith("Point-clouds-")
    found = [(one["splits/name"], one["splits/num_samples"]) for one in dataset.records("splits")]
    assert [(str(name.decode() if isinstance(name, bytes) else name), count) for name, count in found] == [
        ("train", 2),
        ("val", 1),
        ("test", 1),
    ]
    card = hub.DatasetCard.load(folder / "README.md")
    assert card.data.license == "unknown"
    assert card.data.pretty_name.startswith("Point clouds ")
