"""The hidden folder that an unfinished build lives in: its plan, its finished shards, and who works on it.

``.NAME.building`` beside ``NAME``::

    plan.json                  which build it is
    shards/00012-DIGEST/       a finished shard: a store in its folder ``shard``, its signals in another
    records/00012.json         the commit: written when the shard is on disk under its name
    claims/WHAT.HOST-PID-...   who works on it, each locked as long as its process lives
    dataset/                   what becomes NAME

A shard's folder has the digest of its record in its name. So whoever commits the same shard twice, because a process of
a dead build still runs or because a file system has no locks, does the same work twice and spoils nothing.

Of a build that quarantined captures ``.NAME.kept`` stays: its plan, its records and the signals of each shard. So these
captures can be tried again, and the other shards are taken from the dataset.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from pcdata.build.contents import check_only_dataset
from pcdata.build.plan import FILE_NAME as PLAN
from pcdata.build.plan import MOST_BYTES as MOST_PLAN
from pcdata.build.plan import Plan, write_json
from pcdata.build.records import MOST_BYTES as MOST_RECORD
from pcdata.build.records import ShardRecord
from pcdata.errors import CacheError, write_fault
from pcdata.files.interrupts import shielded
from pcdata.files.opening import read_bytes
from pcdata.files.scratch import Note, claimed, hidden_folder, living_claims, scratch_beside
from pcdata.files.syncing import sync_folder, sync_tree
from pcdata.files.whole_folders import check_replaceable, prepared, put_into_place
from pcdata.io.store.shards import FOLDER, shard_folder

_SHARDS, _RECORDS, _CLAIMS, _DATASET = "shards", "records", "claims", "dataset"
_MOST_MARK = 1 << 20  # bytes
SHARD, SIGNALS = "shard", "signals"  # in the folder of a finished shard: what the dataset gets, and what is joined


class BuildingFolder:
    """The folder of the unfinished build of one dataset; holds names alone, so it can be pickled."""

    def __init__(self, target: Path) -> None:
        self.target = target
        self.path = self.kept_at = hidden_folder(target, "building")
        self.dataset = self.path / _DATASET
        self._kept = hidden_folder(target, "kept")

    # -- the name that the dataset gets ----------------------------------------------------------------------------

    def check_target(self, overwrite: bool) -> None:
        """Require that the name is free, or that a dataset alone is there, which may be replaced.

        Raises:
            CacheError: it is neither.
        """
        check_replaceable(self.target, overwrite, check_only_dataset)

    def prepared(self, overwrite: bool, note: Note) -> object:
        """Put right what killed overwrites left at the name; return what is there, for :meth:`put_into_place`.

        Raises:
            CacheError: as for :meth:`check_target`.
        """
        return prepared(self.target, overwrite, check_only_dataset, note)

    def carried(self, names: Iterable[str]) -> Path:
        """Return a folder that holds those of some files that the dataset has which is to be replaced."""
        return self.target

    def put_into_place(self, plan: Plan, records: Mapping[int, ShardRecord], replaced: object, note: Note) -> None:
        """Give the dataset its name, and delete what was there before, and this folder.

        Args:
            plan: of the build.
            records: of all its shards.
            replaced: what :meth:`prepared` found.
            note: told what is left.

        Raises:
            CacheError: something else is there now, or it cannot be put there.
        """
        put_into_place(self.dataset, self.target, replaced, check_only_dataset, note)
        with shielded():
            shutil.rmtree(self._kept, ignore_errors=True)
            if any(record.quarantined for record in records.values()):
                self._keep(records.values())
        self.remove()

    def _keep(self, records: Iterable[ShardRecord]) -> None:
        """Set aside what :meth:`take_over` needs; the plan goes last: without it, the rest counts for nothing."""
        with suppress(OSError):  # of a full disk: then all is built anew
            self._kept.mkdir()
            os.rename(self.path / _RECORDS, self._kept / _RECORDS)
            for record in records:
                if (signals := self.work_place(record) / SIGNALS).is_dir():
                    place = self._kept / _SHARDS / record.folder_name
                    place.mkdir(parents=True)
                    os.rename(signals, place / SIGNALS)
            os.rename(self.path / PLAN, self._kept / PLAN)

    def take_over(self, plan: Plan) -> None:
        """Begin with the shards of the dataset that hold all their captures; an unfinished build goes on as it is.

        Raises:
            CacheError: there is no build to go on with, or it has other settings; or nothing can be written.
        """
        if self._num_kept():
            return
        path = self._kept / PLAN
        if not path.exists():
            raise CacheError(
                f"{self.target}: no captures of it are quarantined, or what its build left ({self._kept.name}) is not "
                "beside it; build all of it again: --overwrite"
            )
        different = plan.differences(str(path), read_bytes("build", path, max_bytes=MOST_PLAN, error=CacheError))
        if different:
            raise CacheError(
                f"{self.target}: was built with other settings: this differs in its {', '.join(different)}; only the "
                "same build can try its quarantined captures again, so repeat its settings, or build all of it again: "
                "--overwrite"
            )
        for shard in range(plan.num_shards):
            with suppress(CacheError):
                self._take_over(plan, shard)

    def _take_over(self, plan: Plan, shard: int) -> None:
        path = self._kept / _RECORDS / f"{shard:05d}.json"
        record = ShardRecord.of(
            str(path), read_bytes("build", path, max_bytes=MOST_RECORD, error=CacheError), plan, shard
        )
        place = shard_folder(self.target, shard)
        signals = self._kept / _SHARDS / record.folder_name / SIGNALS
        if record.quarantined or not record.is_whole(place) or ("digest" in record.signals) > signals.is_dir():
            return
        with self.shard_scratch(shard) as scratch:
            try:
                shutil.copytree(place, scratch / SHARD, copy_function=_linked)
                if signals.is_dir():
                    shutil.copytree(signals, scratch / SIGNALS, copy_function=_linked)
            except OSError as error:
                raise CacheError(f"{self.target}: cannot be written: {write_fault(error)}") from error
            self.commit(scratch, record)

    # -- who works on it -------------------------------------------------------------------------------------------

    @contextmanager
    def opened(self, plan: Plan, what: str, *, restart: bool, note: Note) -> Iterator[None]:
        """Take part in the build as the only one that does ``what``; begin it where there is none.

        At the end, an unfinished build without a finished shard leaves nothing.

        Raises:
            CacheError: another process does it now, another build is unfinished there, or nothing can be written.
        """
        made = [parent for parent in self.path.parents if not parent.exists()]
        is_mine = False
        try:
            try:
                for part in (_SHARDS, _RECORDS, _CLAIMS):
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
        """Be the only process that does ``what`` here.

        Raises:
            CacheError: another process does; says which.
        """
        with claimed(self.path / _CLAIMS / what, note) as other:
            if other is not None:
                raise CacheError(
                    f"{self.target}: another process writes it now (see {other}); wait until that ends, choose another "
                    "folder, or share the work: --num-shards N --shard-index K"
                )
            yield

    def _settle(self, plan: Plan, what: str, restart: bool, note: Note) -> None:
        """Make the folder that of this plan."""
        try:
            different = self.differences(plan)
        except CacheError:
            different = ["plan.json, which is damaged"]
        records = self._num_kept()
        if different == [] and not restart:
            return
        if different is not None:
            others = [one for one in living_claims(self.path / _CLAIMS) if not one.name.startswith(f"{what}.")]
            if others:
                raise CacheError(f"{self.target}: other processes build it now with other settings (see {others[0]})")
            if different and records and not restart:
                raise CacheError(
                    f"{self.target}: an unfinished build with {records} finished shards is there ({self.path}), which "
                    f"differs in its {', '.join(different)}; finish it with its own settings, choose another folder, "
                    "or start over, which deletes it: --restart"
                )
            self._empty()
            if records:
                note(f"deleted the {records} finished shards of an unfinished build of {self.target}")
        write_json(self.path / PLAN, plan.to_json())

    def differences(self, plan: Plan) -> list[str] | None:
        """Say in words how the build that is there differs from a plan; None = there is none.

        Raises:
            CacheError: the plan there cannot be read.
        """
        path = self.path / PLAN
        if not path.exists():
            return None
        there = read_bytes("build", path, max_bytes=MOST_PLAN, error=CacheError)
        return plan.differences(str(path), there)

    def _num_kept(self) -> int:
        """Return how many shards are finished and still here."""
        names = {place.name[:5] for folder in (self.path, self.dataset) for place in (folder / _SHARDS).glob("[0-9]*")}
        return len(names & {place.name[:5] for place in (self.path / _RECORDS).glob("[0-9]*")})

    def _empty(self) -> None:
        with suppress(FileNotFoundError):
            os.unlink(self.path / PLAN)
        for part in (_RECORDS, _SHARDS, _DATASET):
            shutil.rmtree(self.path / part, ignore_errors=True)
        for part in (_SHARDS, _RECORDS):
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
        for part in (_RECORDS, _SHARDS, _DATASET, _CLAIMS):
            shutil.rmtree(self.path / part, ignore_errors=True)
        shutil.rmtree(self.path, ignore_errors=True)

    # -- shards ----------------------------------------------------------------------------------------------------

    def finished(self, plan: Plan) -> dict[int, ShardRecord]:
        """Return the valid records by shard; what a record does not fit is worked on again."""
        found: dict[int, ShardRecord] = {}
        try:
            names = sorted(os.listdir(self.path / _RECORDS))
        except OSError:  # the last process has put it into place
            return found
        for name in names:
            number, _, suffix = name.partition(".")
            if suffix != "json" or not number.isdecimal() or int(number) >= plan.num_shards:
                continue
            if (record := self.record(plan, int(number))) is not None:
                found[int(number)] = record
        return found

    def forget(self, shard: int) -> None:
        """Take the record of a shard back: it is to be done again."""
        self._record_path(shard).unlink(missing_ok=True)

    def record(self, plan: Plan, shard: int) -> ShardRecord | None:
        """Return the record of a finished shard; it does not ask whether the captures are still the same."""
        with suppress(CacheError):
            path = self._record_path(shard)
            text = read_bytes("build", path, max_bytes=MOST_RECORD, error=CacheError)
            record = ShardRecord.of(str(path), text, plan, shard)
            return record if self.place_of(record) is not None else None
        return None

    def _record_path(self, shard: int) -> Path:
        return self.path / _RECORDS / f"{shard:05d}.json"

    def place_of(self, record: ShardRecord) -> Path | None:
        """Return where the store of a shard is: among the shards, or in the dataset already; None = not whole."""
        for place in (self.work_place(record) / SHARD, shard_folder(self.dataset, record.shard)):
            if record.is_whole(place):
                return place
        return None

    def work_place(self, record: ShardRecord) -> Path:
        """Return the folder that a finished shard was given."""
        return self.path / _SHARDS / record.folder_name

    def mark(self, shard: int, text: bytes) -> None:
        """Say of a shard what is done now, where the process that does it may end without a word.

        Raises:
            CacheError: it cannot be written.
        """
        folder = self.path / "marks"
        try:
            folder.mkdir(exist_ok=True)
            (folder / f"{shard:05d}.json").write_bytes(text)
        except OSError as error:
            raise CacheError(f"{self.target}: cannot be written: {write_fault(error)}") from error

    def marked(self, shard: int) -> bytes:
        """Return what was said of a shard last.

        Raises:
            CacheError: nothing that can be read.
        """
        path = self.path / "marks" / f"{shard:05d}.json"
        return read_bytes("build", path, max_bytes=_MOST_MARK, error=CacheError)

    def gather(self, records: Sequence[ShardRecord], form: str) -> None:
        """Let :attr:`dataset` hold the shards of some records, and nothing else.

        Args:
            records: of all shards.
            form: of their stores.

        Raises:
            CacheError: one is gone.
            OSError: the disk is full.
        """
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
        """Give an empty folder to write a shard in, which :meth:`commit` takes; what is not committed is removed."""
        with scratch_beside(self.path / _SHARDS / f"{shard:05d}") as scratch:
            yield scratch

    def sizes_on_disk(self, folder: Path) -> dict[str, int]:
        """Force a written store to disk and return the size of every file.

        Raises:
            CacheError: the disk is full.
        """
        try:
            return sync_tree(folder)
        except OSError as error:
            raise CacheError(f"{self.target}: cannot be written: {write_fault(error)}") from error

    def commit(self, scratch: Path, record: ShardRecord) -> None:
        """Give a shard that is on disk its name, then write its record.

        Raises:
            CacheError: they cannot be written.
        """
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
                write_json(self._record_path(record.shard), record.to_json())
        except OSError as error:
            if isinstance(error, CacheError):
                raise
            raise CacheError(f"{self.target}: cannot be written: {write_fault(error)}") from error


def _linked(source: str, target: str) -> None:
    """Give a file, which nobody writes again, a second name; copy it where the file system has none."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
