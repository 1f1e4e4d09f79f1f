"""An unfinished build of a dataset at a URL: the same plan, shards and records as in a folder, as objects of a store.

``.NAME.building`` beside ``NAME``::

    plan.json                         which build it is
    shards/00012-DIGEST/shard/...     a finished shard, and its signals beside
    records/00012.json                the commit: put when all objects of the shard are
    marks/00012.json                  which capture is worked on (Ray)
    placing.json                      the dataset is being put under its name; what of an old one is to be deleted then

An object appears whole or not at all, and nothing else is promised: no rename, no lock. So a shard is written on the
disk of whoever works on it, and put under a name that has the digest of its record. Whoever does the same work puts the
same bytes under the same names. Finished shards are copied by the store itself to where the dataset has them, and
``dataset.json`` is put last: without it there is no dataset.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from pcdata.build.contents import foreign_names, told_foreign
from pcdata.build.plan import FILE_NAME as PLAN
from pcdata.build.plan import MOST_BYTES as MOST_PLAN
from pcdata.build.plan import Plan, json_bytes
from pcdata.build.records import MOST_BYTES as MOST_RECORD
from pcdata.build.records import ShardRecord
from pcdata.errors import CacheError
from pcdata.files.interrupts import shielded
from pcdata.files.scratch import Note, scratch_beside
from pcdata.files.strict_json import json_object
from pcdata.files.url_writing import WritableUrl, is_missing
from pcdata.io.store.manifest import FILE_NAME as DATASET
from pcdata.io.store.manifest import Manifest
from pcdata.io.store.sample_index import FILES as INDEX_FILES
from pcdata.io.store.sample_index import FOLDER as INDEX
from pcdata.io.store.sample_keys import key_of
from pcdata.io.store.shards import TABLE, shard_folder
from pcdata.io.store.stores import STORES

SHARD, SIGNALS = "shard", "signals"  # below a finished shard
_PLACING = "placing.json"
_MOST_BYTES = 1 << 32  # of a list of files


class BuildingUrl:
    """The place of the unfinished build of a dataset at a URL; holds names alone, so it can be pickled."""

    def __init__(self, url: str) -> None:
        self.target = WritableUrl("build", url)
        self.kept_at = self.target.beside(f".{self.target.name}.building")
        digest = hashlib.sha256(self.target.url.encode()).hexdigest()[:16]
        self._scratch = Path(tempfile.gettempdir()) / f"pcdata-build-{digest}"
        self.path = self.dataset = self._scratch  # until it is opened
        self._plan = b""

    # -- the name that the dataset gets ----------------------------------------------------------------------------

    def check_target(self, overwrite: bool) -> None:
        """Require that nothing is below the URL, or a dataset alone, which may be replaced.

        Raises:
            CacheError: it is neither.
        """
        sizes = self.target.sizes()
        if not sizes or self._placing() is not None:
            return
        if not overwrite:
            raise CacheError(f"{self.target} exists already; choose another URL, or allow overwriting (--overwrite)")
        if DATASET not in sizes:
            raise CacheError(f"{self.target} is not a pcdata dataset, so it is not overwritten; choose another URL")
        with tempfile.TemporaryDirectory(prefix="pcdata-") as folder:
            told_foreign(self.target, foreign_names(sizes, Path(folder), self._manifest(Path(folder))))

    def prepared(self, overwrite: bool, note: Note) -> object:
        """Return what is there, for :meth:`put_into_place`.

        Raises:
            CacheError: as for :meth:`check_target`.
        """
        self.check_target(overwrite)
        return self._state()

    def carried(self, names: Iterable[str]) -> Path:
        """Return a folder that holds those of some files that the dataset has which is to be replaced."""
        before = self.path / "before"
        there = self.target.sizes()
        self.target.fetch({name: before / name for name in names if name in there})
        return before

    def put_into_place(self, plan: Plan, records: Mapping[int, ShardRecord], replaced: object, note: Note) -> None:
        """Let the store hold the dataset at its URL; each step may be done again, by another process too.

        Args:
            plan: of the build.
            records: of all its shards.
            replaced: what :meth:`prepared` found.
            note: told what is left.

        Raises:
            CacheError: something else is there now, or it cannot be put there.
        """
        shards = {
            (shard_folder(Path(), shard) / name).as_posix(): (f"shards/{record.folder_name}/{SHARD}/{name}", size)
            for shard, record in records.items()
            for name, size in record.files.items()
        }
        files = {path.relative_to(self.dataset).as_posix(): path for path in self.dataset.rglob("*") if path.is_file()}
        files = {name: path for name, path in files.items() if name not in shards and not name.startswith("shards/")}
        sizes = {name: size for name, (_, size) in shards.items()}
        sizes.update({name: path.stat().st_size for name, path in files.items() if name != DATASET})
        if self._is_placed(plan.identity) and self._state() != replaced:
            note("another process put the dataset into place")
        else:
            gone = self._begin_placing({*sizes, DATASET}, replaced)
            self.target.remove([DATASET])
            try:
                self.target.copy(self.kept_at, {name: there for name, (there, _) in shards.items()})
            except CacheError as error:  # another process has put it into place, and removed what it needs no more
                there = self.target.sizes()
                if not is_missing(error) or any(there.get(name) != size for name, (_, size) in shards.items()):
                    raise
            self.target.put({name: path for name, path in files.items() if name != DATASET})
            self.target.remove(gone)
            there = self.target.sizes()
            if wrong := [name for name, size in sizes.items() if there.get(name) != size]:
                raise CacheError(
                    f"{self.target}: {wrong[0]} has {there.get(wrong[0], 'no')} bytes, but {sizes[wrong[0]]} were put "
                    f"there; does something else write to {self.target}? The same command puts it there again"
                )
            self.target.put({DATASET: files[DATASET]})
        self.remove()

    def _begin_placing(self, names: set[str], replaced: object) -> list[str]:
        """Say that the dataset is being put under its name; return which files of an old one are in its way."""
        placing = self._placing()
        if placing is None:
            sizes = self.target.sizes()
            if sizes and (replaced is None or self._state() != replaced):
                raise CacheError(
                    f"{self.target}: somebody else made or changed it while this was built, so it is left as it is; "
                    "choose another URL"
                )
            if sizes:
                told_foreign(self.target, foreign_names(sizes, self.path / "old", self._manifest(self.path / "old")))
            placing = sorted({*sizes} - names)
            self.kept_at.write(_PLACING, json_bytes({"gone": placing}))
        return [name for name in placing if name not in names]

    def _placing(self) -> list[str] | None:
        """Return what a build that was stopped while it put a dataset into place was about to delete; None = none."""
        text = self.kept_at.read_each([_PLACING], max_bytes=_MOST_BYTES).get(_PLACING)
        if text is None:
            return None
        gone = json_object(f"{self.kept_at}/{_PLACING}", text, error=CacheError).get("gone")
        return [name for name in gone if isinstance(name, str)] if isinstance(gone, list) else []

    def _manifest(self, folder: Path) -> Manifest:
        """Return the manifest of the dataset that is there, whose small files are fetched to a folder."""
        try:
            self.target.fetch({name: folder / name for name in (DATASET, *(f"{INDEX}/{one}" for one in INDEX_FILES))})
            return Manifest.read(folder)
        except CacheError as error:
            words = str(error).replace(str(folder), str(self.target))
            raise CacheError(f"{self.target}: what is there cannot be told, so it is left as it is: {words}") from error

    def _state(self) -> str | None:
        """Return what tells the dataset that is there from another; None = there is none."""
        text = self.target.read_each([DATASET], max_bytes=_MOST_BYTES).get(DATASET)
        return None if text is None else hashlib.sha256(text).hexdigest()

    def _is_placed(self, identity: str) -> bool:
        """Say whether the dataset that is there is what a plan gives."""
        text = self.target.read_each([DATASET], max_bytes=_MOST_BYTES).get(DATASET)
        with suppress(CacheError):
            return text is not None and json_object(DATASET, text, error=CacheError).get("identity") == identity
        return False

    # -- who works on it -------------------------------------------------------------------------------------------

    @contextmanager
    def opened(self, plan: Plan, what: str, *, restart: bool, note: Note) -> Iterator[None]:
        """Take part in the build; begin it where there is none.

        Nothing tells who else does: two that do the same give the same. At the end, an unfinished build without a
        finished shard leaves nothing.

        Raises:
            CacheError: another build is unfinished there, or nothing can be written.
        """
        with scratch_beside(self._scratch, note=note) as scratch:
            self.path, self.dataset = scratch, scratch / "dataset"
            self._settle(plan, what, restart, note)
            try:
                yield
            finally:
                with shielded(), suppress(CacheError):
                    left = self.kept_at.sizes()
                    if not any(name.startswith(("records/", "shards/")) or name == _PLACING for name in left):
                        self.kept_at.remove(left)

    @contextmanager
    def claim(self, what: str, note: Note) -> Iterator[None]:
        """Do ``what``, which others may do at the same time."""
        yield

    def _settle(self, plan: Plan, what: str, restart: bool, note: Note) -> None:
        """Make the place that of this plan."""
        try:
            different = self.differences(plan)
        except CacheError:
            different = ["plan.json, which is damaged"]
        if restart:
            if what.startswith("part-"):
                raise CacheError(
                    f"{self.kept_at}: one of several jobs cannot restart the build, since nothing tells whether others "
                    "have begun; delete it with the tool of the store, then start them without --restart"
                )
            if self._placing() is not None:
                raise CacheError(
                    f"{self.kept_at}: this build was stopped while it put the dataset into place; let it do so with "
                    f"its own settings and without --restart, or delete {self.kept_at} and {self.target} with the tool "
                    "of the store"
                )
            left = self.kept_at.sizes()
            if records := [name for name in left if name.startswith("records/")]:
                note(f"deleted the {len(records)} finished shards of an unfinished build of {self.target}")
            self.kept_at.remove(left)
        elif different:
            raise CacheError(
                f"{self.target}: an unfinished build is there ({self.kept_at}), which differs in its "
                f"{', '.join(different)}; finish it with its own settings, choose another URL, or start over, which "
                "deletes it: --restart"
            )
        self._plan = json_bytes(plan.to_json())
        if restart or different is None:
            self.kept_at.write(PLAN, self._plan)

    def differences(self, plan: Plan) -> list[str] | None:
        """Say in words how the build that is there differs from a plan; None = there is none.

        Raises:
            CacheError: the plan there cannot be read.
        """
        text = self.kept_at.read_each([PLAN], max_bytes=MOST_PLAN).get(PLAN)
        return None if text is None else plan.differences(f"{self.kept_at}/{PLAN}", text)

    def remove(self) -> None:
        """Delete the unfinished build; the plan goes last, so that what is left of a removal is known."""
        self.kept_at.remove([_PLACING])
        self.kept_at.remove(name for name in sorted(self.kept_at.sizes()) if name != PLAN)
        self.kept_at.remove([PLAN])

    # -- shards ----------------------------------------------------------------------------------------------------

    def finished(self, plan: Plan) -> dict[int, ShardRecord]:
        """Return the valid records by shard; what a record does not fit is worked on again."""
        sizes = self.kept_at.sizes()
        numbers = [name[len("records/") : -len(".json")] for name in sizes if name.startswith("records/")]
        shards = sorted(int(number) for number in numbers if number.isdecimal() and int(number) < plan.num_shards)
        return self._records(plan, shards, sizes)

    def record(self, plan: Plan, shard: int) -> ShardRecord | None:
        """Return the record of a finished shard; it does not ask whether the captures are still the same."""
        return self._records(plan, [shard], None).get(shard)

    def _records(self, plan: Plan, shards: Sequence[int], sizes: Mapping[str, int] | None) -> dict[int, ShardRecord]:
        """Return the records of those shards that are whole: their list by its content, their files by their sizes."""
        found: dict[int, ShardRecord] = {}
        texts = self.kept_at.read_each(map(_record_name, shards), max_bytes=MOST_RECORD)
        for shard in shards:
            if (text := texts.get(_record_name(shard))) is not None:
                with suppress(CacheError):
                    found[shard] = ShardRecord.of(f"{self.kept_at}/{_record_name(shard)}", text, plan, shard)
        tables = {shard: f"shards/{record.folder_name}/{SHARD}/{TABLE}" for shard, record in found.items()}
        read = self.kept_at.read_each(tables.values(), max_bytes=_MOST_BYTES)

        def is_whole(record: ShardRecord) -> bool:
            place = f"shards/{record.folder_name}/{SHARD}"
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
        """Take the record of a shard back: it is to be done again."""
        self.kept_at.remove([_record_name(shard)])

    def work_place(self, record: ShardRecord) -> Path:
        """Return the folder that the signals of a finished shard are fetched to."""
        return self.path / "shards" / record.folder_name

    def mark(self, shard: int, text: bytes) -> None:
        """Say of a shard what is done now, where the process that does it may end without a word.

        Raises:
            CacheError: it cannot be written.
        """
        self.kept_at.write(f"marks/{shard:05d}.json", text)

    def marked(self, shard: int) -> bytes:
        """Return what was said of a shard last.

        Raises:
            CacheError: nothing that can be read.
        """
        return self.kept_at.read_whole(f"marks/{shard:05d}.json", max_bytes=1 << 20)

    def gather(self, records: Sequence[ShardRecord], form: str) -> None:
        """Fetch what the rest of a dataset is made from: the list of files of every shard, signals, the first cloud.

        Args:
            records: of all shards.
            form: of their stores.

        Raises:
            CacheError: one is gone.
            OSError: the disk is full.
        """
        wanted: dict[str, Path] = {}
        for record in records:
            place, final = f"shards/{record.folder_name}", shard_folder(self.dataset, record.shard)
            wanted[f"{place}/{SHARD}/{TABLE}"] = final / TABLE
        first = next(record for record in records if record.samples)
        final = shard_folder(self.dataset, first.shard)
        path = STORES[form](final).path_of(key_of(first.samples[0].id))
        wanted[f"shards/{first.folder_name}/{SHARD}/{path.relative_to(final).as_posix()}"] = path
        if any("digest" in record.signals for record in records):
            for name in self.kept_at.sizes():
                if name.startswith("shards/") and name.split("/")[2] == SIGNALS:
                    wanted[name] = self.path / name
        self.kept_at.fetch(wanted)

    @contextmanager
    def shard_scratch(self, shard: int) -> Iterator[Path]:
        """Give an empty folder of this machine to write a shard in, which :meth:`commit` takes; it is removed."""
        with scratch_beside(self._scratch.with_name(f"{self._scratch.name}-{shard:05d}")) as scratch:
            yield scratch

    def sizes_on_disk(self, folder: Path) -> dict[str, int]:
        """Return the size of every file of a written store; it stays on this disk only until it is put."""
        sizes = {
            path.relative_to(folder).as_posix(): path.stat().st_size for path in folder.rglob("*") if path.is_file()
        }
        return dict(sorted(sizes.items()))

    def commit(self, scratch: Path, record: ShardRecord) -> None:
        """Put the files of a shard, then its record.

        Raises:
            CacheError: they cannot be put, or another build has taken the place of this one.
        """
        self._check_plan(record)
        place = f"shards/{record.folder_name}"
        paths = [path for path in sorted(scratch.rglob("*")) if path.is_file()]
        self.kept_at.put({f"{place}/{path.relative_to(scratch).as_posix()}": path for path in paths})
        self.kept_at.write(_record_name(record.shard), json_bytes(record.to_json()))

    def _check_plan(self, record: ShardRecord) -> None:
        text = self.kept_at.read_each([PLAN], max_bytes=MOST_PLAN).get(PLAN)
        if text is None:  # another process had nothing finished when it failed, or has done all there was to do
            if self._is_placed(record.identity):
                raise CacheError(f"{self.target}: another process has put this dataset into place meanwhile")
            self.kept_at.write(PLAN, self._plan)
        elif json_object(f"{self.kept_at}/{PLAN}", text, error=CacheError).get("identity") != record.identity:
            raise CacheError(f"{self.target}: another build, with other settings, has taken the place of this one")


def _record_name(shard: int) -> str:
    return f"records/{shard:05d}.json"
