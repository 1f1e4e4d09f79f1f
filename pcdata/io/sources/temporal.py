"""The temporal filter over a sequence of captures: TemporalFilterDepth, TemporallyFilteredSource."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

from pcdata.errors import CaptureError, ConfigError, DTypeError, near_matches
from pcdata.functional.depth.disparity import depth_to_disparity, disparity_to_depth
from pcdata.functional.depth.temporal import PERSISTENCE_RULES, TemporalState, temporal_filter
from pcdata.io.sources.source import CaptureSource, checked_ids
from pcdata.io.sources.still_camera import check_still_camera
from pcdata.structures import DepthFrame, with_filled_depth


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
        focal = frame.camera.intrinsics[:, 0, 0].to(frame.device)
        disparity = depth_to_disparity(frame.depth, focal, self.baseline)
        disparity, state = temporal_filter(
            disparity, state, alpha=self.alpha, delta=self.delta, persistence=self.persistence
        )
        depth = disparity_to_depth(disparity, focal, self.baseline)
        return with_filled_depth(frame, depth, (depth > 0) & (frame.depth == 0)), state

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


@dataclass(frozen=True, kw_only=True)
class TemporallyFilteredSource:
    """A stream whose captures come filtered with the ``num_frames - 1`` before each of them.

    A window instead of all the past: every sample can be loaded alone, in any order and by any worker, with the same
    result. After 12 frames the weight of older ones is below 0.4 % at the default alpha, and persistence looks at 8.

    Args:
        source: the captures, in the order of time.
        filter: the settings of the filter.
    """

    source: CaptureSource
    filter: TemporalFilterDepth = field(default_factory=TemporalFilterDepth)
    num_frames: int = 12

    def __post_init__(self) -> None:
        if self.num_frames < 1:
            raise ConfigError(f"TemporallyFilteredSource: num_frames must be at least 1, got {self.num_frames}")
        checked_ids("TemporallyFilteredSource", self.source)

    @property
    def name(self) -> str:
        """The name of the source."""
        return str(getattr(self.source, "name", type(self.source).__name__))

    @property
    def ids(self) -> list[str]:
        """The sample ids of the source."""
        return self.source.ids

    def __len__(self) -> int:
        return len(self.source.ids)

    def load(self, sample_id: str) -> DepthFrame:
        """Load a capture and those before it, and return it filtered.

        Raises:
            CaptureError: no sample has this id, or the camera moved within the window.
        """
        ids = self.source.ids
        if sample_id not in ids:
            raise CaptureError(f"TemporallyFilteredSource: no sample {sample_id!r}{near_matches(sample_id, ids)}")
        place = ids.index(sample_id)
        window = ids[max(0, place + 1 - self.num_frames) : place + 1]
        *_, last = self.filter.frames(self._load(name) for name in window)
        settings = {name: getattr(self.filter, name) for name in ("alpha", "delta", "persistence", "baseline")}
        return replace(last, provenance={**last.provenance, "temporal_filter": {"frames": window, **settings}})

    def _load(self, sample_id: str) -> DepthFrame:
        capture = self.source.load(sample_id)
        if not isinstance(capture, DepthFrame):
            raise DTypeError("TemporallyFilteredSource: filters depth frames, but the source holds point clouds")
        return capture
