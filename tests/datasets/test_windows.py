"""EpisodeWindows: the clouds and actions of a window, the same wherever it is made, with one draw for all of it."""

from __future__ import annotations

import json
import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils.data import ConcatDataset, DataLoader, Subset

from pcdata import (
    CachedCloudDataset,
    CloudDataset,
    Compose,
    Episode,
    EpisodeWindows,
    PointCloud,
    collate_packed,
    collate_windows,
)
from pcdata.build import build_dataset, config_from_yaml
from pcdata.datasets.window_batch import WindowBatch
from pcdata.errors import CacheError, CaptureError, ConfigError, DTypeError, FrameError, PcdataWarning, ShapeError
from pcdata.io.store.manifest import checksum_of
from pcdata.io.store.shards import SIGNALS_KEY
from pcdata.structures import Signal
from pcdata.synthetic import TeleopSource
from pcdata.transforms import MergeViews, RandomJitter, RandomRotation, ToFrame
from tests.io.forged import first_shard

# Workers are counted against the cores of the machine; here there must be more workers than some machines have cores.
pytestmark = pytest.mark.filterwarnings("ignore:This DataLoader will create")

SOURCE = TeleopSource(num_episodes=2, num_views=1, size=(12, 16))
PIPELINE = """
depth: [Deproject]
cloud: [ToFrame: {frame: base}, FarthestPointSample: {num_points: 32}]
augment: [RandomRotation: {degrees: 180}, RandomTranslation: {max_offset: 0.1}]
"""
NUM_OBS, HORIZON = 2, 4


@pytest.fixture(scope="module")
def caches(tmp_path_factory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("windows")
    for form in ("hdf5", "npz", "packed", "pt"):
        build_dataset(config_from_yaml(f"{PIPELINE}output: {{format: {form}}}\n"), SOURCE, root / form)
    return {form: root / form for form in ("hdf5", "npz", "packed", "pt")}


def on_the_fly(transform: Compose | None = None, **options) -> CloudDataset:
    return CloudDataset(SOURCE, transform or config_from_yaml(PIPELINE).pipeline, **options)


@pytest.fixture(params=["on the fly", "npz", "hdf5", "packed", "pt"])
def windows(request, caches) -> EpisodeWindows:
    data = on_the_fly(seed=3) if request.param == "on the fly" else CachedCloudDataset(caches[request.param], seed=3)
    return EpisodeWindows(data, NUM_OBS, HORIZON)


class Cloudy:
    """Single clouds in memory as a source: ``camera`` with or without its way to ``base``."""

    name = "cloudy"

    def __init__(
        self, lengths=(3,), *, moves: bool | None = None, frame: str = "camera", kind: str = "position"
    ) -> None:
        self.ids = [f"{e}-{step}" for e, length in enumerate(lengths) for step in range(length)]
        self.moves, self.frame, self.kind = moves, frame, kind
        firsts = [sum(lengths[:e]) for e in range(len(lengths))]
        self.episodes = [Episode(f"e{e}", firsts[e], length) for e, length in enumerate(lengths)]

    def __len__(self) -> int:
        return len(self.ids)

    def signals(self, sample_id: str) -> dict[str, Signal]:
        place = self.ids.index(sample_id)
        values = torch.full((1, 3), float(place))
        frame = None if self.kind == "invariant" else self.frame
        return {"action": Signal(values, self.kind, frame), "words": Signal((sample_id,), "text")}

    def load(self, sample_id: str) -> PointCloud:
        place = self.ids.index(sample_id)
        pose = torch.eye(4, dtype=torch.float64)[None].clone()
        pose[:, 0, 3] = place if self.moves else 1.0
        frames = {} if self.moves is None else {"base": pose}
        points = torch.arange(12.0).reshape(4, 3) + place
        return PointCloud(points=points, frame_id="camera", frames=frames, recorded_signals=self.signals(sample_id))


def test_every_step_of_an_episode_is_the_newest_of_one_window(windows):
    lengths = [episode.length for episode in windows.episodes]
    assert windows.ids == [f"{one.id}@{step}" for one in SOURCE.episodes for step in range(one.length)]
    assert len(windows) == sum(lengths)


def test_a_window_has_the_clouds_and_the_actions_of_its_steps(windows):
    table = SOURCE.episodes[0].length
    for number in (0, 1, 7, table - 1, table, len(windows) - 1):
        window, steps = windows[number], windows.steps(number)
        ids = windows.dataset.ids
        assert window.num_clouds == NUM_OBS
        assert [meta["sample_id"] for meta in window.meta] == [ids[place] for place in steps[:NUM_OBS]]
        recorded = window.recorded_signals["action"].values
        wanted = torch.cat([SOURCE.signals(ids[place])["action"].values for place in steps])
        assert torch.equal(recorded, wanted.expand(NUM_OBS, HORIZON, 4))
        assert recorded.stride(0) == 0  # no copy for each cloud
        joints = torch.cat([SOURCE.signals(ids[place])["joints"].values for place in steps[:NUM_OBS]])
        assert torch.equal(window.signals["joints"], joints)


def test_one_draw_moves_all_clouds_of_a_window_and_their_actions(windows):
    window = windows[9]
    motion = window.frames["base"] @ window.source_from_cloud  # base from cloud
    assert torch.equal(motion[0], motion[1])
    assert not torch.allclose(motion[0], torch.eye(4, dtype=torch.float64), atol=1e-2)
    back = window.signals["action"][..., :3].double() @ motion[:, :3, :3].mT + motion[:, None, :3, 3]
    assert torch.allclose(back, window.recorded_signals["action"].values[..., :3].double(), atol=1e-6)
    assert not torch.equal(motion, windows[10].frames["base"] @ windows[10].source_from_cloud)


def test_a_window_is_the_same_on_the_fly_and_from_every_cache(caches):
    made = [EpisodeWindows(CachedCloudDataset(caches[form], seed=3), 2, 4)[5] for form in caches]
    made.append(EpisodeWindows(on_the_fly(seed=3), 2, 4)[5])
    for one in made:
        assert torch.equal(one.points, made[0].points)
        assert torch.equal(one.signals["action"], made[0].signals["action"])


@pytest.mark.parametrize("num_workers", [0, 3])
def test_any_number_of_workers_gives_the_same_windows_in_any_order_and_epoch(windows, num_workers):
    order = [5, 0, 7, 3, 1]
    loader = DataLoader(
        windows, batch_size=2, sampler=order, num_workers=num_workers, collate_fn=collate_windows,
        persistent_workers=num_workers > 0, multiprocessing_context="fork" if num_workers else None,
    )  # fmt: skip
    for epoch in range(2):
        windows.set_epoch(epoch)
        batches = list(loader)
        windows.set_epoch(epoch)
        alone = [windows[number] for number in order]
        assert torch.equal(
            torch.cat([one.points for one in batches]).flatten(0, 2), torch.cat([w.points for w in alone])
        )
        actions = torch.stack([w.signals["action"][-1] for w in alone])
        assert torch.equal(torch.cat([one.signals["action"] for one in batches]), actions)


@pytest.mark.slow
@pytest.mark.parametrize("start_method", ["forkserver", "spawn"])
def test_any_start_method_gives_the_same_windows(caches, start_method):
    windows = EpisodeWindows(CachedCloudDataset(caches["hdf5"], seed=3), 2, 4)
    loader = DataLoader(
        windows, batch_size=4, num_workers=1, collate_fn=collate_windows, persistent_workers=True,
        multiprocessing_context=start_method,
    )  # fmt: skip
    for epoch in (0, 5):
        windows.set_epoch(epoch)
        found = torch.cat([one.signals["action"] for one in loader])
        windows.set_epoch(epoch)
        assert torch.equal(found, torch.stack([window.signals["action"][-1] for window in windows]))


def test_epochs_and_repeats_change_the_draws_and_nothing_else(caches):
    windows = EpisodeWindows(CachedCloudDataset(caches["npz"], repeats=2), 2, 4)
    half = len(windows) // 2
    first, again = windows[5], windows[5 + half]
    windows.set_epoch(1)
    assert windows.dataset.epoch == 1
    later = windows[5]
    for other in (again, later):
        assert not torch.equal(first.points, other.points)
        assert torch.equal(first.recorded_signals["action"].values, other.recorded_signals["action"].values)


def test_a_second_pass_in_one_epoch_warns(caches):
    windows = EpisodeWindows(CachedCloudDataset(caches["npz"]), 1, 2)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        list(windows), list(windows)
    assert [str(one.message).count("set_epoch(number)") for one in told] == [1]


def test_collated_windows_are_dense_tensors_with_the_newest_clouds_actions(windows):
    few = [windows[number] for number in (0, 4, 9)]
    batch = collate_windows(few)
    assert isinstance(batch, WindowBatch)
    assert batch.points.shape == (3, NUM_OBS, 32, 3)
    assert batch.mask.shape == (3, NUM_OBS, 32)
    assert batch.field("colors").shape == (3, NUM_OBS, 32, 3)
    assert batch.signals["joints"].shape == (3, NUM_OBS, 5)
    assert batch.signals["hand"].shape == (3, NUM_OBS, 4, 4)
    assert batch.signals["action"].shape == (3, HORIZON, 4)
    assert batch.signals["instruction"] == ("put the cube on the green disc",) * 3
    assert torch.equal(batch.signals["action"][1], few[1].signals["action"][-1])
    assert torch.equal(batch.signals["hand"][2], few[2].signals["hand"])
    assert batch.action_mask.tolist()[:2] == [[False, True, True, True], [True] * 4]
    moved = batch.to("cpu")
    assert torch.equal(moved.points, batch.points)
    assert len(batch) == 3


def test_packed_windows_are_all_their_clouds_in_a_row(windows):
    few = [windows[0], windows[4]]
    packed = collate_packed(few)
    assert packed.num_clouds == 4
    assert packed.signals["action"].shape == (4, HORIZON, 4)
    assert torch.equal(packed[2:4].points, few[1].points)


def test_clouds_of_different_sizes_are_padded():
    class Growing(Cloudy):
        def load(self, sample_id):
            cloud = super().load(sample_id)
            count = 1 + self.ids.index(sample_id)
            return cloud.select(torch.arange(count), torch.tensor([0, count]))

    windows = EpisodeWindows(CloudDataset(Growing()), 2, 2)
    batch = collate_windows([windows[0], windows[2]])
    assert batch.mask.sum(dim=2).tolist() == [[1, 1], [2, 3]]


def test_windows_of_two_kinds_are_not_stacked(windows):
    other = EpisodeWindows(windows.dataset, 1, 2)
    with pytest.raises(ShapeError, match="samples of one EpisodeWindows"):
        collate_windows([other[0].without_signal("action"), windows[0].without_signal("action")])


def test_set_epoch_reaches_windows_within_others(windows):
    from pcdata.datasets import set_epoch

    set_epoch(ConcatDataset([Subset(windows, [1, 2]), windows]), 4)
    assert windows.epoch == windows.dataset.epoch == 4


# -- episodes that are too short, and other bad input --------------------------------------------------------------


def test_an_episode_of_one_step_is_repeated_throughout_its_window():
    windows = EpisodeWindows(CloudDataset(Cloudy((1, 3))), 2, 4)
    assert windows.ids == ["e0@0", "e1@0", "e1@1", "e1@2"]
    window = windows[0]
    assert torch.equal(window[0].points, window[1].points)
    assert window.signals["action"][1].tolist() == [[0.0] * 3] * 4
    assert collate_windows([window]).action_mask.tolist() == [[False, True, False, False]]


def test_what_gives_no_window_is_counted_and_named():
    with pytest.warns(PcdataWarning, match=r"1 of 3 episodes \(1 steps\) give no window.*fewer than 2"):
        windows = EpisodeWindows(CloudDataset(Cloudy((3, 1, 2))), 1, 2, pad="drop")
    assert windows.skipped == {"e1": "1 steps, fewer than 2"}
    assert "1 too short" in repr(windows)
    assert len(windows) == 3
    with pytest.raises(ConfigError, match=r"none of 2 episodes is long enough: 5 steps are needed, the longest has 3"):
        EpisodeWindows(CloudDataset(Cloudy((3, 2))), 2, 5, pad="drop")


def test_a_longer_window_than_its_episode_is_padded_on_both_sides():
    windows = EpisodeWindows(CloudDataset(Cloudy((3,))), 2, 9)
    assert [windows.steps(number).tolist() for number in range(3)] == [
        [0, 0, 1, 2, 2, 2, 2, 2, 2], [0, 1, 2, 2, 2, 2, 2, 2, 2], [1, 2, 2, 2, 2, 2, 2, 2, 2],
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"num_obs": 0}, "num_obs must be a whole number, 1 to"),
        ({"horizon": 1}, "horizon counts the steps of a window"),
        ({"horizon": 2.0}, "horizon must be a whole number"),
        ({"num_actions": 5}, "num_actions must be 1 to the horizon"),
        ({"stride": 0}, "stride must be"),
        ({"pad": "zeros"}, "pad must be 'repeat' or 'drop'"),
        ({"episodes": []}, "has no episodes"),
    ],
)
def test_numbers_that_make_no_window_are_refused(options, told):
    with pytest.raises(ConfigError, match=told):
        EpisodeWindows(CloudDataset(Cloudy()), **{"num_obs": 2, "horizon": 4, **options})


def test_what_is_no_dataset_of_episodes_is_refused():
    data = CloudDataset(Cloudy())
    with pytest.raises(DTypeError, match=r"CloudDataset or CachedCloudDataset, got Subset; choose episodes by"):
        EpisodeWindows(Subset(data, [0]), 1, 1)
    with pytest.raises(DTypeError, match=r"no signal 'actions'; did you mean 'action'"):
        EpisodeWindows(data, 1, 1, actions=["actions"])
    with pytest.raises(DTypeError, match="'words' is a text"):
        EpisodeWindows(data, 1, 1, actions="words")
    with pytest.raises(CaptureError, match="ends at sample 4, but there are 3"):
        EpisodeWindows(data, 1, 1, episodes=[Episode("a", 0, 4)])
    assert "action" in EpisodeWindows(data, 1, 3, actions=())[0].recorded_signals  # its own step's


def test_actions_that_a_sample_lacks_are_named():
    class Shorter(Cloudy):
        def signals(self, sample_id):
            return super().signals(sample_id) if sample_id != self.ids[-1] else {}

    with pytest.raises(ShapeError, match=r"sample '0-2'.*different signals"):
        EpisodeWindows(CloudDataset(Shorter()), 1, 2)


def test_a_step_that_drops_or_changes_an_action_is_found():
    class Dropping(Cloudy):
        def load(self, sample_id):
            return super().load(sample_id).without_signal("action")

    class Changing(Cloudy):
        def load(self, sample_id):
            return super().load(sample_id).with_signal("action", torch.zeros(1, 3) + 9, "position", "camera")

    with pytest.raises(DTypeError, match="drops the signal 'action'"):
        EpisodeWindows(CloudDataset(Dropping()), 1, 2)[0]
    with pytest.raises(DTypeError, match="not what signal_table"):
        EpisodeWindows(CloudDataset(Changing()), 1, 2)[0]


def test_random_motions_of_single_views_are_named_as_the_cause():
    source = TeleopSource(num_episodes=1, num_views=2, size=(12, 16))
    steps = [{"Deproject": {}}, {"RandomRotation": {"degrees": 30}}, {"ToFrame": {"frame": "base"}}, {"MergeViews": {}}]
    windows = EpisodeWindows(CloudDataset(source, Compose.from_config(steps)), 1, 2)
    with pytest.raises((DTypeError, FrameError), match="put random motions after"):
        windows[0]


def test_several_clouds_of_a_sample_are_refused_with_what_to_do():
    source = TeleopSource(num_episodes=1, num_views=2, size=(12, 16))
    windows = EpisodeWindows(CloudDataset(source, Compose.from_config([{"Deproject": {}}])), 2, 2)
    with pytest.raises(ShapeError, match=r"2 \+ 2 clouds; join views by MergeViews"):
        windows[4]


def test_actions_in_the_frame_of_a_camera_that_moves_are_refused():
    windows = EpisodeWindows(CloudDataset(Cloudy(moves=True)), 1, 2)
    with pytest.raises(FrameError, match=r"camera that moves in episode 'e0'.*\['base'\]"):
        windows[0]
    for still in (
        Cloudy(moves=False),
        Cloudy(),
        Cloudy(moves=True, frame="base"),
        Cloudy(moves=True, kind="invariant"),
    ):
        assert EpisodeWindows(CloudDataset(still), 1, 2)[0].signals["action"].shape == (1, 2, 3)


class Wrist(Cloudy):
    """A camera that turns back and forth, and a force in its frame."""

    def signals(self, sample_id):
        force = Signal(torch.tensor([[0.0, 0.0, 1.0]]), "direction", "camera")
        return {**super().signals(sample_id), "force": force}

    def load(self, sample_id):
        place = self.ids.index(sample_id)
        pose = torch.eye(4, dtype=torch.float64)[None].clone()
        pose[:, 0, 3] = place % 2
        cloud = super().load(sample_id).with_meta([{"sample_id": sample_id}])
        return replace(cloud, frames={"base": pose, "camera": torch.eye(4, dtype=torch.float64)[None]})


@pytest.mark.parametrize("steps", [(), (ToFrame(frame="base"), MergeViews())], ids=["as seen", "merged"])
def test_a_camera_that_moves_and_comes_back_is_noticed_and_one_beside_actions_in_base_is_not(steps):
    chain = Compose([*steps]) if steps else None
    with pytest.raises(FrameError, match=r"camera that moves in episode 'e0'.*\['base'\]"):
        EpisodeWindows(CloudDataset(Wrist((5,), moves=True), chain), 1, 2)[1]
    windows = EpisodeWindows(CloudDataset(Wrist((5,), moves=True, frame="base"), chain), 2, 3)
    place = 0.0 if steps else -1.0  # of the camera at the newest step, seen from base
    assert windows[1].signals["action"][1, :, 0].tolist() == [place, 1 + place, 2 + place]


class Base(Cloudy):
    """Clouds recorded in the robot's frame, which also know where its hand is; that moves."""

    def load(self, sample_id):
        place = self.ids.index(sample_id)
        hand = torch.eye(4, dtype=torch.float64)[None].clone()
        hand[:, 0, 3] = place
        cloud = PointCloud(points=torch.rand(4, 3), frame_id="base", frames={"hand": hand})
        for name, signal in self.signals(sample_id).items():
            cloud = cloud.with_signal(name, signal.values, signal.kind, signal.frame)
        return cloud.with_meta([{"sample_id": sample_id}])


def test_actions_in_the_frame_of_the_source_are_given_whatever_moves_in_it():
    windows = EpisodeWindows(CloudDataset(Base((5,), frame="base")), 2, 3)
    assert windows[1].signals["action"].shape == (2, 3, 3)
    assert torch.equal(windows[1].signals["action"][0], windows[1].signals["action"][1])


def test_numbers_of_numpy_make_windows_and_absurd_ones_are_refused():
    data = CloudDataset(Cloudy())
    assert len(EpisodeWindows(data, np.int64(2), np.int32(2), num_actions=np.int64(1), stride=np.int8(1))) == 3
    assert Episode("a", np.int64(1), np.int64(2)) == Episode("a", 1, 2)
    for numbers in ({"horizon": 10**12}, {"horizon": 2, "stride": 10**30}):
        with pytest.raises(ConfigError, match="1 to 1000000"):
            EpisodeWindows(data, 1, **numbers)
    for actions in (None, (3,), (["action"],)):
        with pytest.raises(DTypeError, match="names of signals"):
            EpisodeWindows(data, 1, 2, actions=actions)


# -- what a built dataset keeps ------------------------------------------------------------------------------------


def test_a_built_dataset_keeps_episodes_and_signals_beside_its_records(caches):
    table = on_the_fly().signal_table()
    for form in caches:
        data = CachedCloudDataset(caches[form])
        assert data.episodes == SOURCE.episodes
        found = data.signal_table()
        assert found.keys() == table.keys()
        assert all(signal.same_bits(table[name]) for name, signal in found.items())


def test_signals_are_read_without_a_cloud(caches, monkeypatch):
    data = CachedCloudDataset(caches["npz"])
    monkeypatch.setattr(CachedCloudDataset, "_load", lambda self, index: pytest.fail("a cloud was loaded"))
    assert EpisodeWindows(data, 2, 4).episodes == SOURCE.episodes


def test_captures_that_are_left_out_cut_the_episode_of_a_build(tmp_path):
    class Faulty(Cloudy):
        def load(self, sample_id):
            if sample_id == "0-1":
                raise CaptureError("damaged")
            return super().load(sample_id)

    config = config_from_yaml("cloud: [Center]\n")
    build_dataset(config, Faulty((4, 2)), tmp_path / "set")
    data = CachedCloudDataset(tmp_path / "set")
    assert [(one.id, one.first, one.length) for one in data.episodes] == [("e0~0", 0, 1), ("e0~1", 1, 2), ("e1", 3, 2)]
    assert data.signal_table()["action"].values[:, 0].tolist() == [0.0, 2.0, 3.0, 4.0, 5.0]


def test_signals_that_samples_do_not_share_are_built_and_refused_as_a_table(tmp_path):
    class Mixed(Cloudy):
        def signals(self, sample_id):
            return {} if sample_id == "0-1" else super().signals(sample_id)

    build_dataset(config_from_yaml("cloud: [Center]\n"), Mixed(), tmp_path / "set")
    data = CachedCloudDataset(tmp_path / "set")
    assert [len(cloud.recorded_signals) for cloud in data] == [2, 0, 2]
    with pytest.raises(ShapeError, match=r"no signals in common.*'0-1'"):
        data.signal_table()


HOSTILE = {
    "overlapping": [{"id": "a", "first": 0, "length": 3, "times": [], "attributes": {}}] * 2,
    "too long": [{"id": "a", "first": 0, "length": 10**9, "times": [], "attributes": {}}],
    "a text": ["a"],
    "unknown fields": [{"id": "a", "first": 0, "length": 1}],
    "no list": {"a": 1},
    "infinite times": [{"id": "a", "first": 0, "length": 1, "times": [10**400], "attributes": {}}],
}


@pytest.mark.parametrize("case", HOSTILE)
def test_a_manifest_with_episodes_that_cannot_be_is_refused(case, tmp_path):
    build_dataset(config_from_yaml("cloud: [Center]\n"), Cloudy(), tmp_path / "set")
    path = tmp_path / "set" / "dataset.json"
    content = json.loads(path.read_text()) | {"episodes": HOSTILE[case]}
    content.pop("checksum")
    path.write_text(json.dumps({**content, "checksum": checksum_of(content)}))
    with pytest.raises(CacheError, match=r"dataset\.json"):
        CachedCloudDataset(tmp_path / "set")


def test_damaged_signals_are_refused_by_their_path(tmp_path):
    build_dataset(config_from_yaml("cloud: [Center]\noutput: {format: npz}\n"), Cloudy(), tmp_path / "set")
    data = CachedCloudDataset(tmp_path / "set")
    path = tmp_path / "set" / "signals" / "clouds" / f"{SIGNALS_KEY}.npz"
    other = first_shard(tmp_path / "set") / "clouds" / "0-0.npz"
    path.write_bytes(other.read_bytes())
    with pytest.raises(CacheError, match="the signals differ from what was written"):
        data.signal_table()
    path.unlink()
    with pytest.raises(CacheError, match="the file is missing"):
        data.signal_table()


def test_a_dataset_with_signals_is_overwritten_like_any_other(tmp_path):
    config = config_from_yaml("cloud: [Center]\noutput: {format: npz}\n")
    build_dataset(config, Cloudy(), tmp_path / "set")
    build_dataset(config, Cloudy((2,)), tmp_path / "set", overwrite=True)
    assert len(CachedCloudDataset(tmp_path / "set").signal_table()["action"]) == 2


# -- splits --------------------------------------------------------------------------------------------------------


def test_a_split_shares_no_episode_and_depends_on_the_seed_alone():
    data = CloudDataset(Cloudy([2] * 20))
    parts = data.split_episodes({"train": 0.8, "val": 0.1, "test": 0.1}, seed=1)
    assert [len(part) for part in parts.values()] == [16, 2, 2]
    assert {one.id for part in parts.values() for one in part} == {one.id for one in data.episodes}
    assert parts == data.split_episodes({"train": 0.8, "val": 0.1, "test": 0.1}, seed=1)
    assert parts != data.split_episodes({"train": 0.8, "val": 0.1, "test": 0.1}, seed=2)
    windows = EpisodeWindows(data, 2, 2, episodes=parts["val"])
    shown = {place for number in range(len(windows)) for place in windows.steps(number).tolist()}
    assert shown == {place for one in parts["val"] for place in one.steps}


def test_parts_of_one_recorded_episode_stay_together():
    data = CloudDataset(Cloudy([6] * 4))
    cut = CloudDataset(Cloudy([6] * 4))
    cut.source.episodes = [
        Episode(f"{one.id}~{n}", one.first + 3 * n, 2, attributes={"part_of": one.id})
        for one in data.episodes
        for n in (0, 1)
    ]
    parts = cut.split_episodes({"train": None, "val": 1})
    assert len(parts["train"]) == 6
    assert len({one.whole for one in parts["val"]}) == 1
    whole = data.split_episodes({"train": None, "val": 1})
    assert {one.whole for one in parts["val"]} == {one.whole for one in whole["val"]}


@pytest.mark.parametrize(
    ("parts", "told"),
    [
        ({"train": 2}, "2 episodes would be in no part"),
        ({"train": 3, "val": 3}, "not enough"),
        ({"train": 1.5}, "a share"),
        ({"train": None, "val": None}, "one part alone"),
        ({"train": 0.9, "val": 0.2}, "add up to 1"),
        ({}, "must map names"),
        ({"train": True}, "must be a number"),
    ],
)
def test_parts_that_leave_episodes_out_or_ask_for_more_are_refused(parts, told):
    with pytest.raises(ConfigError, match=told):
        CloudDataset(Cloudy([1] * 4)).split_episodes(parts)


def test_draws_for_noise_and_motion_are_those_of_the_window():
    """A step that draws per point does not bring the motions of two clouds of a window apart."""
    chain = Compose([RandomJitter(sigma=0.01), RandomRotation(degrees=180)])

    class Uneven(Cloudy):
        def load(self, sample_id):
            cloud = super().load(sample_id)
            count = 2 + self.ids.index(sample_id)
            return cloud.select(torch.arange(4)[:count], torch.tensor([0, min(4, count)]))

    window = EpisodeWindows(CloudDataset(Uneven(), chain), 3, 3)[2]
    assert torch.equal(window.source_from_cloud[0], window.source_from_cloud[2])


def test_the_page_on_episodes_runs_as_it_stands(capsys):
    page = (Path(__file__).parents[2] / "docs" / "episodes.md").read_text()
    (block,) = re.findall(r"^```python\n(.*?)^```$", page, flags=re.MULTILINE | re.DOTALL)
    exec(compile(block, "episodes.md", "exec"), {})
    shapes = block.rsplit("# ", 1)[1].strip()
    printed = capsys.readouterr().out
    assert re.findall(r"\[(.*?)\]", printed) == re.findall(r"\((.*?)\)", shapes)


def test_steps_of_a_copy_are_those_of_its_window_and_places_count_from_the_end():
    windows = EpisodeWindows(CloudDataset(Cloudy((3, 2)), repeats=2), 2, 3)
    assert windows.steps(6).tolist() == windows.steps(1).tolist() == windows.steps(np.int64(-4)).tolist()
    with pytest.raises(IndexError, match="there is no sample 10"):
        windows.steps(10)
    with pytest.raises(DTypeError, match="must be a whole number, got 'e0@1'"):
        windows.steps("e0@1")


@pytest.mark.parametrize("given", [3, Episode("a", 0, 1), None], ids=repr)
def test_episodes_that_are_no_list_are_refused(given):
    from pcdata.structures.episodes import checked_episodes

    with pytest.raises(DTypeError, match=r"episodes must be a list of pcdata\.Episode, got"):
        checked_episodes("here", given, 3)


def test_a_split_takes_numbers_of_numpy_and_refuses_a_seed_that_is_none():
    dataset = CloudDataset(Cloudy((1,) * 6))
    plain = dataset.split_episodes({"train": 0.5, "val": 2, "rest": None}, seed=1)
    assert dataset.split_episodes({"train": np.float32(0.5), "val": np.int64(2), "rest": None}, np.int64(1)) == plain
    with pytest.raises(DTypeError, match="seed must be a whole number, got None"):
        dataset.split_episodes({"train": None}, seed=None)
