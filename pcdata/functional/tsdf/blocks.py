"""The stored voxels: compact planes, in chunks so that growing never copies, and the index that finds a block."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import torch
from torch import Tensor

from pcdata.contracts.fields import Fields
from pcdata.functional.tsdf.grid import VOXELS
from pcdata.functional.tsdf.room import VoxelRoom

CHUNK = 8192  # blocks
TSDF_SCALE = 32767  # of a stored distance: one truncation. Rounding costs 1e-5 of it, at most, per view
MAX_WEIGHT = 32767  # a voxel's weight stops here: from then on its average forgets
COLOR_SCALE = 4  # steps of a stored color per 8-bit level; three channels of 10 bits fill an int32


# Some planes of voxels: name -> their type, or, of a chunk of blocks, their values (CHUNK, 512).
#
# * tsdf, int16: signed distance / truncation * TSDF_SCALE, positive in front of the surface
# * weight, int16; all zero = never seen
# * color, int32: r | g << 10 | b << 20
# * views, int16: how many views joined the average
# * label, int32: the candidate of the vote; votes, int16: how far it leads
Planes = dict[str, torch.dtype]
Chunk = dict[str, Tensor]


def voxel_planes(*, colors: bool = False, labels: bool = False, views: bool = False) -> Planes:
    """Return the planes of voxels, in the order in which they lie in memory.

    Without ``views``, which counts views apart from weights, every view weighs 1 and the weight is the count.
    """
    found = {"tsdf": torch.int16, "weight": torch.int16}
    found |= {"color": torch.int32} if colors else {}
    found |= {"views": torch.int16} if views else {}
    found |= {"label": torch.int32, "votes": torch.int16} if labels else {}
    return found


def bytes_per_block(planes: Planes) -> int:
    """Return the memory of one block: 4 bytes a voxel, 8 with color."""
    return VOXELS * sum(dtype.itemsize for dtype in planes.values())


def _chunk(planes: Planes, memory: Tensor) -> Chunk:
    """Lay out ``CHUNK`` blocks in their memory, uint8.

    The planes of one block lie behind one another, so that a block is one stretch of memory: with color, a page.
    """
    of_blocks = memory.reshape(CHUNK, -1)
    found, start = {}, 0
    for name, dtype in planes.items():
        end = start + VOXELS * dtype.itemsize
        found[name] = of_blocks[:, start:end].view(dtype)
        start = end
    return found


@dataclass(eq=False)
class VoxelBlocks:
    """The blocks of a field: block ``keys[row]`` is row ``row % CHUNK`` of chunk ``row // CHUNK``."""

    planes: Planes
    device: torch.device
    chunks: list[Chunk] = field(default_factory=list)
    table: Tensor | None = None  # of hashed keys; kernels make it and keep it up to date
    in_table: int = 0  # rows that the table has
    addresses: Tensor | None = None  # of the chunks; kernels of a GPU make it
    room: VoxelRoom | None = None  # that chunks are cut from; None = one of their own
    _count: int = field(default=0, init=False)
    _keys: Tensor = field(init=False, repr=False)  # and room for more; doubled when full
    _sorted: tuple[Tensor, Tensor] = field(init=False, repr=False)  # keys, rows of the blocks there were at some time

    def __post_init__(self) -> None:
        self.room = VoxelRoom(self.device) if self.room is None else self.room
        self._keys = torch.empty(0, dtype=torch.int64, device=self.device)
        self._sorted = self._keys, self._keys

    def __len__(self) -> int:
        return self._count

    @property
    def keys(self) -> Tensor:
        """The keys (B,) int64 in the order of appearance."""
        return self._keys[: self._count]

    @property
    def capacity(self) -> int:
        """How many blocks there is memory for."""
        assert self.room is not None
        return self.room.num_bytes // bytes_per_block(self.planes)

    @property
    def sorted_keys(self) -> Tensor:
        """The keys (B,) int64 in their own order."""
        return self._merged()[0]

    @property
    def sorted_rows(self) -> Tensor:
        """The row (B,) int64 of every sorted key."""
        return self._merged()[1]

    def add(self, keys: Tensor) -> None:
        """Open blocks for sorted, distinct keys that have none.

        Raises:
            VolumeTooLargeError: the system has no memory for them; none was opened.
        """
        assert self.room is not None
        count = self._count + len(keys)
        while len(self.chunks) * CHUNK < count:
            self.chunks.append(_chunk(self.planes, self.room.take(CHUNK * bytes_per_block(self.planes))))
        if count > len(self._keys):
            more = self._keys.new_empty(max(count, 2 * len(self._keys), self.capacity))
            more[: self._count] = self.keys
            self._keys = more
        self._keys[self._count : count] = keys
        self._count = count

    def clear(self) -> None:
        """Close all blocks and keep their memory, all zero again."""
        for number, chunk in enumerate(self.chunks):
            for plane in chunk.values():
                plane[: max(0, self._count - number * CHUNK)].zero_()
        self._count, self.in_table, self.table = 0, 0, None
        self._sorted = self._keys[:0], self._keys[:0]

    def table_size(self, fewest: int) -> int:
        """Return how many places a table needs to find the blocks, half of them empty once there is no more room."""
        return max(fewest, 1 << (2 * max(2 * self._count, self.capacity) - 1).bit_length())

    def find(self, keys: Tensor) -> Tensor:
        """Return the (N,) row of every key, -1 where there is no block."""
        if len(self) == 0:
            return torch.full_like(keys, -1)
        sorted_keys, sorted_rows = self._merged()
        place = torch.searchsorted(sorted_keys, keys).clamp_(max=len(self) - 1)
        return torch.where(sorted_keys[place] == keys, sorted_rows[place], -1)

    def _merged(self) -> tuple[Tensor, Tensor]:
        """Merge what was added since the last time into the sorted keys: a key goes behind all those below it."""
        known_keys, known_rows = self._sorted
        known = len(known_keys)
        if known < self._count:
            keys, order = self.keys[known:].sort()
            merged_keys, merged_rows = torch.empty_like(self.keys), torch.empty_like(self.keys)
            for own, others, rows in ((keys, known_keys, order + known), (known_keys, keys, known_rows)):
                places = torch.searchsorted(others, own)
                places += torch.arange(len(own), dtype=torch.int64, device=self.device)
                merged_keys[places], merged_rows[places] = own, rows
            self._sorted = merged_keys, merged_rows
        return self._sorted

    def in_chunks(self, rows: Tensor) -> Iterator[tuple[Chunk, Tensor, Tensor]]:
        """Split rows by chunk: the chunk, the rows within it, and where these stood in ``rows``."""
        for number, chunk in enumerate(self.chunks):
            where = torch.nonzero((rows >= number * CHUNK) & (rows < (number + 1) * CHUNK)).squeeze(1)
            if len(where):
                yield chunk, rows[where] - number * CHUNK, where

    def gather(self, name: str, rows: Tensor) -> Tensor:
        """Return one plane of some blocks (N, 512); zeros for row -1."""
        found = self.chunks[0][name].new_zeros((len(rows), VOXELS))
        for chunk, inside, where in self.in_chunks(rows):
            found[where] = chunk[name][inside]
        return found


# The spec of blocks.
BLOCKS = Fields(VoxelBlocks, keys="K : int64")
