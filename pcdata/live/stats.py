"""What a live pipeline has counted so far."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pcdata.live.latency import Latency


@dataclass(frozen=True, kw_only=True)
class LiveStats:
    """Counts since the pipeline was made, or since ``reset_stats``.

    Args:
        captured: the steps that a GPU repeats as one graph, see :attr:`LivePipeline.captured`; their latency is one
            pass, and what the device still has to do is waited for there.
        frames: that were given.
        clouds: that were answered.
        faults: how often each occurred; those that never did are left out.
        dropped: frames that the camera gave while the pipeline was busy, so nobody looked at them.
        restarts: how often the stamps began anew.
        resets: how often the filter over time began anew after its first frame.
        latency: of frames that gave a cloud: ``whole``, and each pass by the names of its steps.
    """

    captured: Sequence[str] = ()
    frames: int
    clouds: int
    faults: Mapping[str, int]
    dropped: int
    restarts: int
    resets: int
    latency: Mapping[str, Latency]

    def __str__(self) -> str:
        told = ", ".join(f"{count} {name}" for name, count in self.faults.items()) or "none"
        told_captured = [f"captured: {', '.join(self.captured)}"] if self.captured else []
        lines = [
            f"{self.frames} frames, {self.clouds} clouds; faults: {told}; {self.dropped} dropped, "
            f"{self.restarts} restarts, {self.resets} resets",
            f"{'milliseconds':40}{'median':>9}{'p90':>9}{'p99':>9}{'p99.9':>9}{'worst':>9}",
            *told_captured,
        ]
        for name, one in self.latency.items():
            figures = (one.median, one.p90, one.p99, one.p999, one.worst)
            lines.append(f"{name:40.40}{''.join(f'{1000 * value:9.2f}' for value in figures)}")
        return "\n".join(lines)
