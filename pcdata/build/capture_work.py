"""What a build does with one capture: load it, run the deterministic steps, make the record that is stored."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pcdata.build.config import BuildConfig
from pcdata.build.origins import Origin, origin_of
from pcdata.build.records import BuiltSample
from pcdata.contracts.on_host import counts_of
from pcdata.errors import CacheError, CaptureError, ConfigError, PcdataError, ReplayError, WriteError, locate
from pcdata.files.inputs import Inputs, recording
from pcdata.io.sources.capture_source import CaptureSource
from pcdata.io.store.cloud_record import Record, record_from_cloud
from pcdata.io.writers.capture_folder import write_capture
from pcdata.structures import DepthFrame, PointCloud, Signal
from pcdata.transforms import Compose, FuseTSDF, ToFrame, Transform
from pcdata.transforms.decisions import Decision
from pcdata.validation.first_look import look_at_refused


@dataclass(frozen=True)
class Made:
    """One capture, ready to be stored."""

    capture: DepthFrame | PointCloud
    record: Record
    signals: Mapping[str, Signal]
    sample: BuiltSample
    origin: Origin


class CaptureWork:
    """The work on every capture of a build; pickled to workers."""

    def __init__(self, config: BuildConfig, source: CaptureSource) -> None:
        self.prefix: Compose = config.pipeline.split()[0]
        self.keep_raw = config.output.keep_raw
        self.compact = config.output.compact
        self.source = source
        self.by_pose = any(
            isinstance(step, FuseTSDF) or (isinstance(step, ToFrame) and step.matrix is None)
            for step in config.pipeline.parts()
        )

    def make(self, sample_id: str, inputs: Inputs) -> Made:
        """Load and process one capture.

        Raises:
            Exception: whatever a source, a step or the store has against it.
        """
        started = time.perf_counter()
        with recording(inputs):
            capture = self.source.load(sample_id)
        if self.keep_raw and not isinstance(capture, DepthFrame):
            raise CaptureError("output.keep_raw is on, but this source gives clouds: there is no depth image to keep")
        try:
            cloud = self.prefix(capture)
        except PcdataError as error:
            raise _with_look(error, capture) from error
        if not isinstance(cloud, PointCloud):
            raise ConfigError(
                f"the pipeline gives a {type(cloud).__name__}, not a cloud to store; end depth in Deproject"
            )
        cloud = cloud.with_meta([{"sample_id": sample_id}] * cloud.num_clouds)
        record = record_from_cloud(cloud, compact=self.compact)
        sample = BuiltSample(
            sample_id,
            "depth" if isinstance(capture, DepthFrame) else "cloud",
            _counts(cloud, {type(step).__name__: step for step in self.prefix.parts()}),
            time.perf_counter() - started,
            cloud.num_points,
            min(counts_of(cloud.ptr), default=0),
            record.digest(),
        )
        return Made(capture, record, _one_each(cloud), sample, origin_of(cloud))


def _with_look(error: PcdataError, capture: DepthFrame | PointCloud) -> PcdataError:
    """Return the error of a step, with what a look at the capture finds, which may well be its cause."""
    told = look_at_refused(capture)
    if told is None:
        return error
    first, *more = str(error).split("\n")
    explained = type(error)("\n".join([f"{first}; {told}", *more]))
    locate(explained, step=getattr(error, "step", None), sample_id=getattr(error, "sample_id", None))
    return explained


def keep_raw(capture: DepthFrame | PointCloud, folder: Path) -> None:
    """Write a capture beside its cloud.

    Raises:
        CacheError: it cannot be written.
    """
    assert isinstance(capture, DepthFrame)  # CaptureWork refuses others
    try:
        write_capture(capture, folder)
    except WriteError as error:
        raise CacheError(str(error)) from error


def _one_each(cloud: PointCloud) -> Mapping[str, Signal]:
    """Return the signals of a sample: those of its clouds, where they are the same, as of views of one moment."""
    found = {}
    for name, signal in cloud.recorded_signals.items():
        rows = [signal.rows(slice(b, b + 1)) for b in range(cloud.num_clouds)]
        found[name] = rows[0] if all(row.same_bits(rows[0]) for row in rows) else signal
    return found


def _counts(cloud: PointCloud, steps: Mapping[str, Transform]) -> list[tuple[str, int]]:
    """Return the points after every step, over all clouds that there were then.

    The clouds that a step split one into all tell what that one went through: before the split it counts once.
    """
    counts: dict[int, tuple[str, int]] = {}
    there = list(cloud.history)
    for position in range(max(map(len, there), default=0) - 1, -1, -1):
        told = [history[position] for history in there if len(history) > position]
        if known := [entry for entry in told if "points" in entry]:
            counts[position] = (known[0]["step"], sum(entry["points"] for entry in known))
        step = steps.get(told[0]["step"])
        if step is not None and not step.keeps_clouds and len(told) == len(there):
            with contextlib.suppress(ReplayError):  # a step of somebody else may not say what it split
                origins = step.origins([Decision(entry, position) for entry in told])
                there = [there[number] for number in dict.fromkeys(number for number, _ in origins)]
    return [counts[position] for position in sorted(counts)]
