"""The temporal filter over a sequence of captures: TemporalFilterDepth, TemporallyFilteredSource."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import ClassVar

from pcdata.errors import ConfigError, DTypeError
from pcdata.files.sample_names import check_known
from pcdata.functional.depth.disparity import disparity_scale
from pcdata.functional.depth.temporal import PERSISTENCE_RULES, TemporalState, checked_state, temporal_step
from pcdata.io.sources.capture_source import CaptureSource, checked_ids, recordings_of, signals_of
from pcdata.io.sources.combine import DerivedSource
from pcdata.io.sources.option_checks import check_numbers
from pcdata.io.sources.registry import register_combinator
from pcdata.io.sources.still_camera import check_still_camera
from pcdata.structures import DepthFrame, Signal, with_filled_depth


@dataclass(frozen=True, kw_only=True)
class TemporalFilterDepth:
    """Averages every pixel with its past, in disparity, with the parameters of librealsense's temporal filter.

    Holds numbers only: what is remembered goes from call to call as a ``TemporalState``, so one filter serves any
    number of streams, and None starts anew. It is no ``Transform``: a frame's result depends on the frames before.

    Args:
        alpha: weight of the new reading; 1 = no averaging.
        delta: 1/32 pixel of disparity: the smallest change that is another surface.
        persistence: 0..8: when a pixel without a reading repeats its last one; see PERSISTENCE_RULES.
        baseline: metres between the two imagers; it scales what delta means.
    """

    alpha: float = 0.4
    delta: float = 20.0
    persistence: int = 3
    baseline: float = 0.05

    def __post_init__(self) -> None:
        check_numbers("TemporalFilterDepth", self, whole=("persistence",), real=("alpha", "delta", "baseline"))
        in_range = 0 < self.alpha <= 1 and self.delta > 0 and self.baseline > 0
        if not in_range or self.persistence not in range(len(PERSISTENCE_RULES)):
            raise ConfigError(
                "TemporalFilterDepth: needs 0 < alpha <= 1, delta > 0, persistence 0..8 and baseline > 0, got "
                f"{self.alpha}, {self.delta}, {self.persistence!r}, {self.baseline}"
            )

    def step(self, frame: DepthFrame, state: TemporalState | None = None) -> tuple[DepthFrame, TemporalState]:
        """Filter one frame; pixels that repeat a former reading become COMPLETED.

        Args:
            frame: the next frame of the stream.
            state: what the step before returned; None starts a stream.

        Raises:
            ShapeError, DeviceError: the state belongs to other images.
        """
        state = checked_state("TemporalFilterDepth", "depth", frame.depth, state)
        scale = disparity_scale(frame.camera.intrinsics[:, 0, 0].to(frame.device), self.baseline)
        rule = self.alpha, self.delta, self.persistence
        depth, last, history = temporal_step(frame.depth, scale, state.last, state.history, *rule)
        state = TemporalState(last=last, history=history)
        return with_filled_depth(frame, depth), state

    def frames(self, frames: Iterable[DepthFrame]) -> Iterator[DepthFrame]:
        """Yield every frame of one stream filtered with those before it.

        Raises:
            CaptureError: the camera is another than in the first frame, or has moved since.
        """
        first, state = None, None
        for frame in frames:
            first = first or frame
            check_still_camera("TemporalFilterDepth", [first, frame])
            filtered, state = self.step(frame, state)
            yield filtered


@register_combinator
@dataclass(frozen=True, kw_only=True)
class TemporallyFilteredSource(DerivedSource):
    """A stream whose captures come filtered with the ``num_frames - 1`` before each of them in its recording.

    A window instead of all the past: every sample can be loaded alone, in any order and by any worker, with the same
    result. After 12 frames the weight of older ones is below 0.4 % at the default alpha, and persistence looks at 8.

    Args:
        source: the captures, in the order of time.
        num_frames: that the filter looks at.
        alpha: as in TemporalFilterDepth.
        delta: as in TemporalFilterDepth.
        persistence: as in TemporalFilterDepth.
        baseline: as in TemporalFilterDepth.
    """

    kind: ClassVar[str] = "temporal"
    over_time: ClassVar[bool] = True

    source: CaptureSource
    num_frames: int = 12
    alpha: float = TemporalFilterDepth.alpha
    delta: float = TemporalFilterDepth.delta
    persistence: int = TemporalFilterDepth.persistence
    baseline: float = TemporalFilterDepth.baseline
    filter: TemporalFilterDepth = field(init=False, repr=False)
    _places: Mapping[str, tuple[list[str], int]] = field(init=False, repr=False, compare=False)  # in the recording

    def __post_init__(self) -> None:
        check_numbers("TemporallyFilteredSource", self, whole=("num_frames",), real=())
        if self.num_frames < 1:
            raise ConfigError(f"TemporallyFilteredSource: num_frames must be at least 1, got {self.num_frames}")
        settings = {setting.name: getattr(self, setting.name) for setting in fields(TemporalFilterDepth)}
        object.__setattr__(self, "filter", TemporalFilterDepth(**settings))
        checked_ids("TemporallyFilteredSource", self.source)
        places = {own: (ids, place) for ids in recordings_of(self.source) for place, own in enumerate(ids)}
        object.__setattr__(self, "_places", places)

    @property
    def ids(self) -> list[str]:
        """The sample ids of the source."""
        return list(self._places)

    def made_of(self, sample_id: str) -> list[tuple[CaptureSource, str]]:
        """Return the captures that the filter looks at, the sample itself last.

        Raises:
            CaptureError: no sample has this id.
        """
        check_known("TemporallyFilteredSource", sample_id, self._places)
        ids, place = self._places[sample_id]
        return [(self.source, own) for own in ids[max(0, place + 1 - self.num_frames) : place + 1]]

    def signals(self, sample_id: str) -> Mapping[str, Signal]:
        """Return the signals of the capture that is filtered.

        Raises:
            CaptureError: no sample has this id.
        """
        source, own = self.made_of(sample_id)[-1]
        return signals_of(source, own)

    def load(self, sample_id: str) -> DepthFrame:
        """Load a capture and those before it, and return it filtered.

        Raises:
            CaptureError: no sample has this id, or the camera moved within the window.
        """
        window = [own for _, own in self.made_of(sample_id)]
        *_, last = self.filter.frames(self._load(name) for name in window)
        facts = {"frames": window, **asdict(self.filter)}
        return replace(last, provenance={**last.provenance, "temporal_filter": facts})

    def _load(self, sample_id: str) -> DepthFrame:
        capture = self.source.load(sample_id)
        if not isinstance(capture, DepthFrame):
            raise DTypeError("TemporallyFilteredSource: filters depth frames, but the source holds point clouds")
        return capture
