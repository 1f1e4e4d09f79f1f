"""Checksums tell one choice of rows from another."""

from __future__ import annotations

import pytest
import torch

from pcdata.contracts.checksums import checksums
from pcdata.rng import seeded, words


def test_every_change_of_one_row_is_told():
    mask = torch.rand(300, generator=seeded(0)) < 0.5
    found = {checksums(mask, [0, 300])[0]}
    for row in range(300):
        changed = mask.clone()
        changed[row] = ~changed[row]
        found.add(checksums(changed, [0, 300])[0])
    assert len(found) == 301


def test_swapped_words_and_other_lengths_are_told():
    halves = torch.rand(2, 64, generator=seeded(0)) < 0.5
    masks = [halves.flatten(), halves.flip(0).flatten(), *(torch.zeros(count).bool() for count in (0, 1, 63, 64, 65))]
    assert len({checksums(mask, [0, len(mask)])[0] for mask in masks}) == len(masks)


def test_random_masks_have_numbers_of_32_bits_as_even_as_chance():
    masks = torch.rand(20_000, 70, generator=seeded(1)) < 0.5
    found = checksums(masks.flatten(), list(range(0, masks.numel() + 1, 70)))
    assert min(found) >= 0
    assert max(found) < 2**32
    assert len(set(found)) >= 20_000 - 3  # of 2e8 pairs 0.05 are expected to agree
    ones = sum(number.bit_count() for number in found) / len(found)
    assert ones == pytest.approx(16, abs=0.1)


def test_a_mask_has_the_number_that_its_definition_gives():
    mask = torch.rand(130, generator=seeded(2)) < 0.5
    keys = [sum(1 << bit for bit, is_true in enumerate(part.tolist()) if is_true) for part in mask.split(64)]
    signed = torch.tensor([key - (key >> 63 << 64) for key in keys])
    total = words(signed, torch.arange(3)).sum()
    assert checksums(mask, [0, 130]) == [int(words(total, torch.tensor(130))) >> 32 & 0xFFFFFFFF]


def test_row_numbers_count_from_the_first_of_their_cloud():
    of_one, of_other = torch.tensor([3, 0, -1]), torch.tensor([5, 2])
    alone = checksums(of_one, [0, 3], [0]) + checksums(of_other, [0, 2], [0])
    together = torch.cat([of_one, of_other + 10])
    assert checksums(together, [0, 3, 5], [0, 10, 20]) == alone
    assert checksums(together, [0, 3, 3, 5], [0, 0, 10, 20])[1] == checksums(of_one[:0], [0, 0], [0])[0]


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int16, torch.float32, torch.float64])
def test_values_of_any_size_are_told_cloud_by_cloud(dtype):
    values = (torch.rand(11, 3, generator=seeded(3)) * 100).to(dtype)
    assert checksums(values, [0, 4, 11]) == [checksums(part, [0, len(part)])[0] for part in values.split([4, 7])]
