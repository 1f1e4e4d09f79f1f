"""Laws of joining streams of different rates on one clock."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pcdata.errors import CaptureError, ConfigError
from pcdata.geometry import rigid
from pcdata.io.sources.synchronized import RULES, Trajectory, joined, mixed, nearest, slerp

EPOCH = 1_700_000_000_000_000_000  # ns: neighbors here are 256 apart as float64


@pytest.mark.parametrize("rule", RULES)
def test_a_stream_of_the_clock_s_own_times_is_joined_to_itself(rule: str) -> None:
    times = EPOCH + np.arange(5) * 33_333_333
    found = joined(times, times, rule, 0)
    assert found.before.tolist() == found.after.tolist() == [0, 1, 2, 3, 4]
    assert found.gap.tolist() == found.share.tolist() == [0.0] * 5
    assert found.counts() == {"messages": 5, "dropped": 0, "doubled": 0, "interpolated": 0, "missing": 0}


@pytest.mark.parametrize("rule", RULES)
def test_the_order_in_which_a_stream_was_written_changes_nothing(rule: str) -> None:
    draw = np.random.default_rng(0)
    times, stream = EPOCH + draw.integers(0, 10**9, 40), EPOCH + draw.choice(10**9, 60, replace=False)
    mixed_up = draw.permutation(60)
    one, other = joined(times, stream, rule), joined(times, stream[mixed_up], rule)
    for before, after in ((one.before, other.before), (one.after, other.after)):
        assert np.array_equal(before, np.where(after >= 0, mixed_up[after], -1))
    assert one.counts() == other.counts()
    assert np.array_equal(one.share, other.share)


def test_nearest_is_what_comparing_with_every_message_gives() -> None:
    draw = np.random.default_rng(1)
    times, stream = draw.integers(0, 100, 50), draw.integers(0, 100, 20)
    found = joined(times, stream, "nearest", 3)
    for time, place in zip(times, found.before):
        ranked = sorted(range(20), key=lambda one: (abs(stream[one] - time), stream[one], one))
        assert place == (ranked[0] if abs(stream[ranked[0]] - time) <= 3 else -1)
    used = set(found.before[found.before >= 0])
    counts = found.counts()
    assert counts["dropped"] == 20 - len(used)
    assert counts["missing"] == int((found.before < 0).sum()) > 0
    assert counts["doubled"] == 50 - counts["missing"] - len(used)


def test_of_two_equally_near_the_earlier_is_taken_to_the_nanosecond() -> None:
    assert joined([EPOCH], [EPOCH - 5, EPOCH + 5], "nearest").before.tolist() == [0]
    assert joined([EPOCH], [EPOCH - 5, EPOCH + 4], "nearest").before.tolist() == [1]


def test_a_linear_stream_is_reproduced_at_every_time() -> None:
    stream = np.array([0, 10, 40, 44])
    values = 3.0 * stream - 7
    times = np.arange(45)
    found = joined(times, stream, "linear")
    got = [mixed(values[a], values[b], s) for a, b, s in zip(found.before, found.after, found.share)]
    assert np.allclose(got, 3.0 * times - 7, rtol=0, atol=1e-12)
    assert found.counts()["interpolated"] == 41
    assert joined([-1, 45], stream, "linear").counts()["missing"] == 2  # nothing is extrapolated


def test_a_constant_turn_is_reproduced_exactly_also_over_the_sign_of_quaternions() -> None:
    def turn(angle: float) -> np.ndarray:
        return np.array([0, 0, np.sin(angle / 2), np.cos(angle / 2)])

    for end in (0.01, 1.0, 3.0):
        for share in (0.0, 0.25, 0.9, 1.0):
            for sign in (1, -1):
                assert abs(abs(slerp(turn(0.2), sign * turn(0.2 + end), share) @ turn(0.2 + share * end)) - 1) < 1e-14
    angles = np.linspace(0, 2.5, 6)
    track = Trajectory("track", EPOCH + np.arange(6) * 100, np.zeros((6, 3)), np.stack([turn(a) for a in angles]))
    expected = rigid.rotation_about_axis(torch.tensor([0.0, 0.0, 1.0]).double(), torch.tensor(0.5 * 1.37).double())
    assert torch.allclose(track.pose(EPOCH + 137)[:3, :3], expected, atol=1e-14)


def test_step_gives_the_last_message_at_or_before() -> None:
    stream = [10, 20, 20, 30]
    found = joined([5, 10, 19, 20, 99], stream, "step")
    assert found.before.tolist() == [-1, 0, 0, 2, 3]
    assert found.counts() == {"messages": 4, "dropped": 1, "doubled": 1, "interpolated": 0, "missing": 1}
    assert joined([99], stream, "step", max_gap=68).before.tolist() == [-1]


def test_a_gap_is_measured_to_the_farther_of_the_two_messages() -> None:
    found = joined([10, 50, 95], [0, 100], "linear", max_gap=90)
    assert found.before.tolist() == [0, 0, -1]
    assert found.gap.tolist() == [90, 50, 95]
    assert joined([90], [0, 100], "nearest", max_gap=10).before.tolist() == [1]
    assert joined([89], [0, 100], "nearest", max_gap=10).before.tolist() == [-1]


def test_messages_of_one_time_are_the_first_of_them() -> None:
    for rule in ("nearest", "linear", "slerp"):
        assert joined([20], [10, 20, 20], rule).before.tolist() == [1]
    found = joined([25], [20, 20, 30, 30], "linear")
    assert (found.before.tolist(), found.after.tolist(), found.share.tolist()) == ([1], [2], [0.5])


def test_a_stream_of_one_message_or_none() -> None:
    for rule in ("linear", "slerp"):
        assert joined([4, 5, 6], [5], rule).before.tolist() == [-1, 0, -1]
    assert joined([4, 5, 6], [5], "nearest").before.tolist() == [0, 0, 0]
    assert joined([4, 5, 6], [5], "step").before.tolist() == [-1, 0, 0]
    for rule in RULES:
        assert joined([4, 5], [], rule).before.tolist() == [-1, -1]
        assert len(joined([], [4], rule).before) == 0
    assert nearest([1.0], [], 1.0).place == {}


def test_no_other_rule_and_no_two_poses_of_one_time() -> None:
    with pytest.raises(ConfigError, match="one of nearest, linear, slerp, step"):
        joined([1], [1], "cubic")
    with pytest.raises(CaptureError, match="two poses are of the time"):
        Trajectory("track", [1, 1], np.zeros((2, 3)), np.tile([0.0, 0, 0, 1], (2, 1)))
