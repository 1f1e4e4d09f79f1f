"""A chain of transforms on a camera's stream: the same answers as offline, and no frame that stops it."""

from pcdata.live.faults import Fault, LiveResult, StalledError
from pcdata.live.latency import Latency
from pcdata.live.latest_frame import LatestFrame
from pcdata.live.over_time import LiveAverage, LiveTemporalFilter
from pcdata.live.pipeline import LivePipeline
from pcdata.live.stats import LiveStats

__all__ = [
    "Fault",
    "Latency",
    "LatestFrame",
    "LiveAverage",
    "LivePipeline",
    "LiveResult",
    "LiveStats",
    "LiveTemporalFilter",
    "StalledError",
]
