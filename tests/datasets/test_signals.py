"""Signals from captures to batches: stored in every format, read by workers, collated, and in a model's batch."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch.utils.data import DataLoader

from pcdata.build import build_dataset, config_from_yaml
from pcdata.datasets import COLLATES, CachedCloudDataset, CloudDataset
from pcdata.io.store.stores import STORES
from pcdata.models import check, preset
from pcdata.report.capture_facts import capture_facts
from pcdata.report.inspection_text import dataset_text, facts_text
from pcdata.structures import DepthFrame, PointCloud, Signal
from pcdata.synthetic import SyntheticSource
from tests.factories import assert_same, cloud_in_base
from tests.signals import markers, with_signals

PIPELINE = """
depth: [Deproject]
cloud: [ToFrame: {frame: base}, MergeViews, FarthestPointSample: {num_points: 16}]
augment: [RandomRotation: {degrees: 90}]
"""


class Robot(SyntheticSource):
    """Scenes with what a robot recorded beside them."""

    def load(self, sample_id: str) -> DepthFrame:
        frame, seed = super().load(sample_id), self.ids.index(sample_id)
        spatial = {"invariant", "text"}
        signals = {
            name: Signal(values, kind, None if kind in spatial else frame.frame_id)
            for name, (values, kind) in markers(1, seed=seed).items()
        }
        return replace(frame, recorded_signals=signals)


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot(num_scenes=2, num_objects=1, num_views=2, size=(12, 16))


@pytest.mark.parametrize("form", list(STORES))
def test_a_built_dataset_keeps_the_bits_that_the_capture_had(robot, form, tmp_path):
    config = config_from_yaml(f"{PIPELINE}output: {{format: {form}}}\n")
    build_dataset(config, robot, tmp_path / "out")
    cached, fresh = CachedCloudDataset(tmp_path / "out"), CloudDataset(robot, config.pipeline)
    for number in range(2):
        stored, made = cached[number], fresh[number]
        assert_same(stored.recorded_signals, made.recorded_signals)
        assert_same(stored.recorded_signals, robot.load(robot.ids[number]).recorded_signals)
        for name, value in stored.signals.items():
            assert_same(value, made.signals[name])
    assert "action: Signal('pose xyz_quat_xyzw + invariant 1' in 'base': (1, 3, 8)" in dataset_text(tmp_path / "out")


def test_a_capture_is_told_with_its_signals(robot):
    assert "joints: invariant, (7,) float32" in facts_text(capture_facts(robot))


@pytest.mark.parametrize("name", list(COLLATES))
def test_every_collate_stacks_signals(name):
    clouds = [with_signals(cloud_in_base((5,), seed=seed), "base", seed=seed) for seed in range(3)]
    batch = COLLATES[name](clouds)
    for signal, value in batch.signals.items():
        alone = [cloud.signals[signal] for cloud in clouds]
        if isinstance(value, torch.Tensor):  # windows have an axis of their steps, one here
            assert_same(value.reshape(3, *alone[0].shape[1:]), torch.cat(alone))
        else:
            assert value == sum(alone, ())
    others = [clouds[0], clouds[1].without_signal("joints")]
    with pytest.raises(ValueError, match=r"carry different signals: .'joints'."):
        COLLATES[name](others)


def test_workers_give_what_the_main_process_gives(robot):
    dataset = CloudDataset(robot, config_from_yaml(PIPELINE).pipeline)
    expected = COLLATES["fixed"]([dataset[0], dataset[1]])
    dataset.set_epoch(0)
    options = {"num_workers": 1, "multiprocessing_context": "fork", "collate_fn": COLLATES["fixed"]}
    (batch,) = DataLoader(dataset, batch_size=2, **options)
    assert_same(batch, expected)


@pytest.mark.parametrize("model", ["dp3_sim", "ggcnn"])
def test_a_models_batch_has_the_signals_in_the_coordinates_that_the_model_sees(model):
    source = Robot(num_scenes=1, num_objects=1, size=(480, 640))
    one = source.load(source.ids[0])
    made = preset(
        model, **({"frame": "base", "crop": ((-0.3, -0.3, -0.05), (0.3, 0.3, 0.6))} if model == "dp3_sim" else {})
    )
    sample = made.pipeline(one)
    batch = made.collate([sample, sample])
    place = markers(1)["place"][0]
    if isinstance(sample, PointCloud):
        expected = sample.signals["place"]
        assert torch.equal(batch.signals["place"], torch.cat([expected, expected]))
    else:
        world = (one.world_from_camera[:, None, :3, :3] @ batch.signals["place"][:1, ..., None].double()).squeeze(-1)
        torch.testing.assert_close((world + one.world_from_camera[:, None, :3, 3]).float(), place, atol=1e-6, rtol=0)
    assert batch.signals["language"] == ("pick cube 0",) * 2
    assert "signals joints, gripper" in repr(batch)
    assert batch.to("meta").signals["place"].device.type == "meta"
    assert check(batch, model).to_json() == check(replace(batch, signals={}), model).to_json()
