from __future__ import annotations

import hashlib
import itertools

import pytest
import torch

from pcdata import rng
from pcdata.errors import DTypeError, ShapeError


def first_draws(generator: torch.Generator) -> tuple[float, ...]:
    return tuple(torch.rand(4, generator=generator).tolist())


def test_the_same_key_gives_the_same_stream():
    assert first_draws(rng.generator_for(3, 1, "scene/7")) == first_draws(rng.generator_for(3, 1, "scene/7"))


def test_neighboring_keys_give_different_streams():
    keys = itertools.product(range(4), range(4), ["a", "b", "1", "11", ""])
    draws = [first_draws(rng.generator_for(*key)) for key in keys]
    assert len(set(draws)) == len(draws)


def test_a_key_cannot_be_shifted_into_another():
    keys = [(1, 11, "x"), (11, 1, "x"), (1, 1, "1x"), (1, 1, "1\0x"), (111, 0, "x")]
    assert len({first_draws(rng.generator_for(*key)) for key in keys}) == len(keys)


def test_neighboring_seeds_are_uncorrelated():
    draws = torch.stack([torch.rand(2000, generator=rng.generator_for(seed, 0, "s")) for seed in range(8)])
    correlation = torch.corrcoef(draws) - torch.eye(8)
    assert float(correlation.abs().max()) < 0.1  # 4.5 standard deviations of 1 / sqrt(2000)


def test_no_draw_touches_the_global_generator():
    before = torch.get_rng_state()
    rng.Streams.of(rng.generator_for(0, 0, "s"), 3).normal(2)
    assert torch.equal(torch.get_rng_state(), before)


def test_a_cloud_draws_the_same_alone_and_in_a_batch():
    def generators() -> list[torch.Generator]:
        return [rng.generator_for(0, 0, name) for name in "abc"]

    batch = rng.Streams.of(generators(), 3)
    drawn = [batch.uniform(-1, 1, 2), batch.normal(3), batch.seeds()]
    for row, generator in enumerate(generators()):
        alone = rng.Streams.of([generator], 1)
        for together, single in zip(drawn, [alone.uniform(-1, 1, 2), alone.normal(3), alone.seeds()]):
            assert torch.equal(together[row : row + 1], single)


def test_a_single_generator_is_split_cloud_by_cloud():
    two = rng.Streams.of(rng.seeded(5), 2).uniform(0, 1)
    three = rng.Streams.of(rng.seeded(5), 3).uniform(0, 1)
    assert torch.equal(two, three[:2])
    assert len(set(three.tolist())) == 3


def test_draws_have_the_batch_in_front_and_lie_in_range():
    streams = rng.Streams.of(rng.seeded(0), 2)
    values = streams.uniform(3.0, 4.0, 500, 2)
    assert values.shape == (2, 500, 2)
    assert values.dtype == torch.float64
    assert bool(((values >= 3.0) & (values < 4.0)).all())
    assert streams.normal().shape == (2,)
    assert streams.seeds().dtype == torch.int64
    assert len(streams) == 2


def test_no_clouds_means_no_draws():
    streams = rng.Streams.of(rng.seeded(0), 0)
    assert streams.uniform(0, 1, 3).shape == (0, 3)
    assert streams.seeds().shape == (0,)


def test_child_seeds_fill_62_bits():
    generator = rng.seeded(0)
    seeds = [rng.child_seed(generator) for _ in range(200)]
    assert len(set(seeds)) == 200
    assert 2**61 < max(seeds) < 2**62


def test_wrong_generators_are_refused():
    with pytest.raises(ShapeError, match="2 generators were given for 3 clouds"):
        rng.Streams.of([rng.seeded(0), rng.seeded(1)], 3)
    with pytest.raises(DTypeError, match=r"torch\.Generator"):
        rng.Streams.of([0, 1], 2)


def test_the_keys_of_a_batch_are_the_hashes_of_its_samples_one_by_one():
    ids, copies = ["scene/7", "bü", "\udcff.npz"], [0, 1, 12]
    wanted = []
    for name, copy in zip(ids, copies, strict=True):
        text = f"3\0-1\0{name}" + (f"\0{copy}" if copy else "")
        wanted.append(int.from_bytes(hashlib.sha256(text.encode(errors="surrogatepass")).digest()[:8], "big") >> 1)
    encoded = [name.encode(errors="surrogatepass") for name in ids]
    assert rng.sample_keys(3, -1, encoded, copies).tolist() == wanted
    assert [rng.sample_key(3, -1, name, copy=copy) for name, copy in zip(ids, copies, strict=True)] == wanted
