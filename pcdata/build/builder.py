"""Build a dataset: run the deterministic steps once on every capture and store the result, shard by shard."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path

from pcdata.build.building import Building
from pcdata.build.building_folder import BuildingFolder
from pcdata.build.config import BuildConfig
from pcdata.build.engines.in_process import work_here
from pcdata.build.finishing import complete_dataset, counts_of
from pcdata.build.kept_for_retry import take_over
from pcdata.build.plan import Plan, plan_of
from pcdata.build.records import BuiltSample, ShardRecord
from pcdata.build.request import BuildRequest, Engine
from pcdata.build.shard_work import Job
from pcdata.build.source_state import captures_digest
from pcdata.build.tally import Tally, all_failed, most_bad
from pcdata.errors import CacheError, CaptureError, add_note
from pcdata.files.sample_names import counted
from pcdata.files.scratch import Note
from pcdata.io.sources.capture_source import CaptureSource, skipped_of
from pcdata.progress import Progress
from pcdata.validation.first_look import judge_of_all
from pcdata.validation.step_losses import judge_step_losses


@dataclass(frozen=True)
class BuildReport:
    """What a build did."""

    folder: Path | str  # str = a URL
    samples: list[BuiltSample] = field(default_factory=list)
    skipped: dict[str, str] = field(default_factory=dict)  # id of a capture that was left out -> why
    quarantined: dict[str, str] = field(default_factory=dict)  # id of a capture that failed twice -> why
    notes: list[str] = field(default_factory=list)  # what was found of builds before, and what became of it
    look: str = ""  # what the captures of the first shard tell of a wrong unit of depth or of wrong poses
    num_shards: int = 0
    num_finished: int = 0  # of them; fewer where others have a part of the work
    is_complete: bool = False  # the dataset is under its name


def build_dataset(
    config: BuildConfig,
    source: CaptureSource,
    folder: str | Path,
    *,
    overwrite: bool = False,
    restart: bool = False,
    workers: int = 0,
    timeout: float | None = None,
    max_bad: int | str | None = None,
    engine: Engine = "pool",
    part: tuple[int, int] | None = None,
    finalize: bool = False,
    strict: bool = False,
    hash_captures: bool = False,
    retry_quarantined: bool = False,
    progress: Progress | None = None,
    note: Note | None = None,
) -> BuildReport:
    """Store every capture of a source as the pipeline's deterministic steps leave it.

    Captures are worked on in shards, each committed when it is on disk; a build that was stopped goes on where it was
    when it is started again with the same settings and captures. The dataset appears under its name only when it is
    complete, and its bytes are the same whoever worked on it and however often it was stopped. Nothing is deleted that
    no build made: a folder that somebody else makes under the name meanwhile makes the build fail.

    A capture that raises, takes too long or ends its worker is tried once more, alone, and then quarantined: left out,
    and named with its error in the report and the manifest.

    Args:
        config: pipeline, storage and loader settings; see :func:`pcdata.load_config`.
        source: the captures; see :func:`pcdata.open_source`.
        folder: where the dataset goes: a folder, or a URL such as ``"s3://bucket/set"``.
        overwrite: replace a dataset that is there already; anything else is never replaced.
        restart: delete an unfinished build of the folder, of these or of other settings, and begin anew.
        workers: processes, of one thread each; 0 = this process, which a capture that crashes or hangs then takes with
            it. Of Ray, how many tasks run at once; 0 = as many as fit.
        timeout: seconds that one capture may take; needs workers. None = any time.
        max_bad: how many captures may be quarantined, or which share of all, "1%"; more stop the build. None = any
            number but all of the first 8.
        engine: "pool" = processes of this machine; "ray" = a Ray cluster, an existing one or one of this machine.
        part: (k, n): do only every n-th shard, from the k-th on, k from 0; whoever finishes last puts the dataset into
            place.
        finalize: only put the dataset into place, of which every shard is finished.
        strict: fail before the dataset is put into place where a step drops more than is usual, or a capture is an
            outlier of the rest; see :mod:`pcdata.validation.step_losses`. Otherwise notes say so.
        retry_quarantined: try the captures again that the build of the dataset, or the unfinished one, quarantined.
            Their shards are built anew, the others are kept, and the dataset is replaced by what a build gives in which
            they never failed.
        hash_captures: tell a file of the captures that was changed by its content, which reads all of them once more
            before a shard, and once at the end; otherwise one above 64 KiB is told by its size and time.
        progress: called after every capture.
        note: told at once what the report's ``notes`` say in the end.

    Raises:
        ConfigError: the pipeline has nothing deterministic to store, or the arguments do not fit together.
        CacheError: the folder exists, another process writes it, an unfinished build of other settings is there, or it
            cannot be written (a full disk).
        CaptureError: a file of the captures, or of their calibration, changed since it was first read; too many
            captures failed; steps drop too much (strict).
        PcdataError: all of the first 8 captures failed, or all; of the type that the first one raised.
    """
    request = BuildRequest(
        overwrite=overwrite,
        restart=restart,
        workers=workers,
        timeout=timeout,
        max_bad=max_bad,
        engine=engine,
        part=part,
        finalize=finalize,
        strict=strict,
        hash_captures=hash_captures,
        retry_quarantined=retry_quarantined,
    )
    return _built(config, source, folder, request, progress, note)


def _built(
    config: BuildConfig,
    source: CaptureSource,
    folder: str | Path,
    asked: BuildRequest,
    progress: Progress | None,
    note: Note | None,
) -> BuildReport:
    building, replaces = asked.building(config, source, folder), asked.replaces
    report = BuildReport(building.target if isinstance(building, BuildingFolder) else building.target.url)
    report.skipped.update(skipped_of(source))

    def tell(text: str) -> None:
        report.notes.append(text)
        if note is not None:
            note(text)

    plan = plan_of(config, source, hash_captures=asked.hash_captures)
    if (
        (asked.part is not None or asked.finalize)
        and not replaces
        and (quarantined := building.quarantined_of(plan.identity)) is not None
    ):  # a job that is started again when all is done
        tell("the dataset was put into place before")
        report.quarantined.update(quarantined)
        return replace(report, num_shards=plan.num_shards, num_finished=plan.num_shards, is_complete=True)
    building.check_target(replaces)
    limit = most_bad(asked.max_bad, len(plan.ids))
    job = Job.of(config, source, plan, building)
    with building.opened(plan, asked.what, restart=asked.restart, note=tell):
        replaced = building.prepared(replaces, tell) if asked.part is None else None
        shards = asked.shards(plan)
        if asked.retry_quarantined and isinstance(building, BuildingFolder):
            take_over(building, plan)
        done = _finished(job, shards, tell, retry_quarantined=asked.retry_quarantined)
        if asked.finalize and len(done) < plan.num_shards:
            missing = plan.num_shards - len(done)
            raise CacheError(f"{folder}: {missing} of {plan.num_shards} shards are not finished; build them first")
        tally = Tally(plan, shards, done, limit, progress, lambda look: tell(f"{look} {judge_of_all(source)}"))
        try:
            _work(job, [shard for shard in shards if shard not in done], tally, asked)
        except BaseException as error:
            _tell_kept(error, building, plan)
            raise
        done = building.finished(plan)
        if asked.part is None and len(done) < plan.num_shards:
            raise CacheError(f"{folder}: shards that were finished are gone or damaged; start again to build them anew")
        is_complete = len(done) == plan.num_shards and _finish(config, source, job, done, replaced, asked, tell)
    return _told(report, [done[shard] for shard in shards if shard in done], plan.num_shards, len(done), is_complete)


def _work(job: Job, shards: list[int], tally: Tally, asked: BuildRequest) -> None:
    if not shards:
        return
    if asked.engine == "ray":
        from pcdata.build.engines.on_ray import work_on_ray

        work_on_ray(job, shards, tally, tasks=asked.workers, timeout=asked.timeout)
    elif asked.workers:
        from pcdata.build.engines.pool import work_in_pool

        work_in_pool(job, shards, tally, workers=asked.workers, timeout=asked.timeout)
    else:
        work_here(job, shards, tally)


def _finished(job: Job, shards: range, note: Note, *, retry_quarantined: bool) -> dict[int, ShardRecord]:
    """Return what is finished already; shards whose captures changed since are to be done again."""
    plan, source = job.plan, job.work.source
    done = job.folder.finished(plan)
    changed = [
        shard
        for shard in shards
        if shard in done and captures_digest(source, plan.ids_of(shard), plan.hashes_captures) != done[shard].captures
    ]
    doubtful = [shard for shard in shards if shard in done and done[shard].is_doubtful]
    bad = [shard for shard in shards if shard in done and retry_quarantined and done[shard].quarantined]
    for shard in {*changed, *doubtful, *bad}:
        del done[shard]
        job.folder.forget(shard)
    if bad:
        note(f"built anew: {counted(len(bad), 'finished shard')}, to try their quarantined captures again")
    elif doubtful:
        note(
            f"built anew: {counted(len(doubtful), 'finished shard')}, since captures of them ran out of memory or time"
        )
    if changed:
        note(f"built anew: {counted(len(changed), 'finished shard')}, since a file of their captures has changed")
    if mine := [shard for shard in shards if shard in done]:
        note(f"{len(mine)} of {len(shards)} shards were finished before")
    return done


def _finish(
    config: BuildConfig,
    source: CaptureSource,
    job: Job,
    done: dict[int, ShardRecord],
    replaced: object,
    asked: BuildRequest,
    note: Note,
) -> bool:
    """Put the dataset into place; False where another process that has a part of the work does."""
    building = job.folder
    if not any(record.samples for record in done.values()):
        failed = {name: why for record in done.values() for name, why in record.quarantined.items()}
        raise all_failed(failed, len(job.plan.ids))
    with ExitStack() as stack:
        try:
            stack.enter_context(building.claim("finish", note))
        except CacheError:
            if asked.part is None:
                raise
            note("another process puts the dataset into place")
            return False
        if asked.part is not None:
            replaced = building.prepared(asked.replaces, note)
        alarms = judge_step_losses(counts_of(done))
        for one in alarms:
            note(f"{one.name} {one.found}; {one.advice}")
        if alarms and asked.strict:
            raise CaptureError(
                f"build_dataset: steps drop more than is usual, of which the notes tell; what is finished is kept in "
                f"{building.kept_at}: mend the steps or leave captures out, or take it as it is without strict"
            )
        complete_dataset(config, source, job, done, alarms, note)
        building.put_into_place(job.plan, done, replaced, note)
    return True


def _tell_kept(error: BaseException, building: Building, plan: Plan) -> None:
    kept = building.finished(plan)
    if any(record.samples for record in kept.values()):
        add_note(
            error,
            f"{len(kept)} of {plan.num_shards} shards are finished and kept in {building.kept_at}; the same command "
            "goes on from there",
        )


def _told(
    report: BuildReport, records: list[ShardRecord], num_shards: int, num_finished: int, is_complete: bool
) -> BuildReport:
    for record in records:
        report.samples.extend(record.samples)
        report.quarantined.update(record.quarantined)
    look = next((record.look for record in records if record.look), "")
    return replace(report, look=look, num_shards=num_shards, num_finished=num_finished, is_complete=is_complete)
