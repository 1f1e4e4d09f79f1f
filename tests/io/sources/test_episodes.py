"""Which samples of a source are an episode: said in a file, kept by every source that is made of others."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from pcdata import Episode, JoinedSource, SubsetSource, open_source
from pcdata.errors import CaptureError, DTypeError
from pcdata.io import CaptureSource, write_episodes, write_ply
from pcdata.io.sources.capture_source import episodes_of, recordings_of
from pcdata.structures import PointCloud
from pcdata.structures.episodes import checked_episodes, kept_episodes
from pcdata.synthetic import SyntheticSource
from tests.captures import CAPTURES, OPTIONS, K, depth_of, folder_capture, image, seven_scenes_capture

NAMES = [f"{number:02d}" for number in range(10)]
RECORDINGS = ("realsense_bag", "azure_kinect")  # one file each
WITH_EPISODES = ("lerobot", "robomimic", "maniskill")  # the files themselves say them
TWO = [Episode("pick", 0, 4, attributes={"task": "cup"}), Episode("place", 5, 4)]


def recorded(root: Path, episodes: list[Episode] = TWO) -> Path:
    """Ten captures of a still camera, the first four and the sixth to ninth an episode each."""
    for name in NAMES:
        image(root / "depth" / f"{name}.png", depth_of(0))
    (root / "intrinsics.json").write_text(json.dumps(K | {"metres_per_unit": 0.001}))
    (root / "timestamps.json").write_text(json.dumps({name: place / 10 for place, name in enumerate(NAMES)}))
    write_episodes(root, episodes, NAMES)
    return root


def steps(source: CaptureSource) -> dict[str, list[str]]:
    ids = source.ids
    return {one.id: [ids[place] for place in one.steps] for one in episodes_of(source)}


def test_a_folder_says_its_episodes_with_their_times(tmp_path):
    source = open_source(recorded(tmp_path))
    pick, place = source.episodes
    assert (pick.id, pick.first, pick.length, pick.attributes) == ("pick", 0, 4, {"task": "cup"})
    assert pick.times == (0.0, 0.1, 0.2, 0.3)
    assert list(place.steps) == [5, 6, 7, 8]
    assert len(source) - sum(one.length for one in source.episodes) == 2
    assert source.unread() == []


@pytest.mark.parametrize("kind", [name for name in CAPTURES if name not in (*RECORDINGS, *WITH_EPISODES)])
def test_every_layout_that_is_a_folder_reads_them(kind, tmp_path):
    said = OPTIONS.get(kind, {})
    ids = open_source(CAPTURES[kind](tmp_path / "made"), kind=kind, **said).ids
    write_episodes(tmp_path / "made", [Episode("one", 1, 1)], ids)
    source = open_source(tmp_path / "made", kind=kind, **said)
    assert steps(source) == {"one": [ids[1]]}
    assert not any("episodes.json" in line for line in source.unread())


def test_a_recording_is_one_episode_and_scenes_beside_each_other_are_none(tmp_path):
    assert steps(open_source(seven_scenes_capture(tmp_path / "seq-01"))).keys() == {"seq-01"}
    for kind in RECORDINGS:
        pytest.importorskip({"realsense_bag": "rosbags", "azure_kinect": "av"}[kind])
        source = open_source(CAPTURES[kind](tmp_path / kind), kind=kind)
        assert [one.length for one in source.episodes] == [len(source)]
    assert episodes_of(open_source(folder_capture(tmp_path / "scenes"))) == []
    assert episodes_of(SyntheticSource(num_scenes=2)) == []


def test_what_remains_of_an_episode_is_cut_where_steps_were_left_out(tmp_path):
    source = open_source(recorded(tmp_path), skip=["06"])
    assert steps(source) == {"pick": NAMES[:4], "place~0": ["05"], "place~1": ["07", "08"]}
    assert [one.whole for one in source.episodes] == ["pick", "place", "place"]
    assert source.episodes[2].times == (0.7, 0.8)
    again = source.without(["02"])
    assert [one.whole for one in again.episodes] == ["pick", "pick", "place", "place"]


def test_a_part_of_a_part_still_belongs_to_the_whole():
    once = kept_episodes([Episode("a", 0, 9)], [0, 1, 2, 4, 5, 6, 8])
    twice = kept_episodes(once, [0, 2, 3, 4, 5, 6])
    assert {one.whole for one in twice} == {"a"}
    assert len({one.id for one in twice}) == len(twice)


def test_a_subset_at_one_distance_is_the_same_episodes_at_another_rate(tmp_path):
    source = open_source(recorded(tmp_path, [Episode("all", 0, 10)]))
    half = SubsetSource(source, NAMES[::2])
    assert steps(half) == {"all": NAMES[::2]}
    assert half.episodes[0].times == (0.0, 0.2, 0.4, 0.6, 0.8)


def test_joined_sources_keep_theirs(tmp_path):
    source = open_source(recorded(tmp_path))
    joined = JoinedSource({"a": source.without(["06"]), "b": SyntheticSource(num_scenes=3), "c": source})
    found = steps(joined)
    assert [*found] == ["a/pick", "a/place~0", "a/place~1", "c/pick", "c/place"]
    assert found["c/place"] == ["c/05", "c/06", "c/07", "c/08"]
    assert joined.episodes[1].whole == "a/place"


def test_averages_and_filters_keep_within_an_episode(tmp_path):
    source = open_source(recorded(tmp_path)).without(["04", "09"])
    averaged = open_source(tmp_path, skip=["04", "09"], averaged={"num_frames": 2, "min_count": 1})
    assert steps(averaged) == {"pick": ["00", "02"], "place": ["05", "07"]}
    assert recordings_of(source) == [NAMES[:4], NAMES[5:9]]
    filtered = open_source(tmp_path, temporal=3)
    assert steps(filtered) == {"pick": NAMES[:4], "place": NAMES[5:9]}
    assert [own for _, own in filtered.made_of("06")] == ["05", "06"]


WRONG: dict[str, tuple[Any, str]] = {
    "no list": ({"episodes": {}}, "must be"),
    "another key": ({"episodes": [], "version": 1}, "must be"),
    "a text": ({"episodes": ["pick"]}, "entry 0 must have id, first, length"),
    "an unknown field": ({"episodes": [{"id": "a", "first": "00", "length": 1, "last": "01"}]}, "entry 0"),
    "no such capture": ({"episodes": [{"id": "a", "first": "0O", "length": 1}]}, "which is no capture"),
    "a place": ({"episodes": [{"id": "a", "first": 0, "length": 1}]}, "first is a name"),
    "no step": ({"episodes": [{"id": "a", "first": "00", "length": 0}]}, "length one from 1"),
    "too long": ({"episodes": [{"id": "a", "first": "08", "length": 3}]}, "ends at sample 11, but there are 10"),
    "huge": ({"episodes": [{"id": "a", "first": "08", "length": 10**30}]}, "length one from 1"),
    "one name twice": ({"episodes": [{"id": "a", "first": f"0{n}", "length": 1} for n in (1, 2)]}, "two episodes"),
    "overlap": ({"episodes": [{"id": i, "first": f, "length": 3} for i, f in (("a", "00"), ("b", "02"))]}, "share"),
    "out of order": (
        {"episodes": [{"id": i, "first": f, "length": 1} for i, f in (("a", "05"), ("b", "02"))]},
        "order",
    ),
    "no name": ({"episodes": [{"id": "", "first": "00", "length": 1}]}, "id must be a printable text"),
    "two lines": ({"episodes": [{"id": "a\nb", "first": "00", "length": 1}]}, "id must be a printable text"),
    "attributes": ({"episodes": [{"id": "a", "first": "00", "length": 1, "attributes": [1]}]}, "attributes must be"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_file_of_episodes_that_cannot_be_meant_is_refused_by_its_path(case, tmp_path):
    document, told = WRONG[case]
    recorded(tmp_path)
    (tmp_path / "episodes.json").write_text(json.dumps(document))
    with pytest.raises(CaptureError, match=told) as raised:
        open_source(tmp_path)
    assert "episodes.json" in str(raised.value)


def test_a_source_that_gives_something_else_is_refused():
    class Odd(SyntheticSource):
        episodes = ("pick",)

    with pytest.raises(DTypeError, match=r"must be pcdata.Episode, got str"):
        episodes_of(Odd(num_scenes=2))


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"times": [0.0, 1.0]}, "times must be 3 finite seconds"),
        ({"times": [0.0, 2.0, 1.0]}, r"must not fall, but step 2 is at 1.0 s after 2.0 s"),
        ({"times": [0.0, float("nan"), 1.0]}, "times must be 3 finite seconds"),
        ({"attributes": {"score": float("inf")}}, "must be what JSON holds"),
        ({"first": -1}, "first must be a whole number from 0"),
        ({"length": True}, "length one from 1"),
        ({"id": "pick\x1b[2J"}, "id must be a printable text"),
    ],
)
def test_an_episode_that_cannot_be_is_refused(fields, told):
    with pytest.raises(CaptureError, match=told):
        Episode(**{"id": "a", "first": 0, "length": 3, **fields})


def test_an_episode_file_is_not_written_over(tmp_path):
    recorded(tmp_path)
    with pytest.raises(CaptureError, match="cannot be written"):
        write_episodes(tmp_path, TWO, NAMES)
    assert checked_episodes("here", TWO, 10) == TWO


def test_cloud_files_in_a_row_have_times_and_episodes(tmp_path: Path) -> None:
    for number in range(3):
        write_ply(tmp_path / f"scan_{number}.ply", PointCloud(points=torch.rand(4, 3), frame_id="base"))
    times = {f"scan_{number}": 10.0 + number / 2 for number in range(3)}
    (tmp_path / "timestamps.json").write_text(json.dumps(times))
    source = open_source(tmp_path)
    assert source.unread() == []
    assert source.load("scan_1").meta[0]["provenance"]["timestamps"] == [10.5]
    write_episodes(tmp_path, [Episode("take", 0, 3)], source.ids)
    (episode,) = open_source(tmp_path).episodes
    assert episode.times == (10.0, 10.5, 11.0)
    (tmp_path / "timestamps.json").write_text(json.dumps({"scan_0": 1.0}))
    with pytest.raises(CaptureError, match="timestamp is missing for"):
        open_source(tmp_path)
