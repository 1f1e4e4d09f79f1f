"""Shards done as tasks of a Ray cluster, one that runs or one of this machine: only ids and statuses travel.

Every machine of the cluster must have pcdata, and see the captures and the folder of the dataset under the same paths.
A task says in a small file which capture it works on, since nothing else is left of one whose process ends.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterable
from contextlib import suppress
from typing import Any

from pcdata import extras
from pcdata.build.plan import json_bytes
from pcdata.build.schedule import Schedule, Task
from pcdata.build.shard_work import Job
from pcdata.build.tally import Tally, stop_in_words, stopped
from pcdata.errors import CacheError
from pcdata.files.interrupts import shielded
from pcdata.files.strict_json import json_object

_WAIT = 1.0  # seconds between two looks at signals
_STARTS = 4  # tries to start a Ray: each gives up after 30 s by itself, which a machine with other work may need


def work_on_ray(job: Job, shards: Iterable[int], tally: Tally, *, tasks: int, timeout: float | None) -> None:
    """Do the shards as tasks of a Ray cluster: that of ``RAY_ADDRESS``, the one of this machine, or a new one.

    Args:
        job: what is done.
        shards: those to be done.
        tally: told of every capture when its shard is finished.
        tasks: how many run at once; 0 = one per core of the cluster.
        timeout: seconds that one capture may take; None = any time.

    Raises:
        MissingExtraError: Ray is not installed.
        CacheError: no Ray can be reached or started.
        PcdataError: the build must stop; what is committed stays.
    """
    ray: Any = extras.require("ray")
    is_ours = not ray.is_initialized()
    if is_ours:
        _start(ray)
    running: dict[Any, Task] = {}
    try:
        most = tasks or max(1, int(ray.cluster_resources().get("CPU", 1)))
        shared, schedule = ray.put(job), Schedule(shards)
        run = ray.remote(_run).options(num_cpus=1, max_retries=0)
        while True:
            while len(running) < most and (task := schedule.next(len(running))) is not None:
                if task.sample_id is None and not task.given_up and job.folder.record(job.plan, task.shard):
                    continue  # by another process, meanwhile
                _mark(job, task.shard)
                running[run.remote(shared, task, timeout)] = task
            if not running:
                return
            for done in ray.wait([*running], timeout=_WAIT)[0]:
                _take(ray, done, running.pop(done), job, schedule, tally)
    finally:
        with shielded():
            for task_running in running:
                with suppress(Exception):  # it ends anyway with the job
                    ray.cancel(task_running, force=True)
            if is_ours:
                ray.shutdown()


def _start(ray: Any) -> None:
    """Reach the Ray of ``RAY_ADDRESS`` or of this machine, or start one; on a busy machine that takes several tries.

    Raises:
        CacheError: there is none.
    """
    tries = 1 if os.environ.get("RAY_ADDRESS") else _STARTS
    for number in range(1, tries + 1):
        try:
            # A dashboard, of a Ray that ends with the build, is several processes that nobody looks at.
            ray.init(log_to_driver=False, logging_level="warning", include_dashboard=False)
            return
        except Exception as error:  # of many types: no such cluster, another version, a machine that is too busy
            with suppress(Exception):  # what came up of it
                ray.shutdown()
            if number == tries:
                raise CacheError(
                    f"build_dataset: no Ray can be reached or started: {str(error) or type(error).__name__:.500}; see "
                    "RAY_ADDRESS and 'ray status', or build with --engine pool"
                ) from error


def _take(ray: Any, done: Any, task: Task, job: Job, schedule: Schedule, tally: Tally) -> None:
    """Take what became of a task."""
    try:
        kind, *told = ray.get(done)
    except ray.exceptions.RayError as error:
        sample_id, what = _marked(job, task.shard)
        reason = what or f"ProcessEnded: {type(error).__name__} of Ray"
        if schedule.ended(task, sample_id, reason, was_killed=not what) and sample_id is not None:
            tally.captured(task.shard, sample_id, reason)
        return
    if kind == "tried":
        schedule.tried(task, *told)
    elif kind == "committed":
        record = job.folder.record(job.plan, task.shard)
        if record is None:
            raise CacheError(
                f"{job.folder.kept_at}: a finished shard does not show here; do all machines see this folder, under "
                "this path?"
            )
        for sample_id, why in told[0].items():
            tally.captured(task.shard, sample_id, why)
        tally.committed(record)
    else:
        raise stopped(*told)


def _mark(job: Job, shard: int, sample_id: str | None = None, what: str = "") -> None:
    """Say which capture of a shard is worked on, and what happened to it; None = none is.

    Raises:
        CacheError: it cannot be written.
    """
    job.folder.mark(shard, json_bytes({"sample_id": sample_id, "what": what}))


def _marked(job: Job, shard: int) -> tuple[str | None, str]:
    """Return which capture of a shard was worked on last, and what happened to it."""
    try:
        told = json_object("the mark of a shard", job.folder.marked(shard), error=CacheError)
    except CacheError:  # cut short by the end of its process
        return None, ""
    return told.get("sample_id"), str(told.get("what", ""))


# -- in a task ---------------------------------------------------------------------------------------------------------


def _run(job: Job, task: Task, timeout: float | None) -> tuple[Any, ...]:
    """Do one task; whatever stops the build is returned in words, since its class may not travel."""
    import torch

    torch.set_num_threads(1)
    watch = _Marker(job, task.shard, timeout)
    try:
        if task.sample_id is not None:
            return "tried", job.try_alone(task.sample_id, watch)
        job.do(task.shard, task.given_up, watch)
        return "committed", watch.outcomes
    except Exception as error:
        return "stops", *stop_in_words(error)
    finally:
        watch.close()


class _Marker:
    """Says in a file which capture is worked on, and ends the process when that takes too long."""

    def __init__(self, job: Job, shard: int, timeout: float | None) -> None:
        self.job, self.shard, self.timeout = job, shard, timeout
        self.outcomes: dict[str, str | None] = {}
        self._timer: threading.Timer | None = None

    def begins(self, sample_id: str) -> None:
        self.close()
        _mark(self.job, self.shard, sample_id)
        if self.timeout is not None:
            self._timer = threading.Timer(self.timeout, self._end, [sample_id])
            self._timer.daemon = True
            self._timer.start()

    def ends(self, sample_id: str, error: str | None) -> None:
        self.close()
        _mark(self.job, self.shard)
        self.outcomes[sample_id] = error

    def close(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _end(self, sample_id: str) -> None:
        _mark(self.job, self.shard, sample_id, f"TimeoutError: took longer than {self.timeout:g} s")
        os._exit(1)
