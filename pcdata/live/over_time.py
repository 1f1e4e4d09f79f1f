"""Filters that remember frames: what they gathered goes when the camera moves, or frames are missing."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Any

from pcdata.errors import CaptureError, ConfigError
from pcdata.functional.depth.temporal import TemporalState
from pcdata.io.sources.averaged import averaged_frame
from pcdata.io.sources.still_camera import check_still_camera
from pcdata.io.sources.temporal import TemporalFilterDepth
from pcdata.live.kept_memory import keep_freed_memory
from pcdata.structures import DepthFrame


class OverTime:
    """A filter whose result depends on the frames before; it begins anew after a gap, and when the camera moves.

    Args:
        max_gap: seconds between stamps beyond which the frames before are another scene.
    """

    def __init__(self, *, max_gap: float) -> None:
        if not max_gap > 0:
            raise ConfigError(f"{type(self).__name__}: max_gap must be above 0 seconds, got {max_gap!r}")
        keep_freed_memory()
        self.max_gap = max_gap
        self.resets = 0
        self._first: DepthFrame | None = None
        self._stamp: float | None = None

    def __call__(self, frame: DepthFrame, stamp: float | None = None) -> DepthFrame:
        """Return the frame filtered with those before it.

        Args:
            frame: the next one.
            stamp: seconds; frames without stamps have no gaps.
        """
        gap = stamp is not None and self._stamp is not None and not 0 <= stamp - self._stamp <= self.max_gap
        if self._first is not None and (gap or not self._still(frame)):
            self.resets += 1
            self.reset()
        if self._first is None:
            self._first = without_images(frame)
        self._stamp = stamp
        return self.filtered(frame)

    def _still(self, frame: DepthFrame) -> bool:
        assert self._first is not None
        try:
            check_still_camera(type(self).__name__, [self._first, frame])
        except CaptureError:
            return False
        return (frame.world_from_camera is None) == (self._first.world_from_camera is None)

    def filtered(self, frame: DepthFrame) -> DepthFrame:
        """Return the frame filtered with what is remembered, and remember it."""
        raise NotImplementedError

    def reset(self) -> None:
        """Forget all frames."""
        self._first = self._stamp = None


class LiveTemporalFilter(OverTime):
    """The temporal filter of a stream: every frame as ``TemporalFilterDepth.frames`` gives it since the last reset.

    Args:
        max_gap: seconds between stamps beyond which the past counts for nothing.
        parameters: those of :class:`pcdata.TemporalFilterDepth`.
    """

    def __init__(self, *, max_gap: float = 0.25, **parameters: Any) -> None:
        super().__init__(max_gap=max_gap)
        self.filter = TemporalFilterDepth(**parameters)
        self._state: TemporalState | None = None

    def filtered(self, frame: DepthFrame) -> DepthFrame:
        """Step the filter."""
        result, self._state = self.filter.step(frame, self._state)
        return result

    def reset(self) -> None:
        """Forget all frames."""
        super().reset()
        self._state = None


class LiveAverage(OverTime):
    """The average of the last frames of a still scene, as ``AveragedSource`` makes one of as many captures.

    The newest frame's colors, pose and signals are kept. Where the scene moves, it begins anew with the newest frame.

    Args:
        num_frames: that are averaged; fewer after a reset.
        max_gap: seconds between stamps beyond which the past counts for nothing.
        mad_factor: as in :func:`pcdata.functional.average_depth`.
        resolution: as there.
        max_jump: as there.
        min_count: as there; of fewer frames, all must agree.
        max_moving: the part of all readings that may jump before something must have moved.
    """

    def __init__(
        self,
        *,
        num_frames: int = 5,
        max_gap: float = 0.25,
        mad_factor: float = 5.0,
        resolution: float = 0.001,
        max_jump: float = 0.03,
        min_count: int = 3,
        max_moving: float = 0.01,
    ) -> None:
        super().__init__(max_gap=max_gap)
        if num_frames < 1:
            raise ConfigError(f"LiveAverage: num_frames must be at least 1, got {num_frames!r}")
        self._rules = {
            "mad_factor": mad_factor,
            "resolution": resolution,
            "max_jump": max_jump,
            "max_moving": max_moving,
        }
        self._min_count = min_count
        self._frames: deque[DepthFrame] = deque(maxlen=num_frames)

    def filtered(self, frame: DepthFrame) -> DepthFrame:
        """Average the window."""
        self._frames.append(replace(frame, depth=frame.depth.clone()))  # the caller may use its buffer again
        try:
            return self._average()
        except CaptureError:  # the scene moved
            self.resets += 1
            self._frames.clear()
            self._frames.append(replace(frame, depth=frame.depth.clone()))
            return self._average()

    def _average(self) -> DepthFrame:
        newest_first = [*reversed(self._frames)]
        min_count = min(self._min_count, len(newest_first))
        names = [frame.sample_id for frame in newest_first]
        return averaged_frame("LiveAverage", newest_first, names, min_count=min_count, **self._rules)

    def reset(self) -> None:
        """Forget all frames."""
        super().reset()
        self._frames.clear()


def without_images(frame: DepthFrame) -> DepthFrame:
    """Return a frame of which nothing but its cameras and poses is kept alive: its size is told by the camera."""
    return replace(
        frame,
        depth=frame.depth.new_zeros(1).expand(frame.depth.shape),
        colors=None,
        labels=None,
        confidence=None,
        mask=None,
        recorded_signals={},
    )
