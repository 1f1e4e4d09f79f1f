"""Explicit randomness: every draw is keyed by (seed, epoch, sample id), never by a worker or a global state.

Decisions are drawn on the CPU, one stream per cloud, so that a cloud gets the same draws alone or in a batch, on any
device and for any number of workers. A stream is a key: its word number i is a hash of the key and i, so the words of
all clouds of a batch, or of all points, are computed at once. torch's own generators, with a state of 5 KB each, would
take longer to make than a stored batch takes to read.

Source of the hash: Steele, Lea and Flood, Fast splittable pseudorandom number generators, OOPSLA 2014 (SplitMix64).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Generator, Tensor

from pcdata.errors import DeviceError, DTypeError, ShapeError

_GOLDEN = 0x9E3779B97F4A7C15
_FIRST_WORDS = 8  # of every stream, computed at once
_FIRST, _SECOND = 0xBF58476D1CE4E5B9, 0x94D049BB133111EB


def seeded(seed: int) -> Generator:
    """Return a fresh CPU generator for one seed."""
    return Generator().manual_seed(seed)


def generator_for(seed: int, epoch: int, sample_id: str, *, copy: int = 0) -> Generator:
    """Return the generator that belongs to one sample in one epoch, or to one of several copies of it.

    The key is hashed (SHA-256), so neighboring seeds and ids give unrelated streams.
    """
    return seeded(sample_key(seed, epoch, sample_id, copy=copy))


def sample_key(seed: int, epoch: int, sample_id: str, *, copy: int = 0) -> int:
    """Return the key, of 63 bits, of the stream that belongs to one sample in one epoch, or to a copy of it."""
    encoded = sample_id.encode(errors="surrogatepass")  # file names may be no UTF-8
    return int(sample_keys(seed, epoch, [encoded], [copy])[0])


def sample_keys(seed: int, epoch: int, ids: Sequence[bytes], copies: Sequence[int]) -> NDArray[np.int64]:
    """Return the keys of the streams of many samples."""
    begun = hashlib.sha256(f"{seed}\0{epoch}\0".encode())
    digests = []
    for sample_id, copy in zip(ids, copies, strict=True):
        total = begun.copy()
        total.update(sample_id + b"\0%d" % copy if copy else sample_id)
        digests.append(total.digest())
    return (np.frombuffer(b"".join(digests), ">u8")[::4] >> np.uint64(1)).astype(np.int64)


def words(keys: Tensor, number: Tensor) -> Tensor:
    """Return words of streams, int64 of 64 random bits, for int64 keys and numbers that broadcast; on any device."""
    mixed = keys + (number + 1) * _signed(_GOLDEN)
    mixed = (mixed ^ _shifted(mixed, 30)) * _signed(_FIRST)
    mixed = (mixed ^ _shifted(mixed, 27)) * _signed(_SECOND)
    return mixed ^ _shifted(mixed, 31)


def mixed_words(keys: NDArray[np.uint64], number: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Return the same of NumPy arrays, on the calling thread alone."""
    mixed = keys + (number.astype(np.uint64) + np.uint64(1)) * np.uint64(_GOLDEN)
    mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(_FIRST)
    mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(_SECOND)
    found: NDArray[np.uint64] = mixed ^ (mixed >> np.uint64(31))
    return found


def _signed(word: int) -> int:
    return word - (1 << 64) if word >> 63 else word


def _shifted(word: Tensor, bits: int) -> Tensor:
    """Shift right and fill with zeros, where torch copies the sign."""
    return (word >> bits) & ((1 << (64 - bits)) - 1)


def child_seed(generator: Generator) -> int:
    """Draw one 62-bit seed."""
    return int(torch.randint(0, 2**62, (), generator=generator, device="cpu"))


class Streams:
    """One random stream per cloud of a batch; every method draws the same amount from each, in order.

    Clouds that are given the same generator, or the same key, get the same draws.
    """

    def __init__(self, keys: Sequence[int] | NDArray[np.int64]) -> None:
        """Begin streams of these keys, of 63 bits."""
        self._keys = np.asarray(keys, dtype=np.int64).view(np.uint64)
        self.place = 0  # the number of the next word
        self._ahead: NDArray[np.uint64] = np.empty((len(self._keys), 0), np.uint64)  # the first words

    @classmethod
    def of(cls, generator: GeneratorLike, num_clouds: int) -> Streams:
        """Take streams, one generator per cloud, or a single one: each cloud in turn draws a key from it.

        Streams of another number of clouds are those of views that were merged or split: the first one carries on.

        Raises:
            ShapeError: a sequence of generators whose length is not the number of clouds.
            DTypeError: something other than generators.
            DeviceError: a generator that is not on the CPU.
        """
        if isinstance(generator, Streams):
            return generator._carried(num_clouds)
        given = [generator] if isinstance(generator, Generator) else generator
        if not isinstance(given, Sequence) or not all(isinstance(one, Generator) for one in given):
            raise DTypeError(f"generator must be a torch.Generator or a sequence with one per cloud, not {generator!r}")
        if any(one.device.type != "cpu" for one in given):
            raise DeviceError(
                "generator must be on the CPU, where decisions are drawn for every device: use torch.Generator()"
            )
        if isinstance(generator, Generator):
            # All at once: the numbers that child_seed draws one by one.
            return cls(torch.randint(0, 2**62, (num_clouds,), generator=generator, device="cpu").numpy())
        if len(given) != num_clouds:
            raise ShapeError(f"generator: {len(given)} generators were given for {num_clouds} clouds")
        keys = {one: child_seed(one) for one in dict.fromkeys(given)}
        return cls([keys[one] for one in given])

    @property
    def keys(self) -> list[int]:
        """The key of each stream."""
        return self._keys.view(np.int64).tolist()

    def here(self) -> NDArray[np.int64]:
        """Return (B,) the key of a stream that begins with the next word of each."""
        return (self._keys + np.uint64(self.place * _GOLDEN % 2**64)).view(np.int64)

    def take(self, count: int) -> Tensor:
        """Draw (B,) int64 keys of streams whose first ``count`` words are the next ones of these."""
        keys = torch.from_numpy(self.here())
        self.place += count
        return keys

    def __len__(self) -> int:
        return len(self._keys)

    def part(self, which: slice, repeats: int = 1) -> Streams:
        """Return the streams of some clouds from their beginning, each for ``repeats`` clouds in a row."""
        return Streams(np.repeat(self._keys[which], repeats).view(np.int64))

    def uniform(self, low: float, high: float, *shape: int) -> Tensor:
        """Draw (B, *shape) float64 values in [low, high)."""
        return low + (high - low) * torch.from_numpy(self._unit(math.prod(shape))).reshape(len(self), *shape)

    def normal(self, *shape: int) -> Tensor:
        """Draw (B, *shape) float64 standard normal values."""
        count = math.prod(shape)
        unit = self._unit(2 * count).reshape(-1, 2).tolist()
        # By Box and Muller, number by number: array libraries round a logarithm as their vectors have it.
        values = [math.sqrt(-2 * math.log(1 - one)) * math.cos(2 * math.pi * other) for one, other in unit]
        return torch.tensor(values, dtype=torch.float64, device="cpu").reshape(len(self), *shape)

    def seeds(self) -> Tensor:
        """Draw (B,) int64 seeds of 62 bits, for decisions too large to keep (per-point noise, permutations)."""
        return torch.from_numpy((self._next(1)[:, 0] >> np.uint64(2)).view(np.int64))

    def _unit(self, count: int) -> NDArray[np.float64]:
        return (self._next(count) >> np.uint64(11)).astype(np.float64) * 2.0**-53

    def _next(self, count: int) -> NDArray[np.uint64]:
        """Return (B, count) words, those of :func:`words`."""
        begin, self.place = self.place, self.place + count
        if self.place <= _FIRST_WORDS:  # most steps draw one or two
            if not self._ahead.size:
                self._ahead = self._words(0, _FIRST_WORDS)
            return self._ahead[:, begin : self.place]
        return self._words(begin, count)

    def _words(self, begin: int, count: int) -> NDArray[np.uint64]:
        number = np.arange(begin + 1, begin + 1 + count, dtype=np.uint64) * np.uint64(_GOLDEN)
        mixed = self._keys[:, None] + number
        mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(_FIRST)
        mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(_SECOND)
        mixed ^= mixed >> np.uint64(31)
        return mixed

    def _carried(self, num_clouds: int) -> Streams:
        if len(self) == num_clouds:
            return self
        first = Streams(self._keys[:1].view(np.int64))
        first.place = self.place
        if num_clouds == 1:
            return first
        return Streams((first._next(num_clouds)[0] >> np.uint64(2)).view(np.int64))


GeneratorLike: TypeAlias = Generator | Sequence[Generator] | Streams
