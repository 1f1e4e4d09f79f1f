"""The unfinished build of a dataset: what it consists of and what may be asked of it, wherever it lies.

``.NAME.building`` beside ``NAME``::

    plan.json                        which build it is
    shards/00012-DIGEST/shard/...    a finished shard: a store; what is joined of it, its signals, in ``signals`` beside
    records/00012.json               the commit: written when the shard is there under its name
    marks/00012.json                 which capture is worked on (Ray)

A shard's folder has the digest of its record in its name. So whoever commits the same shard twice, because a process of
a dead build still runs or because nothing can be locked there, does the same work twice and spoils nothing.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from pcdata.build.plan import FILE_NAME as PLAN
from pcdata.build.plan import Plan
from pcdata.build.records import ShardRecord
from pcdata.errors import CacheError
from pcdata.files.sample_names import counted
from pcdata.files.scratch import Note

RECORDS, SHARDS = "records", "shards"
SHARD, SIGNALS = "shard", "signals"  # below a finished shard: what the dataset gets, and what is joined
MOST_MARK = 1 << 20  # bytes


class Building(ABC):
    """One unfinished build; holds names alone, so it can be pickled.

    Args:
        target: what the dataset is called in the end: a path or a URL.
        kept_at: where the unfinished build is.
        path: a folder of this machine for what the end of a build needs.
    """

    place = "folder"  # what the target is, in messages

    def __init__(self, target: Any, kept_at: Any, path: Path) -> None:
        self.target = target
        self.kept_at = kept_at
        self.path = path
        self.dataset = path / "dataset"  # what becomes the dataset

    # -- the name that the dataset gets ----------------------------------------------------------------------------

    @abstractmethod
    def check_target(self, overwrite: bool) -> None:
        """Require that nothing has the name, or a dataset alone, which may be replaced.

        Raises:
            CacheError: it is neither.
        """

    @abstractmethod
    def prepared(self, overwrite: bool, note: Note) -> object:
        """Put right what killed overwrites left at the name; return what is there, for :meth:`put_into_place`.

        Raises:
            CacheError: as for :meth:`check_target`.
        """

    @abstractmethod
    def carried(self, names: Iterable[str]) -> Path:
        """Return a folder that holds those of some files that the dataset has which is to be replaced."""

    @abstractmethod
    def put_into_place(self, plan: Plan, records: Mapping[int, ShardRecord], replaced: object, note: Note) -> None:
        """Give the dataset its name, and delete what was there before, and the unfinished build.

        Args:
            plan: of the build.
            records: of all its shards.
            replaced: what :meth:`prepared` found.
            note: told what is left.

        Raises:
            CacheError: something else is there now, or it cannot be put there.
        """

    @abstractmethod
    def quarantined_of(self, identity: str) -> dict[str, str] | None:
        """Return what the dataset that has the name lacks, if it is of this build; None = there is no such dataset."""

    # -- who works on it -------------------------------------------------------------------------------------------

    @abstractmethod
    def opened(self, plan: Plan, what: str, *, restart: bool, note: Note) -> AbstractContextManager[None]:
        """Take part in the build by doing ``what``; begin it where there is none.

        At the end, an unfinished build without a finished shard leaves nothing.

        Raises:
            CacheError: another process does it now, another build is unfinished there, or nothing can be written.
        """

    @abstractmethod
    def claim(self, what: str, note: Note) -> AbstractContextManager[None]:
        """Be the only process that does ``what``, where that can be known.

        Raises:
            CacheError: another process does; says which.
        """

    def differences(self, plan: Plan) -> list[str] | None:
        """Say in words how the build that is there differs from a plan; None = there is none.

        Raises:
            CacheError: the plan there cannot be read.
        """
        there = self._plan_there()
        return None if there is None else plan.differences(f"{self.kept_at}/{PLAN}", there)

    def _settled_differences(self, plan: Plan) -> list[str] | None:
        try:
            return self.differences(plan)
        except CacheError:
            return [f"{PLAN}, which is damaged"]

    def _refused(self, different: Sequence[str], num_finished: int) -> CacheError:
        """Return the error of a build that is refused for another that is unfinished."""
        return CacheError(
            f"{self.target}: an unfinished build with {counted(num_finished, 'finished shard')} is there "
            f"({self.kept_at}), which differs in its {', '.join(different)}; finish it with its own settings, choose "
            f"another {self.place}, or start over, which deletes it: --restart"
        )

    @abstractmethod
    def _plan_there(self) -> bytes | None:
        """Return what the plan holds that is there; None = there is none."""

    # -- shards ----------------------------------------------------------------------------------------------------

    @abstractmethod
    def finished(self, plan: Plan) -> dict[int, ShardRecord]:
        """Return the valid records by shard; what a record does not fit is worked on again."""

    @abstractmethod
    def record(self, plan: Plan, shard: int) -> ShardRecord | None:
        """Return the record of a finished shard; it does not ask whether the captures are still the same."""

    @abstractmethod
    def forget(self, shard: int) -> None:
        """Take the record of a shard back: it is to be done again."""

    def work_place(self, record: ShardRecord) -> Path:
        """Return the folder, on this machine, of a finished shard, or of what is fetched of it."""
        return self.path / SHARDS / record.folder_name

    @abstractmethod
    def mark(self, shard: int, text: bytes) -> None:
        """Say of a shard what is done now, where the process that does it may end without a word.

        Raises:
            CacheError: it cannot be written.
        """

    @abstractmethod
    def marked(self, shard: int) -> bytes:
        """Return what was said of a shard last.

        Raises:
            CacheError: nothing that can be read.
        """

    @abstractmethod
    def gather(self, records: Sequence[ShardRecord], form: str) -> None:
        """Let :attr:`dataset` hold what the rest of a dataset is made from, and nothing else.

        Args:
            records: of all shards.
            form: of their stores.

        Raises:
            CacheError: one is gone.
            OSError: the disk is full.
        """

    @abstractmethod
    def shard_scratch(self, shard: int) -> AbstractContextManager[Path]:
        """Give an empty folder to write a shard in, which :meth:`commit` takes; what is not committed is removed."""

    @abstractmethod
    def sizes_on_disk(self, folder: Path) -> dict[str, int]:
        """Make a written store ready to commit and return the size of every file.

        Raises:
            CacheError: the disk is full.
        """

    @abstractmethod
    def commit(self, scratch: Path, record: ShardRecord) -> None:
        """Give a written shard its name, then write its record.

        Raises:
            CacheError: they cannot be written, or another build has taken the place of this one.
        """


def record_name(shard: int) -> str:
    """Return the name of the record of a shard."""
    return f"{RECORDS}/{shard:05d}.json"


def mark_name(shard: int) -> str:
    """Return the name of what is said of a shard that is worked on."""
    return f"marks/{shard:05d}.json"


def shards_recorded(names: Iterable[str], plan: Plan) -> list[int]:
    """Return the shards of a plan that files of a folder of records are of, by their names there."""
    found = []
    for name in sorted(names):
        number, _, suffix = name.partition(".")
        if suffix == "json" and number.isdecimal() and int(number) < plan.num_shards:
            found.append(int(number))
    return found
