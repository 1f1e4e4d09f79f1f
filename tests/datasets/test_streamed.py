"""A stream gives every sample once, with the draws of the dataset, whoever reads it, in few requests, and goes on."""

from __future__ import annotations

import itertools
import pickle
import random
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import fsspec
import pytest
import torch
from torch.utils.data import DataLoader

import pcdata
from pcdata import CachedCloudDataset, DevicePipeline, PointCloud, StreamedCloudDataset, collate_packed
from pcdata.build import build_dataset, config_from_yaml
from pcdata.datasets import RepeatedEpochWarning
from pcdata.errors import CacheError, ConfigError, DTypeError
from pcdata.files import urls
from pcdata.io.store import tar_shard, url_dataset
from pcdata.structures.unbatched import Unbatched
from tests.build.test_builder import Clouds
from tests.io.store.test_stores import assert_same_cloud

pytestmark = pytest.mark.filterwarnings("ignore:This DataLoader will create")

STORED = """
cloud: [Center]
augment: [RandomRotation: {degrees: 180}, RandomJitter: {sigma: 0.01}, RandomPointDropout: {low: 0.1, high: 0.5}]
"""


def numbered(number: int) -> PointCloud:
    points = torch.rand(20 + number, 3, generator=torch.Generator().manual_seed(number))
    cloud = PointCloud(points=points, colors=points, frame_id="base", meta=[{"sample_id": f"s{number}"}])
    return cloud.with_signal("joints", torch.full((1, 2), float(number)), "invariant")


@pytest.fixture(scope="module")
def places(tmp_path_factory) -> dict[str, str]:
    """The same dataset of seven shards as tars, packed, and tars on a server."""
    root = tmp_path_factory.mktemp("streamed")
    source = Clouds({f"s{number}": numbered(number) for number in range(27)})
    for form in ("webdataset", "packed"):
        build_dataset(config_from_yaml(f"{STORED}output: {{format: {form}, shard_size: 4}}\n"), source, root / form)
    pcdata.split_dataset(root / "webdataset", {"train": 0.5, "val": None}, by="sample")
    served(root / "webdataset", "memory://streamed/set")
    return {form: str(root / form) for form in ("webdataset", "packed")} | {"server": "memory://streamed/set"}


def served(folder: Path, url: str) -> None:
    system, root = fsspec.core.url_to_fs(url)
    for path in folder.rglob("*"):
        if path.is_file():
            name = f"{root}/{path.relative_to(folder).as_posix()}"
            system.makedirs(name.rpartition("/")[0], exist_ok=True)
            system.pipe_file(name, path.read_bytes())


@pytest.fixture
def requests(monkeypatch) -> list[tuple[str, int, int]]:
    """The ranges that are asked for of tars."""
    asked, whole = [], urls.UrlFolder.read

    def read(self, name, begin, end):
        if name.endswith(".tar"):
            asked.append((name, begin, end))
        return whole(self, name, begin, end)

    monkeypatch.setattr(urls.UrlFolder, "read", read)
    return asked


def stream(place: str, *, seed: int = 3, epoch: int = 2, **options) -> StreamedCloudDataset:
    own = {name: options.pop(name) for name in ("repeats", "split", "augment") if name in options}
    dataset = CachedCloudDataset(place, seed=seed, **own)
    dataset.set_epoch(epoch)
    return StreamedCloudDataset(dataset, **options)


def clouds(given: Iterable) -> list[PointCloud]:
    """Samples, one by one or in batches, as single clouds."""
    return [
        one for part in given for one in ([part] if isinstance(part, PointCloud) and part.num_clouds == 1 else part)
    ]


def names(given: Iterable) -> list[str]:
    return [cloud.meta[0]["sample_id"] for cloud in clouds(given)]


def drawn(given: Iterable) -> list[tuple[str, list]]:
    return [(cloud.meta[0]["sample_id"], cloud.points.tolist()) for cloud in clouds(given)]


@pytest.mark.parametrize(("place", "batch_size"), [("webdataset", None), ("server", 5), ("packed", 5)])
def test_every_sample_comes_once_with_the_draws_of_the_dataset(places, place, batch_size):
    wanted = CachedCloudDataset(places["packed"], seed=3)
    wanted.set_epoch(2)
    given = clouds(stream(places[place], batch_size=batch_size, shuffle_buffer=6))
    assert sorted(names(given)) == sorted(wanted.ids)
    for cloud in given:
        assert_same_cloud(cloud, wanted[wanted.ids.index(cloud.meta[0]["sample_id"])])


def test_batches_are_made_at_once_and_collated_as_they_are(places):
    made = stream(places["server"], batch_size=5, shuffle_buffer=6)
    loader = DataLoader(made, batch_size=None, collate_fn=collate_packed)
    sizes = [batch.num_clouds for batch in loader]
    assert sum(sizes) == len(made.dataset)
    assert sizes[:-1] == [5] * (len(sizes) - 1)
    made.set_epoch(1)
    assert all(isinstance(batch, Unbatched) for batch in made)


def test_the_order_is_that_of_seed_and_epoch_whatever_the_store(places):
    def order(place: str = "webdataset", **options) -> list[str]:
        made = stream(places[place], **{"shuffle_buffer": 6, **options})
        epochs = made._order()
        return [made.dataset.ids[made._index(epochs, one.place)] for one in made._outputs(made._part())]

    first = order()
    assert first == order() == order("packed") == order("server") == order(batch_size=3)
    assert first == names(stream(places["packed"], shuffle_buffer=6, augment=None))
    others = [order(epoch=3), order(seed=4), order(shuffle_buffer=5), order(shuffle_buffer=1), order(shuffle_buffer=0)]
    assert len({tuple(one) for one in [first, *others]}) == 6
    assert others[-1] == list(stream(places["packed"]).dataset.ids)


def test_a_window_of_one_shuffles_shards_alone(places):
    made = stream(places["packed"], shuffle_buffer=1)
    given = names(made)
    number = {name: int(shard) for name, shard in zip(made.dataset.ids, made.dataset.manifest.index.shards.tolist())}
    shards = [number[name] for name in given]
    assert len([*dict.fromkeys(shards)]) == made.dataset.manifest.index.num_shards
    assert sum(one != other for one, other in itertools.pairwise(shards)) == max(shards)
    assert shards != sorted(shards)


@pytest.mark.parametrize("ranks", [1, 2, 3, 11, 40])
def test_ranks_share_the_samples_also_where_there_are_fewer_shards(places, ranks):
    dataset = CachedCloudDataset(places["packed"], augment=None)
    options = {"shuffle_buffer": 6, "num_replicas": ranks}
    parts = [names(StreamedCloudDataset(dataset, rank=rank, **options)) for rank in range(ranks)]
    wanted = dataset.ids
    assert Counter(name for part in parts for name in part) == Counter(wanted)
    assert max(map(len, parts)) - min(map(len, parts)) <= 1
    made = stream(places["packed"], rank=ranks - 1, num_replicas=ranks)
    assert made.num_samples == len(parts[-1])


def test_with_drop_last_all_give_equally_many_whole_batches(places):
    total = len(stream(places["packed"]).dataset)
    for ranks, size in ((1, 4), (3, 2), (2, 7), (5, None)):
        parts = [
            stream(places["packed"], batch_size=size, drop_last=True, rank=rank, num_replicas=ranks)
            for rank in range(ranks)
        ]
        counts = [[len(batch) if size else 1 for batch in part] for part in parts]
        assert all(one == counts[0] for one in counts)
        assert {*counts[0]} == {size or 1}
        assert len(counts[0]) == total // ranks // (size or 1)


def test_repeats_and_splits_are_those_of_the_dataset(places):
    given = clouds(stream(places["server"], repeats=3, shuffle_buffer=4, batch_size=4))
    wanted = CachedCloudDataset(places["packed"], seed=3, repeats=3)
    wanted.set_epoch(2)
    assert sorted(drawn(given)) == sorted(drawn(wanted))
    train = stream(places["server"], split="train", shuffle_buffer=4)
    assert sorted(names(train)) == sorted(train.dataset.ids) != sorted(wanted.ids)


@pytest.mark.parametrize(
    ("workers", "start"),
    [
        (1, "fork"),
        (3, "fork"),
        pytest.param(2, "forkserver", marks=pytest.mark.slow),
        pytest.param(1, "spawn", marks=pytest.mark.slow),
    ],
)
def test_workers_share_the_samples_and_see_new_epochs(places, workers, start):
    place = places["server" if start == "fork" else "webdataset"]  # that of these tests lives in one process
    made = stream(place, batch_size=4, shuffle_buffer=6)
    loader = DataLoader(
        made, batch_size=None, num_workers=workers, multiprocessing_context=start, collate_fn=collate_packed,
        persistent_workers=True,
    )  # fmt: skip
    for epoch in (2, 5):
        pcdata.set_epoch(loader, epoch)
        wanted = CachedCloudDataset(places["packed"], seed=3)
        wanted.set_epoch(epoch)
        assert sorted(drawn(loader)) == sorted(drawn(wanted))


def test_a_loader_that_makes_the_batches_itself_gives_the_same_samples(places):
    made = stream(places["webdataset"], shuffle_buffer=6)
    loader = DataLoader(made, batch_size=4, collate_fn=collate_packed)
    given = drawn(loader)
    made.set_epoch(2)
    assert given == drawn(made)


def test_a_second_pass_in_one_epoch_warns(places):
    made = stream(places["webdataset"], batch_size=4)
    list(made)
    with pytest.warns(RepeatedEpochWarning):
        list(made)


# -- requests and memory -------------------------------------------------------------------------------------------


def test_a_shard_is_asked_for_once_and_in_order(places, requests):
    made = stream(places["server"], shuffle_buffer=0, batch_size=4)
    list(made)
    shards = made.dataset.manifest.index.num_shards
    assert len(requests) == 2 * shards  # its end, with the index, and the samples
    assert [name for name, *_ in requests[1::2]] == [f"shards/{number:05d}/clouds.tar" for number in range(shards)]


def test_parts_of_one_shard_ask_for_no_byte_twice(places, requests):
    for rank in range(5):
        list(stream(places["server"], shuffle_buffer=3, rank=rank, num_replicas=5))
    samples = sorted((name, begin, end) for name, begin, end in requests if begin != 0 or end % 512)
    inside = Counter()
    for name, begin, end in requests:
        inside[name] += end - begin
    assert samples
    size = {name: CachedCloudDataset(places["server"])._shards.server.status(name).size for name in inside}
    ends = Counter(name for name, begin, end in requests if end == size[name])
    assert all(inside[name] - ends[name] * size[name] <= size[name] for name in inside)


def test_a_worker_keeps_the_window_and_one_answer(places, monkeypatch):
    monkeypatch.setattr(tar_shard, "_AT_ONCE", 60_000)
    held, opened = [], []
    init = tar_shard.TarShard.__init__
    monkeypatch.setattr(
        tar_shard.TarShard, "__init__", lambda self, *a, **k: (init(self, *a, **k), opened.append(self))[0]
    )
    made = stream(places["server"], shuffle_buffer=5, repeats=2)
    for _ in made:
        held.append(sum(len(shard._held) for shard in opened))
        assert sum(len(shard._answer[1]) for shard in opened if shard._answer[1]) <= 60_000 * len(opened)
    assert max(held) <= 5 + 32  # the window, and those that are made at once
    assert sum(len(shard._held) for shard in opened) == 0
    assert sum(made.dataset._shards._held.values()) == 0


def test_shards_that_are_done_are_forgotten(places, monkeypatch):
    monkeypatch.setattr(url_dataset, "_MOST_OPEN", 2)
    made = stream(places["server"], shuffle_buffer=0, batch_size=4)
    for _ in made:
        assert len(made.dataset._shards._stores) <= 2


# -- going on ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("place", "batch_size"), [("webdataset", None), ("server", 4)])
def test_a_pass_that_was_stopped_goes_on_where_it_was(places, place, batch_size):
    options = {"shuffle_buffer": 6, "batch_size": batch_size}
    whole = drawn(stream(places[place], **options))
    for stop in (0, 7):
        stopped = stream(places[place], **options)
        batches = iter(stopped)
        begun = [next(batches) for _ in range(stop)]
        state = pickle.loads(pickle.dumps(stopped.state_dict()))
        resumed = stream(places[place], epoch=0, **options)
        resumed.load_state_dict(state)
        assert resumed.state_dict() == state
        assert drawn(begun) + drawn(resumed) == whole
        resumed.set_epoch(2)
        assert drawn(resumed) == whole  # the next pass begins at the beginning


def test_a_state_of_another_stream_is_refused(places):
    state = stream(places["packed"], shuffle_buffer=6).state_dict()
    for options in ({"seed": 4}, {"shuffle_buffer": 5}, {"repeats": 2}, {"rank": 0, "num_replicas": 2}):
        with pytest.raises(ConfigError, match="another stream"):
            stream(places["packed"], **{"shuffle_buffer": 6, **options}).load_state_dict(state)
    with pytest.raises(ConfigError, match="done"):
        stream(places["packed"], shuffle_buffer=6).load_state_dict({**state, "done": -1})


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("workers", [0, 2])
def test_a_stateful_loader_goes_on_where_it_was(places, workers):
    stateful = pytest.importorskip("torchdata.stateful_dataloader", reason="pip install torchdata")

    def begin():
        made = stream(places["webdataset"], batch_size=4, shuffle_buffer=6)
        return stateful.StatefulDataLoader(made, batch_size=None, num_workers=workers, collate_fn=collate_packed)

    whole = drawn(begin())
    stopped = begin()
    batches = iter(stopped)
    begun = [next(batches) for _ in range(3)]
    resumed = begin()
    resumed.load_state_dict(stopped.state_dict())
    assert drawn(begun) + drawn(resumed) == whole


# -- what fails ----------------------------------------------------------------------------------------------------


def test_a_read_that_fails_is_tried_again_and_then_told_with_shard_and_bytes(places, monkeypatch):
    monkeypatch.setattr(urls, "_FIRST_WAIT", 0.0)
    made = stream(places["server"], shuffle_buffer=0, batch_size=4)
    system = type(made.dataset._shards.server.opened()[0])
    whole, asked = system.cat_file, Counter()

    def cat_file(self, path, start=None, end=None, **options):
        asked[path, start] += 1
        if "00002" in path and start == 0 and asked[path, start] <= fails:
            raise ConnectionResetError("reset by peer")
        return whole(self, path, start=start, end=end, **options)

    monkeypatch.setattr(system, "cat_file", cat_file)
    monkeypatch.setattr(tar_shard, "_AT_END", 4096)
    fails = 3
    assert len(names(made)) == len(made.dataset)
    made.set_epoch(3)
    asked.clear()
    fails = 4
    given = []
    with pytest.raises(
        CacheError, match=r"shards/00002/clouds.tar: its bytes 0 to \d+ .*reset by peer.*tried 4"
    ) as told:
        given += [batch for batch in made]  # noqa: C416
    assert told.value.path == "memory://streamed/set/shards/00002/clouds.tar"


@pytest.mark.parametrize("workers", [0, 1])
def test_a_sample_that_was_changed_on_the_server_is_never_left_out(places, tmp_path, workers):
    system, root = fsspec.core.url_to_fs(places["server"])
    url = "memory://streamed/damaged"
    for name in system.find(root):
        system.makedirs(name.replace("/set/", "/damaged/").rpartition("/")[0], exist_ok=True)
        system.pipe_file(name.replace("/set/", "/damaged/"), system.cat_file(name))
    content = bytearray(system.cat_file("/streamed/damaged/shards/00003/clouds.tar"))
    content[3000] ^= 1
    system.pipe_file("/streamed/damaged/shards/00003/clouds.tar", bytes(content))
    loader = DataLoader(stream(url, batch_size=4), batch_size=None, num_workers=workers, collate_fn=collate_packed)
    with pytest.raises(CacheError, match=r"00003/clouds.tar.*are not those that were written") as told:
        list(loader)
    assert told.value.path == f"{url}/shards/00003/clouds.tar"
    system.pipe_file("/streamed/damaged/shards/00003/clouds.tar", bytes(content[:-512]))
    with pytest.raises(CacheError, match=r"00003/clouds.tar: has \d+ bytes, but \d+ were written"):
        list(stream(url, batch_size=4))
    system.rm_file("/streamed/damaged/shards/00003/clouds.tar")
    with pytest.raises(CacheError, match="missing"):
        list(stream(url, batch_size=4))


def test_single_samples_are_read_from_a_server_too(places, requests):
    dataset, wanted = (CachedCloudDataset(places[one], seed=3) for one in ("server", "packed"))
    for number in random.Random(0).sample(range(len(wanted)), 5):
        assert_same_cloud(dataset[number], wanted[number])
    assert len(requests) <= 5 * 2
    assert dataset.signal_table().keys() == wanted.signal_table().keys()
    assert "memory://streamed/set" in repr(dataset)
    copy = pickle.loads(pickle.dumps(dataset))
    assert_same_cloud(copy[0], wanted[0])


def test_other_formats_are_read_from_folders_alone(places):
    served(Path(places["packed"]), "memory://streamed/packed")
    with pytest.raises(CacheError, match=r"format packed is read from folders alone.*webdataset"):
        CachedCloudDataset("memory://streamed/packed")[0]


def test_a_url_without_a_dataset_is_told():
    with pytest.raises(CacheError, match=r"memory://streamed/nothing/dataset.json: the file is missing"):
        CachedCloudDataset("memory://streamed/nothing")


def test_what_a_stream_is_given_is_checked(places, monkeypatch):
    dataset = CachedCloudDataset(places["packed"])
    with pytest.raises(DTypeError, match="CachedCloudDataset"):
        StreamedCloudDataset(places["packed"])
    for options in ({"batch_size": 0}, {"shuffle_buffer": -1}, {"rank": 2, "num_replicas": 2}, {"num_replicas": 0}):
        with pytest.raises(ConfigError):
            StreamedCloudDataset(dataset, **options)
    monkeypatch.setenv("RANK", "3")
    monkeypatch.setenv("WORLD_SIZE", "5")
    made = StreamedCloudDataset(dataset)
    assert (made.rank, made.num_replicas) == (3, 5)


def test_random_steps_run_on_a_device_with_the_same_draws(places):
    steps = CachedCloudDataset(places["packed"]).pipeline.split()[1]
    made = stream(places["webdataset"], augment=None, batch_size=4, shuffle_buffer=6)
    loader = DataLoader(made, batch_size=None, collate_fn=collate_packed)
    given = drawn(DevicePipeline(loader, steps, device="cpu"))
    assert given == drawn(stream(places["webdataset"], batch_size=4, shuffle_buffer=6))


def test_a_long_pass_is_taken_up_in_a_moment(places):
    made = stream(places["packed"])
    outputs = made._outputs(range(100_000))
    begun = time.process_time()
    assert len({one.place for one in outputs}) == 100_000
    assert time.process_time() - begun < 5


def test_statistics_of_a_stream_are_those_of_the_dataset(places):
    ours = pcdata.fit_normalizers(stream(places["server"], batch_size=4), ["points"])["points"]
    wanted = CachedCloudDataset(places["packed"], seed=3)
    wanted.set_epoch(2)
    assert torch.allclose(ours.mean, pcdata.fit_normalizers(wanted, ["points"])["points"].mean, atol=1e-6)
