"""Build a dataset: run the deterministic steps once on every capture and store the result, all or nothing."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

import pcdata
from pcdata.build.carried import carry_splits
from pcdata.build.config import BuildConfig
from pcdata.build.contents import check_only_dataset
from pcdata.build.loading_script import loading_script
from pcdata.datasets.collate import COLLATES
from pcdata.datasets.splits import FILE_NAME as SPLITS
from pcdata.errors import (
    CacheError,
    CaptureError,
    ConfigError,
    DTypeError,
    FrameError,
    ShapeError,
    WriteError,
    add_note,
    write_fault,
)
from pcdata.files.inputs import recording
from pcdata.files.whole_folders import complete_or_nothing
from pcdata.imports import imported_files, step_names
from pcdata.io.sources.capture_source import (
    REFUSALS,
    CaptureSource,
    checked_ids,
    episodes_of,
    inputs_of,
    kinds_of,
    reason_of,
    skipped_of,
    streams_of,
)
from pcdata.io.store.cloud_record import record_from_cloud, record_from_signals
from pcdata.io.store.manifest import Manifest
from pcdata.io.store.sample_index import Sample
from pcdata.io.store.sample_keys import key_of
from pcdata.io.store.shards import SIGNALS_FOLDER, SIGNALS_KEY, seal_shard, shard_folder, shard_size_of
from pcdata.io.store.stores import STORES, Store
from pcdata.io.writers.capture_folder import write_capture
from pcdata.progress import Progress
from pcdata.structures import DepthFrame, Episode, PointCloud, Signal
from pcdata.structures.episodes import kept_episodes
from pcdata.structures.signal_joining import stacked_signals


@dataclass(frozen=True)
class BuiltSample:
    """What happened to one capture."""

    id: str
    entered_at: str  # "depth", or "cloud" where the capture was one already
    counts: list[tuple[str, int]]  # step name -> points after it, over all clouds of the sample
    seconds: float


@dataclass(frozen=True)
class BuildReport:
    """What a build did."""

    folder: Path
    samples: list[BuiltSample] = field(default_factory=list)
    skipped: dict[str, str] = field(default_factory=dict)  # id of a capture that was left out -> why
    notes: list[str] = field(default_factory=list)  # what killed builds had left, and what became of it


def build_dataset(
    config: BuildConfig,
    source: CaptureSource,
    folder: str | Path,
    *,
    overwrite: bool = False,
    skip_refused: bool | None = None,
    progress: Progress | None = None,
) -> BuildReport:
    """Store every capture of a source as the pipeline's deterministic steps leave it.

    The dataset appears under its name only when it is complete: everything is written to a hidden neighbor first, and
    a failure removes that and leaves what was there before. Nothing is deleted that no build made: a folder that
    somebody else makes under the name meanwhile makes the build fail.

    Args:
        config: pipeline, storage and loader settings; see :func:`pcdata.load_config`.
        source: the captures; see :func:`pcdata.open_source`.
        folder: where the dataset goes.
        overwrite: replace a dataset that is there already; anything else is never replaced.
        skip_refused: leave out captures that cannot be read or that a step refuses, and go on; the report and the
            manifest tell which and why. None = as the configuration says, where the default is to stop at the first.
        progress: called after every capture.

    Raises:
        ConfigError: the pipeline has nothing deterministic to store.
        CacheError: the folder exists, another process writes it, or it cannot be written (a full disk).
        CaptureError: a file of the captures, or of their calibration, changed since it was first read.
        PcdataError: a capture or a step failed; the note names the sample, the step and its input.
    """
    _check_arguments(config, source)
    # Resolved: "." has no name to write beside, and a link must lead to the new dataset afterwards.
    folder = Path(os.path.realpath(Path(folder).expanduser()))
    report = BuildReport(folder, skipped=skipped_of(source))
    skip_refused = config.source.skip_refused if skip_refused is None else skip_refused
    with complete_or_nothing(
        folder, overwrite=overwrite, owned=check_only_dataset, note=report.notes.append
    ) as partial:
        sections = config.pipeline.sections()
        steps = {name for file in imported_files() for name in file.transforms}
        steps &= step_names(sections) if steps else set()
        kinds = {*kinds_of(source)}
        # What loads the dataset must know where its steps, its store and its batches are at home.
        modules = {STORES[config.output.format].__module__, COLLATES[config.loader.collate].__module__}
        loading = [file for file in imported_files() if steps & {*file.transforms} or file.module in modules]
        imports = [file for file in imported_files() if file in loading or kinds & {*file.layouts, *file.combinators}]
        samples, signals = _write_samples(config, source, partial, report, skip_refused, progress)
        manifest = Manifest(
            format=config.output.format,
            compression=config.output.compression,
            fingerprint=config.pipeline.stored_fingerprint(),
            pipeline=sections,
            samples=samples,
            keep_raw=config.output.keep_raw,
            shard_size=config.output.shard_size,
            episodes=tuple(_episodes(source, samples)),
            signals=signals,
            skipped=report.skipped,
            streams=tuple(streams_of(source)),
            model=_model_of(config),
            source={**getattr(source, "opened", {}), **({"skip_refused": True} if skip_refused else {})},
            imports=[file.to_json() for file in imports],
            versions={
                "pcdata": pcdata.__version__,
                "torch": str(torch.__version__),
                "numpy": np.__version__,
                "python": platform.python_version(),
            },
        )
        try:
            (partial / "pipeline.yaml").write_text(config.pipeline.to_yaml(), encoding="utf-8")
            (partial / "load.py").write_text(
                loading_script(config.loader, config.model, [file.name for file in loading]),
                encoding="utf-8",
            )
            manifest.write(partial)
            if (folder / SPLITS).is_file():
                report.notes.extend(carry_splits(folder, partial))
        except OSError as error:
            raise CacheError(f"{folder}: cannot be written: {write_fault(error)}") from error
    return report


def _write_samples(
    config: BuildConfig,
    source: CaptureSource,
    partial: Path,
    report: BuildReport,
    skip_refused: bool,
    progress: Progress | None,
) -> tuple[list[Sample], dict[str, str]]:
    each = shard_size_of(len(source.ids), config.output.shard_size)
    store, shard = _store_of(config, shard_folder(partial, 0)), 0
    prefix, _ = config.pipeline.split()
    ids = list(source.ids)
    written: list[Sample] = []
    signals: list[Mapping[str, Signal]] = []
    told: dict[str, str] = {}
    inputs = inputs_of(source)
    try:
        for position, sample_id in enumerate(ids):
            if position // each != shard:
                _seal(store)
                shard = position // each
                store = _store_of(config, shard_folder(partial, shard))
            started = time.perf_counter()
            try:
                try:
                    with recording(inputs):
                        capture = source.load(sample_id)
                    made = prefix(capture)
                except REFUSALS as error:
                    if not skip_refused:
                        raise
                    report.skipped[sample_id] = reason_of(error)
                    continue
                cloud = _with_sample_id(_checked_cloud(made), sample_id)
                record = record_from_cloud(cloud)
                key = key_of(sample_id)
                store.write(key, record)
                if config.output.keep_raw:
                    _keep_raw(capture, store.folder / "raw" / key)
            except Exception as error:
                way_out = isinstance(error, REFUSALS) and not skip_refused
                hint = f"; leave it out with --skip {sample_id}, or all such captures with --skip-refused"
                add_note(error, f"sample {sample_id!r} of {source!r}{hint if way_out else ''}", sample_id=sample_id)
                raise
            inputs.check_latest("build_dataset")
            written.append(Sample(sample_id, key, cloud.num_points, record.digest(), shard))
            signals.append(_one_each(cloud))
            report.samples.append(_built_sample(sample_id, capture, cloud, time.perf_counter() - started))
            if progress is not None:
                progress(position + 1, len(ids), sample_id)
        inputs.check("build_dataset")
        _seal(store)
        if any(signals):
            store = _store_of(config, partial / SIGNALS_FOLDER)
            told = _write_signals(store, [sample.id for sample in written], signals)
    finally:
        store.close()
    if not written:
        first, reason = next(iter(report.skipped.items()))
        raise CaptureError(
            f"build_dataset: all {len(ids)} captures were refused, so there is nothing to store; {first!r}: {reason}"
        )
    return written, told


def _store_of(config: BuildConfig, folder: Path) -> Store:
    return STORES[config.output.format](folder, config.output.compression)


def _seal(store: Store) -> None:
    """End a shard: nothing is added to it any more."""
    store.close()
    seal_shard(store.folder)


def _one_each(cloud: PointCloud) -> Mapping[str, Signal]:
    """Return the signals of a sample: those of its clouds, where they are the same, as of views of one moment."""
    found = {}
    for name, signal in cloud.recorded_signals.items():
        rows = [signal.rows(slice(b, b + 1)) for b in range(cloud.num_clouds)]
        found[name] = rows[0] if all(row.same_bits(rows[0]) for row in rows) else signal
    return found


def _write_signals(store: Store, ids: list[str], signals: list[Mapping[str, Signal]]) -> dict[str, str]:
    """Keep the signals of all samples side by side, so that nobody has to load clouds for them."""
    try:
        record = record_from_signals(stacked_signals("signals", ids, signals))
    except (ShapeError, FrameError, DTypeError) as error:
        return {"fault": str(error)}  # each sample still has its own
    store.write(SIGNALS_KEY, record)
    return {"digest": record.digest()}


def _episodes(source: CaptureSource, samples: list[Sample]) -> list[Episode]:
    written = {sample.id for sample in samples}
    places = [place for place, sample_id in enumerate(source.ids) if sample_id in written]
    return kept_episodes(episodes_of(source), places)


def _check_arguments(config: BuildConfig, source: CaptureSource) -> None:
    if not isinstance(config, BuildConfig):
        raise DTypeError(
            f"build_dataset: config must be a BuildConfig, not {type(config).__name__}; "
            "pcdata.load_config(path) reads one"
        )
    checked_ids("build_dataset", source)
    if config.loader.windows is not None and not episodes_of(source):
        raise ConfigError(
            f"build_dataset: loader.windows: {source!r} has no episodes to cut windows from; say in episodes.json "
            "beside the captures which follow each other (pcdata.write_episodes), or leave windows out"
        )
    stored, on_the_fly = config.pipeline.split()
    if on_the_fly.takes is not PointCloud:
        raise ConfigError(
            f"build_dataset: {type(on_the_fly.steps[0]).__name__} in the section depth is random, so no cloud is the "
            "same in every epoch and none can be stored; leave it out here, or load captures on the fly with "
            "CloudDataset"
        )
    if stored.gives is not PointCloud:
        raise ConfigError("build_dataset: the pipeline gives images, not clouds to store; put Deproject last")


def _model_of(config: BuildConfig) -> dict[str, Any]:
    if config.model is None:
        return {}
    return {"name": config.model.contract.name, "choices": config.model.plain_choices()}


def _checked_cloud(data: Any) -> PointCloud:
    if not isinstance(data, PointCloud):
        raise ConfigError(f"the pipeline gives a {type(data).__name__}, not a cloud to store; end depth in Deproject")
    return data


def _with_sample_id(cloud: PointCloud, sample_id: str) -> PointCloud:
    return cloud.with_meta([{"sample_id": sample_id}] * cloud.num_clouds)


def _keep_raw(capture: DepthFrame | PointCloud, folder: Path) -> None:
    if not isinstance(capture, DepthFrame):
        raise CaptureError("output.keep_raw is on, but this source gives clouds: there is no depth image to keep")
    try:
        write_capture(capture, folder)
    except WriteError as error:
        raise CacheError(str(error)) from error


def _built_sample(sample_id: str, capture: Any, cloud: PointCloud, seconds: float) -> BuiltSample:
    counts: dict[int, tuple[str, int]] = {}
    for history in cloud.history:
        for position, step in enumerate(history):
            if "points" in step:
                before = counts.get(position, (step["step"], 0))[1]
                counts[position] = (step["step"], before + step["points"])
    entered = "depth" if isinstance(capture, DepthFrame) else "cloud"
    return BuiltSample(sample_id, entered, [counts[position] for position in sorted(counts)], seconds)
