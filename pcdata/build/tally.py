"""What came of the captures so far: whether too many fail for the build to go on, and how far it is."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

from pcdata import errors
from pcdata.build.plan import Plan
from pcdata.build.records import ShardRecord
from pcdata.errors import CacheError, CaptureError, ConfigError, PcdataError, add_note, locate
from pcdata.files.scratch import Note
from pcdata.progress import Progress

_STARVED = 3  # captures in shards one after another that lack memory: the machine is at fault, not they
_FIRST = 8  # captures: where all of them fail, the configuration is at fault


def most_bad(max_bad: int | str | None, num_samples: int) -> int | None:
    """Return how many captures may be quarantined: of a count, or of a share such as "1%", which is rounded down.

    Raises:
        ConfigError: it is neither.
    """
    if max_bad is None:
        return None
    found = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?)(%?)", str(max_bad))
    most = 100 if found is not None and found[2] else 1e15
    if isinstance(max_bad, bool) or found is None or (not found[2] and "." in found[1]) or float(found[1]) > most:
        raise ConfigError(
            f'build: max_bad must be a number of captures, or a share from "0%" to "100%", got {max_bad!r:.60}'
        )
    return math.floor(float(found[1]) / 100 * num_samples) if found[2] else int(found[1])


class Tally:
    """The captures of a build that are stored, and those that failed."""

    def __init__(
        self,
        plan: Plan,
        shards: range,
        finished: Mapping[int, ShardRecord],
        limit: int | None,
        progress: Progress | None,
        note: Note,
    ) -> None:
        """Begin with the shards that are finished.

        Args:
            plan: of the whole build.
            shards: those that are to be done here.
            finished: of all shards.
            limit: how many captures may be quarantined in all.
            progress: told of the captures of ``shards``.
            note: told what a look at captures finds, as soon as their shard is finished.

        Raises:
            CaptureError: more are quarantined than may be.
        """
        self._num_samples, self._limit, self._progress, self._note = len(plan.ids), limit, progress, note
        self._total = sum(len(plan.ids_of(shard)) for shard in shards)
        self._num_done = sum(len(plan.ids_of(shard)) for shard in shards if shard in finished)
        self._any_stored = any(record.samples for record in finished.values())
        self._quarantined = {name: why for one in finished.values() for name, why in one.quarantined.items()}
        self._num_starved = 0
        self._first: dict[str, str] = {}  # the captures that failed before any was stored
        self._open: dict[int, set[str]] = {}  # captures that are done, of shards that are not
        for record in finished.values():
            self._tell_look(record)
        self._check()

    def captured(self, shard: int, sample_id: str, error: str | None) -> None:
        """Note that a capture is done, or failed once or again.

        Raises:
            PcdataError: of the type that the captures raise: all of the first fail.
        """
        self._any_stored |= error is None
        if error is not None and not self._any_stored:
            self._first.setdefault(sample_id, error)
            if len(self._first) >= _FIRST:
                raise all_failed(self._first, self._num_samples)
        if sample_id not in self._open.setdefault(shard, set()):
            self._open[shard].add(sample_id)
            self._tell(sample_id)

    def committed(self, record: ShardRecord) -> None:
        """Note that a shard is finished.

        Raises:
            CaptureError: more captures are quarantined than may be.
            CacheError: the machine lacks memory.
        """
        self._open.pop(record.shard, None)
        self._any_stored |= bool(record.samples)
        self._num_done += len(record.samples) + len(record.quarantined)
        self._quarantined.update(record.quarantined)
        self._tell_look(record)
        self._check()
        starved = [name for name, why in record.quarantined.items() if why.startswith(MemoryError.__name__)]
        self._num_starved = self._num_starved + len(starved) if starved else 0
        if self._num_starved >= _STARVED:
            raise CacheError(
                f"build_dataset: the memory does not suffice for {starved[-1]!r} and others before it; what is "
                "finished is kept, and the same command, perhaps with fewer --workers, goes on and tries them again"
            )

    def _tell_look(self, record: ShardRecord) -> None:
        if record.look:
            self._note(record.look)

    def _check(self) -> None:
        if self._limit is not None and len(self._quarantined) > self._limit:
            shown = "; ".join(f"{name!r}: {why}" for name, why in list(self._quarantined.items())[:5])
            raise CaptureError(
                f"build_dataset: {len(self._quarantined)} of {self._num_samples} captures failed, and at most "
                f"{self._limit} may: {shown}; what is finished is kept: the same command with a larger --max-bad, or "
                "without, goes on"
            )

    def _tell(self, sample_id: str) -> None:
        if self._progress is not None:
            done = self._num_done + sum(map(len, self._open.values()))
            self._progress(min(done, self._total), self._total, sample_id)


def all_failed(failed: Mapping[str, str], num_samples: int) -> PcdataError:
    """Return the error of a build of which nothing comes: of the type that the first capture raised."""
    sample_id, reason = next(iter(failed.items()))
    which = f"all of the first {len(failed)} captures" if len(failed) < num_samples else f"all {num_samples} captures"
    which = "the only capture" if num_samples == 1 else which
    error = told_error(
        reason,
        f"build_dataset: {which} failed, so the configuration or the source is at fault and nothing can "
        f"be stored; {sample_id!r}: {reason}",
    )
    step = re.match(r"\w+ in (\w+)", reason)  # as shard_work.error_in_words writes it
    locate(error, step=step[1] if step else None, sample_id=sample_id)
    return error


def stop_in_words(error: Exception) -> tuple[str, str, list[str]]:
    """Return what stops a build, as it travels from a worker: its type, its message, its notes."""
    kind = type(error).__name__
    message = str(error) if isinstance(error, PcdataError) else f"{kind}: {error}"
    return kind, message, [str(note) for note in getattr(error, "__notes__", [])]


def stopped(kind: str, message: str, notes: list[str]) -> PcdataError:
    """Return the error of :func:`stop_in_words`."""
    error = told_error(kind, message)
    for note in notes:
        add_note(error, note)
    return error


def told_error(reason: str, message: str) -> PcdataError:
    """Return an error of the type that a reason names, ``TypeError in STEP: ...``, where that is one of pcdata's."""
    kind = re.split(r"[ :]", reason, maxsplit=1)[0]
    known = getattr(errors, kind, None)
    if isinstance(known, type) and issubclass(known, PcdataError):
        return known(message)
    return CaptureError(message)
