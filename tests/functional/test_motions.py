"""Motions are drawn, and led back through, with the same bits by the core and by the reference, and they are right."""

from __future__ import annotations

import math

import pytest
import torch

from pcdata.functional.motions import (
    ENTRY,
    SIGN,
    TURN,
    are_plain_motions,
    draw_motions,
    inverse_linear,
    led_back,
    sine_and_cosine,
)
from pcdata.functional.noise import dropped_rows
from pcdata.rng import Streams

KEYS = torch.from_numpy(Streams(range(-40, 60)).here())
AXIS = torch.nn.functional.normalize(torch.tensor([1.0, 2.0, -0.5], dtype=torch.float64), dim=0).tolist()
DRAWS = torch.tensor(
    [
        (0, 0, TURN, -math.pi, math.pi, 0, 0, 1),
        (1, 1, ENTRY, 0.9, 1.1, 0, 0, 0),
        (1, 1, ENTRY, 0.9, 1.1, 1, 1, 0),
        (1, 9, ENTRY, -0.2, 0.1, 2, 3, 0),
        (2, 2, SIGN, 0.5, 0, 2, 0, 0),
        (3, 4, TURN, -2 * math.pi, 2 * math.pi, *AXIS),
        (3, 5, TURN, -1, 2, 1, 0, 0),
    ],
    dtype=torch.float64,
)


def bits(values):
    return values.contiguous().view(torch.int64)


def test_the_core_draws_the_matrices_of_the_reference_bit_for_bit():
    wanted = draw_motions(KEYS, DRAWS, 5, backend="torch")
    assert torch.equal(bits(draw_motions(KEYS, DRAWS, 5, backend="cpu")), bits(wanted))
    one = draw_motions(KEYS[7:8], DRAWS, 5, backend="torch")
    assert torch.equal(bits(one), bits(wanted[:, 7:8]))


def test_what_is_drawn_is_what_the_rows_say():
    turn, entries, sign, turns, nothing = draw_motions(KEYS, DRAWS, 5, backend="torch")
    identity = torch.eye(4, dtype=torch.float64)
    assert torch.equal(nothing, identity.expand(100, 4, 4))
    for rotation in (turn, turns):
        torch.testing.assert_close(rotation @ rotation.mT, identity.expand(100, 4, 4), atol=1e-15, rtol=0)
        assert torch.linalg.det(rotation).min() > 0.999
    assert torch.equal(turn[:, 2], identity[2].expand(100, 4))  # z stays, to the last bit
    angles = torch.atan2(turn[:, 1, 0], turn[:, 0, 0])
    assert angles.min() < -3
    assert angles.max() > 3
    assert torch.equal(entries[:, 0, 0], entries[:, 1, 1])
    assert entries[:, 0, 0].min() >= 0.9
    assert entries[:, 0, 0].max() < 1.1
    assert entries[:, 2, 3].min() >= -0.2
    assert entries[:, 2, 3].max() < 0.1
    assert 30 < int((sign[:, 2, 2] < 0).sum()) < 70
    # Turned about one axis, then about another: the first of them as the stream alone has it.
    unit = Streams(range(-40, 60)).uniform(0, 1, 6)
    for number in range(3):
        first, second = -2 * math.pi + 4 * math.pi * float(unit[number, 4]), -1 + 3 * float(unit[number, 5])
        wanted = torch.linalg.matrix_exp(second * skew([1, 0, 0])) @ torch.linalg.matrix_exp(first * skew(AXIS))
        torch.testing.assert_close(turns[number, :3, :3], wanted, atol=1e-13, rtol=0)


def skew(axis):
    x, y, z = axis
    return torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)


def test_sine_and_cosine_are_right_within_a_few_turns():
    angle = torch.cat([torch.linspace(-13, 13, 100_001, dtype=torch.float64), torch.arange(-8, 9) * (math.pi / 4)])
    sine, cosine = sine_and_cosine(angle)
    assert float((sine - angle.sin()).abs().max()) <= 2.3e-16
    assert float((cosine - angle.cos()).abs().max()) <= 2.3e-16


def test_the_way_back_undoes_the_motions_bit_for_bit_as_the_reference():
    motions = draw_motions(KEYS, DRAWS, 5, backend="torch")
    source = torch.randn(100, 4, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    wanted = led_back(source, motions, backend="torch")
    assert torch.equal(bits(led_back(source, motions, backend="cpu")), bits(wanted))
    for motion in motions:
        source = source @ torch.linalg.inv(motion)
    torch.testing.assert_close(wanted, source, atol=1e-14, rtol=1e-13)


@pytest.mark.parametrize("factors", [(1e-150, 1.0, 1e150), (1e-9, 1.0, 1.0), (1e300, 1e300, 1e300), (3.0, 3.0, 3.0)])
@pytest.mark.parametrize("backend", ["cpu", "torch"])
def test_motions_that_are_nearly_flat_are_undone_too(factors, backend):
    source = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    motion = torch.diag_embed(torch.tensor([*factors, 1.0], dtype=torch.float64)).repeat(1, 2, 1, 1)
    motion[0, 1] = torch.eye(4)  # beside one that is not
    back = led_back(source, motion, backend=backend)
    assert torch.equal(back[1], source[1])
    assert torch.equal(back[0].diagonal(), 1 / motion[0, 0].diagonal())


FAULTS = {
    "nan": lambda matrix: matrix[0].fill_(math.nan),
    "infinite": lambda matrix: matrix[1, 3].fill_(math.inf),
    "projective": lambda matrix: matrix[3, 0].fill_(1e-9),
    "flat": lambda matrix: matrix[2].zero_(),
    "zero": lambda matrix: matrix[:3].zero_(),
    "tiny": lambda matrix: matrix[:3].mul_(1e-120),
}


@pytest.mark.parametrize("backend", ["cpu", "torch"])
@pytest.mark.parametrize("fault", FAULTS)
def test_what_is_no_plain_motion_is_seen(fault, backend):
    motions = draw_motions(KEYS, DRAWS, 5, backend="torch")
    assert are_plain_motions(motions, backend=backend)
    FAULTS[fault](motions[3, 50])
    assert not are_plain_motions(motions, backend=backend)


def test_inverses_have_gradients():
    linear = torch.eye(3, dtype=torch.float64) + torch.tensor([[0.1, 0.2, 0], [0, -0.1, 0.3], [0.2, 0, 0]]).double()
    assert torch.autograd.gradcheck(inverse_linear, linear[None].requires_grad_())


@pytest.mark.parametrize(("low", "high"), [(0.05, 0.1), (0.0, 0.0), (1.0, 1.0), (0.3, 0.9)])
def test_the_core_drops_the_rows_that_the_reference_drops(low, high):
    counts = torch.tensor([0, 1, 2, 17, 400] * 20)
    ptr = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
    mask, kept = dropped_rows(KEYS, ptr, low, high, backend="cpu")
    wanted, wanted_ptr = dropped_rows(KEYS, ptr, low, high, backend="torch")
    assert torch.equal(mask, wanted)
    assert torch.equal(kept, wanted_ptr)
    left = [int(mask[start:stop].sum()) for start, stop in zip(ptr[:-1].tolist(), ptr[1:].tolist(), strict=True)]
    assert left == kept.diff().tolist()
    assert all(one >= min(1, int(count)) for one, count in zip(left, counts, strict=True))
    part = 1 - sum(left) / int(counts.sum())
    assert low - 0.01 <= part <= high + 0.01
    assert torch.equal(dropped_rows(KEYS, ptr, low, high)[0], mask)
