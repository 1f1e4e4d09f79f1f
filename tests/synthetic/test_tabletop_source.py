"""Many scenes as a source of captures."""

from __future__ import annotations

import pickle

import pytest
import torch

from pcdata.errors import CaptureError, ConfigError
from pcdata.synthetic import SyntheticSource, tabletop, tabletop_frames

SMALL = (24, 32)


def test_ids_are_sorted_unique_and_name_the_scene_seed() -> None:
    source = SyntheticSource(num_scenes=3, seed=9998, size=SMALL)
    assert source.ids == ["tabletop-09998", "tabletop-09999", "tabletop-10000"]
    assert source.ids == sorted(set(source.ids))
    assert len(source) == 3


def test_a_loaded_scene_is_the_tabletop_of_its_seed_in_any_process() -> None:
    source = SyntheticSource(num_scenes=3, seed=5, num_views=2, noise="stereo", size=SMALL)
    frame = pickle.loads(pickle.dumps(source)).load("tabletop-0006")
    assert frame.sample_id == "tabletop-0006"
    assert torch.equal(frame.depth, tabletop(6, num_views=2, noise="stereo", size=SMALL).frame.depth)
    assert torch.equal(source.scene("tabletop-0006").truth.labels, frame.labels)


def test_frames_come_in_order_and_differ() -> None:
    frames = list(tabletop_frames(2, 3, size=SMALL))
    assert [frame.sample_id for frame in frames] == ["tabletop-0003", "tabletop-0004"]
    assert not torch.equal(frames[0].depth, frames[1].depth)


def test_an_unknown_id_is_named_with_near_matches() -> None:
    with pytest.raises(CaptureError, match="did you mean 'tabletop-0001'"):
        SyntheticSource(num_scenes=2).load("tabeltop-0001")


def test_a_wrong_noise_name_is_refused_when_the_source_is_made() -> None:
    with pytest.raises(ConfigError, match="did you mean 'stereo'"):
        SyntheticSource(num_scenes=1, noise="sterio")
