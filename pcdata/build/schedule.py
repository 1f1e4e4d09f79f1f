"""What is left to do of a build, and what becomes of captures that end or block the process that works on them.

Such a capture is tried once more in a process that does nothing else. One that was killed, perhaps for memory, waits
until no other work is left. If the second try ends the same way, or the shard's next one does, the capture is
quarantined, and its shard is done without it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from pcdata.errors import CacheError

_MOST_DEATHS = 2  # of processes between two captures, in one shard


@dataclass(frozen=True)
class Task:
    """A shard to be done, or one capture of it to be tried alone."""

    shard: int
    given_up: Mapping[str, str] = field(default_factory=dict)  # captures that are not loaded again, and why
    sample_id: str | None = None  # to be tried alone
    is_alone: bool = False  # begins only when nothing else runs


class Schedule:
    """The tasks of an engine: it asks for the next one, and tells how each ended."""

    def __init__(self, shards: Iterable[int]) -> None:
        self._waiting = deque(Task(shard) for shard in shards)
        self._alone: deque[Task] = deque()
        self._strikes: dict[tuple[int, str], str] = {}  # capture -> what happened when it was loaded first
        self._given_up: dict[int, dict[str, str]] = {}
        self._deaths: dict[int, int] = {}

    def next(self, num_running: int) -> Task | None:
        """Return the next task, or None where one that runs must end first."""
        if self._waiting:
            # One that must be alone runs while nothing else is left to do, so here none does.
            return self._waiting.popleft()
        if self._alone and not num_running:
            return self._alone.popleft()
        return None

    def tried(self, task: Task, error: str | None) -> None:
        """Note that a capture was tried alone, and what it raised."""
        assert task.sample_id is not None
        if error is not None:
            self._give_up(task.shard, task.sample_id, error)
        self._again(task.shard, task.is_alone)

    def ended(self, task: Task, sample_id: str | None, what: str, *, was_killed: bool) -> bool:
        """Note that a process ended, or was ended, in the middle of a task; say whether the capture is given up.

        Args:
            task: what it did.
            sample_id: the capture that it worked on; None = it was between two.
            what: happened, for the record.
            was_killed: by whom is not known, perhaps for memory: the next try waits until nothing else runs.

        Raises:
            CacheError: that happened between captures again.
        """
        alone = was_killed or task.is_alone
        if sample_id is None:
            self._deaths[task.shard] = self._deaths.get(task.shard, 0) + 1
            if self._deaths[task.shard] >= _MOST_DEATHS:
                raise CacheError(
                    f"build_dataset: the process that worked on shard {task.shard} ended twice between two captures "
                    f"({what}); is there enough memory? --workers says how many share it"
                )
            self._again(task.shard, alone)
        elif task.sample_id is not None or (task.shard, sample_id) in self._strikes:
            self._give_up(task.shard, sample_id, what)
            self._again(task.shard, alone)
            return True
        else:
            self._strikes[task.shard, sample_id] = what
            (self._alone if alone else self._waiting).append(Task(task.shard, {}, sample_id, alone))
        return False

    def _give_up(self, shard: int, sample_id: str, error: str) -> None:
        self._given_up.setdefault(shard, {})[sample_id] = error

    def _again(self, shard: int, alone: bool) -> None:
        task = Task(shard, dict(self._given_up.get(shard, {})), None, alone)
        (self._alone if alone else self._waiting).append(task)
