"""Export: stream samples into a layout that an official loader opens, all of it or nothing."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pcdata.errors import CacheError, ConfigError, PcdataError, add_note
from pcdata.exports.record import ExportRecord, check_replaceable, files_of
from pcdata.exports.registry import target_named
from pcdata.exports.sources import identity_of, open_for
from pcdata.exports.target import Item, Samples, Target
from pcdata.io.source import CaptureSource
from pcdata.io.whole_folders import complete_or_nothing, scratch_beside

Progress = Callable[[int, int, str], None]  # samples done, samples in all, id of the last one


@dataclass
class ExportReport:
    """What an export did."""

    folder: Path
    target: str
    written: int = 0  # samples
    kept: int = 0  # samples that an export which was continued had finished before
    notes: list[str] = field(default_factory=list)  # what to know before training on it


def export_dataset(
    source: Any,
    target: str,
    out: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    resume: bool = False,
    progress: Progress | None = None,
    **options: Any,
) -> ExportReport:
    """Write samples in the layout of an official loader.

    One sample is in memory at a time. The folder appears under its name only when it is complete. With ``resume`` it
    is made at once and items (a file, a folder, a scene, as the target says) are moved into it one by one, each
    complete, so that a later call with ``resume`` goes on where an interrupted one stopped.

    Args:
        source: what ``pcdata build`` wrote (for targets of clouds) or captures (for targets of depth images), as
            a path or an object with ``ids`` and ``load``.
        target: one of :data:`pcdata.exports.TARGETS`.
        out: the folder of the export.
        overwrite: replace a complete export that is there; files it did not write are never deleted.
        resume: keep what is finished when interrupted, and continue an export of the same samples and options.
        progress: called after every sample.
        **options: of the target; see docs/exports.md.

    Raises:
        ConfigError: the target or an option is unknown, missing or does not fit the samples.
        CacheError: the folder exists, or cannot be written.
        PcdataError: a sample is not what the loader needs: its unit, frame, channels, size or number of points.
    """
    if overwrite and resume:
        raise ConfigError("export: continue an export or overwrite it, not both")
    chosen = target_named(target, options)
    opened = open_for(chosen, source)
    ids = list(opened.ids)
    items = chosen.items(ids)
    folder = Path(os.path.realpath(Path(out).expanduser()))
    report = ExportReport(folder, chosen.name)
    plan = ExportRecord(chosen.name, chosen.options(), identity_of(opened), ids, complete=False)
    run = _Run(chosen, opened, items, report, progress)
    if resume:
        _continue(run, plan, folder)
        return report
    check_replaceable(folder, overwrite)
    with complete_or_nothing(folder) as partial:
        for item in items:
            run.write(item, partial)
        run.finish(partial)
        replace(plan, complete=True, files=files_of(partial)).write(partial)
    return report


class _Run:
    """Writes items of one export and counts samples."""

    def __init__(
        self,
        target: Target,
        source: CaptureSource,
        items: Sequence[Item],
        report: ExportReport,
        progress: Progress | None,
    ) -> None:
        self.target, self.source, self.items, self.report, self.progress = target, source, items, report, progress
        self.total = sum(len(item.ids) for item in items)

    def write(self, item: Item, folder: Path) -> None:
        """Write one item below a folder."""
        with _writing(folder):
            self.target.write(item, self._samples(item), folder, self._note)

    def finish(self, folder: Path) -> None:
        """Write what goes over all items."""
        with _writing(folder):
            self.target.finish(self.items, folder, self._note)

    def keep(self, item: Item) -> None:
        """Count an item that was there."""
        self.report.kept += len(item.ids)

    def _samples(self, item: Item) -> Samples:
        for sample_id in item.ids:
            try:
                yield sample_id, self.source.load(sample_id)
            except PcdataError as error:
                add_note(error, f"sample {sample_id!r} of {self.source!r}")
                raise
            # Only when the writer asks for the next one is this one written.
            self.report.written += 1
            if self.progress is not None:
                self.progress(self.report.kept + self.report.written, self.total, sample_id)

    def _note(self, text: str) -> None:
        if text not in self.report.notes:
            self.report.notes.append(text)


def _continue(run: _Run, plan: ExportRecord, folder: Path) -> None:
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        found = ExportRecord.read(folder)
        difference = plan.difference(found)
        if difference is not None:
            raise CacheError(
                f"{folder} cannot be continued: {difference}; choose another folder, or replace it (--overwrite)"
            )
        if found.complete:
            for item in run.items:
                run.keep(item)
            return
    else:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise CacheError(f"{folder}: cannot write there: {error}") from error
        plan.write(folder)
    for item in run.items:
        if (folder / item.paths[-1]).exists():
            run.keep(item)
            continue
        with scratch_beside(folder) as scratch:
            run.write(item, scratch)
            _move(item.paths, scratch, folder)
    with scratch_beside(folder) as scratch:
        run.finish(scratch)
        _move(files_of(scratch), scratch, folder)
    replace(plan, complete=True, files=files_of(folder)).write(folder)


def _move(paths: Sequence[str], scratch: Path, folder: Path) -> None:
    """Put finished files and folders into place, in order; what an interrupted move had put there is replaced."""
    try:
        for number, path in enumerate(paths):
            new, place = scratch / path, folder / path
            if not new.exists():  # an item may do without, e.g. colour
                continue
            place.parent.mkdir(parents=True, exist_ok=True)
            if place.is_dir():  # a folder cannot be renamed onto one
                os.replace(place, scratch / f".replaced-{number}")
            os.replace(new, place)
    except OSError as error:
        raise CacheError(f"{folder}: cannot be put into place: {error}") from error


@contextmanager
def _writing(folder: Path) -> Iterator[None]:
    """Name the folder in what a full disk or a missing permission raises."""
    try:
        yield
    except OSError as error:
        if isinstance(error, PcdataError):
            raise
        raise CacheError(f"{folder}: cannot be written: {error}; is the disk full, or the folder read-only?") from error
