"""The hidden folder that an unfinished build lives in, beside the folder of the dataset.

Besides what every unfinished build has, it holds ``claims/WHAT.HOST-PID-...``, who works on it, each locked as long as
its process lives; and ``dataset/``, what becomes the dataset.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from pcdata.build.building import MOST_MARK, RECORDS, SHARD, SHARDS, Building, mark_name, record_name, shards_recorded
from pcdata.build.contents import check_only_dataset
from pcdata.build.kept_for_retry import keep_for_retry
from pcdata.build.plan import FILE_NAME as PLAN
from pcdata.build.plan import MOST_BYTES as MOST_PLAN
from pcdata.build.plan import Plan, write_json
from pcdata.build.records import MOST_BYTES as MOST_RECORD
from pcdata.build.records import ShardRecord
from pcdata.errors import CacheError, write_fault
from pcdata.files.interrupts import shielded
from pcdata.files.opening import read_bytes
from pcdata.files.sample_names import counted
from pcdata.files.scratch import Note, claimed, hidden_folder, living_claims, scratch_beside
from pcdata.files.syncing import sync_folder, sync_tree
from pcdata.files.whole_folders import check_replaceable, prepared, put_into_place
from pcdata.io.store.manifest import Manifest
from pcdata.io.store.shards import FOLDER, shard_folder

_CLAIMS = "claims"


class BuildingFolder(Building):
    """The folder of the unfinished build of one dataset.

    Args:
        target: the folder of the dataset.
    """

    target: Path

    def __init__(self, target: Path) -> None:
        path = hidden_folder(target, "building")
        super().__init__(target, path, path)
        self.kept_for_retry = hidden_folder(target, "kept")

    # -- the name that the dataset gets ----------------------------------------------------------------------------

    def check_target(self, overwrite: bool) -> None:
        check_replaceable(self.target, overwrite, check_only_dataset)

    def prepared(self, overwrite: bool, note: Note) -> object:
        return prepared(self.target, overwrite, check_only_dataset, note)

    def carried(self, names: Iterable[str]) -> Path:
        return self.target

    def quarantined_of(self, identity: str) -> dict[str, str] | None:
        with suppress(CacheError):
            there = Manifest.read(self.target)
            return dict(there.quarantined.items()) if there.identity == identity else None
        return None

    def put_into_place(self, plan: Plan, records: Mapping[int, ShardRecord], replaced: object, note: Note) -> None:
        put_into_place(self.dataset, self.target, replaced, check_only_dataset, note)
        is_kept = any(record.quarantined for record in records.values())
        if is_kept or self.kept_for_retry.exists():
            with shielded():
                keep_for_retry(self, records.values())
        self.remove()

    # -- who works on it -------------------------------------------------------------------------------------------

    @contextmanager
    def opened(self, plan: Plan, what: str, *, restart: bool, note: Note) -> Iterator[None]:
        made = [parent for parent in self.path.parents if not parent.exists()]
        is_mine = False
        try:
            try:
                for part in (SHARDS, RECORDS, _CLAIMS):
                    (self.path / part).mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise CacheError(f"{self.target}: cannot write there: {write_fault(error)}") from error
            with self.claim(what, note):
                self._settle(plan, what, restart, note)
                is_mine = True
                yield
        finally:
            with shielded():
                if is_mine or not (self.path / PLAN).exists():
                    self._remove_if_empty(plan, made)

    @contextmanager
    def claim(self, what: str, note: Note) -> Iterator[None]:
        with claimed(self.path / _CLAIMS / what, note) as other:
            if other is not None:
                raise CacheError(
                    f"{self.target}: another process writes it now (see {other}); wait until that ends, choose another "
                    "folder, or share the work: --num-shards N --shard-index K"
                )
            yield

    def _settle(self, plan: Plan, what: str, restart: bool, note: Note) -> None:
        """Make the folder that of this plan."""
        different = self._settled_differences(plan)
        records = self.num_kept()
        if different == [] and not restart:
            return
        if different is not None:
            others = [one for one in living_claims(self.path / _CLAIMS) if not one.name.startswith(f"{what}.")]
            if others:
                raise CacheError(f"{self.target}: other processes build it now with other settings (see {others[0]})")
            if different and records and not restart:
                raise self._refused(different, records)
            self._empty()
            if records:
                note(f"deleted {counted(records, 'finished shard')} of an unfinished build of {self.target}")
        write_json(self.path / PLAN, plan.to_json())

    def _plan_there(self) -> bytes | None:
        path = self.path / PLAN
        return read_bytes("build", path, max_bytes=MOST_PLAN, error=CacheError) if path.exists() else None

    def num_kept(self) -> int:
        """Return how many shards are finished and still here."""
        names = {place.name[:5] for folder in (self.path, self.dataset) for place in (folder / SHARDS).glob("[0-9]*")}
        return len(names & {place.name[:5] for place in (self.path / RECORDS).glob("[0-9]*")})

    def _empty(self) -> None:
        with suppress(FileNotFoundError):
            os.unlink(self.path / PLAN)
        for part in (RECORDS, SHARDS, self.dataset.name):
            shutil.rmtree(self.path / part, ignore_errors=True)
        for part in (SHARDS, RECORDS):
            (self.path / part).mkdir(exist_ok=True)

    def _remove_if_empty(self, plan: Plan, made: list[Path]) -> None:
        if any(record.samples for record in self.finished(plan).values()) or living_claims(self.path / _CLAIMS):
            return
        self.remove()
        with suppress(OSError):  # not empty: somebody else uses it
            for parent in made:
                parent.rmdir()

    def remove(self) -> None:
        """Delete the folder; the plan goes last, so that what is left of a removal is known."""
        for part in (RECORDS, SHARDS, self.dataset.name, _CLAIMS):
            shutil.rmtree(self.path / part, ignore_errors=True)
        shutil.rmtree(self.path, ignore_errors=True)

    # -- shards ----------------------------------------------------------------------------------------------------

    def finished(self, plan: Plan) -> dict[int, ShardRecord]:
        found: dict[int, ShardRecord] = {}
        try:
            names = os.listdir(self.path / RECORDS)
        except OSError:  # the last process has put it into place
            return found
        for shard in shards_recorded(names, plan):
            if (record := self.record(plan, shard)) is not None:
                found[shard] = record
        return found

    def forget(self, shard: int) -> None:
        (self.path / record_name(shard)).unlink(missing_ok=True)

    def record(self, plan: Plan, shard: int) -> ShardRecord | None:
        with suppress(CacheError):
            path = self.path / record_name(shard)
            text = read_bytes("build", path, max_bytes=MOST_RECORD, error=CacheError)
            record = ShardRecord.of(str(path), text, plan, shard)
            return record if self.place_of(record) is not None else None
        return None

    def place_of(self, record: ShardRecord) -> Path | None:
        """Return where the store of a shard is: among the shards, or in the dataset already; None = not whole."""
        for place in (self.work_place(record) / SHARD, shard_folder(self.dataset, record.shard)):
            if record.is_whole(place):
                return place
        return None

    def mark(self, shard: int, text: bytes) -> None:
        path = self.path / mark_name(shard)
        try:
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(text)
        except OSError as error:
            raise CacheError(f"{self.target}: cannot be written: {write_fault(error)}") from error

    def marked(self, shard: int) -> bytes:
        return read_bytes("build", self.path / mark_name(shard), max_bytes=MOST_MARK, error=CacheError)

    def gather(self, records: Sequence[ShardRecord], form: str) -> None:
        shards = self.dataset / FOLDER
        shards.mkdir(parents=True, exist_ok=True)
        for record in records:
            place, final = self.place_of(record), shard_folder(self.dataset, record.shard)
            if place is None:
                raise CacheError(f"{self.target}: shard {record.shard} is gone; start again: only it is built anew")
            if place != final:
                shutil.rmtree(final, ignore_errors=True)
                place.rename(final)
        wanted = {shards, *(shard_folder(self.dataset, record.shard) for record in records)}
        for path in [*self.dataset.iterdir(), *shards.iterdir()]:
            if path not in wanted:
                shutil.rmtree(path) if path.is_dir() else path.unlink()

    @contextmanager
    def shard_scratch(self, shard: int) -> Iterator[Path]:
        with scratch_beside(self.path / SHARDS / f"{shard:05d}") as scratch:
            yield scratch

    def sizes_on_disk(self, folder: Path) -> dict[str, int]:
        try:
            return sync_tree(folder)
        except OSError as error:
            raise CacheError(f"{self.target}: cannot be written: {write_fault(error)}") from error

    def commit(self, scratch: Path, record: ShardRecord) -> None:
        place = self.work_place(record)
        try:
            with shielded():
                try:
                    os.rename(scratch, place)
                except OSError:
                    if not place.is_dir():
                        raise
                    if not record.is_whole(place / SHARD):  # else it was made meanwhile, with the same content
                        shutil.rmtree(place)
                        os.rename(scratch, place)
                sync_folder(place.parent)
                write_json(self.path / record_name(record.shard), record.to_json())
        except OSError as error:
            if isinstance(error, CacheError):
                raise
            raise CacheError(f"{self.target}: cannot be written: {write_fault(error)}") from error
