"""An unfinished build of a dataset at a URL: the same plan, shards and records as in a folder, as objects of a store.

An object appears whole or not at all, and nothing else is promised: no rename, no lock. So a shard is written on the
disk of whoever works on it, and then put; whoever does the same work puts the same bytes under the same names. Finished
shards are copied by the store itself to where the dataset has them: :mod:`pcdata.build.placing_at_url`.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from pcdata.build.building import (
    MOST_MARK,
    RECORDS,
    SHARD,
    SHARDS,
    SIGNALS,
    Building,
    mark_name,
    record_name,
    shards_recorded,
)
from pcdata.build.contents import foreign_names, told_foreign
from pcdata.build.placing_at_url import MOST_BYTES, PLACING, PlacingAtUrl
from pcdata.build.plan import FILE_NAME as PLAN
from pcdata.build.plan import MOST_BYTES as MOST_PLAN
from pcdata.build.plan import Plan, json_bytes
from pcdata.build.records import MOST_BYTES as MOST_RECORD
from pcdata.build.records import ShardRecord
from pcdata.errors import CacheError
from pcdata.files.interrupts import shielded
from pcdata.files.sample_names import counted
from pcdata.files.scratch import Note, scratch_beside
from pcdata.files.strict_json import json_object
from pcdata.files.url_writing import WritableUrl
from pcdata.io.store.manifest import FILE_NAME as DATASET
from pcdata.io.store.sample_keys import key_of
from pcdata.io.store.shards import TABLE, shard_folder
from pcdata.io.store.stores import STORES


class BuildingUrl(Building):
    """The place of the unfinished build of a dataset at a URL.

    Args:
        url: of the dataset.
    """

    place = "URL"
    target: WritableUrl
    kept_at: WritableUrl

    def __init__(self, url: str) -> None:
        target = WritableUrl("build", url)
        digest = hashlib.sha256(target.url.encode()).hexdigest()[:16]
        self._scratch = Path(tempfile.gettempdir()) / f"pcdata-build-{digest}"
        super().__init__(target, target.beside(f".{target.name}.building"), self._scratch)  # until it is opened
        self._placing = PlacingAtUrl(self.target, self.kept_at)
        self._plan = b""

    # -- the name that the dataset gets ----------------------------------------------------------------------------

    def check_target(self, overwrite: bool) -> None:
        sizes = self.target.sizes()
        if not sizes or self._placing.begun() is not None:
            return
        if DATASET not in sizes:
            raise CacheError(f"{self.target} is not a pcdata dataset, so it is not overwritten; choose another URL")
        with tempfile.TemporaryDirectory(prefix="pcdata-") as folder:
            told_foreign(self.target, foreign_names(sizes, Path(folder), self._placing.manifest(Path(folder))))
        if not overwrite:
            raise CacheError(f"{self.target} exists already; choose another URL, or allow overwriting (--overwrite)")

    def prepared(self, overwrite: bool, note: Note) -> object:
        self.check_target(overwrite)
        return self._placing.state()

    def quarantined_of(self, identity: str) -> dict[str, str] | None:
        if self._placing.identity() != identity:
            return None
        with suppress(CacheError), tempfile.TemporaryDirectory(prefix="pcdata-") as folder:
            return dict(self._placing.manifest(Path(folder)).quarantined.items())
        return None

    def carried(self, names: Iterable[str]) -> Path:
        before = self.path / "before"
        there = self.target.sizes()
        self.target.fetch({name: before / name for name in names if name in there})
        return before

    def put_into_place(self, plan: Plan, records: Mapping[int, ShardRecord], replaced: object, note: Note) -> None:
        self._placing.run(self.dataset, plan.identity, records, replaced, note)
        self.remove()

    # -- who works on it -------------------------------------------------------------------------------------------

    @contextmanager
    def opened(self, plan: Plan, what: str, *, restart: bool, note: Note) -> Iterator[None]:
        with scratch_beside(self._scratch, note=note) as scratch:
            self.path, self.dataset = scratch, scratch / "dataset"
            self._settle(plan, what, restart, note)
            try:
                yield
            finally:
                with shielded(), suppress(CacheError):
                    left = self.kept_at.sizes()
                    if not any(name.startswith((f"{RECORDS}/", f"{SHARDS}/")) or name == PLACING for name in left):
                        self.kept_at.remove(left)

    @contextmanager
    def claim(self, what: str, note: Note) -> Iterator[None]:
        """Do ``what``, which others may do at the same time."""
        yield

    def _settle(self, plan: Plan, what: str, restart: bool, note: Note) -> None:
        """Make the place that of this plan."""
        different = self._settled_differences(plan)
        if restart:
            if what.startswith("part-"):
                raise CacheError(
                    f"{self.kept_at}: one of several jobs cannot restart the build, since nothing tells whether others "
                    "have begun; delete it with the tool of the store, then start them without --restart"
                )
            if self._placing.begun() is not None:
                raise CacheError(
                    f"{self.kept_at}: this build was stopped while it put the dataset into place; let it do so with "
                    f"its own settings and without --restart, or delete {self.kept_at} and {self.target} with the tool "
                    "of the store"
                )
            left = self.kept_at.sizes()
            if records := [name for name in left if name.startswith(f"{RECORDS}/")]:
                note(f"deleted {counted(len(records), 'finished shard')} of an unfinished build of {self.target}")
            self.kept_at.remove(left)
        elif different:
            records = [name for name in self.kept_at.sizes() if name.startswith(f"{RECORDS}/")]
            raise self._refused(different, len(records))
        self._plan = json_bytes(plan.to_json())
        if restart or different is None:
            self.kept_at.write(PLAN, self._plan)

    def _plan_there(self) -> bytes | None:
        return self.kept_at.read_each([PLAN], max_bytes=MOST_PLAN).get(PLAN)

    def remove(self) -> None:
        """Delete the unfinished build; the plan goes last, so that what is left of a removal is known."""
        self.kept_at.remove([PLACING])
        self.kept_at.remove(name for name in sorted(self.kept_at.sizes()) if name != PLAN)
        self.kept_at.remove([PLAN])

    # -- shards ----------------------------------------------------------------------------------------------------

    def finished(self, plan: Plan) -> dict[int, ShardRecord]:
        sizes = self.kept_at.sizes()
        names = (name.removeprefix(f"{RECORDS}/") for name in sizes if name.startswith(f"{RECORDS}/"))
        shards = shards_recorded(names, plan)
        return self._records(plan, shards, sizes)

    def record(self, plan: Plan, shard: int) -> ShardRecord | None:
        return self._records(plan, [shard], None).get(shard)

    def _records(self, plan: Plan, shards: Sequence[int], sizes: Mapping[str, int] | None) -> dict[int, ShardRecord]:
        """Return the records of those shards that are whole: their list by its content, their files by their sizes."""
        found: dict[int, ShardRecord] = {}
        texts = self.kept_at.read_each(map(record_name, shards), max_bytes=MOST_RECORD)
        for shard in shards:
            if (text := texts.get(record_name(shard))) is not None:
                with suppress(CacheError):
                    found[shard] = ShardRecord.of(f"{self.kept_at}/{record_name(shard)}", text, plan, shard)
        tables = {shard: f"{SHARDS}/{record.folder_name}/{SHARD}/{TABLE}" for shard, record in found.items()}
        read = self.kept_at.read_each(tables.values(), max_bytes=MOST_BYTES)

        def is_whole(record: ShardRecord) -> bool:
            place = f"{SHARDS}/{record.folder_name}/{SHARD}"
            there = sizes
            if there is None:
                there = {f"{place}/{name}": size for name, size in self.kept_at.below(place).sizes().items()}
            table = read.get(tables[record.shard])
            return (
                table is not None
                and hashlib.sha256(table).hexdigest() == record.table
                and all(there.get(f"{place}/{name}") == size for name, size in record.files.items())
            )

        return {shard: record for shard, record in found.items() if is_whole(record)}

    def forget(self, shard: int) -> None:
        self.kept_at.remove([record_name(shard)])

    def mark(self, shard: int, text: bytes) -> None:
        self.kept_at.write(mark_name(shard), text)

    def marked(self, shard: int) -> bytes:
        return self.kept_at.read_whole(mark_name(shard), max_bytes=MOST_MARK)

    def gather(self, records: Sequence[ShardRecord], form: str) -> None:
        wanted: dict[str, Path] = {}
        for record in records:
            place, final = f"{SHARDS}/{record.folder_name}", shard_folder(self.dataset, record.shard)
            wanted[f"{place}/{SHARD}/{TABLE}"] = final / TABLE
        first = next(record for record in records if record.samples)
        final = shard_folder(self.dataset, first.shard)
        path = STORES[form](final).path_of(key_of(first.samples[0].id))
        wanted[f"{SHARDS}/{first.folder_name}/{SHARD}/{path.relative_to(final).as_posix()}"] = path
        if any("digest" in record.signals for record in records):
            for name in self.kept_at.sizes():
                if name.startswith(f"{SHARDS}/") and name.split("/")[2] == SIGNALS:
                    wanted[name] = self.path / name
        self.kept_at.fetch(wanted)

    @contextmanager
    def shard_scratch(self, shard: int) -> Iterator[Path]:
        with scratch_beside(self._scratch.with_name(f"{self._scratch.name}-{shard:05d}")) as scratch:
            yield scratch

    def sizes_on_disk(self, folder: Path) -> dict[str, int]:
        sizes = {
            path.relative_to(folder).as_posix(): path.stat().st_size for path in folder.rglob("*") if path.is_file()
        }
        return dict(sorted(sizes.items()))

    def commit(self, scratch: Path, record: ShardRecord) -> None:
        self._check_plan(record)
        place = f"{SHARDS}/{record.folder_name}"
        paths = [path for path in sorted(scratch.rglob("*")) if path.is_file()]
        self.kept_at.put({f"{place}/{path.relative_to(scratch).as_posix()}": path for path in paths})
        self.kept_at.write(record_name(record.shard), json_bytes(record.to_json()))

    def _check_plan(self, record: ShardRecord) -> None:
        text = self.kept_at.read_each([PLAN], max_bytes=MOST_PLAN).get(PLAN)
        if text is None:  # another process had nothing finished when it failed, or has done all there was to do
            if self._placing.identity() == record.identity:
                raise CacheError(f"{self.target}: another process has put this dataset into place meanwhile")
            self.kept_at.write(PLAN, self._plan)
        elif json_object(f"{self.kept_at}/{PLAN}", text, error=CacheError).get("identity") != record.identity:
            raise CacheError(f"{self.target}: another build, with other settings, has taken the place of this one")
