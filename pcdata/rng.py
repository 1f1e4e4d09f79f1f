"""Explicit randomness: every draw is keyed by (seed, epoch, sample id), never by a worker or a global state.

Decisions are drawn on the CPU, one stream per cloud, so that a cloud gets the same draws alone or in a batch, on any
device and for any number of workers.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Sequence

import torch
from torch import Generator, Tensor

from pcdata.errors import DeviceError, DTypeError, ShapeError


def seeded(seed: int) -> Generator:
    """Return a fresh CPU generator for one seed."""
    return Generator().manual_seed(seed)


def generator_for(seed: int, epoch: int, sample_id: str, *, copy: int = 0) -> Generator:
    """Return the generator that belongs to one sample in one epoch, or to one of several copies of it.

    The key is hashed (SHA-256), so neighboring seeds and ids give unrelated streams.
    """
    key = f"{seed}\0{epoch}\0{sample_id}" + (f"\0{copy}" if copy else "")
    digest = hashlib.sha256(key.encode(errors="surrogatepass")).digest()  # file names may be no UTF-8
    return seeded(int.from_bytes(digest[:8], "big") >> 1)


def child_seed(generator: Generator) -> int:
    """Draw one 62-bit seed."""
    return int(torch.randint(0, 2**62, (), generator=generator, device="cpu"))


class Streams:
    """One random stream per cloud of a batch; every method draws the same amount from each, in order.

    Clouds that are given the same generator get the same draws.
    """

    def __init__(self, generators: Sequence[Generator]) -> None:
        self.generators = list(generators)

    @functools.cached_property
    def _distinct(self) -> list[Generator]:
        return list(dict.fromkeys(self.generators))

    @functools.cached_property
    def _which(self) -> list[int] | None:
        """Of the distinct generators each cloud's; None = its own."""
        if len(self._distinct) == len(self.generators):
            return None
        numbers = {one: number for number, one in enumerate(self._distinct)}
        return [numbers[one] for one in self.generators]

    @classmethod
    def of(cls, generator: Generator | Sequence[Generator], num_clouds: int) -> Streams:
        """Take one generator per cloud as given, or split a single one: each cloud in turn draws a seed from it.

        Raises:
            ShapeError: a sequence whose length is not the number of clouds.
            DTypeError: something other than generators.
            DeviceError: a generator that is not on the CPU.
        """
        given = [generator] if isinstance(generator, Generator) else generator
        if not isinstance(given, Sequence) or not all(isinstance(one, Generator) for one in given):
            raise DTypeError(f"generator must be a torch.Generator or a sequence with one per cloud, not {generator!r}")
        if any(one.device.type != "cpu" for one in given):
            raise DeviceError(
                "generator must be on the CPU, where decisions are drawn for every device: use torch.Generator()"
            )
        if isinstance(generator, Generator):
            return cls([seeded(child_seed(generator)) for _ in range(num_clouds)])
        generators = list(given)
        if len(generators) != num_clouds:
            raise ShapeError(f"generator: {len(generators)} generators were given for {num_clouds} clouds")
        return cls(generators)

    def __len__(self) -> int:
        return len(self.generators)

    def uniform(self, low: float, high: float, *shape: int) -> Tensor:
        """Draw (B, *shape) float64 values in [low, high)."""
        unit = [torch.rand(shape, generator=one, dtype=torch.float64, device="cpu") for one in self._distinct]
        return low + (high - low) * self._given(unit, shape)

    def normal(self, *shape: int) -> Tensor:
        """Draw (B, *shape) float64 standard normal values."""
        values = [torch.randn(shape, generator=one, dtype=torch.float64, device="cpu") for one in self._distinct]
        return self._given(values, shape)

    def seeds(self) -> Tensor:
        """Draw (B,) int64 seeds, for decisions too large to keep (per-point noise, permutations)."""
        seeds = torch.tensor([child_seed(one) for one in self._distinct], dtype=torch.int64, device="cpu")
        return seeds if self._which is None else seeds[self._which]

    def _given(self, drawn: list[Tensor], shape: tuple[int, ...]) -> Tensor:
        """Give each cloud what its generator drew."""
        if not drawn:
            return torch.empty((0, *shape), dtype=torch.float64, device="cpu")
        values = torch.stack(drawn)
        return values if self._which is None else values[self._which]
