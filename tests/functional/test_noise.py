"""Random numbers for rows: what they are, and that every way to compute them gives the same bits."""

from __future__ import annotations

import pytest
import torch
from scipy import stats

from pcdata.functional.noise import move_points, normal_rows, random_order, random_rows, standard_normal
from pcdata.functional.rows import ptr_from_counts
from pcdata.kernels.cpu import unavailable
from pcdata.rng import Streams, words

COUNTS = torch.tensor([0, 1, 2, 63, 64, 65, 0, 5000, 129])
needs_core = pytest.mark.skipif(unavailable() is not None, reason="needs the compiled core")


def seeds(number: int = 0) -> torch.Tensor:
    return Streams([number + key for key in range(len(COUNTS))]).seeds()


def test_words_are_the_same_by_torch_and_by_streams():
    keys = torch.tensor([0, 5, 2**62 - 1, 2**63 - 1])
    drawn = Streams(keys.tolist())._next(50).view("int64")
    assert torch.equal(words(keys[:, None], torch.arange(50)), torch.from_numpy(drawn))
    assert len({*drawn.ravel().tolist()}) == 200


def test_words_are_those_of_the_published_generator():
    # SplitMix64 begun at 1234567, as its authors' code prints them.
    first = [6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431, 16408922859458223821]
    assert [word % 2**64 for word in words(torch.tensor(1234567), torch.arange(5)).tolist()] == first


def test_normal_numbers_are_normal_and_independent():
    values = standard_normal(words(torch.tensor(3), torch.arange(200_000)))
    assert stats.kstest(values.double().reshape(-1).numpy(), "norm").pvalue > 1e-3
    assert abs(float(torch.corrcoef(values.double().T)[0, 1])) < 0.01
    assert abs(float(torch.corrcoef(values.double().square().T)[0, 1])) < 0.01
    flat = values.double().reshape(-1)
    assert abs(float((flat[1:] * flat[:-1]).mean())) < 0.01
    assert float(values.abs().max()) > 4.5


def test_the_rarest_numbers_are_those_of_the_ends_of_a_word():
    word = torch.tensor([0, -1, -(1 << 32), (1 << 32) - 1])
    values = standard_normal(word)
    assert bool(values.isfinite().all())
    assert float(values.norm(dim=-1).max()) == pytest.approx(5.887, abs=1e-3)


def test_a_cloud_has_the_same_noise_alone_and_in_a_batch():
    together = normal_rows(ptr_from_counts(COUNTS), seeds()).split(COUNTS.tolist())
    for count, seed, rows in zip(COUNTS.tolist(), seeds(), together, strict=True):
        assert torch.equal(normal_rows(torch.tensor([0, count]), seed[None]), rows)


@needs_core
@pytest.mark.parametrize("clip", [None, 0.01])
def test_one_pass_over_the_points_gives_the_bits_of_step_after_step(clip):
    ptr = ptr_from_counts(COUNTS)
    points = torch.rand(int(ptr[-1]), 3) * 4 - 2
    turns = torch.rand(2, len(COUNTS), 4, 4, dtype=torch.float64)
    steps = [turns[0], (seeds(), 0.02, clip), turns[1], (seeds(50), 1.0, None)]
    wanted = move_points(points, ptr, steps, backend="torch")
    assert torch.equal(move_points(points, ptr, steps, backend="cpu"), wanted)
    own = points.clone()
    assert move_points(own, ptr, steps, in_place=True, backend="cpu") is own
    assert torch.equal(own, wanted)
    one_by_one = points
    for step in steps:
        one_by_one = move_points(one_by_one, ptr, [step])
    assert torch.equal(one_by_one, wanted)


def test_as_many_rows_are_chosen_as_are_wanted():
    shares = (0, 0.07, 0.5, 0.93, 1)
    for wanted in [*((COUNTS * share).long() for share in shares), COUNTS.clamp(max=1)]:
        mask = random_rows(COUNTS, wanted, seeds())
        assert [int(rows.sum()) for rows in mask.split(COUNTS.tolist())] == wanted.tolist()


def test_every_row_is_as_likely_to_be_chosen():
    times = 4000
    mask = random_rows(torch.full((times,), 10), torch.full((times,), 3), Streams(range(times)).seeds()).reshape(-1, 10)
    chosen = mask.sum(dim=0).double().numpy()
    assert stats.chisquare(chosen).pvalue > 1e-3
    pairs = (mask[:, :1] & mask[:, 1:]).sum(dim=0).double().numpy()
    assert stats.chisquare(pairs).pvalue > 1e-3


@needs_core
@pytest.mark.parametrize("size", [1, 60, 150])  # 750,000 rows: some sixty pairs have equal keys
def test_permutations_by_the_core_are_those_of_the_reference(size):
    counts = COUNTS * size
    for wanted in (counts, counts // 2, counts // 5, counts.clamp(max=1), counts.clamp(max=700), 0 * counts):
        for some in (slice(None), slice(-1, None)):
            given = counts[some], wanted[some], seeds()[some]
            assert torch.equal(random_order(*given, backend="cpu"), random_order(*given, backend="torch"))


def test_every_permutation_is_as_likely():
    times = 6000
    order = random_order(torch.full((times,), 4), torch.full((times,), 4), Streams(range(times)).seeds()).reshape(-1, 4)
    kinds = ((order % 4) * torch.tensor([64, 16, 4, 1])).sum(1)
    drawn = kinds.unique(return_counts=True)[1].double().numpy()
    assert len(drawn) == 24
    assert stats.chisquare(drawn).pvalue > 1e-3
