"""Samples into which a second scene is mixed: the same whoever asks for them, with labels and draws kept apart."""

from __future__ import annotations

import json
import pickle

import pytest
import torch
from torch.utils.data import DataLoader, Subset

from pcdata import (
    CachedCloudDataset,
    CloudDataset,
    Compose,
    CountedSampler,
    DevicePipeline,
    EpisodeWindows,
    MixedCloudDataset,
    PointCloud,
    collate_packed,
)
from pcdata.datasets import RepeatedEpochWarning
from pcdata.errors import CaptureError, ConfigError, DTypeError, FrameError
from pcdata.rng import Streams
from pcdata.transforms import Center, MaskDepth, RandomRotation, RandomSample
from tests.factories import assert_same

AFTER = Compose([RandomRotation(), RandomSample(num_points=40, if_short="repeat")])


def on_the_fly(source, config, **options) -> MixedCloudDataset:
    return MixedCloudDataset(
        CloudDataset(source, config.pipeline, seed=3, repeats=options.pop("repeats", 1)), **options
    )


def stored(caches, form: str = "packed", **options) -> MixedCloudDataset:
    repeats = options.pop("repeats", 1)
    return MixedCloudDataset(CachedCloudDataset(caches[form], seed=3, repeats=repeats), **options)


def told(cloud: PointCloud) -> dict:
    """What the history of a sample tells of the mixing."""
    (entry,) = [entry for entry in json.loads(json.dumps(cloud.history[0])) if entry["step"] == "mix_scenes"]
    return entry["params"]


def test_a_sample_is_that_of_the_dataset_and_the_partner_that_the_history_tells(caches, source, config):
    mixed = stored(caches)
    plain = CachedCloudDataset(caches["packed"], seed=3)
    chain = plain.pipeline.split()[1]
    whole, partners = CachedCloudDataset(caches["packed"], augment=None), set()
    for epoch in range(4):
        mixed.set_epoch(epoch)
        plain.set_epoch(epoch)
        for number, sample_id in enumerate(mixed.ids):
            sample, alone = mixed[number], plain[number]
            params = told(sample)
            partners.add(params["partner"])
            assert params["partner"] != sample_id
            assert sample.meta[0]["sample_id"] == sample_id
            own = sample.extra["scene"] == 0
            for name, values in alone.fields().items():
                assert torch.equal(sample.fields()[name][own], values), name
            if params["partner"] is None:
                assert bool(own.all())
                continue
            stored_partner = whole[list(whole.ids).index(params["partner"])]
            partner = chain(stored_partner, generator=Streams([params["stream"]]))
            assert torch.equal(sample.points[~own], partner.points)
            ours, theirs = sample.labels[own], sample.labels[~own]
            assert not set(ours[ours >= 0].tolist()) & set(theirs[theirs >= 0].tolist())
            assert torch.equal(theirs < 0, partner.labels < 0)
            # What was decided about the sample before is repeated on its capture.
            assert torch.equal(chain.replay(whole[number], sample.history).points, alone.points)
    assert partners == {None, *mixed.ids}


@pytest.mark.parametrize("form", ["packed", "npz", "webdataset"])
@pytest.mark.parametrize("probability", [0.0, 0.5, 1.0])
def test_a_batch_at_once_is_sample_by_sample(caches, form, probability):
    at_once, singly = (stored(caches, form, probability=probability, transform=AFTER, repeats=2) for _ in range(2))
    for asked in ([3, 0, 1, 15, 2], [0], [1, 1, (1, 1), -1, (0, 2)]):
        batch = at_once.__getitems__(asked)
        for made, index in zip(batch, asked, strict=True):
            assert_same(made, singly[index])
    assert not isinstance(batch, list)  # made at once


def test_a_stored_sample_is_mixed_as_one_on_the_fly(caches, source, config):
    for epoch in range(2):
        ours, theirs = stored(caches, transform=AFTER), on_the_fly(source, config, transform=AFTER)
        for one in (ours, theirs):
            one.set_epoch(epoch)
        for number in range(len(ours)):
            assert torch.equal(ours[number].points, theirs[number].points)
            assert told(ours[number]) == told(theirs[number])


@pytest.mark.parametrize("start", ["fork", "forkserver"])
def test_workers_change_nothing(caches, start):
    dataset, alone = stored(caches, transform=AFTER), stored(caches, transform=AFTER)
    dataset.set_epoch(2)
    alone.set_epoch(2)
    loader = DataLoader(dataset, batch_size=3, num_workers=2, collate_fn=collate_packed, multiprocessing_context=start)
    expected = list(alone)
    found = [cloud for batch in loader for cloud in batch.unbatch()]
    for ours, theirs in zip(found, expected, strict=True):
        assert torch.equal(ours.points, theirs.points)
        assert told(ours) == told(theirs)


def test_a_run_that_goes_on_draws_the_partners_of_its_epoch(caches):
    began = stored(caches)
    drawn = []
    for epoch in range(4):
        began.set_epoch(epoch)
        drawn.append([told(sample) for sample in began])
    assert len({json.dumps(one) for one in drawn}) == 4
    resumed = pickle.loads(pickle.dumps(stored(caches)))
    resumed.set_epoch(3)
    assert [told(sample) for sample in Subset(resumed, range(len(resumed)))] == drawn[3]


def test_copies_of_a_sample_have_partners_of_their_own(caches):
    dataset = stored(caches, probability=1.0, repeats=3)
    keys = {told(sample)["stream"] for sample in dataset}
    assert len(keys) == len(dataset)
    loader = DataLoader(dataset, batch_size=4, sampler=CountedSampler([0, 0, 1, 0]), collate_fn=collate_packed)
    (batch,) = loader
    assert len({told(cloud)["stream"] for cloud in batch.unbatch()}) == 4


def test_partners_are_drawn_as_often_as_it_says_and_all_alike(caches):
    dataset = stored(caches, probability=0.7, repeats=100)
    drawn = dataset._partners([number % 8 for number in range(800)], dataset._streams(dataset._asked(range(800))).keys)
    assert abs(sum(one.mixes for one in drawn) / 800 - 0.7) < 4 * (0.7 * 0.3 / 800) ** 0.5
    assert all(one.number != number % 8 for number, one in enumerate(drawn))
    counts = torch.bincount(torch.tensor([one.number for one in drawn]), minlength=8)
    assert float((counts - 100).abs().max()) < 40  # 4 standard deviations


def test_partners_may_be_of_another_dataset(caches, source, config):
    others = CloudDataset(source, config.pipeline, seed=9)
    dataset = stored(caches, partners=others, probability=1.0)
    sample = dataset[0]
    number = list(others.ids).index(told(sample)["partner"])
    partner = others._made(number, Streams([told(sample)["stream"]]))
    assert torch.equal(sample.points[sample.extra["scene"] == 1], partner.points)


def test_steps_behind_draw_otherwise_than_those_before(caches):
    dataset = MixedCloudDataset(
        CachedCloudDataset(caches["packed"], augment=RandomRotation(), seed=3), transform=RandomRotation()
    )
    history = [entry for entry in dataset[0].history[0] if entry["step"] == "RandomRotation"]
    assert len(history) == 2
    assert history[0]["params"]["matrix"] != history[1]["params"]["matrix"]


def test_steps_after_the_loader_draw_what_the_dataset_would(caches):
    inside, outside = stored(caches, transform=AFTER), stored(caches)
    loader = DataLoader(outside, batch_size=3, collate_fn=collate_packed)
    pipeline = DevicePipeline(loader, AFTER, device="cpu")
    for epoch in range(2):
        inside.set_epoch(epoch)
        outside.set_epoch(epoch)
        for given, wanted in zip(pipeline, DataLoader(inside, batch_size=3, collate_fn=collate_packed), strict=True):
            assert torch.equal(given.points, wanted.points)


def test_a_second_pass_in_one_epoch_warns(caches):
    dataset = stored(caches, transform=None)
    list(dataset)
    with pytest.warns(RepeatedEpochWarning):
        list(dataset)


def test_an_error_names_the_sample_and_its_partner(source, config):
    class Broken:
        ids = source.ids

        def load(self, sample_id):
            raise CaptureError("this one is broken")

    partners = CloudDataset(Broken(), config.pipeline)
    dataset = on_the_fly(source, config, partners=partners, probability=1.0)
    with pytest.raises(CaptureError, match="broken") as caught:
        dataset[2]
    notes = " ".join(caught.value.__notes__)
    assert repr(told(on_the_fly(source, config, probability=1.0, partners=dataset.dataset)[2])["partner"]) in notes
    assert "to be mixed in" in notes
    assert f"sample {source.ids[2]!r} of MixedCloudDataset" in notes


def test_what_cannot_be_mixed_is_refused(caches, source, config):
    clouds = CachedCloudDataset(caches["packed"])
    with pytest.raises(DTypeError, match="takes a CloudDataset or CachedCloudDataset, got Subset"):
        MixedCloudDataset(Subset(clouds, [0]))
    with pytest.raises(DTypeError, match="got MixedCloudDataset"):
        MixedCloudDataset(MixedCloudDataset(clouds))
    with pytest.raises(DTypeError, match="MixedCloudDataset"):
        EpisodeWindows(MixedCloudDataset(clouds), 2, 4)
    for probability in (-0.1, 1.5, "x", True, float("nan")):
        with pytest.raises(ConfigError, match="probability must be a number from 0 to 1"):
            MixedCloudDataset(clouds, probability=probability)
    with pytest.raises(DTypeError, match="MaskDepth takes captures"):
        MixedCloudDataset(clouds, transform=MaskDepth())
    with pytest.raises(DTypeError, match="sequence of names"):
        MixedCloudDataset(clouds, apart="labels")
    one = CachedCloudDataset(caches["packed"], augment=None)
    one.ids = list(one.ids)[:1]
    with pytest.raises(ConfigError, match="no other sample to mix with"):
        MixedCloudDataset(one)
    elsewhere = CachedCloudDataset(caches["packed"], augment=Center())
    with pytest.raises(FrameError, match="bring them into one by ToFrame"):
        MixedCloudDataset(clouds, partners=elsewhere, probability=1.0)[0]
