"""The work on one shard: process its captures in their order, store them, commit.

A capture that raises is tried once more, alone, when the others of its shard are done. What raises twice is
quarantined: left out, with its error in the record. What succeeds the second time belongs into its place, so the shard
is written again. Nothing of a shard depends on who works on it, nor on what else that process did before.
"""

from __future__ import annotations

import gc
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from pcdata.build.building import SHARD, SIGNALS, Building
from pcdata.build.capture_work import CaptureWork, keep_raw
from pcdata.build.config import BuildConfig
from pcdata.build.origins import Origin, joined
from pcdata.build.plan import Plan
from pcdata.build.records import BuiltSample, ShardRecord
from pcdata.build.source_state import captures_digest
from pcdata.errors import DTypeError, FrameError, ShapeError, add_note, is_out_of_memory
from pcdata.files.inputs import Inputs
from pcdata.imports import ImportedFile, imported_files
from pcdata.io.sources.capture_source import CaptureSource, inputs_of
from pcdata.io.store.cloud_record import record_from_signals, signals_from_record
from pcdata.io.store.sample_keys import key_of
from pcdata.io.store.shards import SIGNALS_KEY, seal_shard
from pcdata.io.store.stores import STORES, Compression
from pcdata.structures import Signal
from pcdata.structures.signal_joining import stacked_signals
from pcdata.validation.first_look import FirstLook


class Watch(Protocol):
    """What is told while captures are worked on; what it raises stops the build."""

    def begins(self, sample_id: str) -> None:
        """A capture is about to be loaded."""

    def ends(self, sample_id: str, error: str | None) -> None:
        """A capture is done; or failed, for the first or the second time."""


@dataclass(frozen=True)
class Job:
    """All that a worker needs; pickled to every one of them once."""

    imports: tuple[ImportedFile, ...] = field(repr=False)  # first: what follows may be of classes from them
    work: CaptureWork
    plan: Plan
    folder: Building
    format: str
    compression: Compression

    @classmethod
    def of(cls, config: BuildConfig, source: CaptureSource, plan: Plan, folder: Building) -> Job:
        """Return the job of a build."""
        output = config.output
        return cls(imported_files(), CaptureWork(config, source), plan, folder, output.format, output.compression)

    def try_alone(self, sample_id: str, watch: Watch) -> str | None:
        """Process a capture and drop it; return why that failed, or None."""
        gc.collect()  # memory may be what it lacked
        watch.begins(sample_id)
        try:
            self.work.make(sample_id, Inputs())
        except Exception as error:
            return error_in_words(error)
        return None

    def do(self, shard: int, given_up: Mapping[str, str], watch: Watch) -> ShardRecord:
        """Work on a shard and commit it.

        Args:
            shard: its number.
            given_up: captures that ended or blocked their process, with what happened: they are not loaded again.
            watch: told before and after every capture.

        Raises:
            CacheError: the shard cannot be written.
            CaptureError: a file of the captures changed meanwhile.
        """
        return _ShardWork(self, shard, given_up, watch).run()


class _ShardWork:
    """One shard on its way."""

    def __init__(self, job: Job, shard: int, given_up: Mapping[str, str], watch: Watch) -> None:
        self.job, self.shard, self.watch = job, shard, watch
        self.quarantined = dict(given_up)
        self.failed_once: set[str] = set()
        self.origins: list[Origin] = []  # of the samples that are stored
        self.look = ""

    def run(self) -> ShardRecord:
        """Work until every capture is stored or quarantined."""
        folder = self.job.folder
        while True:
            with folder.shard_scratch(self.shard) as scratch:
                samples, failed, captures, signals = self._write(scratch)
                if self._tried_again(failed):
                    continue
                table = seal_shard(scratch / SHARD)
                told = _write_signals(self.job, scratch / SIGNALS, samples, signals)
                order = [one for one in self.job.plan.ids_of(self.shard) if one in self.quarantined]
                record = ShardRecord(
                    self.job.plan.identity,
                    self.shard,
                    captures,
                    table,
                    samples,
                    {name: self.quarantined[name] for name in order},
                    told,
                    folder.sizes_on_disk(scratch / SHARD),
                    joined(self.origins),
                    self.look,
                )
                folder.commit(scratch, record)
                return record

    def _write(self, scratch: Path) -> tuple[list[BuiltSample], dict[str, str], str, list[Mapping[str, Signal]]]:
        """Store what can be stored; return it, what failed, the state of the captures, and the signals."""
        job, source = self.job, self.job.work.source
        ids = job.plan.ids_of(self.shard)
        captures = captures_digest(source, ids, job.plan.hashes_captures)
        inputs = inputs_of(source)
        samples: list[BuiltSample] = []
        signals: list[Mapping[str, Signal]] = []
        failed: dict[str, str] = {}
        self.origins.clear()
        look = FirstLook(by_pose=job.work.by_pose) if self.shard == 0 else None
        told: str | None = None
        with closing(STORES[job.format](scratch / SHARD, job.compression)) as store:
            for sample_id in ids:
                if sample_id in self.quarantined:
                    continue
                self.watch.begins(sample_id)
                try:
                    made = job.work.make(sample_id, inputs)
                except Exception as error:
                    failed[sample_id] = error_in_words(error)
                    self.watch.ends(sample_id, failed[sample_id])
                    continue
                try:
                    store.write(key_of(sample_id), made.record)
                    if job.work.keep_raw:
                        keep_raw(made.capture, scratch / SHARD / "raw" / key_of(sample_id))
                except Exception as error:
                    add_note(error, f"sample {sample_id!r} of {source!r}", sample_id=sample_id)
                    raise
                inputs.check_latest("build_dataset")
                samples.append(made.sample)
                self.origins.append(made.origin)
                signals.append(made.signals)
                self.watch.ends(sample_id, None)
                if look is not None:
                    told = look.see(made.capture) or told
            inputs.check("build_dataset")
        self.look = told or (look is not None and look.end()) or ""
        return samples, failed, captures, signals

    def _tried_again(self, failed: Mapping[str, str]) -> bool:
        """Try captures that failed once more; say whether one succeeds: then the shard is to be written again."""
        succeeds = False
        for sample_id, error in failed.items():
            again: str | None = error
            if sample_id not in self.failed_once:
                self.failed_once.add(sample_id)
                again = self.job.try_alone(sample_id, self.watch)
                self.watch.ends(sample_id, again)
            if again is None:
                succeeds = True
            else:
                self.quarantined[sample_id] = again
        return succeeds


def error_in_words(error: BaseException) -> str:
    """Return what a record says of an error: its type, the step that raised it, and its first line."""
    lines = str(error).splitlines()
    step = getattr(error, "step", None)
    kind = MemoryError.__name__ if is_out_of_memory(error) else type(error).__name__
    head = f"{kind} in {step}" if step else kind
    return f"{head}: {lines[0]:.1000}" if lines else head


def _write_signals(
    job: Job, folder: Path, samples: Iterable[BuiltSample], signals: list[Mapping[str, Signal]]
) -> dict[str, str]:
    """Keep the signals of a shard side by side, to be joined with those of the others."""
    if not any(signals):
        return {}
    try:
        record = record_from_signals(stacked_signals("signals", [one.id for one in samples], signals))
    except (ShapeError, FrameError, DTypeError) as error:
        return {"fault": str(error)}  # each sample still has its own
    with closing(STORES[job.format](folder, job.compression)) as store:
        store.write(SIGNALS_KEY, record)
    return {"digest": record.digest()}


def signals_of_shard(job: Job, folder: Path, record: ShardRecord) -> Iterator[Mapping[str, Signal]]:
    """Yield the signals of the samples of a finished shard; without any, as many empty ones."""
    if "digest" not in record.signals:
        yield from ({} for _ in record.samples)
        return
    with closing(STORES[job.format](folder / SIGNALS)) as store:
        table = signals_from_record(store.read(SIGNALS_KEY), len(record.samples))
    for number in range(len(record.samples)):
        yield {name: signal.rows(slice(number, number + 1)) for name, signal in table.items()}
