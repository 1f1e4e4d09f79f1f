"""Export: stream samples into a layout that an official loader opens, all of it or nothing."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pcdata.errors import (
    CacheError,
    CaptureError,
    ConfigError,
    ContractError,
    DTypeError,
    FrameError,
    PcdataError,
    ShapeError,
    add_note,
)
from pcdata.exports.export_folders import empty_part, move_into_place, naming_faults_of, refuse_links
from pcdata.exports.export_record import FILE_NAME, ExportRecord, check_only_export, files_of
from pcdata.exports.export_source import DrawnClouds, identity_of, open_for, splits_of, stated_by_model
from pcdata.exports.target import Item, Samples, Target
from pcdata.exports.targets import target_named
from pcdata.files.inputs import recording
from pcdata.files.scratch import scratch_beside
from pcdata.files.whole_folders import complete_or_nothing, is_free, rename_to_free, restore_retired
from pcdata.io.sources.capture_source import REFUSALS, CaptureSource, check_apart, episodes_of, inputs_of
from pcdata.progress import Progress
from pcdata.structures import CAMERA_FRAME, METRE, DepthFrame, PointCloud

# What is wrong with one sample, not with what is asked of all of them.
UNFIT = (*REFUSALS, ContractError, ShapeError, DTypeError, FrameError)
_SHOWN = 5
_LONGEST = 400  # characters of the reason why a sample was left out


@dataclass
class _ExportReport:
    """What an export did."""

    folder: Path
    target: str
    written: int = 0  # samples
    kept: int = 0  # samples that an export which was continued had finished before
    notes: list[str] = field(default_factory=list)  # what to know before training on it
    left_out: dict[str, str] = field(default_factory=dict)  # id of a sample that was left out -> why


def export_dataset(
    source: Any,
    target: str,
    out: str | os.PathLike[str],
    *,
    seed: int | None = None,
    epoch: int | None = None,
    copies: int | None = None,
    skip_bad: bool = False,
    overwrite: bool = False,
    resume: bool = False,
    progress: Progress | None = None,
    **options: Any,
) -> _ExportReport:
    """Write samples in the layout of an official loader.

    One sample is in memory at a time. The folder appears under its name only when it is complete. With ``resume`` it
    is made at once and items (a file, a folder, a scene, as the target says) are moved into it one by one, each
    complete, so that a later call with ``resume`` goes on where an interrupted one stopped.

    Args:
        source: what ``pcdata build`` wrote (for targets of clouds) or captures (for targets of depth images), as
            a path or an object with ``ids`` and ``load``; or a dataset of clouds. The random end of a pipeline runs on
            what was stored, and the record names it; of ``CachedCloudDataset(folder, augment=None)`` nothing random
            runs. For targets of depth images a dataset stands for its captures: those that the build kept
            (``output: {keep_raw: true}``), or those that it processes on the fly.
        target: one of :data:`pcdata.exports.TARGETS`.
        out: the folder of the export.
        seed: of the random end, together with the epoch, the sample and the copy; None = 0, or the dataset's.
        epoch: which epoch's draws; None = 0, or the dataset's.
        copies: how often every sample comes, each time with other draws; ``a-copy1`` is a copy of ``a``.
        skip_bad: leave out samples that do not fit, with their episode or scene where the target has such, and go on;
            report and record tell which and why. All are looked at before the first is written. Otherwise the first
            that does not fit is raised, and a note names the others.
        overwrite: replace a complete export that is there; files it did not write are never deleted.
        resume: keep what is finished when interrupted, and continue an export of the same samples and options.
        progress: called after every sample.
        **options: of the target; see docs/exports.md. Of a dataset that was built for the target's model, its choices
            are the default of frame, num_points and colors.

    Raises:
        ConfigError: the target or an option is unknown, missing or does not fit the samples.
        CacheError: the folder exists, or cannot be written.
        PcdataError: a sample is not what the loader needs: its unit, frame, channels, size or number of points.
    """
    if overwrite and resume:
        raise ConfigError("export: continue an export or overwrite it, not both")
    chosen = target_named(target, options)
    if stated := stated_by_model(source, type(chosen)):
        chosen = target_named(target, {**stated, **options})
    opened, notes = open_for(chosen, source, seed=seed, epoch=epoch, copies=copies)
    if type(chosen).with_splits is not Target.with_splits and (part_of := splits_of(source)):
        chosen = chosen.with_splits(part_of)
    ids = list(opened.ids)
    folder = Path(os.path.realpath(Path(out).expanduser()))
    check_apart("export", folder, source)
    report = _ExportReport(folder, chosen.name)
    run = _Run(chosen, opened, report, progress)
    if skip_bad:
        run.leave_out_bad()
    report.notes += notes
    draws = opened.draws() if isinstance(opened, DrawnClouds) else {}
    exported = [sample_id for sample_id in ids if sample_id not in report.left_out]
    plan = ExportRecord(
        chosen.name,
        chosen.options(),
        identity_of(opened),
        exported,
        complete=False,
        draws=draws,
        left_out=report.left_out,
    )
    if resume:
        _continue(run, plan, folder)
        return report
    if not overwrite and not is_free(folder):
        check_only_export(folder)  # what may never be replaced is not advised to be
        raise CacheError(
            f"{folder} exists already; choose another folder, finish an interrupted export (--continue), or replace it "
            "(--overwrite)"
        )
    with complete_or_nothing(folder, overwrite=overwrite, owned=check_only_export, note=report.notes.append) as partial:
        for item in run.items:
            run.write(item, partial)
        run.finish(partial)
        replace(plan, complete=True, coordinates=run.coordinates(), files=files_of(partial)).write(partial)
    return report


class _Run:
    """Writes items of one export and counts samples."""

    def __init__(
        self,
        target: Target,
        source: CaptureSource,
        report: _ExportReport,
        progress: Progress | None,
    ) -> None:
        self.target, self.source, self.report, self.progress = target, source, report, progress
        self.inputs = inputs_of(source)
        self.items: list[Item] = []
        self.total = 0
        self._done = 0
        self._unplanned: dict[str, str] = {}  # id of a sample that nothing is made of -> why
        self._coordinates: set[tuple[str, str]] = set()
        self._plan({})

    def _plan(self, bad: Mapping[str, str]) -> None:
        """Plan the export without some samples; what goes with them is left out too, and told."""
        ids = list(self.source.ids)
        self.items = self.target.plan(ids, episodes_of(self.source), bad)
        planned = {sample_id for item in self.items for sample_id in item.ids}
        self.total = len(planned)
        with_bad = "goes with a sample that is left out" if bad else "is in no episode that can be exported"
        before = self._unplanned
        self._unplanned = {name: bad.get(name) or before.get(name) or with_bad for name in ids if name not in planned}
        told = {sample_id: why for item in self.items for sample_id, why in item.unwritten.items()} | self._unplanned
        self.report.left_out = left_out = {name: told[name] for name in ids if name in told}
        if not planned:
            first, reason = next(iter(left_out.items()))
            raise CaptureError(
                f"export: all {len(ids)} samples are left out, so there is nothing to export; {first!r}: {reason}"
            )

    def leave_out_bad(self) -> None:
        """Examine every sample, and plan the export without those that do not fit."""
        if bad := dict(self._bad_from(0)):
            self._plan(bad)

    def _bad_from(self, start: int) -> Iterator[tuple[str, str]]:
        """Yield the samples of the items from one on that do not fit, with the reason."""
        for item in self.items[start:]:
            seen: dict[str, Any] = {}
            for sample_id in item.ids:
                try:
                    self.target.examine(item, sample_id, self._load(sample_id), seen)
                except UNFIT as error:
                    yield sample_id, _reason(error, f"{self.target.name}: sample {sample_id!r}: ")

    def _load(self, sample_id: str) -> DepthFrame | PointCloud:
        try:
            with recording(self.inputs):
                data = self.source.load(sample_id)
            if self.target.robot_stays and isinstance(self.source, DrawnClouds) and self.source.moved:
                raise ConfigError(
                    f"export: the random end of the pipeline moves the clouds, and the states and actions of "
                    f"{self.target.name}'s episodes stay where they are; attach them to the clouds as signals, which "
                    "move along, or export what is stored: --as-stored, or CachedCloudDataset(folder, augment=None)"
                )
        except PcdataError as error:
            add_note(error, f"sample {sample_id!r} of {self.source!r}", sample_id=sample_id)
            raise
        return data

    def write(self, item: Item, folder: Path) -> None:
        """Write one item below a folder."""
        self._current = ""
        try:
            with naming_faults_of(folder):
                self.target.write(item, self._samples(item), folder, self._note)
        except UNFIT as error:
            self._tell_others(item, error)
            raise

    def _tell_others(self, item: Item, error: PcdataError) -> None:
        """Say in a note which other samples do not fit either, so that one run tells of all."""
        first = self._current
        if not first or type(self.target).examine is Target.examine:  # a target of one's own that only writes
            return
        place = self.items.index(item)
        others = [one for one in self._bad_from(place) if one[0] != first]
        named: dict[str, list[str]] = {}
        for name, reason in others:
            named.setdefault(reason, []).append(name)
        shown = "; ".join(f"{_some(names)}: {reason}" for reason, names in list(named.items())[:_SHOWN])
        more = f"; and for {len(named) - _SHOWN} more reasons" if len(named) > _SHOWN else ""
        told = f"{len(others)} others do not fit either: {shown}{more}" if others else "all others fit"
        add_note(error, f"{told}; leave out what does not fit with --skip-bad (skip_bad=True)", sample_id=first)

    def finish(self, folder: Path) -> None:
        """Write what goes over all items."""
        self.inputs.check("export")
        with naming_faults_of(folder):
            self.target.finish(self.items, folder, self._note)

    def coordinates(self) -> list[list[str]]:
        """Return frame and unit of what was written, every pair once."""
        return [list(pair) for pair in sorted(self._coordinates)]

    def keep_coordinates(self, found: ExportRecord) -> None:
        """Take over frames and units of what an export that is continued had written before."""
        self._coordinates |= {(frame, unit) for frame, unit in found.coordinates}

    def keep(self, item: Item) -> None:
        """Count an item that was there."""
        self.report.kept += len(item.ids) - len(item.unwritten)
        self._done += len(item.ids)

    def _samples(self, item: Item) -> Samples:
        for sample_id in item.ids:
            self._current = sample_id
            data = self._load(sample_id)
            self.inputs.check_latest("export")
            # The loaders make points of images in the camera's own frame.
            self._coordinates.add((data.frame_id, data.unit) if isinstance(data, PointCloud) else (CAMERA_FRAME, METRE))
            yield sample_id, data
            # Only when the writer asks for the next one is this one written.
            self.report.written += sample_id not in item.unwritten
            self._done += 1
            if self.progress is not None:
                self.progress(self._done, self.total, sample_id)

    def _note(self, text: str) -> None:
        if text not in self.report.notes:
            self.report.notes.append(text)


def _reason(error: PcdataError, place: str) -> str:
    """Return why a sample does not fit, in one line: of a contract, every rule that it breaks."""
    return f"{type(error).__name__}: {' '.join(str(error).splitlines()).removeprefix(place)}"[:_LONGEST]


def _some(names: Sequence[str]) -> str:
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return ", ".join(map(repr, names[:3])) + more


def _continue(run: _Run, plan: ExportRecord, folder: Path) -> None:
    with scratch_beside(folder, alone=True, note=run.report.notes.append) as scratch:
        restore_retired(folder, check_only_export, run.report.notes.append)
        if is_free(folder):
            # At once, with its plan: one killed between the two would leave a folder that nothing is known about.
            with empty_part(scratch, "start") as start, naming_faults_of(folder):
                plan.write(start)
                rename_to_free(start, folder)
        else:
            refuse_links(folder, [FILE_NAME])
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
            run.keep_coordinates(found)
        for number, item in enumerate(run.items):
            refuse_links(folder, item.paths)
            if (folder / item.paths[-1]).exists():
                run.keep(item)
                continue
            with empty_part(scratch, f"item-{number}") as part:
                before = run.coordinates()
                run.write(item, part)
                if run.coordinates() != before:  # known before the item is there, whatever stops this run
                    replace(plan, coordinates=run.coordinates()).write(folder)
                move_into_place(item.paths, part, folder)
        with empty_part(scratch, "finish") as part:
            run.finish(part)
            move_into_place(files_of(part), part, folder)
        replace(plan, complete=True, coordinates=run.coordinates(), files=files_of(folder)).write(folder)
