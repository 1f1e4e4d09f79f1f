"""Many captures of a still scene as one: AveragedSource."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch

from pcdata.errors import CaptureError, ConfigError, DTypeError, add_note
from pcdata.files.sample_names import check_known
from pcdata.functional.depth.average import DepthAverage, average_depth
from pcdata.io.sources.capture_source import CaptureSource, checked_ids, recordings_of
from pcdata.io.sources.combine import DerivedSource
from pcdata.io.sources.option_checks import check_numbers
from pcdata.io.sources.registry import register_combinator
from pcdata.io.sources.still_camera import check_still_camera
from pcdata.structures import Confidence, DepthFrame, confidence_of


@register_combinator
@dataclass(frozen=True, kw_only=True)
class AveragedSource(DerivedSource):
    """Averages every ``num_frames`` consecutive captures of a source into one with less noise and fewer holes.

    A sample bears the id, colors, labels, pose, mask and signals of the first capture of its group: a state and an
    action are those of one moment, as recorded; none is averaged. Its provenance tells what was averaged and what was
    dropped: ``averaged: {frames, readings, jitter, jumps, too_few, noise}``, counts of readings and of pixels, and
    the median standard deviation of a single reading in metres; and ``changing_signals``, the names of those signals
    that were not the same in all captures of the group.

    Readings with the confidence NO_READING count for nothing; with any other, an average is as good as the worst of its
    readings. Groups follow the order of the ids within one recording; every group must show a still scene from still
    cameras. Moving cameras are told by their poses, and where there are none, as moving scenes, by readings that jump
    to another surface.

    Args:
        source: the captures, in the order of time.
        num_frames: captures that become one.
        mad_factor: as in average_depth.
        resolution: as in average_depth.
        max_jump: as in average_depth.
        min_count: as in average_depth.
        max_moving: the part of all readings that may jump before something must have moved.
    """

    kind: ClassVar[str] = "averaged"
    over_time: ClassVar[bool] = True

    source: CaptureSource
    num_frames: int = 10
    mad_factor: float = 5.0
    resolution: float = 0.001
    max_jump: float = 0.03
    min_count: int = 3
    max_moving: float = 0.01
    _groups: Mapping[str, list[str]] = field(init=False, repr=False, compare=False)  # id -> ids of the captures

    def __post_init__(self) -> None:
        where = "AveragedSource"
        reals = ("mad_factor", "resolution", "max_jump", "max_moving")
        check_numbers(where, self, whole=("num_frames", "min_count"), real=reals)
        if self.num_frames < 2 or not 1 <= self.min_count <= self.num_frames or not 0 <= self.max_moving <= 1:
            raise ConfigError(
                f"{where}: needs num_frames >= 2, 1 <= min_count <= num_frames and 0 <= max_moving <= 1, got "
                f"num_frames {self.num_frames}, min_count {self.min_count}, max_moving {self.max_moving}"
                + f"; say min_count={self.num_frames} too"
                * (2 <= self.num_frames < self.min_count)
            )
        if not (self.mad_factor > 0 and self.resolution >= 0 and self.max_jump > 0):
            raise ConfigError(
                f"{where}: needs mad_factor > 0, resolution >= 0 and max_jump > 0, got {self.mad_factor}, "
                f"{self.resolution}, {self.max_jump}"
            )
        checked_ids(where, self.source)
        groups: dict[str, list[str]] = {}
        recordings = [list(ids) for ids in recordings_of(self.source)]
        over = [name for ids in recordings for name in ids[len(ids) - len(ids) % self.num_frames :]]
        if over:
            raise CaptureError(
                f"{where}: {' and '.join(str(len(ids)) for ids in recordings[:5])}{' ...' * (len(recordings) > 5)} "
                f"captures are no whole number of groups of {self.num_frames}; leave out the {len(over)} at the end of "
                f"each recording, skip={over[:20]}{' ...' * (len(over) > 20)} (--skip-file FILE, an id on a line), or "
                "take another num_frames"
            )
        for ids in recordings:
            groups |= {ids[n]: ids[n : n + self.num_frames] for n in range(0, len(ids), self.num_frames)}
        object.__setattr__(self, "_groups", groups)

    @property
    def ids(self) -> list[str]:
        """The id of the first capture of every group, in order."""
        return list(self._groups)

    def group(self, sample_id: str) -> list[str]:
        """Return the ids of the captures that make a sample.

        Raises:
            CaptureError: no sample has this id.
        """
        check_known("AveragedSource", sample_id, self._groups, "; a group is called after its first capture")
        return list(self._groups[sample_id])

    def made_of(self, sample_id: str) -> list[tuple[CaptureSource, str]]:
        """Return the captures of a group.

        Raises:
            CaptureError: no sample has this id.
        """
        return [(self.source, own) for own in self.group(sample_id)]

    def load(self, sample_id: str) -> DepthFrame:
        """Load and average one group.

        Raises:
            CaptureError: no sample has this id, the captures differ in camera or pose, or the scene moved.
        """
        names = self.group(sample_id)
        captures = [self.source.load(name) for name in names]
        frames = [capture for capture in captures if isinstance(capture, DepthFrame)]
        if len(frames) < len(captures):
            raise DTypeError("AveragedSource: averages depth frames, but the source holds point clouds")
        try:
            check_still_camera("AveragedSource", frames)
            return self._average(frames, names)
        except CaptureError as error:
            add_note(error, f"while averaging {names[0]!r} .. {names[-1]!r}")
            raise

    def _average(self, frames: Sequence[DepthFrame], names: Sequence[str]) -> DepthFrame:
        return averaged_frame(
            "AveragedSource",
            frames,
            names,
            mad_factor=self.mad_factor,
            resolution=self.resolution,
            max_jump=self.max_jump,
            min_count=self.min_count,
            max_moving=self.max_moving,
        )


def averaged_frame(
    where: str,
    frames: Sequence[DepthFrame],
    names: Sequence[str],
    *,
    max_moving: float,
    **limits: Any,
) -> DepthFrame:
    """Return the first of the frames of a still camera with the average of the depth of all.

    Args:
        where: the door, named in errors.
        frames: of one camera that stood still.
        names: what the provenance calls them.
        max_moving: as AveragedSource has it.
        limits: those of average_depth.

    Raises:
        CaptureError: the scene moved.
    """
    confidences = torch.stack([confidence_of(frame) for frame in frames])
    depths = torch.stack([frame.depth for frame in frames])
    depths = torch.where(confidences > int(Confidence.NO_READING), depths, 0.0)
    average = average_depth(depths, **limits)
    readings = int((depths > 0).sum())
    jumps = int(average.num_jumps.sum())
    if jumps > max_moving * readings:
        raise CaptureError(
            f"{where}: {100 * jumps / max(readings, 1):.1f} % of the readings lie on another surface than "
            f"the others of their pixel (at most {100 * max_moving:g} %): the camera or the scene moved. "
            "Average fewer captures, or only still ones; if it is the sensor's noise, raise max_jump"
        )
    confidence = None
    if any(frame.confidence is not None for frame in frames):
        worst = torch.where(depths > 0, confidences, int(Confidence.RELIABLE)).amin(0)
        confidence = torch.where(average.depth > 0, worst, int(Confidence.NO_READING)).to(torch.uint8)
    facts = {"frames": list(names), "readings": readings, **_facts(average)}
    facts |= {"changing_signals": changing} if (changing := _changing_signals(frames)) else {}
    provenance = {**frames[0].provenance, "averaged": facts}
    return replace(frames[0], depth=average.depth, confidence=confidence, provenance=provenance)


def _facts(average: DepthAverage) -> dict[str, Any]:
    spread = average.variance[average.num_readings > 1].sqrt()
    return {
        "jitter": int(average.num_jitter.sum()),
        "jumps": int(average.num_jumps.sum()),
        "too_few": int(((average.depth == 0) & (average.num_readings > 0)).sum()),
        "noise": float(spread.median()) if len(spread) else 0.0,
    }


def _changing_signals(frames: Sequence[DepthFrame]) -> list[str]:
    """Return the names of the first frame's signals that another lacks or has otherwise."""
    return [
        name
        for name, signal in frames[0].recorded_signals.items()
        if not all(
            name in frame.recorded_signals and signal.same_bits(frame.recorded_signals[name]) for frame in frames[1:]
        )
    ]
