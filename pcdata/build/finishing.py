"""The end of a build: its shards become one dataset, which appears under its name at once.

Every step may be done again after a kill: shards are moved one by one, everything else is written anew.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch

import pcdata
from pcdata.build.card import card_texts
from pcdata.build.card_answers import FILE_NAME as ANSWERS
from pcdata.build.card_facts import CardFacts
from pcdata.build.carried import carried_answers, carry_splits
from pcdata.build.config import BuildConfig
from pcdata.build.loading_script import loading_script
from pcdata.build.origins import commonest
from pcdata.build.records import ShardRecord
from pcdata.build.shard_work import Job, signals_of_shard
from pcdata.build.source_state import captures_digest
from pcdata.build.written_texts import write_new_texts
from pcdata.datasets.collate import COLLATES
from pcdata.datasets.splits import FILE_NAME as SPLITS
from pcdata.errors import CacheError, CaptureError, DTypeError, FrameError, ShapeError, write_fault
from pcdata.files.scratch import Note
from pcdata.files.syncing import sync_folder
from pcdata.imports import ImportedFile, imported_files, step_names
from pcdata.io.sources.capture_source import CaptureSource, episodes_of, kinds_of, skipped_of, streams_of
from pcdata.io.store.cloud_record import record_from_signals
from pcdata.io.store.manifest import Manifest
from pcdata.io.store.sample_index import Sample
from pcdata.io.store.sample_keys import key_of
from pcdata.io.store.shards import FOLDER, SIGNALS_FOLDER, SIGNALS_KEY
from pcdata.io.store.stores import STORES
from pcdata.structures import Episode, Signal
from pcdata.structures.episodes import kept_episodes
from pcdata.structures.signal_joining import stacked_signals
from pcdata.validation.step_losses import Counts, step_statistics
from pcdata.verdicts import Finding
from pcdata.yaml_nodes import yaml_text


def complete_dataset(
    config: BuildConfig,
    source: CaptureSource,
    job: Job,
    records: Mapping[int, ShardRecord],
    alarms: Sequence[Finding],
    note: Note,
) -> None:
    """Make the dataset of a build whose shards are all finished, in its hidden folder.

    What it is to replace gives it its splits, and the answers of its card.

    Raises:
        CacheError: it cannot be written.
        CaptureError: the captures changed since they were read.
        ConfigError: the answers of the card are damaged.
    """
    ordered = [records[shard] for shard in range(job.plan.num_shards)]
    _check_captures(source, job, ordered)
    dataset = job.folder.dataset
    try:
        job.folder.gather(ordered, config.output.format)
        samples = [
            Sample(one.id, key_of(one.id), one.num_points, one.digest, record.shard)
            for record in ordered
            for one in record.samples
        ]
        signals = _write_signals(config, job, ordered)
        sections = config.pipeline.sections()
        loading, imports = _imports(config, source, sections)
        opened = {name: value for name, value in getattr(source, "opened", {}).items() if name != "skip_refused"}
        manifest = Manifest(
            format=config.output.format,
            compression=config.output.compression,
            identity=job.plan.identity,
            fingerprint=job.plan.settings["steps"],
            pipeline=sections,
            samples=samples,
            keep_raw=config.output.keep_raw,
            compact=config.output.compact,
            shard_size=config.output.shard_size,
            episodes=tuple(_episodes(source, samples)),
            signals=signals,
            skipped=skipped_of(source),
            quarantined={name: why for record in ordered for name, why in record.quarantined.items()},
            streams=tuple(streams_of(source)),
            steps=tuple(step_statistics(counts_of(records))),
            origins=tuple(commonest(one for record in ordered for one in record.origins)),
            alarms=tuple(finding.to_json() for finding in alarms),
            model=_model_of(config),
            source=json.loads(json.dumps(opened)),  # lists, as it will be read
            imports=[file.to_json() for file in imports],
            versions={
                "pcdata": pcdata.__version__,
                "torch": str(torch.__version__),
                "numpy": np.__version__,
                "python": platform.python_version(),
            },
        )
        manifest.write(dataset)
        before = job.folder.carried((SPLITS, ANSWERS))
        carry_splits(before, dataset, manifest, note)
        facts = CardFacts.of(dataset, manifest, carried_answers(before, dataset))
        script = loading_script(config.loader, config.model, [file.name for file in loading])
        write_new_texts(dataset, {"pipeline.yaml": yaml_text(sections), "load.py": script, **card_texts(facts)})
        for folder in (dataset / FOLDER, dataset):
            sync_folder(folder)
    except OSError as error:
        raise CacheError(f"{job.folder.target}: cannot be written: {write_fault(error)}") from error


def counts_of(records: Mapping[int, ShardRecord]) -> dict[str, Counts]:
    """Return the points after every step of every sample, in their order."""
    return {one.id: one.counts for shard in sorted(records) for one in records[shard].samples}


def _check_captures(source: CaptureSource, job: Job, records: Sequence[ShardRecord]) -> None:
    for record in records:
        ids = job.plan.ids_of(record.shard)
        if captures_digest(source, ids, job.plan.hashes_captures) != record.captures:
            raise CaptureError(
                f"build_dataset: a file of the captures {ids[0]!r} to {ids[-1]!r} was changed after it was read, so "
                "the dataset would mix two states of them; let them rest and start again: only these are built anew"
            )


def _write_signals(config: BuildConfig, job: Job, records: Sequence[ShardRecord]) -> dict[str, str]:
    """Keep the signals of all samples side by side, so that nobody has to load clouds for them."""
    if not any(record.signals for record in records):
        return {}
    faults = [record.signals["fault"] for record in records if "fault" in record.signals]
    if faults:
        return {"fault": faults[0]}
    ids = [sample.id for record in records for sample in record.samples]
    try:
        together = record_from_signals(stacked_signals("signals", ids, _signals(job, records)))
    except (ShapeError, FrameError, DTypeError) as error:
        return {"fault": str(error)}
    store = STORES[config.output.format](job.folder.dataset / SIGNALS_FOLDER, config.output.compression)
    try:
        store.write(SIGNALS_KEY, together)
    finally:
        store.close()
    return {"digest": together.digest()}


def _signals(job: Job, records: Sequence[ShardRecord]) -> Iterator[Mapping[str, Signal]]:
    for record in records:
        yield from signals_of_shard(job, job.folder.work_place(record), record)


def _imports(
    config: BuildConfig, source: CaptureSource, sections: Mapping[str, Any]
) -> tuple[list[ImportedFile], list[ImportedFile]]:
    """Return the files of one's own that loading the dataset needs, and those that building it needed."""
    steps = {name for file in imported_files() for name in file.transforms}
    steps &= step_names(sections) if steps else set()
    kinds = {*kinds_of(source)}
    # What loads the dataset must know where its steps, its store and its batches are at home.
    modules = {STORES[config.output.format].__module__, COLLATES[config.loader.collate].__module__}
    loading = [file for file in imported_files() if steps & {*file.transforms} or file.module in modules]
    built = [file for file in imported_files() if file in loading or kinds & {*file.layouts, *file.combinators}]
    return loading, built


def _episodes(source: CaptureSource, samples: Sequence[Sample]) -> list[Episode]:
    written = {sample.id for sample in samples}
    places = [place for place, sample_id in enumerate(source.ids) if sample_id in written]
    return kept_episodes(episodes_of(source), places)


def _model_of(config: BuildConfig) -> dict[str, Any]:
    if config.model is None:
        return {}
    return {"name": config.model.contract.name, "choices": config.model.plain_choices()}
