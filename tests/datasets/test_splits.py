"""Splits: whole groups, like shares of every stratum, and nothing ever moves."""

from __future__ import annotations

import json
from collections import Counter

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pcdata import CachedCloudDataset, Episode, EpisodeWindows, PointCloud, export_dataset, split_dataset
from pcdata.build import build_dataset, config_from_yaml
from pcdata.datasets.split_dataset import added
from pcdata.datasets.split_drawing import draw_parts
from pcdata.datasets.split_groups import SampleFacts
from pcdata.datasets.splits import FILE_NAME, Splits
from pcdata.errors import CacheError, ConfigError
from pcdata.io.store.manifest import checksum_of

SHARES = {"train": 0.8, "val": 0.1, "test": 0.1}


class Named:
    """Clouds by name, the same for the same name."""

    name = "named"
    kind = "clouds"

    def __init__(self, ids, episodes=()) -> None:
        self.ids, self.episodes = list(ids), list(episodes)

    def __len__(self) -> int:
        return len(self.ids)

    def load(self, sample_id):
        number = sum(sample_id.encode())
        points = torch.rand(64, 3, generator=torch.Generator().manual_seed(number))
        cloud = PointCloud(points=points, ptr=torch.tensor([0, 64]), frame_id="base")
        return cloud.with_signal("number", torch.tensor([[number]]), "invariant")


def built(folder, ids, episodes=(), **options):
    form = options.pop("form", "npz")
    build_dataset(config_from_yaml(f"output: {{format: {form}}}"), Named(ids, episodes), folder, **options)
    return folder


def facts(ids, episodes=(), table=None) -> SampleFacts:
    return SampleFacts("data", ids, episodes, table)


# -- the draw ------------------------------------------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(0, 3), min_size=3, max_size=60), st.integers(0, 9))
def test_every_stratum_is_shared_out_as_the_whole_is(strata, seed):
    groups = {f"g{number}": str(stratum) for number, stratum in enumerate(strata)}
    parts = draw_parts("test", groups, {"a": 0.5, "b": 0.5}, seed)
    assert parts.keys() == groups.keys()
    for stratum in [None, *set(groups.values())]:
        own = [parts[group] for group in groups if stratum in (None, groups[group])]
        assert abs(own.count("a") - len(own) / 2) <= 1


@settings(max_examples=30, deadline=None)
@given(st.integers(3, 40), st.lists(st.integers(1, 10), max_size=4), st.integers(0, 9))
def test_what_is_added_moves_nothing_and_brings_the_shares_back(first, more, seed):
    """As builds do that grow: the parts before are kept, and the whole stays within a group of its shares."""
    kept: dict[str, str] = {}
    total = first
    for number in [0, *more]:
        total += number
        kept_before = dict(kept)
        kept = draw_parts("test", {f"g{n}": str(n % 3) for n in range(total)}, SHARES, seed, kept=kept)
        assert kept_before.items() <= kept.items()
    counts = Counter(kept.values())
    assert all(abs(counts[part] - max(1, share * total)) <= 2 for part, share in SHARES.items())


def test_parts_depend_on_names_and_seed_and_not_on_the_order():
    names = [f"scene_{number}" for number in range(40)]
    parts = draw_parts("test", dict.fromkeys(names, ""), SHARES, 1)
    assert parts == draw_parts("test", dict.fromkeys(reversed(names), ""), SHARES, 1)
    assert parts != draw_parts("test", dict.fromkeys(names, ""), SHARES, 2)
    one_more = draw_parts("test", dict.fromkeys([*names, "new"], ""), SHARES, 1)
    assert sum(one_more[name] != parts[name] for name in names) <= 2


# -- what stays together -------------------------------------------------------------------------------------------


def test_groups_follow_from_folders_patterns_columns_and_episodes():
    ids = ["s1/a", "s1/b", "s2/a"]
    known = facts(ids, [Episode("e", 0, 2)], {one: {"day": n // 2} for n, one in enumerate(ids)})
    assert known.values("folder") == ["s1", "s1", "s2"]
    assert known.values("id:/(.)") == ["a", "b", "a"]
    assert known.values("column:day") == ["0", "0", "1"]
    assert known.values("episode") == ["e", "e", "s2/a"]
    assert known.default_rule() == "episode"
    assert facts(["a", "b"]).default_rule() == "sample"


@pytest.mark.parametrize(
    ("rule", "told"),
    [
        ("scene", "no rule that groups samples"),
        ("id:(", "no regular expression"),
        ("id:^s", "1 of 3 do not match"),
        ("folder", r"1 of 3 have no /"),
        ("episode", "has no episodes"),
        ("column:day", "needs a table"),
        ("id:x*", "3 of 3 match it with nothing"),
    ],
)
def test_rules_that_leave_samples_without_a_group_are_refused(rule, told):
    with pytest.raises(ConfigError, match=told):
        facts(["s1/a", "s1/b", "c"]).values(rule)


def test_ids_that_could_be_frames_of_a_scene_must_be_told_apart():
    with pytest.raises(ConfigError, match="--by folder"):
        added(facts(["s1/a", "s1/b", "s2/a"]), None, {})


def test_a_recorded_episode_is_never_in_two_splits():
    ids = [f"f{number}" for number in range(20)]
    known = facts(ids, [Episode("e", 0, 20)])
    with pytest.raises(ConfigError, match="episode 'e' would be in"):
        added(known, None, {"by": "sample"})


def test_a_number_with_many_values_is_shared_out_by_quarters():
    ids = [f"f{number:03}" for number in range(80)]
    known = facts(ids, table={one: {"objects": place} for place, one in enumerate(ids)})
    splits = added(known, None, {"parts": {"a": 0.5, "b": 0.5}, "stratify": ["column:objects"]})
    places = [ids.index(one) for one in splits.ids("a")]
    assert [sum(low <= place < low + 20 for place in places) for low in (0, 20, 40, 60)] == [10] * 4


@pytest.mark.parametrize("suffix", ["csv", "json"])
def test_a_table_names_the_splits(tmp_path, suffix):
    table = tmp_path / f"table.{suffix}"
    rows = {"a": {"split": "train"}, "b": {"split": "test"}}
    text = "sample,split\na,train\nb,test\n"
    table.write_text(text if suffix == "csv" else json.dumps(rows))
    splits = added(facts(["a", "b"], table=table), None, {"named_by": "column:split"})
    assert splits.groups == {"train": {"a": ["a"]}, "test": {"b": ["b"]}}


def test_graspnets_scenes_are_split_as_its_own_loader_splits_them():
    scenes = (0, 99, 100, 129, 130, 159, 160, 189)
    ids = [f"scene_{number:04d}/realsense/{frame:04d}" for number in scenes for frame in (0, 1)]
    splits = added(facts(ids), None, {"named_by": "graspnet"})
    found = {name: sorted({int(one[6:10]) for one in splits.ids(name)}) for name in splits.names}
    assert found == {"train": [0, 99], "test_seen": [100, 129], "test_similar": [130, 159], "test_novel": [160, 189]}
    with pytest.raises(ConfigError, match="must name its scene"):
        added(facts(["scene_0190/a"]), None, {"named_by": "graspnet"})


# -- the file ------------------------------------------------------------------------------------------------------


def test_a_dataset_loads_the_samples_of_one_split(tmp_path):
    ids = [f"{e}-{step}" for e in range(10) for step in range(2)]
    folder = built(tmp_path / "set", ids, [Episode(f"e{e}", 2 * e, 2) for e in range(10)])
    whole = CachedCloudDataset(folder)
    assert split_dataset(folder) == Splits.read(folder)
    seen = []
    for split in ("train", "val", "test"):
        part = CachedCloudDataset(folder, split=split)
        seen += part.ids
        assert len(part) == {"train": 16, "val": 2, "test": 2}[split]
        for place, sample_id in enumerate(part.ids):
            same = whole[whole.ids.index(sample_id)]
            assert torch.equal(part[place].points, same.points)
            assert torch.equal(part.signal_table()["number"].values[place], same.recorded_signals["number"].values[0])
        assert part.__getitems__([0, 1])[1].points.equal(part[1].points)
        windows = EpisodeWindows(part, 1, 2, actions=())
        assert {one.id for one in windows.episodes} == {f"e{one[0]}" for one in part.ids}
    assert sorted(seen) == sorted(ids)
    with pytest.raises(ConfigError, match="no split 'trian'; did you mean 'train'"):
        CachedCloudDataset(folder, split="trian")


def test_a_later_build_moves_no_scene(tmp_path):
    folder = built(tmp_path / "set", [f"a{number}" for number in range(12)])
    first = split_dataset(folder, seed=3).part_of()
    built(folder, [f"a{number}" for number in range(2, 30)], overwrite=True)
    second = split_dataset(folder)
    assert first.items() <= second.part_of().items()
    assert sorted(second.absent) == ["a0", "a1"]
    assert "a0" not in {one for split in second.names for one in CachedCloudDataset(folder, split=split).ids}
    built(folder, [f"a{number}" for number in range(12)], overwrite=True)
    assert {one: split for one, split in split_dataset(folder).part_of().items() if one in first} == first
    assert not {f"a{number}" for number in range(12)} & {*Splits.read(folder).absent}


def test_new_samples_wait_for_a_split_and_other_rules_for_a_fresh_draw(tmp_path):
    ids = [f"a{number}" for number in range(10)]
    folder = built(tmp_path / "set", ids)
    split_dataset(folder, path=tmp_path / "mine.json")
    built(folder, [*ids, "new"], overwrite=True)
    with pytest.raises(CacheError, match="sample 'new' of the dataset is in no split; 'pcdata split DATASET' adds"):
        CachedCloudDataset(folder, split="train", splits=tmp_path / "mine.json")
    with pytest.raises(ConfigError, match="the file says seed 0, and 1 was given"):
        split_dataset(folder, seed=1, path=tmp_path / "mine.json")
    with pytest.raises(CacheError, match="there are no splits; draw them with 'pcdata split"):
        CachedCloudDataset(folder, split="train")
    fresh = split_dataset(folder, {"train": None, "val": 3}, seed=1, path=tmp_path / "mine.json", fresh=True)
    assert len(fresh.ids("val")) == 3


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda c: c["splits"]["train"]["a"].append("b"), "checksum"),
        (lambda c: c["splits"]["test"].update({"x": ["a"]}), "'a' comes twice"),
        (lambda c: c["splits"]["test"].update({"a": ["x"]}), "group 'a' comes twice"),
        (lambda c: c["splits"]["test"].update({"x": ["x"]}), "'x' is not of the dataset"),
        (lambda c: c["absent"].append("x"), "'x' called absent had no split"),
        (lambda c: c.update(schema="pcdata.splits/9"), "schema"),
        (lambda c: c.update(splits=["a"]), "must map names"),
        (lambda c: c["splits"]["train"].update({"a": "a"}), "must map names"),
        (lambda c: c.pop("settings"), "must have schema, settings"),
    ],
)
def test_files_that_do_not_say_one_thing_are_refused(tmp_path, change, told):
    added(facts(["a", "b"]), None, {"parts": {"train": 1, "test": 1}}).write(tmp_path / FILE_NAME)
    content = json.loads((tmp_path / FILE_NAME).read_text())
    del content["checksum"]
    content["splits"] = {"train": {"a": ["a"]}, "test": {"b": ["b"]}}
    if told != "checksum":
        change(content)
        content["checksum"] = checksum_of(content)
    else:
        content["checksum"] = checksum_of(content)
        change(content)
    (tmp_path / FILE_NAME).write_text(json.dumps(content))
    with pytest.raises(CacheError, match=told):
        Splits.read(tmp_path, ["a", "b"])


def test_a_file_that_is_no_json_is_refused_with_its_name(tmp_path):
    (tmp_path / FILE_NAME).write_text("{")
    with pytest.raises(CacheError, match=r"splits\.json: .*not valid JSON"):
        Splits.read(tmp_path)


# -- exports -------------------------------------------------------------------------------------------------------


def test_exports_take_the_splits_of_the_dataset(tmp_path):
    folder = built(tmp_path / "set", [f"a{number}" for number in range(10)])
    splits = split_dataset(folder)
    export_dataset(folder, "pointcept", tmp_path / "out")
    for split in splits.names:
        assert sorted(path.name for path in (tmp_path / "out" / split).iterdir()) == sorted(splits.ids(split))
    export_dataset(CachedCloudDataset(folder, split="val"), "pointcept", tmp_path / "val")
    assert [path.name for path in (tmp_path / "val" / "val").iterdir()] == splits.ids("val")
