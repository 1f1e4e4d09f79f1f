"""The temporal filter, against its documented rules written out pixel by pixel."""

from __future__ import annotations

import itertools

import pytest
import torch

from pcdata.errors import ConfigError, DTypeError, ShapeError
from pcdata.functional import TemporalState, temporal_filter
from pcdata.rng import seeded

# As librealsense documents the persistency index: readings needed, of how many last frames.
DOCUMENTED = {1: (8, 8), 2: (2, 3), 3: (2, 4), 4: (2, 8), 5: (1, 2), 6: (1, 5), 7: (1, 8)}


def run(frames: torch.Tensor, **options) -> torch.Tensor:
    """Filter (T, H, W) frames one after another."""
    state, found = None, []
    for frame in frames:
        filtered, state = temporal_filter(frame[None], state, **options)
        found.append(filtered[0])
    return torch.stack(found)


@pytest.mark.parametrize("persistence", range(9))
def test_a_lost_reading_is_repeated_by_the_documented_rule_for_every_history(persistence):
    # Every one of the 2^8 histories as a pixel of its own, then a frame without readings. A first frame with readings
    # gives every pixel a value to repeat; it lies nine frames back.
    seen = torch.tensor(list(itertools.product([0.0, 1.0], repeat=8))).T.reshape(8, 16, 16)
    frames = 5.0 * torch.cat([torch.ones(1, 16, 16), seen, torch.zeros(1, 16, 16)])
    repeated = run(frames, persistence=persistence)[-1] > 0
    if persistence in (0, 8):
        assert bool(repeated.any()) == bool(repeated.all()) == (persistence == 8)
        return
    needed, window = DOCUMENTED[persistence]
    assert torch.equal(repeated, seen[-window:].sum(0) >= needed)


def test_a_repeated_reading_does_not_count_as_one():
    frames = torch.tensor([5.0, 5.0, 0.0, 0.0, 0.0, 0.0]).reshape(-1, 1, 1)
    assert run(frames, persistence=5).flatten().tolist() == [5.0, 5.0, 5.0, 5.0, 0.0, 0.0]


def test_readings_are_averaged_exponentially():
    values = [100.0, 104.0, 96.0, 110.0]
    expected, last = [100.0], 100.0
    for value in values[1:]:
        last = 0.4 * value + 0.6 * last
        expected.append(last)
    found = run(torch.tensor(values).reshape(-1, 1, 1), alpha=0.4, delta=20.0)
    assert found.flatten().tolist() == pytest.approx(expected, rel=1e-6)


def test_a_change_of_delta_starts_anew():
    frames = torch.tensor([100.0, 100.0, 120.0, 120.0]).reshape(-1, 1, 1)
    assert run(frames, delta=20.0).flatten().tolist() == [100.0, 100.0, 120.0, 120.0]
    assert run(frames, delta=20.1).flatten()[2].item() == pytest.approx(108.0)


def test_a_new_surface_cannot_lean_on_the_history_of_the_old_one():
    frames = torch.tensor([100.0, 100.0, 100.0, 300.0, 0.0]).reshape(-1, 1, 1)
    assert run(frames, persistence=3)[-1].item() == 0.0, "one reading of the last four is of this surface"
    assert run(frames, persistence=6)[-1].item() == 300.0


def test_noise_of_a_still_scene_goes_down_as_the_weights_say():
    noise = torch.randn(40, 60, 80, generator=seeded(0))
    found = run(900 + noise, alpha=0.4)
    expected = (0.4 / (2 - 0.4)) ** 0.5  # standard deviation of an exponential average, in the limit
    assert float((found[-1] - 900).std()) == pytest.approx(expected, rel=0.05)


def test_the_given_state_stays_as_it_was_and_two_streams_do_not_meet():
    frames = 100 + torch.randn(6, 2, 5, 5, generator=seeded(1))
    _, state = temporal_filter(frames[0])
    last, history = state.last.clone(), state.history.clone()
    once, _ = temporal_filter(frames[1], state)
    again, _ = temporal_filter(frames[1], state)
    assert torch.equal(once, again)
    assert torch.equal(state.last, last)
    assert torch.equal(state.history, history)


def test_views_are_filtered_alone_as_together():
    frames = 100 + torch.randn(5, 2, 6, 7, generator=seeded(2))
    state, alone = None, [None, None]
    for frame in frames:
        together, state = temporal_filter(frame, state)
        for view in range(2):
            single, alone[view] = temporal_filter(frame[view : view + 1], alone[view])
            assert torch.equal(single[0], together[view])


def test_bad_parameters_and_foreign_states_are_refused():
    values = torch.ones(1, 3, 4)
    for wrong in ({"alpha": 0.0}, {"alpha": 1.5}, {"delta": 0.0}, {"persistence": 9}, {"persistence": -1}):
        with pytest.raises(ConfigError, match="temporal_filter: needs"):
            temporal_filter(values, **wrong)
    _, state = temporal_filter(values)
    with pytest.raises(ShapeError, match="temporal_filter: last has"):
        temporal_filter(torch.ones(1, 5, 4), state)
    with pytest.raises(ShapeError, match="TemporalState: history"):
        TemporalState(last=state.last, history=state.history[:, 1:])
    with pytest.raises(DTypeError, match="state must be what the call before returned"):
        temporal_filter(values, values)
