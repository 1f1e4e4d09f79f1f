"""A pool of spawned processes: what ends or blocks one costs one capture, not the build.

Every worker has a pipe of its own to this process and shares no lock with others, so one that is killed at any moment
leaves nothing behind that the rest waits for. Workers end by themselves when this process is gone.

What they need is sent when they ask for it, not as an argument of the process: :mod:`multiprocessing` writes arguments
into a pipe whose other end it holds itself, and waits forever where they are many and the process is killed meanwhile.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
import time
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from typing import Any

import torch

from pcdata.build.records import ShardRecord
from pcdata.build.schedule import Schedule, Task
from pcdata.build.shard_work import Job
from pcdata.build.tally import Tally, stop_in_words, stopped
from pcdata.errors import CacheError, ConfigError, PcdataWarning
from pcdata.files.interrupts import deaf_children, shielded

_ONE_THREAD = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS")
START = "spawn"  # how workers are started: a fork copies the locks of threads that it does not have
_GRACE = 5.0  # seconds that workers have to end by themselves when the work is done


def work_in_pool(job: Job, shards: Iterable[int], tally: Tally, *, workers: int, timeout: float | None) -> None:
    """Do the shards in so many processes.

    Args:
        job: what is done.
        shards: those to be done.
        tally: told of every capture.
        workers: how many processes; each uses one thread.
        timeout: seconds that one capture may take; None = any time.

    Raises:
        ConfigError: the source or a step cannot be sent to another process.
        PcdataError: the build must stop; what is committed stays.
    """
    todo = list(shards)
    schedule = Schedule(todo)
    pool: list[_Worker] = []
    pickled = _pickled(job)
    try:
        while True:
            _hand_out(job, pickled, schedule, pool, min(workers, len(todo)))
            busy = [worker for worker in pool if worker.task is not None]
            if not busy:
                break
            ready = wait([worker.pipe for worker in busy], _time_left(busy, timeout))
            for worker in busy:
                if worker.pipe in ready:
                    _hear(worker, schedule, tally)
                elif timeout is not None and worker.sample_id is not None and time.monotonic() - worker.since > timeout:
                    worker.end()
                    what = f"TimeoutError: took longer than {timeout:g} s"
                    _end(worker, schedule, tally, what, was_killed=False)
            pool[:] = [worker for worker in pool if worker.is_alive]
        for worker in pool:
            worker.dismiss()
        until = time.monotonic() + _GRACE  # they end side by side
        for worker in pool:
            worker.process.join(max(0.0, until - time.monotonic()))
    finally:
        with shielded():
            for worker in pool:
                worker.end()


def _pickled(job: Job) -> bytes:
    try:
        return pickle.dumps(job, pickle.HIGHEST_PROTOCOL)
    except (TypeError, AttributeError, ValueError, RecursionError, pickle.PicklingError) as error:  # as pickling raises
        raise ConfigError(
            f"build_dataset: the source and the steps must be sent to worker processes, and cannot: {error}; "
            "workers=0 builds in this process"
        ) from error


def _time_left(busy: Iterable[_Worker], timeout: float | None) -> float | None:
    """Return the seconds until the first capture will have taken too long."""
    begun = [worker.since for worker in busy if worker.sample_id is not None]
    return None if timeout is None or not begun else max(min(begun) + timeout - time.monotonic(), 0.0)


def _hand_out(job: Job, pickled: bytes, schedule: Schedule, pool: list[_Worker], most: int) -> None:
    """Give every idle worker a task, and start workers while there are more."""
    while (running := sum(worker.task is not None for worker in pool)) < most:
        task = schedule.next(running)
        if task is None:
            return
        if task.sample_id is None and not task.given_up and job.folder.record(job.plan, task.shard):
            continue  # by another process, meanwhile
        worker = next((one for one in pool if one.task is None), None)
        if worker is None:
            worker = _Worker(pickled)
            pool.append(worker)
        worker.give(task)


def _hear(worker: _Worker, schedule: Schedule, tally: Tally) -> None:
    """Take what a worker tells, or find that it has ended."""
    try:
        kind, *told = worker.pipe.recv()
    except (EOFError, OSError):
        _bury(worker, schedule, tally)
        return
    if kind == "warned":
        category, text = told
        warnings.warn(text, category, stacklevel=2)
        return
    worker.since = time.monotonic()
    if kind == "started":
        worker.begin()
    elif kind == "ready":
        worker.is_ready = True
    elif kind == "begins":
        (worker.sample_id,) = told
    elif kind == "ends":
        worker.sample_id = None
        assert worker.task is not None
        tally.captured(worker.task.shard, *told)
    elif kind == "tried":
        schedule.tried(worker.taken(), *told)
    elif kind == "committed":
        worker.taken()
        tally.committed(ShardRecord.from_text(*told))
    else:
        raise stopped(*told)


def _bury(worker: _Worker, schedule: Schedule, tally: Tally) -> None:
    worker.end()
    code = worker.process.exitcode or 0
    if not worker.is_ready and code >= 0:
        raise CacheError(
            f"build_dataset: a worker process could not start (exit code {code}; what it said is above). A script "
            'needs `if __name__ == "__main__":` around its call, since workers import it; workers=0 starts none'
        )
    what = _signal_name(-code) if code < 0 else f"exit code {code}"
    _end(worker, schedule, tally, f"ProcessEnded: its process ended by {what}", was_killed=code < 0)


def _end(worker: _Worker, schedule: Schedule, tally: Tally, what: str, *, was_killed: bool) -> None:
    """Note what became of the task of a worker that has ended."""
    task, sample_id = worker.taken(), worker.sample_id
    if schedule.ended(task, sample_id, what, was_killed=was_killed) and sample_id is not None:
        tally.captured(task.shard, sample_id, what)  # so that a build of which all fail ends soon


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


class _Worker:
    """One process of the pool, and what it does now."""

    def __init__(self, pickled: bytes) -> None:
        context: Any = multiprocessing.get_context(START)
        self.pipe, far_end = context.Pipe()
        self.process = context.Process(target=_serve, args=(far_end,), name="pcdata-build", daemon=True)
        self.task: Task | None = None
        self.sample_id: str | None = None  # the capture that it works on
        self.since = time.monotonic()
        self.is_ready = False
        self.is_alive = True
        self._pickled: bytes | None = pickled  # the job, until it is sent
        try:
            with _one_thread_each(), deaf_children():
                self.process.start()
        except OSError as error:  # too many processes, or no memory for another one
            raise CacheError(
                f"build_dataset: no worker process can be started: {error}; try fewer --workers"
            ) from error
        finally:
            far_end.close()

    def give(self, task: Task) -> None:
        """Let it begin with a task, as soon as it has the job."""
        self.task, self.sample_id, self.since = task, None, time.monotonic()
        if self._pickled is None:
            self._send_task()

    def begin(self) -> None:
        """Send the job, which it waits for, and its first task."""
        assert self._pickled is not None
        with suppress(OSError):  # it has ended: found when it is listened to
            self.pipe.send_bytes(self._pickled)
        self._pickled = None
        if self.task is not None:
            self._send_task()

    def _send_task(self) -> None:
        with suppress(OSError):
            self.pipe.send(self.task)

    def taken(self) -> Task:
        """Return the task that is done."""
        task, self.task = self.task, None
        assert task is not None
        return task

    def dismiss(self) -> None:
        """Let it end by itself."""
        with suppress(OSError):
            self.pipe.send(None)

    def end(self) -> None:
        """End it, at once."""
        self.is_alive = False
        if self.process.is_alive():
            self.process.kill()
        self.process.join(_GRACE)  # one that waits for a disk that is away ends later
        self.pipe.close()


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Let processes that are started in the block use one thread each: libraries read these when they are loaded."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


# -- in the worker -----------------------------------------------------------------------------------------------------


class _Teller:
    """Tells the parent of every capture."""

    def __init__(self, pipe: Connection) -> None:
        self.pipe, self.show_here = pipe, warnings.showwarning

    def begins(self, sample_id: str) -> None:
        self.pipe.send(("begins", sample_id))

    def ends(self, sample_id: str, error: str | None) -> None:
        self.pipe.send(("ends", sample_id, error))

    def show(self, message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
        """Take the place of ``warnings.showwarning``: warnings of pcdata are the parent's to show."""
        is_ours = issubclass(category, PcdataWarning) and category.__module__.startswith("pcdata.")
        if is_ours and threading.current_thread() is threading.main_thread():  # two at once would garble the pipe
            self.pipe.send(("warned", category, str(message)))
        else:
            self.show_here(message, category, *place, **more)


def _serve(pipe: Connection) -> None:
    """Do tasks until there are no more."""
    _end_with_parent()
    torch.set_num_threads(1)
    teller = _Teller(pipe)
    warnings.showwarning = teller.show
    pipe.send(("started",))
    try:
        job: Job = pipe.recv()
    except EOFError:
        return
    pipe.send(("ready",))
    while True:
        try:
            task: Task | None = pipe.recv()
        except EOFError:
            return
        if task is None:
            return
        try:
            if task.sample_id is None:
                pipe.send(("committed", job.do(task.shard, task.given_up, teller).to_text()))
            else:
                pipe.send(("tried", job.try_alone(task.sample_id, teller)))
        except BrokenPipeError:
            return
        except Exception as error:
            pipe.send(("stops", *stop_in_words(error)))


def _end_with_parent() -> None:
    """End this process when its parent is gone, whatever it is doing."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
