"""The index of a dataset: which samples it has and where each lies, as arrays that stay on disk until they are asked.

``index/`` holds ``.npy`` files alone, which any NumPy maps: the ids as UTF-8 bytes with row pointers, and per sample
the number of points, the digest of its record and its shard. Opening looks at all of it with a few passes over the
arrays, so 100,000 samples take milliseconds, and no object is made of a sample before it is asked for.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CacheError, locates_path
from pcdata.files.mapping import map_file
from pcdata.files.npy import PREFIX, header_length, npy_bytes, parse_header
from pcdata.files.opening import MAX_STREAMED_BYTES, open_input
from pcdata.files.whole_folders import INDEX
from pcdata.io.store.sample_keys import key_of
from pcdata.io.store.text_table import LONGEST_TEXT, TextTable

FOLDER = INDEX

_LETTERS, _ENDS, _COUNTS, _DIGESTS, _SHARDS, _TABLES = (
    f"{name}.npy" for name in ("ids", "id_ends", "num_points", "digests", "shards", "shard_tables")
)
FILES: Mapping[str, tuple[str, tuple[int, ...]]] = {  # dtype and the shape of a row
    _LETTERS: ("|u1", ()),
    _ENDS: ("<i8", ()),  # behind the last byte of each id
    _COUNTS: ("<i8", ()),
    _DIGESTS: ("|u1", (32,)),
    _SHARDS: ("<i4", ()),
    _TABLES: ("|u1", (32,)),  # of every shard, the SHA-256 of the table of its files
}
_MOST_POINTS = 1 << 48  # of a sample


@dataclass(frozen=True)
class Sample:
    """One stored sample: its id, the key it is stored under, its size, the digest of its record, and its shard."""

    id: str
    key: str
    num_points: int
    digest: str
    shard: int = 0


class SampleIds(TextTable):
    """The ids of an index, which are unique; each is decoded when it is asked for."""

    def __init__(self, index: SampleIndex) -> None:
        super().__init__(index.arrays[_LETTERS], index.arrays[_ENDS])
        self._index = index  # which does not hold this: a circle would keep the mapped files

    def index(self, value: str, start: int = 0, stop: int | None = None) -> int:
        """Return which sample has an id, as ``list.index`` does."""
        place = self.place_of(value)
        if place is None or place not in range(len(self))[start:stop]:
            raise ValueError(f"no sample has the id {value!r:.300}")
        return place

    def __repr__(self) -> str:
        return f"<{len(self)} sample ids>" if len(self) > 9 else repr(list(self))

    def __reduce__(self) -> tuple[Any, ...]:
        return _ids_of, (self._index,)

    def check(self) -> None:
        """Require that every id is a text in one line, and that no two are the same.

        Raises:
            CacheError: they are not.
        """
        self.check_lines("id")
        repeated = self.repeated()
        if repeated is not None:
            raise CacheError(f"two samples have the id {repeated!r:.300}")


class SampleIndex(Sequence[Sample]):
    """The samples of a dataset in their order; a :class:`Sample` is made when it is asked for."""

    def __init__(
        self,
        ids: Iterable[str],
        num_points: Iterable[int],
        digests: Iterable[str],
        shards: Iterable[int],
    ) -> None:
        texts = []
        for sample_id in ids:
            key_of(sample_id)
            texts.append(sample_id.encode("utf-8", "surrogatepass"))
            if len(texts[-1]) > LONGEST_TEXT:
                raise CacheError(f"a sample id has at most {LONGEST_TEXT} bytes, {sample_id[:100]!r}... has more")
        told = [*digests]
        for digest in told:
            if not (isinstance(digest, str) and re.fullmatch("[0-9a-f]{64}", digest)):
                raise CacheError(f"a digest has 64 hexadecimal digits, got {digest!r:.100}")
        try:
            counts, places = np.array([*num_points], "<i8"), np.array([*shards], "<i4")
        except (ValueError, TypeError, OverflowError) as error:
            raise CacheError(f"num_points and shards must be whole numbers: {error}") from error
        self._take(
            {
                _LETTERS: np.frombuffer(b"".join(texts), np.uint8),
                _ENDS: np.cumsum([len(text) for text in texts], dtype="<i8"),
                _COUNTS: counts,
                _DIGESTS: np.frombuffer(bytes.fromhex("".join(told)), np.uint8).reshape(-1, 32),
                _SHARDS: places,
                _TABLES: np.empty((0, 32), np.uint8),
            }
        )
        self._check()
        self._source: tuple[str, Mapping[str, Any]] | None = None

    @classmethod
    def of(cls, samples: Sequence[Sample]) -> SampleIndex:
        """Return the index of samples.

        Raises:
            CacheError: one is none; two share an id; or they are not in the order of their shards.
        """
        if isinstance(samples, cls):
            return samples
        for sample in samples:
            if not isinstance(sample, Sample) or type(sample.num_points) is not int or type(sample.shard) is not int:
                raise CacheError(f"a sample needs an id, a key, num_points, a digest and a shard, got {sample!r:.200}")
            if sample.key != key_of(sample.id):
                raise CacheError(f"sample {sample.id!r} must have the key {key_of(sample.id)!r}, got {sample.key!r}")
        return cls(
            [one.id for one in samples],
            [one.num_points for one in samples],
            [one.digest for one in samples],
            [one.shard for one in samples],
        )

    def _take(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        self.arrays = arrays  # by file name
        self.num_points: NDArray[np.int64] = arrays[_COUNTS]  # (S,)
        self.shards: NDArray[np.int32] = arrays[_SHARDS]  # (S,) never falling
        self.tables: NDArray[np.uint8] = arrays[_TABLES]  # (shards, 32) SHA-256; of none before it is written

    def _check(self) -> None:
        arrays = self.arrays
        size = len(arrays[_ENDS])
        if any(len(arrays[name]) != size for name in (_COUNTS, _DIGESTS, _SHARDS)):
            counts = {name: len(arrays[name]) for name in FILES if name != _LETTERS}
            raise CacheError(f"its arrays are of different numbers of samples: {counts}")
        if not size:
            raise CacheError("it lists no samples; rebuild the dataset")
        lengths = np.diff(arrays[_ENDS], prepend=np.int64(0))
        # Sums of int64 wrap: every end is held to the size, not only the last.
        if bool((arrays[_ENDS] > len(arrays[_LETTERS])).any()) or bool((lengths < 1).any()):
            raise CacheError("a sample id must be a text that is not empty; the ends of its ids do not rise")
        if int(arrays[_ENDS][-1]) != len(arrays[_LETTERS]) or int(lengths.max()) > LONGEST_TEXT:
            raise CacheError(f"its ids do not fill their {len(arrays[_LETTERS])} bytes, or one is too long")
        if bool((self.num_points < 0).any()) or bool((self.num_points > _MOST_POINTS).any()):
            raise CacheError(f"num_points must be from 0 to {_MOST_POINTS} for every sample")
        if int(self.shards[0]) < 0 or bool((np.diff(self.shards) < 0).any()):
            raise CacheError("the samples must be in the order of their shards, which are numbers from 0")
        if len(self.tables) and int(self.shards[-1]) >= len(self.tables):
            raise CacheError(f"a sample lies in shard {int(self.shards[-1])}, but there are {len(self.tables)}")
        self.ids.check()

    @property
    def ids(self) -> SampleIds:
        """The ids of all samples."""
        return SampleIds(self)

    @property
    def num_shards(self) -> int:
        """How many shards there are, some of which may have no sample."""
        return len(self.tables) or int(self.shards[-1]) + 1

    def __len__(self) -> int:
        return len(self.num_points)

    @overload
    def __getitem__(self, place: int) -> Sample: ...
    @overload
    def __getitem__(self, place: slice) -> list[Sample]: ...
    def __getitem__(self, place: int | slice) -> Sample | list[Sample]:
        if isinstance(place, slice):
            return [self[number] for number in range(*place.indices(len(self)))]
        number = range(len(self))[place]
        sample_id = self.ids[number]
        return Sample(
            sample_id,
            key_of(sample_id),
            int(self.num_points[number]),
            self.digest(number),
            int(self.shards[number]),
        )

    def digest(self, number: int) -> str:
        """Return the digest of the record of one sample."""
        return self.arrays[_DIGESTS][number].tobytes().hex()

    def of_shard(self, shard: int) -> range:
        """Return which samples lie in a shard."""
        first, stop = np.searchsorted(self.shards, [shard, shard + 1]).tolist()
        return range(first, stop)

    def __eq__(self, other: object) -> bool:
        if isinstance(other, SampleIndex):
            return all(np.array_equal(self.arrays[name], other.arrays[name]) for name in FILES if name != _TABLES)
        if isinstance(other, (list, tuple)):
            return len(self) == len(other) and all(mine == one for mine, one in zip(self, other))
        return NotImplemented

    __hash__ = None  # type: ignore[assignment]  # as of a list

    def __repr__(self) -> str:
        return f"<{len(self)} samples in {self.num_shards} shards>"

    # -- on disk ---------------------------------------------------------------------------------------------------

    def write(self, folder: Path, tables: Sequence[bytes]) -> dict[str, dict[str, Any]]:
        """Write the files into a new folder ``index`` and force them to disk; return the size and SHA-256 of each.

        Args:
            folder: of the dataset.
            tables: the SHA-256 of the table of every shard.

        Raises:
            CacheError: there are fewer shards than the samples say.
            OSError: the disk is full.
        """
        if int(self.shards[-1]) >= len(tables):
            raise CacheError(f"a sample lies in shard {int(self.shards[-1])}, but there are {len(tables)}")
        told = {}
        (folder / FOLDER).mkdir()
        self._take({**self.arrays, _TABLES: np.frombuffer(b"".join(tables), np.uint8).reshape(-1, 32)})
        for name, (dtype, row) in FILES.items():
            content = npy_bytes(np.ascontiguousarray(self.arrays[name], dtype).reshape(-1, *row))
            told[name] = written(folder / FOLDER / name, content)
        return told

    @classmethod
    def read(cls, folder: Path, told: Any, num_samples: Any) -> SampleIndex:
        """Map the files of a dataset's index and look at all of them.

        Args:
            folder: of the dataset.
            told: what :meth:`write` returned.
            num_samples: how many there must be.

        Raises:
            CacheError: missing, changed, damaged or hostile.
        """
        if not isinstance(told, dict) or set(told) != {*FILES}:
            raise CacheError(f"index must tell of {', '.join(FILES)}, got {told!r:.200}")
        index = cls.__new__(cls)
        index._take({name: mapped_array(folder, name, told[name], form) for name, form in FILES.items()})
        if not len(index.tables):
            raise CacheError("it has no shards; rebuild the dataset")
        index._check()
        if type(num_samples) is not int or len(index) != num_samples:
            raise CacheError(f"num_samples is {num_samples!r:.100}, but its index has {len(index)}")
        index._source = os.path.abspath(folder), told
        return index

    def __reduce__(self) -> tuple[Any, ...]:
        if self._source is not None:  # mapped again, wherever it is needed: no worker gets a copy
            return _read_again, (*self._source, len(self))
        return _of_arrays, ({name: np.asarray(array) for name, array in self.arrays.items()},)


def _read_again(folder: str, told: Mapping[str, Any], num_samples: int) -> SampleIndex:
    return SampleIndex.read(Path(folder), told, num_samples)


def _ids_of(index: SampleIndex) -> SampleIds:
    return index.ids


def _of_arrays(arrays: Mapping[str, NDArray[Any]]) -> SampleIndex:
    index = SampleIndex.__new__(SampleIndex)
    index._take(arrays)
    index._source = None
    return index


def written(path: Path, content: bytes | memoryview) -> dict[str, Any]:
    """Write a new file and force it to disk; return its size and SHA-256.

    Raises:
        OSError: the disk is full.
    """
    with open(path, "xb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    return {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}


def mapped_array(folder: Path, name: str, told: Any, form: tuple[str, tuple[int, ...]]) -> NDArray[Any]:
    """Return the array of one file of the index, read-only and still on disk.

    Args:
        folder: of the dataset.
        name: of the file.
        told: its size and SHA-256.
        form: its dtype, and the shape of a row.

    Raises:
        CacheError: missing, changed, damaged or hostile.
    """
    return _mapped_at(folder / FOLDER / name, folder, name, told, form)


@locates_path
def _mapped_at(path: Path, folder: Path, name: str, told: Any, form: tuple[str, tuple[int, ...]]) -> NDArray[Any]:
    size, sha256 = (told.get("bytes"), told.get("sha256")) if isinstance(told, dict) else (None, None)
    if type(size) is not int or not isinstance(sha256, str):
        raise CacheError(f"index must give bytes and sha256 of {name}, got {told!r:.200}")
    where = f"{FOLDER}/{name}"
    if not os.path.lexists(path):
        raise CacheError(f"{where} is missing; copy the dataset again, or rebuild it")
    with open_input("dataset", path, max_bytes=MAX_STREAMED_BYTES, inside=[folder], error=CacheError) as file:
        found = os.fstat(file.fileno()).st_size
        if found != size:
            raise CacheError(
                f"{where} has {found} bytes, but {size} were written; copy it again, or rebuild the dataset"
            )
        content = map_file(file)
    if hashlib.sha256(content).hexdigest() != sha256:
        raise CacheError(f"{where} is not what was written; copy it again, or rebuild the dataset")
    try:
        header = parse_header(bytes(content[: header_length(bytes(content[:PREFIX]))]), size)
    except CacheError as error:
        raise CacheError(f"{where}: {error}") from error
    dtype, row = form
    if header.dtype.str != dtype or header.shape[1:] != row or not header.shape or (header.by_columns and row):
        raise CacheError(f"{where} must be {dtype} (S, {', '.join(map(str, row))}), got {header.dtype} {header.shape}")
    if not header.nbytes:
        return np.empty(header.shape, dtype)
    return np.ndarray(header.shape, dtype, content, header.begin)
